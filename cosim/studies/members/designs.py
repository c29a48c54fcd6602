"""Designs of members as text: what linear algebra has computed, which other machines do otherwise.

The members of a study take the designs of its scenario from where it was planned. Of each member
there is what its own values have changed of them, array by array.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from cosim.core.contracts import Design
from cosim.errors import UsageError, quoted
from cosim.log.contents.metadata import decode_design, encode_design, json_table
from cosim.scenario.building.common_designs import same_bits


def encode_designs(designs: Mapping[str, Design]) -> str:
    """Return designs by component as JSON, bit for bit; empty: there are none."""
    texts = {name: encode_design(design) for name, design in designs.items() if design}
    return json.dumps(texts, separators=(",", ":")) if texts else ""


def decode_designs(text: str) -> dict[str, Design]:
    """Return the designs that :func:`encode_designs` wrote.

    Raises
    ------
    UsageError
        If it is something else.
    """
    if not text:
        return {}
    try:
        return {name: decode_design(design) for name, design in json_table(text).items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f"designs: expected the designs of an outcome of this study, got {quoted(text)}"
        ) from error


def own_designs(designs: Mapping[str, Design], common: Mapping[str, Design]) -> dict[str, Design]:
    """Return the arrays of designs that are not those of all members, by component and name."""
    own: dict[str, Design] = {}
    for name, design in designs.items():
        others = common.get(name, {})
        arrays = {}
        for key, array in design.items():
            if key not in others or not same_bits(array, others[key]):
                arrays[key] = array
        if arrays:
            own[name] = arrays
    return own
