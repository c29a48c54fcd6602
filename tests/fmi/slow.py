"""Values of ``parametrize`` of which the usual run of the tests takes but some."""

from collections.abc import Iterable
from typing import Any

import pytest

SLOW = pytest.mark.slow


def slow_but(fast: Iterable[Any], values: Iterable[Any]) -> list[Any]:
    """Return values for ``parametrize``, all of which but some are slow ones."""
    kept = list(fast)
    return [value if value in kept else pytest.param(value, marks=SLOW) for value in values]
