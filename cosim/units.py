"""SI unit expressions: what a unit is in base units, for UnitDefinitions and for comparing ports (FMI 2.0.4 section 2.2.2)."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

BASE: Final = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
DERIVED: Final[Mapping[str, tuple[float, Mapping[str, int]]]] = {
    "1": (1.0, {}),
    "g": (1e-3, {"kg": 1}),
    "min": (60.0, {"s": 1}),
    "h": (3600.0, {"s": 1}),
    "deg": (math.pi / 180.0, {"rad": 1}),
    "Hz": (1.0, {"s": -1}),
    "N": (1.0, {"kg": 1, "m": 1, "s": -2}),
    "Pa": (1.0, {"kg": 1, "m": -1, "s": -2}),
    "bar": (1e5, {"kg": 1, "m": -1, "s": -2}),
    "J": (1.0, {"kg": 1, "m": 2, "s": -2}),
    "W": (1.0, {"kg": 1, "m": 2, "s": -3}),
    "C": (1.0, {"A": 1, "s": 1}),
    "V": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -1}),
    "Ohm": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -2}),
    "F": (1.0, {"kg": -1, "m": -2, "s": 4, "A": 2}),
    "H": (1.0, {"kg": 1, "m": 2, "s": -2, "A": -2}),
    "Wb": (1.0, {"kg": 1, "m": 2, "s": -2, "A": -1}),
    "T": (1.0, {"kg": 1, "s": -2, "A": -1}),
}


@dataclass(frozen=True, slots=True)
class BaseUnit:
    """A value in it is ``factor * value + offset`` in a product of powers of ``BASE`` (FMI 2.0.4 section 2.2.2)."""

    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0


def base_unit(unit: str) -> BaseUnit | None:
    """Read ``m/s2``, ``N.m``, ``kg.m2/s^2``; None where a part is not known. A ``/`` divides by the one factor after it."""
    exponents, factor, sign = dict.fromkeys(BASE, 0), 1.0, 1
    for part in re.split(r"([./*])", unit):
        if part in (".", "*", "/"):
            sign = -1 if part == "/" else 1
            continue
        found = re.fullmatch(r"([A-Za-z]+|1)\^?(-?\d+)?", part.strip())
        name = found[1] if found else ""
        if not found or (name not in DERIVED and name not in BASE):
            return None
        power = sign * int(found[2] or 1)
        scale, powers = DERIVED.get(name, (1.0, {name: 1}))
        factor *= scale**power
        for base, exponent in powers.items():
            exponents[base] += exponent * power
    return BaseUnit(tuple(exponents.values()), factor)


def same_unit(first: str | None, second: str | None) -> bool:
    """Is a value in one unit the same number in the other? Where one is not declared there is nothing to compare."""
    if first is None or second is None or first == second:
        return True
    one, other = base_unit(first), base_unit(second)
    return one is not None and one == other
