"""Lists of values on the command line: ``1e3,1e6``, ``[0,2],[0,4]``, ``sine,step``."""

from __future__ import annotations

from typing import Any

from cosim.errors import UsageError, quoted
from cosim.scenario.document.edits import parse_value

_OPENING = {"[": "]", "{": "}", "(": ")"}
_QUOTES = ('"', "'")


def read_values(text: str) -> list[Any]:
    """Return values with commas between them; each is TOML where it can be, else a string.

    Raises
    ------
    UsageError
        If one is empty, or cannot be read.
    """
    values = []
    for part in split_values(text):
        if not part:
            raise UsageError(
                f"expected values separated by commas, got an empty one in {quoted(text)}"
            )
        values.append(parse_value(part))
    return values


def split_values(text: str) -> list[str]:
    """Split a text at its commas, but not inside brackets or quotes."""
    parts = [""]
    closing: list[str] = []
    quote = ""
    for character in text:
        if character == "," and not closing and not quote:
            parts.append("")
            continue
        parts[-1] += character
        if quote:
            quote = "" if character == quote else quote
        elif character in _QUOTES:
            quote = character
        elif character in _OPENING:
            closing.append(_OPENING[character])
        elif closing and character == closing[-1]:
            closing.pop()
    return [part.strip() for part in parts]
