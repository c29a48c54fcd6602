"""Keys that reach into lists: ``terms[0].theta`` is in the first entry, ``A[0][1]`` in a row."""

from __future__ import annotations

import re
from typing import Any

from cosim.errors import quoted
from cosim.scenario.document.problems import Key

_PART = re.compile(r"([^\[\]]+)((?:\[[^\[\]]*\])+)")
_INDEX = re.compile(r"0|[1-9][0-9]{0,8}")


def split_elements(part: str) -> tuple[str, list[str]]:
    """Return the name in a part of a dotted key, and the indices that follow it."""
    match = _PART.fullmatch(part)
    if match is None:
        return part, []
    return match[1], match[2][1:-1].split("][")


def address(key: str) -> str:
    """Return a dotted key with its indices as parts: ``terms[0].theta`` as ``terms.0.theta``."""
    parts: list[str] = []
    for part in key.split("."):
        name, indices = split_elements(part)
        parts += [name, *indices]
    return ".".join(parts)


def written(key: Key) -> str:
    """Return a key as it is written in edits: ``("terms", 0, "theta")`` as ``terms[0].theta``."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text.removeprefix(".")


def numbered(count: int) -> str:
    """Return the end of a message about an unknown index: the numbers that are known."""
    return f"available: 0 to {count - 1}" if count else "none is available"


def element_at(value: Any, place: Key, index: str) -> tuple[int, str | None]:
    """Return the number of an element of a list, and the problem with that, if there is one.

    Parameters
    ----------
    value : Any
        What stands at ``place``; None: nothing.
    place : Key
    index : str
        As it was written.
    """
    name = written(place)
    if value is None:
        return 0, f"{name} is not given, so element {index} cannot be set; set it as a whole"
    if not isinstance(value, list):
        return 0, f"{name}: expected a list, got {quoted(value)}"
    if _INDEX.fullmatch(index) is None or int(index) >= len(value):
        count = len(value)
        return 0, f"{name} has no element {quoted(index)}; {numbered(count)}"
    return int(index), None
