"""A table: its columns with their names and units, and what is given and found of its form.

The name of a column says what it is, with its unit: ``t [ms]``, ``y (mm)``, ``x_a[1]``. A message
tells where a file is no table, and never what stands there: whoever runs a scenario of another may
be able to read what that other is not.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
from pydantic import Field

from cosim.arrays import ABSENT, NAN, Matrix, Vector
from cosim.errors import UsageError, nearest
from cosim.files import read_bounded
from cosim.instants import EXACT
from cosim.scenario.document.schema import TomlTable, Whole
from cosim.units import base_unit

LARGEST: Final = 2**28  # bytes
NO_UNIT: Final = ("-", "1")  # as dimensionless quantities are often marked

SameTime: TypeAlias = Literal["last", "spread"]

_HEADER: Final = re.compile(r"(?P<name>.*?)\s*(?:\[(?P<unit>[^\[\]]+)\]|\((?P<known>[^()]+)\))")
_TIMES: Final = re.compile(
    r"(t|(?P<date>(?i:date|datum|date_?time))|"
    r"(?i:times?|zeit|uhrzeit|time_?stamps?|zeitstempel|(elapsed|simulation|log)_?time))"
    r"(_(?P<unit>[mun]?s(ec)?|min|h|(?i:(milli|micro|nano)?seconds|minutes|hours)))?"
)
_PREFIXES: Final = {"": "", "milli": "m", "micro": "u", "mikro": "u", "nano": "n"}
# units of time in words of English and German, and their symbols
_TIME_WORDS: Final = {
    **{
        f"{prefix}{word}": f"{symbol}s"
        for prefix, symbol in _PREFIXES.items()
        for word in ("second", "seconds", "sekunde", "sekunden")
    },
    **dict.fromkeys(("minute", "minutes", "minuten"), "min"),
    **dict.fromkeys(("hour", "hours", "stunde", "stunden"), "h"),
    **dict.fromkeys(("day", "days", "tag", "tage"), "d"),
}


# --- what is given ---


class TableForm(TomlTable):
    """How a table stands in its file, where that is not as it is found."""

    separator: str | None = Field(
        None,
        description="column separator of a text; default: tab, semicolon, vertical bar or "
        "comma, the one that splits its lines into equally many cells; several blanks are one",
    )
    decimal: Literal[".", ","] | None = Field(
        None, description="decimal separator of a text; default: as found in its numbers"
    )
    skip: Annotated[Whole, Field(ge=0)] | None = Field(
        None,
        description="lines before the names of the columns; default: the names are found, above "
        "the first row of numbers, or between them a row of units",
    )
    comment: Annotated[str, Field(max_length=10)] | None = Field(
        None, description='what lines begin with that are left out; default: "#"'
    )
    sheet: str | None = Field(None, description="sheet of a workbook; default: its only one")


AS_FOUND: Final = TableForm.model_validate({})

# --- names and units of columns ---


@dataclass(frozen=True, slots=True)
class Header:
    """All that is written of a column, its name and unit in it, where it stands, and what it has.

    ``stamp_unit`` is the unit of dates and durations; ``is_index``: it was the index of a frame.
    """

    text: str
    name: str
    unit: str | None
    position: int
    is_number: bool = False
    stamp_unit: str | None = None
    is_index: bool = False

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
    if meaning is None or second is None or meaning.exponents != second.exponents:
        return None
    return meaning.factor


def is_time_word(text: str) -> bool:
    """Return whether a text is a unit of time in a word, such as ``Millisekunden``."""
    return text.lower() in _TIME_WORDS


def symbol_of(unit: str) -> str:
    """Return the symbol of a unit of time in a word; any other unit as it is."""
    return _TIME_WORDS.get(unit.lower(), unit)


def is_number(cell: str) -> bool:
    """Return whether a cell is a number as numpy reads it: as Python, but without underscores."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell and cell.isascii()


# --- columns ---


class Reading(NamedTuple):
    """What was found in a file, and the key that says it otherwise."""

    what: str
    found: str
    reason: str
    key: str


class DataTable:
    """Columns of numbers, each with its position from 0.

    ``same_time`` says what is done with rows of one time where nobody says it. A file has its own
    :meth:`numbers_of`; its columns are at their positions in ``headers``.
    """

    hint = ""
    same_time: SameTime | None = None

    def __init__(self, path: Path) -> None:
        self.label = f"file {str(path)!r}"
        self.headers: list[Header] = []
        self.reading: list[Reading] = []
        self.left_out: dict[str, str] = {}  # what is no column, and why

    def numbers_of(self, position: int) -> Sequence[Any] | Vector:
        """Return the numbers of a column, as the file has them, texts too; None: there is none.

        Of dates and durations, what they count in their unit.

        Raises
        ------
        UsageError
            If it has something else.
        """
        raise NotImplementedError

    def place(self, row: int) -> str:
        """Return how messages name a row."""
        return f"row {row + 1}"

    def cell(self, row: int, position: int) -> str:
        """Return how messages name a cell."""
        return f"{self.label}, {self.place(row)}, column {self.headers[position].text!r}"

    def tell(self, what: str, found: str, reason: str, key: str, given: object = None) -> None:
        """Note what was found and why: because its key says so, where that is ``given``."""
        self.reading.append(Reading(what, found, "given" if given is not None else reason, key))

    def add_header(self, header: Header, unit: str = "", source: str = "") -> None:
        """Add a column, with the unit that ``source`` declares beside its name, if it does."""
        unit = "1" if unit in NO_UNIT else unit
        if unit and header.unit not in (None, unit):
            raise UsageError(
                f"{self.label}, column {header.text!r}: expected one unit, got {header.unit!r} in "
                f"its name and {unit!r} in {source}"
            )
        self.headers.append(replace(header, unit=unit or header.unit))

    def times(self, position: int) -> list[Decimal]:
        """Return the time stamps of a column, in its unit.

        Raises
        ------
        UsageError
            If one is missing, infinite, or none.
        """
        stamps = [Decimal(str(NAN if n is None else n)) for n in self.numbers_of(position)]
        for row, stamp in enumerate(stamps):
            if not stamp.is_finite():
                found = "an empty cell" if stamp.is_nan() else float(stamp)
                raise UsageError(f"{self.cell(row, position)}: expected a finite time, got {found}")
        return stamps

    def values(self, position: int, *, finite: bool = True) -> Vector:
        """Return the numbers of a column; NaN: not measured, ABSENT: the cell is empty.

        Raises
        ------
        UsageError
            If it has something else, an integer that is no float64, or an infinite number where
            they have to be finite.
        """
        header = self.headers[position]
        if header.stamp_unit is not None:
            raise UsageError(
                f"{self.label}: column {header.text!r}: expected numbers, got dates or durations"
            )
        written = self.numbers_of(position)
        if isinstance(written, np.ndarray):
            values = written.astype(np.float64)
        else:
            numbers = (NAN if number is None else float(number) for number in written)
            values = np.fromiter(numbers, np.float64, len(written))
        for row in np.flatnonzero(np.isnan(values)).tolist():
            values[row] = ABSENT if written[row] is None else NAN
        for row in np.flatnonzero(np.abs(values) >= EXACT).tolist():
            if math.isinf(values[row]) and finite:
                raise UsageError(
                    f"{self.cell(row, position)}: expected a finite number, got {values[row]}"
                )
            digits = str(written[row])
            if digits.lstrip("+-").isdigit() and Decimal(digits) != Decimal(values[row]):
                raise UsageError(
                    f"{self.cell(row, position)}: expected an integer that a float64 represents "
                    "(up to 2**53), got a larger one; write it in fewer digits, or leave its "
                    "column out by columns"
                )
        return values

    def find(self, names: Iterable[str] | None) -> list[Header]:
        """Return columns by their names, or all; see :func:`find_headers`."""
        if names is not None:
            return find_headers(self.label, self.headers, names)
        name, count = Counter(header.text for header in self.headers).most_common(1)[0]
        if count > 1:
            raise UsageError(
                f"{self.label}: expected unique column names, got {count} columns {name!r}"
            )
        return self.headers

    def columns(self, headers: Sequence[Header]) -> Matrix:
        """Return columns without gaps side by side, shape (N, number of ``headers``).

        Raises
        ------
        UsageError
            If a cell is empty, or no finite number.
        """
        columns = [self.values(header.position) for header in headers]
        for header, column in zip(headers, columns, strict=True):
            for row in np.flatnonzero(np.isnan(column)).tolist():
                raise UsageError(
                    f"{self.cell(row, header.position)}: expected a number, got an empty cell"
                )
        return np.stack(columns, axis=1)


def content_of(path: Path) -> bytes:
    """Return the bytes of a file.

    Raises
    ------
    UsageError
        If it cannot be read, or is too large.
    """
    try:
        return read_bounded(path, LARGEST)
    except OSError as error:
        raise UsageError(f"file {str(path)!r} cannot be read: {error.strerror}") from error
