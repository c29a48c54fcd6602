"""Tables of cases in one test: every case is tried, and every one that fails is reported."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import pytest


def for_each(
    names: str | Sequence[str], cases: Iterable[Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test for every case like ``parametrize``, as one test.

    For tables whose rows are no subjects of their own: seeds, radii, bad inputs.
    """
    words = names.replace(",", " ").split() if isinstance(names, str) else list(names)
    rows = [case if len(words) > 1 else (case,) for case in cases]

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        def loop(**fixtures: Any) -> None:
            failures = []
            for row in rows:
                values = dict(zip(words, row, strict=True))
                try:
                    test(**values, **fixtures)
                except (Exception, pytest.fail.Exception) as error:
                    failures.append(f"{values}: {type(error).__name__}: {error}")
            assert not failures, "\n".join([f"{len(failures)} of {len(rows)}", *failures])

        loop.__name__ = test.__name__
        loop.__doc__ = test.__doc__
        loop.__module__ = test.__module__
        loop.pytestmark = list(getattr(test, "pytestmark", []))
        signature = inspect.signature(test)
        kept = []
        for parameter in signature.parameters.values():
            if parameter.name not in words:
                kept.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
        loop.__signature__ = signature.replace(parameters=kept)
        return loop

    return decorate
