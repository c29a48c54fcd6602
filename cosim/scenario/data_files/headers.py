"""The columns of tables: their names, their units, and which of them have times."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Final

from cosim.errors import UsageError, nearest
from cosim.units import base_unit

_HEADER: Final = re.compile(r"(?P<name>.*?)\s*(?:\[(?P<unit>[^\[\]]+)\]|\((?P<known>[^()]+)\))")
NO_UNIT: Final = ("-", "1")  # as dimensionless quantities are often marked
_TIMES: Final = re.compile(
    r"(t|(?P<date>(?i:date|datum|date_?time))|"
    r"(?i:times?|zeit|uhrzeit|time_?stamps?|zeitstempel|(elapsed|simulation|log)_?time))"
    r"(_(?P<unit>[mun]?s(ec)?|min|h|(?i:(milli|micro|nano)?seconds|minutes|hours)))?"
)
# units of time in words of English and German, and the symbols of their beginnings
_TIME_WORDS: Final = re.compile(
    r"(?P<prefix>milli|mi[ck]ro|nano)?(seconds?|sekunden?)|minute[ns]?|hours?|stunden?|days?|tage?",
    re.IGNORECASE,
)
_SYMBOLS: Final = {"se": "s", "mi": "min", "ho": "h", "st": "h", "da": "d", "ta": "d"}


@dataclass(frozen=True, slots=True)
class Header:
    """All that is written of a column, its name and unit in it, and where it stands."""

    text: str
    name: str
    unit: str | None
    position: int

    @staticmethod
    def parse(text: str, position: int) -> Header:
        """Split ``y [mm]`` or ``y (mm)``; what is in parentheses may be no unit."""
        text = text.strip()
        match = _HEADER.fullmatch(text)
        if match is None or not match["name"]:
            return Header(text, text, None, position)
        unit = (match["unit"] or match["known"]).strip()
        is_spaced = text[len(match["name"])].isspace()
        is_index = unit.isdecimal() and not (is_spaced and unit == "1")
        if is_index or (match["known"] and base_unit(symbol_of(unit)) is None):
            return Header(text, text, None, position)
        return Header(text, match["name"], "1" if unit in NO_UNIT else unit, position)

    @property
    def times(self) -> re.Match[str] | None:
        """The name where it is ``t``, ``Time``, ``time_ms``, ``Timestamp`` or the like; no ``T``.

        Its ``unit`` is that at the end.
        """
        return _TIMES.fullmatch(re.sub("[ -]", "_", self.name))

    @property
    def time_unit(self) -> str | None:
        """The unit in which it has times, as it is written; None: it does not say."""
        if self.unit is not None:
            return self.unit if seconds_in(self.unit) is not None else None
        if is_time_word(self.name) and self.name[-1] in "ns":  # no minute of a clock, no tag
            return self.name
        return self.times and self.times["unit"]

    @property
    def has_dates(self) -> bool:
        """Whether its name says dates, so that numbers such as 20240301 are no seconds."""
        return self.times is not None and bool(self.times["date"]) and self.time_unit is None


def find_headers(label: str, headers: Iterable[Header], names: Iterable[str]) -> list[Header]:
    """Return columns by all that is written of them, or else by their names without units.

    Raises
    ------
    UsageError
        If there is none of a name, or there are several.
    """
    by_text: dict[str, list[Header]] = {}
    by_name: dict[str, list[Header]] = {}
    for header in headers:
        by_text.setdefault(header.text, []).append(header)
        by_name.setdefault(header.name, []).append(header)
    found = []
    for name in names:
        matches = by_text.get(name) or by_name.get(name, [])
        if not matches:
            raise UsageError(f"{label} has no column {name!r}; {nearest(name, by_name)}")
        if len(matches) > 1:
            raise UsageError(f"{label}: expected a unique column {name!r}, got {len(matches)}")
        found += matches
    return found


def unit_of(label: str, name: str, parts: Sequence[Header]) -> str | tuple[str, ...] | None:
    """Return the unit of a signal made of columns: one for all, one for each, or none.

    Raises
    ------
    UsageError
        If some of them have a unit, and others have not.
    """
    units = [part.unit for part in parts if part.unit is not None]
    if len(units) not in (0, len(parts)):
        listed = ", ".join(f"{part.name!r} in {part.unit or 'no unit'}" for part in parts)
        raise UsageError(
            f"{label}: expected a unit in each column of {name!r}, or in none, got {listed}"
        )
    if len(set(units)) > 1:
        return tuple(units)
    return units[0] if units else None


def second_of(
    label: str,
    clock: Header,
    unit: str | None = None,
    way_out: str = "select another column by time",
) -> Decimal:
    """Return the unit of the times in s: the one given, or that of their column.

    Raises
    ------
    UsageError
        If it is no unit of time.
    """
    if unit is None and clock.has_dates:
        raise UsageError(
            f"{label}: column {clock.name!r}: expected dates, such as 2024-03-01 12:00, or times "
            f"with a unit, got neither; {way_out}"
        )
    name = unit or clock.unit or clock.time_unit or "s"
    seconds = seconds_in(name)
    if seconds is None:
        raise UsageError(
            f"{label}: column {clock.name!r}: expected times in a unit of time, such as ms, "
            f"got {name!r}; {way_out}"
        )
    return Decimal(repr(seconds))


def seconds_in(unit: str) -> float | None:
    """Return a unit of time in s; None: it is none."""
    meaning = base_unit(symbol_of(unit))
    second = base_unit("s")
    assert second is not None
    is_time = meaning is not None and meaning.exponents == second.exponents
    return meaning.factor if meaning is not None and is_time else None


def is_time_word(text: str) -> bool:
    """Return whether a text is a unit of time in a word, such as ``Millisekunden``."""
    return _TIME_WORDS.fullmatch(text) is not None


def symbol_of(unit: str) -> str:
    """Return the symbol of a unit of time in a word; any other unit as it is."""
    word = _TIME_WORDS.fullmatch(unit)
    if word is None:
        return unit
    if word["prefix"]:
        return {"mil": "ms", "mic": "us", "mik": "us", "nan": "ns"}[unit[:3].lower()]
    return _SYMBOLS[unit[:2].lower()]


def is_number(cell: str) -> bool:
    """Return whether a cell is a number as numpy reads it: as Python, but without underscores."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell and cell.isascii()
