"""Tables of numbers from CSV files: a line of names, then rows of numbers separated by commas.

A message tells where a file is no such table, and never what stands there: whoever runs a scenario
of another may be able to read what that other is not.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Final

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import UsageError, nearest
from cosim.files import read_bounded
from cosim.units import base_unit

LARGEST: Final = 2**28  # bytes
MOST_COLUMNS: Final = 100_000
SEPARATORS: Final = {";": "semicolons", "\t": "tabs", "|": "bars"}
_HEADER: Final = re.compile(r"(?P<name>.*?)\s*(?:\[(?P<unit>[^\[\]]+)\]|\((?P<known>[^()]+)\))")
NO_UNIT: Final = ("-", "1")  # as dimensionless quantities are often marked
_TIMES: Final = re.compile(
    r"(t|(?P<date>(?i:date|date_?time))|(?i:times?|time_?stamps?|(elapsed|simulation|log)_?time))"
    r"(_(?P<unit>[mun]?s|min|h))?"
)


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
        if is_index or (match["known"] and base_unit(unit) is None):
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
    meaning = base_unit(unit)
    second = base_unit("s")
    assert second is not None
    is_time = meaning is not None and meaning.exponents == second.exponents
    return meaning.factor if meaning is not None and is_time else None


@dataclass(frozen=True, slots=True)
class NamedColumns:
    """Columns of numbers by name.

    Parameters
    ----------
    file : str
        As it is named in messages.
    names : tuple of str
    values : Matrix, shape (N, number of names)
    """

    file: str
    names: tuple[str, ...]
    values: Matrix

    @property
    def label(self) -> str:
        """How messages name it."""
        return f"file {self.file}"

    @property
    def headers(self) -> list[Header]:
        """The columns, in their order."""
        return [Header.parse(text, position) for position, text in enumerate(self.names)]

    def find(self, names: Iterable[str]) -> list[Header]:
        """Return columns by their names; see :func:`find_headers`."""
        return find_headers(self.label, self.headers, names)

    def columns(self, headers: Sequence[Header]) -> Matrix:
        """Return columns side by side, shape (N, number of ``headers``)."""
        selected: Matrix = self.values[:, [header.position for header in headers]]
        return selected


def read_csv(path: Path) -> NamedColumns:
    """Read a table of numbers in UTF-8; empty lines are left out.

    Raises
    ------
    UsageError
        If the file cannot be read, or is no such table.
    """
    file = repr(str(path))
    lines = read_lines(path, file)
    names = _names(lines[0], file)
    rows = [line for line in lines[1:] if line.strip()]
    if not rows:
        raise UsageError(f"file {file}: expected a header line and rows of numbers, got no rows")
    try:
        values = np.loadtxt(rows, delimiter=",", ndmin=2, comments=None, quotechar='"')
    except ValueError:
        values = np.empty((0, 0))  # its message would quote the file
    if values.shape != (len(rows), len(names)):
        problem = _first_problem(lines, len(names))
        raise UsageError(f"file {file}: expected comma-separated numbers: {problem}")
    _check_names(names, file)
    return NamedColumns(file, names, values)


def read_lines(path: Path, file: str) -> list[str]:
    """Return the lines of a text in UTF-8; ``file`` is its name in messages.

    Raises
    ------
    UsageError
        If the file cannot be read, is too large, or is no text.
    """
    try:
        content = read_bounded(path, LARGEST)
        text = content.decode("utf-8-sig")  # Excel writes a byte order mark
    except OSError as error:
        raise UsageError(f"file {file} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        # not "from error": that one holds the content
        raise UsageError(
            f"file {file}: expected UTF-8 text, got another encoding (byte {error.start})"
        ) from None
    if "\0" in text:
        raise UsageError(f"file {file}: expected UTF-8 text, got a NUL character")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _names(line: str, file: str) -> tuple[str, ...]:
    cells = _cells(line)
    if cells is None:
        raise UsageError(f"file {file}: expected comma-separated numbers: line 1 cannot be split")
    if len(cells) > MOST_COLUMNS:
        raise UsageError(f"file {file}: expected at most {MOST_COLUMNS} columns, got {len(cells)}")
    if len(cells) == 1:
        for separator, name in SEPARATORS.items():
            if separator in line:
                raise UsageError(
                    f"file {file}: expected comma-separated numbers: line 1 has {name}; save it "
                    "with commas as separators and decimal points"
                )
        raise UsageError(f"file {file}: expected at least two comma-separated columns, got one")
    return tuple(cell.strip() for cell in cells)


def _check_names(names: tuple[str, ...], file: str) -> None:
    """Refuse rows of numbers without names that tell them apart."""
    if all(is_number(name) for name in names):
        raise UsageError(
            f"file {file}: expected the names of {len(names)} columns in line 1, got numbers"
        )
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise UsageError(f"file {file}: expected unique column names, got {count} columns {name!r}")


def _first_problem(lines: Sequence[str], columns: int) -> str:
    """Return where a table is none, as line and column, both from 1."""
    for number, line in enumerate(lines[1:], start=2):
        if line.strip():
            for problem in _problems(line, columns):
                return f"line {number}{problem}"
    return "a cell spans several lines"


def _problems(line: str, columns: int) -> Iterator[str]:
    cells = _cells(line)
    if cells is None:
        yield " cannot be split"
        return
    for column, cell in enumerate(cells, start=1):
        if not is_number(cell):
            found = "text" if cell.strip() else "an empty cell"
            yield f", column {column}: expected a number, got {found}"
    if len(cells) != columns:
        yield f": expected {columns} columns as in line 1, got {len(cells)}"


def _cells(line: str) -> list[str] | None:
    """Split a line; None: it cannot be split, because of its quotes or a cell beyond all size."""
    try:
        return next(csv.reader([line], strict=True), [])
    except csv.Error:
        return None


def is_number(cell: str) -> bool:
    """Return whether a cell is a number as numpy reads it: as Python, but without underscores."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell and cell.isascii()
