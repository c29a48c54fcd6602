"""The option --vary of the command replay."""

from __future__ import annotations

from typing import Any

from cosim.errors import UsageError, option, quoted

_OPENING = {"[": "]", "{": "}", "(": ")"}
_QUOTES = ('"', "'")


def read_variations(texts: list[str]) -> dict[str, list[Any]]:
    """Read KEY=V1,V2,... of --vary; the values are TOML where they can be, as those of --set.

    Raises
    ------
    UsageError
        If there is no '=', a value is empty, or a key is given twice.
    """
    from cosim.cli.options import read_unique_pairs
    from cosim.scenario.document.edits import parse_value

    variations = {}
    for key, text in read_unique_pairs(texts, "vary").items():
        values = []
        for part in split_values(text):
            if not part:
                raise UsageError(
                    f"{option('vary', key)}: found an empty value in {quoted(text)}; needed "
                    "values with a comma between them"
                )
            try:
                values.append(parse_value(part))
            except UsageError as error:
                raise UsageError(f"{option('vary', key)}: {error}") from error
        variations[key] = values
    return variations


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
