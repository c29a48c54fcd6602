"""What is varied in a sweep: every combination of the values of several keys."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from cosim.arguments import mapping_argument
from cosim.errors import UsageError, option, quoted
from cosim.scenario.document.document import plain, short

MOST_COMBINATIONS: Final = 1000


def combinations(vary: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Return every combination of values by key; that of the last key changes first.

    Parameters
    ----------
    vary : mapping of dotted key to sequence of values
        Such as ``{"identifier.P0": [1e3, 1e6]}``.

    Raises
    ------
    UsageError
        If a key has no values or something else than a list of them, there is no key, or there
        are more than ``MOST_COMBINATIONS`` combinations.
    """
    given = mapping_argument("vary", vary)
    if not given:
        raise UsageError(f"{option('vary')}: expected a key and its values, got nothing")
    values_of: dict[str, list[Any]] = {}
    for key, values in given.items():
        if isinstance(values, str) or not isinstance(values, Sequence | np.ndarray):
            raise UsageError(f"{option('vary', key)}: expected a list, got {quoted(values)}")
        if not len(values):
            raise UsageError(f"{option('vary', key)}: expected at least one value, got none")
        try:
            values_of[key] = list(map(plain, values))
        except UsageError as error:
            raise UsageError(f"{option('vary', key)}: {error}") from error
    counts = list(map(len, values_of.values()))
    if math.prod(counts) > MOST_COMBINATIONS:
        raise UsageError(
            f"{option('vary')}: expected at most {MOST_COMBINATIONS} combinations, got "
            f"{' x '.join(map(str, counts))} = {math.prod(counts)}"
        )
    chosen = itertools.product(*values_of.values())
    return [dict(zip(values_of, values, strict=True)) for values in chosen]


def combination_text(values: Mapping[str, Any]) -> str:
    """Return a combination in words: ``identifier.P0 = 1000.0, observer.L = [8.0]``."""
    return ", ".join(f"{key} = {quoted(value)}" for key, value in values.items())


def check_varied(changes: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Check that nothing is varied that is set, too.

    Raises
    ------
    UsageError
        If something is.
    """
    known = {short(key) for key in changes}
    for key in values:
        if short(key) in known:
            raise UsageError(
                f"expected {option('set', short(key))} or {option('vary', short(key))}, got both"
            )
