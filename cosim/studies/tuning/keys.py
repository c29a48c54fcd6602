"""What a tuning varies, as users write it: bounds or values by dotted key."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from cosim.arguments import mapping_argument
from cosim.errors import UsageError, option, quoted
from cosim.scenario.document.edits import plain
from cosim.studies.contracts import SWAP
from cosim.studies.study_file import absolute, varied_key
from cosim.studies.tuning.space import BoundedKey, ChoiceKey, SearchSpace

_BOUNDS: Final = ("linear", "log")
_LISTS: Final = ("values", "choice")


def read_space(vary: object) -> SearchSpace:
    """Return what is varied.

    Parameters
    ----------
    vary : mapping of dotted key to table or list
        Bounds, ``{"log": [10.0, 1e4]}`` or ``{"linear": [0.0, 1.0]}``, or a list of values. A key
        without a dot is a component: its list has paths for a swap, taken from the working
        directory.

    Raises
    ------
    UsageError
        If an entry is neither.
    """
    entries = mapping_argument("vary", vary)
    return SearchSpace(tuple(_read_key(key, value) for key, value in entries.items()))


def _read_key(key: str, value: Any) -> BoundedKey | ChoiceKey:
    try:
        value = plain(value)
    except UsageError as error:
        raise UsageError(f"{option('vary', key)}: {error}") from error
    name = varied_key(key)
    form, items = next(iter(value.items())) if _has_one_entry(value) else ("values", value)
    if form in _BOUNDS and _are_bounds(items):
        lower, upper = items
        return BoundedKey(name, float(lower), float(upper), form == "log")
    if form in _LISTS and isinstance(items, list):
        if name.startswith(SWAP):
            items = [absolute(path, Path.cwd()) for path in items]
        return ChoiceKey(name, tuple(items))
    raise UsageError(
        f"{option('vary', key)}: expected bounds, such as {{'linear': [0.0, 1.0]}} or {{'log': "
        f"[10.0, 1e4]}}, or a list of values, got {quoted(value)}"
    )


def _has_one_entry(value: Any) -> bool:
    return isinstance(value, Mapping) and len(value) == 1


def _are_bounds(items: Any) -> bool:
    if not isinstance(items, list) or len(items) != 2:
        return False
    return all(isinstance(item, int | float) and not isinstance(item, bool) for item in items)
