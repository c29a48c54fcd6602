"""Physical units in SI base units, and the conversion between them (FMI 2.0.4 section 2.2.2).

A value v in a unit is ``factor v + offset`` in its base unit, a product of powers of ``BASE``. Two
units can be converted where these powers are the same. FMI requires identical powers of the radian
too: an angle does not drive a number, nor rad/s 1/s; only the dimensional analysis of equations
takes rad as 1 (FMI 3.0 section 2.4.4). A conversion computes, in this order,

    v2 = ((v1 * factor1 + offset1) - offset2) / factor2

and copies the bits where both units are the same. The meaning of a unit is its definition where
there is one, else that of its name: ``m/s2``, ``kN.m``, ``kg.m2/s^2``, ``degC``. A ``/`` divides by
the one factor after it, or by those in parentheses, as in ``W/(m2.K)``. A temperature in degC or
degF has an offset; in a product, such as W/degC, it is a difference and has none. A unit whose name
says nothing is not known: nothing is compared with it, and nothing converted. Nor is dB, which is
no multiple of a number, and what is another quantity elsewhere, such as gal, kt (knot, kilotonne)
and psig (above the pressure of the day).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

Values = TypeVar("Values", float, NDArray[np.float64])

BASE: Final = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
_ONE: Final = Fraction(1)
_INCH: Final = Fraction("0.0254")  # m
_POUND: Final = Fraction("0.45359237")  # kg
_GRAVITY: Final = Fraction("9.80665")  # m/s2
_MERCURY: Final = Fraction("13595.1") * _GRAVITY  # Pa/m, a column of it as manometers take it
_DERIVED: Final[Mapping[str, tuple[Fraction, Mapping[str, int]]]] = {
    "1": (_ONE, {}),
    "%": (Fraction(1, 100), {}),
    "g": (Fraction(1, 1000), {"kg": 1}),
    "t": (Fraction(1000), {"kg": 1}),
    "l": (Fraction(1, 1000), {"m": 3}),
    "L": (Fraction(1, 1000), {"m": 3}),
    "min": (Fraction(60), {"s": 1}),
    "h": (Fraction(3600), {"s": 1}),
    "deg": (Fraction(1, 180), {"rad": 1}),  # times pi
    "rev": (Fraction(2), {"rad": 1}),  # times pi
    "turn": (Fraction(2), {"rad": 1}),  # times pi
    "gon": (Fraction(1, 200), {"rad": 1}),  # times pi
    "rpm": (Fraction(2, 60), {"rad": 1, "s": -1}),  # times pi
    "Hz": (_ONE, {"s": -1}),
    "N": (_ONE, {"kg": 1, "m": 1, "s": -2}),
    "Pa": (_ONE, {"kg": 1, "m": -1, "s": -2}),
    "bar": (Fraction(100_000), {"kg": 1, "m": -1, "s": -2}),
    "J": (_ONE, {"kg": 1, "m": 2, "s": -2}),
    "Nm": (_ONE, {"kg": 1, "m": 2, "s": -2}),
    "Wh": (Fraction(3600), {"kg": 1, "m": 2, "s": -2}),
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
    "degF": (Fraction(5, 9), {"K": 1}),
    "degR": (Fraction(5, 9), {"K": 1}),
    "d": (Fraction(86_400), {"s": 1}),
    "week": (Fraction(604_800), {"s": 1}),
    "in": (_INCH, {"m": 1}),
    "ft": (12 * _INCH, {"m": 1}),
    "yd": (36 * _INCH, {"m": 1}),
    "mi": (63_360 * _INCH, {"m": 1}),
    "nmi": (Fraction(1852), {"m": 1}),
    "kn": (Fraction(1852, 3600), {"m": 1, "s": -1}),
    "lpm": (Fraction(1, 60_000), {"m": 3, "s": -1}),
    "gpm": (231 * _INCH**3 / 60, {"m": 3, "s": -1}),  # of the United States
    "cfm": ((12 * _INCH) ** 3 / 60, {"m": 3, "s": -1}),
    "cc": (Fraction(1, 10**6), {"m": 3}),
    "lb": (_POUND, {"kg": 1}),
    "oz": (_POUND / 16, {"kg": 1}),
    "slug": (_POUND * _GRAVITY / (12 * _INCH), {"kg": 1}),
    "kgf": (_GRAVITY, {"kg": 1, "m": 1, "s": -2}),
    "lbf": (_POUND * _GRAVITY, {"kg": 1, "m": 1, "s": -2}),
    "kip": (1000 * _POUND * _GRAVITY, {"kg": 1, "m": 1, "s": -2}),
    "dyn": (Fraction(1, 10**5), {"kg": 1, "m": 1, "s": -2}),
    "psi": (_POUND * _GRAVITY / _INCH**2, {"kg": 1, "m": -1, "s": -2}),
    "ksi": (1000 * _POUND * _GRAVITY / _INCH**2, {"kg": 1, "m": -1, "s": -2}),
    "atm": (Fraction(101_325), {"kg": 1, "m": -1, "s": -2}),
    "Torr": (Fraction(101_325, 760), {"kg": 1, "m": -1, "s": -2}),
    "mmHg": (_MERCURY / 1000, {"kg": 1, "m": -1, "s": -2}),
    "cmHg": (_MERCURY / 100, {"kg": 1, "m": -1, "s": -2}),
    "inHg": (_MERCURY * _INCH, {"kg": 1, "m": -1, "s": -2}),
    "mmH2O": (_GRAVITY, {"kg": 1, "m": -1, "s": -2}),
    "cmH2O": (10 * _GRAVITY, {"kg": 1, "m": -1, "s": -2}),
    "inH2O": (1000 * _INCH * _GRAVITY, {"kg": 1, "m": -1, "s": -2}),
    "erg": (Fraction(1, 10**7), {"kg": 1, "m": 2, "s": -2}),
    "eV": (Fraction("1.602176634e-19"), {"kg": 1, "m": 2, "s": -2}),
    "cal": (Fraction("4.184"), {"kg": 1, "m": 2, "s": -2}),
    "BTU": (Fraction("1055.05585262"), {"kg": 1, "m": 2, "s": -2}),
    "hp": (550 * 12 * _INCH * _POUND * _GRAVITY, {"kg": 1, "m": 2, "s": -3}),
    "PS": (75 * _GRAVITY, {"kg": 1, "m": 2, "s": -3}),
    "VA": (_ONE, {"kg": 1, "m": 2, "s": -3}),
    "var": (_ONE, {"kg": 1, "m": 2, "s": -3}),
    "Ah": (Fraction(3600), {"A": 1, "s": 1}),
    "Vs": (_ONE, {"kg": 1, "m": 2, "s": -2, "A": -1}),
    "As": (_ONE, {"A": 1, "s": 1}),
    "Ws": (_ONE, {"kg": 1, "m": 2, "s": -2}),
    "Nms": (_ONE, {"kg": 1, "m": 2, "s": -1}),
    "P": (Fraction(1, 10), {"kg": 1, "m": -1, "s": -1}),
    "St": (Fraction(1, 10**4), {"m": 2, "s": -1}),
    "lm": (_ONE, {"cd": 1}),
    "lx": (_ONE, {"cd": 1, "m": -2}),
    "ppm": (Fraction(1, 10**6), {}),
    "ppb": (Fraction(1, 10**9), {}),
}
_TIMES_PI: Final = ("deg", "rev", "turn", "gon", "rpm")
# other spellings of a symbol, which take its prefixes
_SPELLINGS: Final[Mapping[str, str]] = {
    "ohm": "Ohm", "ohms": "Ohm", "sec": "s", "second": "s", "seconds": "s", "minute": "min",
    "minutes": "min", "hr": "h", "hour": "h", "hours": "h", "day": "d", "days": "d", "r": "rev",
    "meter": "m", "metre": "m", "inch": "in", "inches": "in", "foot": "ft", "feet": "ft",
    "knot": "kn", "knots": "kn", "kts": "kn", "liter": "l", "litre": "l", "lbm": "lb",
    "kp": "kgf", "Btu": "BTU", "VAr": "var", "degree": "deg", "degrees": "deg", "radian": "rad",
    "radians": "rad", "RPM": "rpm", "torr": "Torr", "psia": "psi", "percent": "%", "pct": "%",
    "Kelvin": "K", "kelvin": "K", "degK": "K",
}  # fmt: skip
_WORDS: Final[Mapping[str, str]] = {
    "mph": "mi/h", "kph": "km/h", "kmh": "km/h", "rps": "rev/s", "U/min": "rev/min",
    "Celsius": "degC", "celsius": "degC", "deg_C": "degC", "Fahrenheit": "degF",
    "fahrenheit": "degF", "deg_F": "degF", "-": "1",
}  # fmt: skip
_SIGNS: Final = str.maketrans(
    {
        "\N{DEGREE SIGN}": "deg",
        "\N{DEGREE CELSIUS}": "degC",
        "\N{DEGREE FAHRENHEIT}": "degF",
        "\N{OHM SIGN}": "Ohm",
        "\N{GREEK CAPITAL LETTER OMEGA}": "Ohm",
        "\N{KELVIN SIGN}": "K",
        "\N{MIDDLE DOT}": ".",
        "\N{DOT OPERATOR}": ".",
        "\N{MULTIPLICATION SIGN}": ".",
        "\N{SUPERSCRIPT ONE}": "1",
        "\N{SUPERSCRIPT TWO}": "2",
        "\N{SUPERSCRIPT THREE}": "3",
        "\N{SUPERSCRIPT FOUR}": "4",
        "\N{SUPERSCRIPT MINUS}": "-",
        "\N{MINUS SIGN}": "-",
    }
)
_ICE_POINT: Final = Fraction(27315, 100)  # K at 0 degC and at 32 degF
_OFFSETS: Final = {
    "degC": float(_ICE_POINT),
    "degF": float(_ICE_POINT - 32 * Fraction(5, 9)),
}
_PREFIX: Final = {
    "p": Fraction(1, 10**12),
    "n": Fraction(1, 10**9),
    "u": Fraction(1, 10**6),
    "m": Fraction(1, 1000),
    "c": Fraction(1, 100),
    "d": Fraction(1, 10),
    "h": Fraction(100),
    "k": Fraction(1000),
    "M": Fraction(10**6),
    "G": Fraction(10**9),
}
_MICRO: Final = {"\N{MICRO SIGN}": "u", "\N{GREEK SMALL LETTER MU}": "u"}  # they look the same
# only what is in use, and has one reading: no Gs (gauss), no cd (candela), no min, no kt (knot)
_PREFIXED: Final[Mapping[str, str]] = {
    "m": "pnumcdk", "s": "num", "g": "num", "A": "pnumk", "K": "m", "mol": "umk", "rad": "um",
    "Hz": "mkMG", "N": "umkM", "Pa": "mhkMG", "bar": "m", "J": "mkMG", "W": "numkMG", "C": "pnum",
    "V": "numkM", "Ohm": "mkMG", "S": "um", "F": "pnum", "H": "num", "Wb": "m", "T": "num",
    "l": "umcd", "L": "umcd", "Nm": "mkM", "Wh": "kMG", "Ah": "mk", "VA": "kM", "var": "kM",
    "cal": "k", "lbf": "k", "As": "m", "Vs": "m", "Ws": "k",
    "P": "cm", "St": "c", "eV": "kM", "psi": "k", "Torr": "mu", "lm": "k", "lx": "k",
}  # fmt: skip
_JOINED: Final = re.compile("(Nms?|Vs|As|Ws|VA)$")  # nobody knows what Nm2 is a square of
_DENOMINATOR: Final = re.compile(r"/\(([^()/]+)\)")  # in W/(m2.K)
_ROUNDED: Final = 1e-9  # definitions of one name differ only by the digits that were written


@dataclass(frozen=True, slots=True)
class BaseUnit:
    """The meaning of a unit (FMI 2.0.4 section 2.2.2).

    A value in it is ``factor * value + offset`` in the product of powers of ``BASE`` with these
    ``exponents``.

    Raises
    ------
    ValueError
        If there is not one whole exponent for each of ``BASE``, a number is not finite or the
        factor is 0.
    """

    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        is_whole = [type(exponent) is int for exponent in self.exponents]
        if len(is_whole) != len(BASE) or not all(is_whole):
            raise ValueError(
                f"unit: expected a whole exponent for each of {', '.join(BASE)}, "
                f"got {self.exponents!r}"
            )
        finite = math.isfinite(self.factor) and math.isfinite(self.offset)
        if not finite or self.factor == 0.0:
            raise ValueError(
                f"unit: expected a finite factor other than 0 and a finite offset, "
                f"got factor {self.factor}, offset {self.offset}"
            )


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit by its name, and its definition where there is one.

    Parameters
    ----------
    name : str or None
        None: not declared.
    base : BaseUnit or None
        None: the meaning of its name.
    """

    name: str | None
    base: BaseUnit | None = None

    @property
    def si(self) -> BaseUnit | None:
        """The unit in SI; None: not declared, or not known."""
        if self.base is not None or self.name is None:
            return self.base
        return base_unit(self.name)


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

    @property
    def factor(self) -> float:
        """What a difference of two values is multiplied with."""
        return self.factor1 / self.factor2

    def __call__(self, values: Values) -> Values:
        """Convert a value or an array of them."""
        if self.copies:
            return values
        base_values = values * self.factor1 + self.offset1
        return (base_values - self.offset2) / self.factor2

    def __str__(self) -> str:
        base_value = f"(v * {self.factor1!r} + {self.offset1!r})"
        return f"({base_value} - {self.offset2!r}) / {self.factor2!r}"


def conversion(first: Unit, second: Unit) -> Conversion | None:
    """Return the conversion of a value in ``first`` to one in ``second``; None where there is none.

    Units that are not :func:`comparable` are copied. One name is one unit where at most one of the
    two is defined, or both are, equal to their written digits. Different names need the same powers
    of the base units.
    """
    if _same_name(first, second):
        return Conversion()
    source = first.si
    target = second.si
    if source is None or target is None:
        return Conversion()
    if source.exponents != target.exponents:
        return None
    return Conversion(source.factor, source.offset, target.offset, target.factor)


def conversions_between(first: Sequence[Unit], second: Sequence[Unit]) -> list[Conversion | None]:
    """Return the conversion of each element in the units ``first`` to those in ``second``."""
    pairs = list(zip(first, second, strict=True))
    by_pair = {pair: conversion(*pair) for pair in set(pairs)}
    return [by_pair[pair] for pair in pairs]


def units_text(units: Sequence[Unit]) -> str:
    """Return the units of the elements of a vector for people: ``mm``, or ``mm, m/s``."""
    names = [unit.name for unit in units if unit.name is not None]
    return ", ".join(names[:1] if len(set(units)) == 1 else names)


def with_unit(name: str, unit: str | None) -> str:
    """Return a name with its unit: ``y [mm]``."""
    return name if unit is None else f"{name} [{unit}]"


def comparable(first: Unit, second: Unit) -> bool:
    """Return whether it can be said if values in both units mean the same.

    It cannot where one of them is not declared, or not known and of another name.
    """
    if _same_name(first, second):
        return True
    return first.si is not None and second.si is not None


def _same_name(first: Unit, second: Unit) -> bool:
    return first.name is not None and first.name == second.name and _agree(first.base, second.base)


def unknown_unit(name: str) -> str:
    """Return what is wrong with a unit that is not known, and what is expected."""
    return (
        f"{name!r} is not known; expected a product of units, such as mm, kN.m, W/(m2.K), degC or "
        "rev/min, or no unit"
    )


@lru_cache(maxsize=1024)
def base_unit(unit: str) -> BaseUnit | None:
    """Return the meaning of the name of a unit; None where a part of it is not known."""
    text = _plain_text(unit)
    exponents = dict.fromkeys(BASE, 0)
    factor = _ONE
    pi_power = 0
    sign = 1
    for part in re.split(r"([./*])", _DENOMINATOR.sub(_one_by_one, text)):
        if part in (".", "*", "/"):
            sign = -1 if part == "/" else 1
            continue
        parsed = _parse_factor(part)
        if parsed is None:
            return None
        symbol, exponent = parsed
        power = sign * exponent
        factor *= symbol.factor**power
        pi_power += power * symbol.times_pi
        for base, base_exponent in symbol.exponents.items():
            exponents[base] += base_exponent * power
    size = _rounded(factor, pi_power)
    if size is None:
        return None
    offset = _OFFSETS.get(text, 0.0)
    return BaseUnit(tuple(exponents.values()), size, offset)


def _plain_text(unit: str) -> str:
    """Return the text of a unit in letters, digits and the signs of a product."""
    text = unit.strip().translate(_SIGNS).replace("**", "^")
    text = re.sub(r"\^\((-?\d)\)", r"^\1", text)  # s^(-1)
    text = re.sub(r"\bdeg\s+(?=[CF]\b)", "deg", text)
    text = re.sub(r"\bkgm(?=2?\b)", "kg.m", text)
    text = re.sub(r"(?<=\w)\s+(?=[^\W\d])", ".", text)  # N m
    return _WORDS.get(text, text)


def _one_by_one(denominator: re.Match[str]) -> str:
    """Return /a/b for /(a.b)."""
    return "/" + re.sub("[.*]", "/", denominator[1])


@dataclass(frozen=True, slots=True)
class _Symbol:
    """A symbol with its prefix: its factor, times pi where ``times_pi``, and its powers of BASE."""

    factor: Fraction
    times_pi: bool
    exponents: Mapping[str, int]


def _parse_factor(part: str) -> tuple[_Symbol, int] | None:
    """Read one factor of a unit, like ``mm``, ``s2`` or ``s^-1``: its symbol and its exponent."""
    match = re.fullmatch(r"([A-Za-z\u00b5\u03bc]+|[a-z]+H2O|1|%)\^?(-?\d)?", part.strip())
    symbol = _parse_symbol(match[1]) if match else None
    if match is None or symbol is None or (match[2] and _JOINED.search(match[1])):
        return None
    return symbol, int(match[2] or 1)


def _parse_symbol(name: str) -> _Symbol | None:
    name = _SPELLINGS.get(name, name)
    if name in _DERIVED or name in BASE:
        return _plain_symbol(name)
    prefix = _MICRO.get(name[:1], name[:1])
    symbol = _SPELLINGS.get(name[1:], name[1:])
    if prefix not in _PREFIXED.get(symbol, ""):
        return None
    plain = _plain_symbol(symbol)
    return _Symbol(_PREFIX[prefix] * plain.factor, plain.times_pi, plain.exponents)


def _plain_symbol(name: str) -> _Symbol:
    """Return a symbol without a prefix, derived or of ``BASE``."""
    factor, exponents = _DERIVED.get(name, (_ONE, {name: 1}))
    return _Symbol(factor, name in _TIMES_PI, exponents)


def _rounded(factor: Fraction, pi_power: int) -> float | None:
    """Round ``factor * pi**pi_power``, once, with the double pi; None beyond ordinary sizes."""
    size = factor * Fraction(math.pi) ** pi_power
    if not Fraction(1, 10**100) < size < 10**100:
        return None
    return float(size)


def _agree(first: BaseUnit | None, second: BaseUnit | None) -> bool:
    """Return whether two definitions, where both are given, mean the same to their digits."""
    if first is None or second is None:
        return True
    same_factor = math.isclose(first.factor, second.factor, rel_tol=_ROUNDED)
    same_offset = math.isclose(first.offset, second.offset, rel_tol=_ROUNDED)
    return first.exponents == second.exponents and same_factor and same_offset
