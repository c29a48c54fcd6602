"""The option --vary of the command replay."""

from __future__ import annotations

from typing import Any

from cosim.errors import UsageError, option


def read_variations(texts: list[str]) -> dict[str, list[Any]]:
    """Read KEY=V1,V2,... of --vary; the values are TOML where they can be, as those of --set.

    Raises
    ------
    UsageError
        If there is no '=', a value is empty, or a key is given twice.
    """
    from cosim.cli.options import read_unique_pairs
    from cosim.scenario.document.document import parse_values

    variations = {}
    for key, text in read_unique_pairs(texts, "vary").items():
        try:
            variations[key] = parse_values(text)
        except UsageError as error:
            raise UsageError(f"{option('vary', key)}: {error}") from error
    return variations
