"""Units: what they are in SI base units, and how a value in one becomes a value in another (FMI 2.0.4 section 2.2.2).

A value v in a unit is ``factor v + offset`` in its base unit, a product of powers of ``BASE``. Two units can be converted where
these powers are the same. FMI asks for identical powers of the radian too: an angle does not drive a number, nor rad/s 1/s; only
the dimensional analysis of equations takes rad as 1 (FMI 3.0 section 2.4.4). A conversion computes, in this order,

    v2 = ((v1 * factor1 + offset1) - offset2) / factor2

and copies the bits where both units are the same. What a unit is, its definition says, else its name: ``m/s2``, ``kN.m``,
``kg.m2/s^2``, ``degC``. A ``/`` divides by the one factor after it. A temperature in degC has an offset; in a product, such as
W/degC, it is a difference and has none.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

Values = TypeVar("Values", float, NDArray[np.float64])

BASE: Final = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
_ONE: Final = Fraction(1)
_DERIVED: Final[Mapping[str, tuple[Fraction, Mapping[str, int]]]] = {
    "1": (_ONE, {}),
    "g": (Fraction(1, 1000), {"kg": 1}),
    "min": (Fraction(60), {"s": 1}),
    "h": (Fraction(3600), {"s": 1}),
    "deg": (Fraction(1, 180), {"rad": 1}),  # times pi
    "rpm": (Fraction(2, 60), {"rad": 1, "s": -1}),  # times pi
    "Hz": (_ONE, {"s": -1}),
    "N": (_ONE, {"kg": 1, "m": 1, "s": -2}),
    "Pa": (_ONE, {"kg": 1, "m": -1, "s": -2}),
    "bar": (Fraction(100_000), {"kg": 1, "m": -1, "s": -2}),
    "J": (_ONE, {"kg": 1, "m": 2, "s": -2}),
    "W": (_ONE, {"kg": 1, "m": 2, "s": -3}),
    "C": (_ONE, {"A": 1, "s": 1}),
    "V": (_ONE, {"kg": 1, "m": 2, "s": -3, "A": -1}),
    "Ohm": (_ONE, {"kg": 1, "m": 2, "s": -3, "A": -2}),
    "S": (_ONE, {"kg": -1, "m": -2, "s": 3, "A": 2}),
    "F": (_ONE, {"kg": -1, "m": -2, "s": 4, "A": 2}),
    "H": (_ONE, {"kg": 1, "m": 2, "s": -2, "A": -2}),
    "Wb": (_ONE, {"kg": 1, "m": 2, "s": -2, "A": -1}),
    "T": (_ONE, {"kg": 1, "s": -2, "A": -1}),
    "degC": (_ONE, {"K": 1}),
}
_TIMES_PI: Final = ("deg", "rpm")
_CELSIUS: Final = 273.15  # K at 0 degC
_PREFIX: Final = {
    "p": Fraction(1, 10**12),
    "n": Fraction(1, 10**9),
    "u": Fraction(1, 10**6),
    "m": Fraction(1, 1000),
    "c": Fraction(1, 100),
    "h": Fraction(100),
    "k": Fraction(1000),
    "M": Fraction(10**6),
    "G": Fraction(10**9),
}
_PREFIXED: Final[Mapping[str, str]] = {  # only what is in use, and has one reading: no Gs (gauss), no cd (candela), no min
    "m": "pnumck", "s": "num", "g": "num", "A": "pnumk", "K": "m", "mol": "umk", "rad": "um", "Hz": "mkMG", "N": "umkM",
    "Pa": "hkMG", "bar": "m", "J": "mkMG", "W": "numkMG", "C": "pnum", "V": "numkM", "Ohm": "mkMG", "S": "um", "F": "pnum",
    "H": "num", "Wb": "m", "T": "num",
}  # fmt: skip
_ROUNDED: Final = (
    1e-9  # definitions of one name differ by the digits that were written, not by more
)


@dataclass(frozen=True, slots=True)
class BaseUnit:
    """A value in it is ``factor * value + offset`` in a product of powers of ``BASE`` (FMI 2.0.4 section 2.2.2)."""

    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.factor) and self.factor and math.isfinite(self.offset)):
            raise ValueError(
                f"unit: found factor {self.factor} and offset {self.offset}; needed finite numbers, no factor 0"
            )


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit by its name, and by what a definition says it is.

    Parameters
    ----------
    name : str or None
        None: not declared.
    base : BaseUnit or None
        None: what its name says.
    """

    name: str | None
    base: BaseUnit | None = None

    @property
    def si(self) -> BaseUnit | None:
        """What it is in SI; None: not declared, or not known."""
        return self.base or (None if self.name is None else base_unit(self.name))


@dataclass(frozen=True, slots=True)
class Conversion:
    """``((v * factor1 + offset1) - offset2) / factor2``; by default a copy."""

    factor1: float = 1.0
    offset1: float = 0.0
    offset2: float = 0.0
    factor2: float = 1.0

    @property
    def copies(self) -> bool:
        """Whether values stay as they are, bit for bit."""
        return self.factor1 == self.factor2 and self.offset1 == self.offset2

    def __call__(self, values: Values) -> Values:
        """Convert."""
        return (
            values
            if self.copies
            else ((values * self.factor1 + self.offset1) - self.offset2) / self.factor2
        )

    def __str__(self) -> str:
        return f"((v * {self.factor1!r} + {self.offset1!r}) - {self.offset2!r}) / {self.factor2!r}"


def conversion(first: Unit, second: Unit) -> Conversion | None:
    """Say how a value in ``first`` becomes one in ``second``; None where it cannot.

    Where one is not declared there is nothing to compare. One name is one unit where at most one of the two is defined, or both
    are to within their written digits; other names need a meaning each, and the same powers of the base units.
    """
    if (
        first.name is None
        or second.name is None
        or (first.name == second.name and _agree(first.base, second.base))
    ):
        return Conversion()
    one, other = first.si, second.si
    if one is None or other is None or one.exponents != other.exponents:
        return None
    return Conversion(one.factor, one.offset, other.offset, other.factor)


def _agree(one: BaseUnit | None, other: BaseUnit | None) -> bool:
    if one is None or other is None:
        return True
    pairs = ((one.factor, other.factor), (one.offset, other.offset))
    return one.exponents == other.exponents and all(
        math.isclose(*pair, rel_tol=_ROUNDED) for pair in pairs
    )


def base_unit(unit: str) -> BaseUnit | None:
    """Read the name of a unit; None where a part of it is not known."""
    exponents, factor, pi, sign = dict.fromkeys(BASE, 0), _ONE, 0, 1
    for part in re.split(r"([./*])", unit):
        if part in (".", "*", "/"):
            sign = -1 if part == "/" else 1
            continue
        found = re.fullmatch(r"([A-Za-z]+|1)\^?(-?\d)?", part.strip())
        symbol = _symbol(found[1]) if found else None
        if not found or symbol is None:
            return None
        name, scale, powers = symbol
        power = sign * int(found[2] or 1)
        factor *= scale**power
        pi += power * (name in _TIMES_PI)
        for base, exponent in powers.items():
            exponents[base] += exponent * power
    size = _float(factor, pi)
    return (
        BaseUnit(tuple(exponents.values()), size, _CELSIUS if unit.strip() == "degC" else 0.0)
        if size
        else None
    )


def _symbol(text: str) -> tuple[str, Fraction, Mapping[str, int]] | None:
    """Give the symbol without its prefix, its factor but for pi, and its powers."""
    if text in _DERIVED:
        return text, *_DERIVED[text]
    if text in BASE:
        return text, _ONE, {text: 1}
    prefix, symbol = text[:1], text[1:]
    if prefix not in _PREFIXED.get(symbol, ""):
        return None
    scale, powers = _DERIVED.get(symbol, (_ONE, {symbol: 1}))
    return symbol, _PREFIX[prefix] * scale, powers


def _float(factor: Fraction, pi: int) -> float:
    """Round once where there is no pi; 0 where it is no number of ordinary size."""
    if not Fraction(1, 10**100) < factor < 10**100:
        return 0.0
    return float(factor) if pi == 0 else math.pi**pi * factor.numerator / factor.denominator
