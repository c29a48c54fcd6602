"""Tables of cases that one test goes through: all that fail are reported, not only the first."""

from collections.abc import Callable, Iterable
from itertools import product
from typing import Any

import pytest

SLOW = pytest.mark.slow


def check_all(check: Callable[..., None], *tables: Iterable[Any]) -> None:
    """Call a function with each case of a table, or of the product of several.

    A case that is a tuple is spread over the parameters. Fails with all cases that fail.
    """
    failed = []
    for cases in product(*tables):
        arguments = []
        for case in cases:
            arguments += case if isinstance(case, tuple) else [case]
        try:
            check(*arguments)
        except (AssertionError, pytest.fail.Exception) as error:
            shown = ", ".join(repr(argument)[:100] for argument in arguments)
            failed.append(f"{shown}: {error}")
    assert not failed, "\n".join(failed)


def slow_but(fast: Iterable[Any], values: Iterable[Any]) -> list[Any]:
    """Return values for ``parametrize``, all of which but some are slow ones."""
    kept = list(fast)
    return [value if value in kept else pytest.param(value, marks=SLOW) for value in values]
