"""Tables of samples as the field writes them: text of many forms, Excel, Parquet, MAT-files.

Of a text the separator, the decimal sign, what stands before the names of the columns and a row of
units below them are found, unless they are given; of Excel all but the separator. Then both are
the same rows of cells. What was found, and why, is in :attr:`Table.reading`.

A message tells where a file is no such table, and never what stands there: whoever runs a scenario
of another may be able to read what that other is not.
"""

from __future__ import annotations

import codecs
import csv
import json
import math
import re
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, timedelta
from decimal import Decimal
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from cosim.arrays import NAN, Matrix, Vector
from cosim.errors import UsageError, listing, nearest
from cosim.files import read_bounded
from cosim.instants import NANOSECONDS
from cosim.scenario.data_files.headers import NO_UNIT, Header, find_headers, is_number
from cosim.scenario.data_files.mat_file import read_variables
from cosim.units import base_unit

LARGEST: Final = 2**28  # bytes
MOST_COLUMNS: Final = 100_000
EXCEL: Final = (".xlsx", ".xlsm")
COMMENT: Final = "#"
_SEPARATORS: Final = ("\t", ";", "|", ",")
_NAMES: Final = {"\t": "tab", " ": "blank"}
_SAMPLE: Final = 50  # lines at each end that show how a file is made
_BYTES: Final = 8  # of a number
_THOUSANDS: Final = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+", re.ASCII)
_MARKS: Final = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)


class Reading(NamedTuple):
    """What was found in a file, and the key that says it otherwise."""

    what: str
    found: str
    reason: str
    key: str


@dataclass(frozen=True, slots=True)
class TableForm:
    """What is given of the form of a table; see the keys of the kind field-data.

    Parameters
    ----------
    separator, decimal, comment, sheet : str or None
    skip : int or None
        Lines before the names of the columns; None: they are found.
    missing : tuple of numbers and texts
        That stand for no measured value.
    """

    separator: str | None = None
    decimal: str | None = None
    skip: int | None = None
    comment: str | None = None
    missing: tuple[float | str, ...] = ()
    sheet: str | None = None

    @property
    def missing_texts(self) -> frozenset[str]:
        """The cells that are no measured values."""
        return frozenset(code for code in self.missing if isinstance(code, str))


class Table:
    """Columns of numbers, each with its place from 0.

    ``headers`` are the columns with a name, ``index`` those that were the index of a frame,
    ``stamps`` those of dates or durations, ``numbers`` those of numbers. ``same_time`` says what is
    done with rows of one time where nobody says it.
    """

    hint = ""
    same_time: str | None = None

    def __init__(self, path: Path) -> None:
        self.label = f"file {str(path)!r}"
        self.headers: list[Header] = []
        self.index: set[int] = set()
        self.stamps: set[int] = set()
        self.numbers: set[int] = set()
        self.reading: list[Reading] = []

    def place(self, row: int) -> str:
        """Return how messages name a row."""
        return f"row {row + 1}"

    def stamp_unit(self, position: int) -> str | None:
        """Return the unit of dates or durations; None: the times are numbers."""
        return "ns" if position in self.stamps else None

    def times(self, position: int) -> list[Decimal]:
        """Return the time stamps of a column, in its unit.

        Raises
        ------
        UsageError
            If one is missing, or is none.
        """
        raise NotImplementedError

    def values(self, position: int) -> Vector:
        """Return the numbers of a column; NaN: not measured.

        Raises
        ------
        UsageError
            If it has something else, or an infinite number.
        """
        raise NotImplementedError

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
            empty = np.flatnonzero(np.isnan(column))
            if empty.size:
                raise UsageError(
                    f"{self.label}, {self.place(int(empty[0]))}, column {header.text!r}: expected "
                    "a number, got an empty cell"
                )
        return np.stack(columns, axis=1)

    def _refuse_infinite(self, values: Vector, name: str) -> None:
        infinite = np.flatnonzero(np.isinf(values))
        if infinite.size:
            row = int(infinite[0])
            raise UsageError(
                f"{self.label}, {self.place(row)}, column {name}: expected a finite number, got "
                f"{values[row]}"
            )


def read_table(path: Path, form: TableForm | None = None) -> Table:
    """Read a table by the ending of its name; all that is none of the others is text.

    Raises
    ------
    UsageError
        If the file cannot be read, is too large, is no table, or a library is missing.
    """
    form = form or TableForm()
    table: Table
    match path.suffix.lower():
        case ".parquet":
            table = ParquetTable(path)
        case ".mat":
            table = MatTable(path)
        case _:
            table = _table_of_cells(path, form, texts=False)
    named = [header for header in table.headers if header.text]
    if len(named) + len(table.index & {h.position for h in table.headers if not h.text}) < 2:
        raise UsageError(
            f"{table.label}: expected at least two named columns (times and samples), got "
            f"{len(named)}{table.hint}"
        )
    if all(is_number(header.name) for header in named):
        raise UsageError(f"{table.label}: expected column names in line 1, got numbers")
    return table


def read_texts(path: Path) -> TextTable:
    """Read a table whose cells need not be numbers, and may span several lines; without units.

    Raises
    ------
    UsageError
        As :func:`read_table`.
    """
    return _table_of_cells(path, TableForm(), texts=True)


def _table_of_cells(path: Path, form: TableForm, *, texts: bool) -> TextTable:
    read = _excel_table if path.suffix.lower() in EXCEL else _text_table
    return read(path, form, texts=texts)


def _content(path: Path) -> bytes:
    try:
        return read_bounded(path, LARGEST)
    except OSError as error:
        raise UsageError(f"file {str(path)!r} cannot be read: {error.strerror}") from error


# --- dates and durations ---

_DURATION: Final = re.compile(
    r"(?:(?P<days>-?\d{1,9}) days?)?\s*(?:\+?(?P<h>\d{1,9}):(?P<min>\d\d):(?P<s>\d\d(?:\.\d+)?))?"
)
_DATE: Final = re.compile(
    r"(?P<day>\d{4}-\d\d-\d\d)(?:[T ](?P<time>\d\d:\d\d(?::\d\d)?)(?:[.,](?P<fraction>\d+))?"
    r" ?(?P<zone>Z|[+-]\d\d(?::?\d\d)?)?)?"
)
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def nanoseconds(text: str) -> Decimal | None:
    """Return a duration, or a date since 1970, in ns, with all its digits; None: it is neither."""
    day = _DATE.fullmatch(text)
    if day is not None:
        try:
            instant = datetime.fromisoformat(
                f"{day['day']}T{day['time'] or '00:00'}{day['zone'] or 'Z'}"
            )
        except ValueError:
            return None
        since = instant - _EPOCH
        seconds = 86400 * since.days + since.seconds + Decimal(f"0.{day['fraction'] or 0}")
        return seconds * NANOSECONDS
    duration = _DURATION.fullmatch(text)
    if duration is None or not text:
        return None
    hours = 24 * int(duration["days"] or 0) + int(duration["h"] or 0)
    minutes = 60 * hours + int(duration["min"] or 0)
    return (60 * minutes + Decimal(duration["s"] or 0)) * NANOSECONDS


# --- rows of cells: text and Excel ---


@dataclass(slots=True)
class _Row:
    """A row of cells and its number from 1; None: the line cannot be split."""

    number: int
    cells: list[str] | None

    @property
    def width(self) -> int:
        return len(self.cells) if self.cells is not None else 0


@dataclass(frozen=True, slots=True)
class _Sheet:
    """The rows of a file, comments apart; ``unit`` names a row in messages."""

    rows: list[_Row]
    comments: list[_Row] = field(default_factory=list)
    unit: str = "line"
    separator: str | None = None
    count: int = 0


class TextTable(Table):
    """Names of columns, and rows of cells below them."""

    def __init__(self, path: Path, form: TableForm, sheet: _Sheet, *, texts: bool) -> None:
        super().__init__(path)
        self._unit = sheet.unit
        self._gaps = form.missing_texts | {""}
        self._has_commas = sheet.separator != ","
        if sheet.separator is not None:
            self.hint = f" (separated by {sheet.separator!r})"
        rows = sheet.rows
        width = _usual_width(rows)
        if width > MOST_COLUMNS:
            raise UsageError(f"{self.label}: expected at most {MOST_COLUMNS} columns, got {width}")
        numeric = self._numeric(rows, width)
        if texts or form.skip is not None:
            wide = [place for place, row in enumerate(rows) if row.width == width]
            header = (0 if form.skip is not None else min(wide, default=0)) if rows else None
            data = header + 1 if header is not None else 0
        else:
            header, data = self._header(rows, width, numeric)
        names = rows[header] if header is not None else self._commented(sheet, rows, data)
        units = None
        if header is not None and not texts:
            if form.skip is not None:
                below = rows[1] if len(rows) > 1 else None
                if below is not None and self._are_units(below, names, numeric):
                    units, data = below, 2
            elif header and self._are_units(names, rows[header - 1], numeric):
                units, names = names, rows[header - 1]
        self._rows = rows[data:]
        self._check_widths(names.width, rows[header + 1 : data] if header is not None else [])
        if self._rows and names.width > 1 and not (numeric or texts):
            raise UsageError(f"{self.label}: expected rows of numbers, got text")
        self._decimal = form.decimal or self._likely_decimal(sheet.separator, numeric, texts=texts)
        self._tell(sheet, form, names, units)
        self._take_headers(names.cells or [], units.cells if units is not None else None)
        if not texts:
            self._classify()

    # what stands where

    def _is_value(self, cell: str) -> bool:
        cell = cell.strip()
        number = cell.replace(",", ".") if self._has_commas else cell
        return is_number(number) or nanoseconds(cell) is not None

    def _numeric(self, rows: Sequence[_Row], width: int) -> list[int]:
        """Return the columns that have numbers or times in the last rows."""
        found: set[int] = set()
        for row in rows[-_SAMPLE:]:
            if row.cells is not None and len(row.cells) == width:
                found |= {place for place, cell in enumerate(row.cells) if self._is_value(cell)}
        return sorted(found)

    def _values_in(self, row: _Row, numeric: Sequence[int]) -> list[int]:
        cells = row.cells or []
        return [place for place in numeric if place < len(cells) and self._is_value(cells[place])]

    def _is_data(self, row: _Row, numeric: Sequence[int]) -> bool:
        """Whether a row has numbers where the last rows have them, and no text before them."""
        assert row.cells is not None
        values = self._values_in(row, numeric)
        return bool(values) and (
            values[0] == numeric[0] or row.cells[numeric[0]].strip() in self._gaps
        )

    def _header(
        self, rows: Sequence[_Row], width: int, numeric: Sequence[int]
    ) -> tuple[int | None, int]:
        """Return where the names stand, above the first row of numbers, and where that is.

        Raises
        ------
        UsageError
            If a row has names and numbers, or there are numbers above the names.
        """
        wide: list[int] = []
        data = len(rows)
        for place, row in enumerate(rows):
            if row.width == width:
                if self._is_data(row, numeric):
                    data = place
                    break
                wide.append(place)
        if not numeric and wide:
            return wide[0], wide[0] + 1
        if not wide:
            return None, data
        header = wide[-1]
        for row in rows[:header]:
            cells = row.cells or []
            if len(cells) > 1 and all(self._is_value(cell) for cell in cells):
                raise UsageError(
                    f"{self.label}, {self._at(row)}: expected nothing but text above the names of "
                    f"the columns, in {self._at(rows[header])}, got numbers; skip = "
                    f"{rows[header].number - 1} reads the table that begins there"
                )
        if len(wide) > 1 and self._values_in(rows[header], numeric):
            raise UsageError(
                f"{self.label}, {self._at(rows[header])}: expected names of columns or numbers, "
                f"got both; skip = {rows[header].number - 1} reads names there"
            )
        return header, data

    def _commented(self, sheet: _Sheet, rows: Sequence[_Row], data: int) -> _Row:
        """Return the names in the comment above the first row, as numpy writes them.

        Raises
        ------
        UsageError
            If there are rows, and no names.
        """
        if data >= len(rows):
            return _Row(1, [])
        first = rows[data]
        above = [row for row in sheet.comments if row.number < first.number]
        if data == 0 and above and above[-1].width == first.width:
            return above[-1]
        if data == 0:
            raise UsageError(
                f"{self.label}: expected column names in {self._at(first)}, got numbers"
            )
        raise UsageError(
            f"{self.label}: expected {first.width} names of columns above {self._at(first)}, which "
            f"has {first.width} cells, got {rows[data - 1].width} in {self._at(rows[data - 1])}"
        )

    def _are_units(self, row: _Row, above: _Row, numeric: Sequence[int]) -> bool:
        """Whether a row has the units of the names above it."""
        names = above.cells or []
        units = row.cells or []
        if len(names) != len(units) or self._values_in(above, numeric):
            return False
        if len(numeric) and self._is_data(row, numeric):
            return False
        if any(unit.strip() and not name.strip() for name, unit in zip(names, units, strict=True)):
            return False
        if any(Header.parse(name, 0).times for name in names):
            return not any(Header.parse(unit, 0).times and unit.strip() != "t" for unit in units)
        if any(Header.parse(unit, 0).times for unit in units):
            return False
        return all(_is_unit(unit.strip()) for unit in units)

    def _check_widths(self, width: int, between: Sequence[_Row]) -> None:
        """Refuse rows of another width than the names have."""
        for row in (*between, *self._rows):
            if row.cells is None:
                raise UsageError(
                    f"{self.label}: {self._at(row)} cannot be split: text beside quotes, or a cell "
                    "that spans several lines"
                )
            if len(row.cells) != width:
                hint = "; quote a cell that contains the separator" if row.width > width else ""
                raise UsageError(
                    f"{self.label}, {self._at(row)}: expected {width} cells, got {row.width}{hint}"
                )

    def _likely_decimal(self, separator: str | None, numeric: Sequence[int], *, texts: bool) -> str:
        """Return the decimal sign: a comma where it is in numbers, and no point is.

        Raises
        ------
        UsageError
            If it may separate thousands.
        """
        if separator == ",":
            return "."
        commas: list[str] = []
        for row in self._rows:
            cells = row.cells or []
            for cell in cells if texts else [cells[place] for place in numeric]:
                if "," in cell or "." in cell:
                    number = cell.strip()
                    if is_number(number):
                        return "."
                    if is_number(number.replace(",", ".", 1)):
                        commas.append(number)
        if not commas:
            return "."
        if all(map(_THOUSANDS.fullmatch, commas)):
            raise UsageError(
                f"{self.label}: expected commas that are decimal signs or separate thousands, got "
                'three digits behind each; decimal = "," reads them as decimal signs'
            )
        return ","

    # what is told

    def place_of(self, number: int) -> str:
        """Return how a row is named by its number."""
        return f"{self._unit} {number}"

    def _at(self, row: _Row) -> str:
        return self.place_of(row.number)

    def place(self, row: int) -> str:
        return self._at(self._rows[row])

    def _tell(self, sheet: _Sheet, form: TableForm, names: _Row, units: _Row | None) -> None:
        """Note what was found."""
        if sheet.separator is not None:
            name = _NAMES.get(sheet.separator, sheet.separator)
            reason = _reason(form.separator, "splits the lines into equally many cells")
            self.reading.append(Reading("separator", name, reason, "separator"))
        reason = "as in its numbers" if self._decimal == "," else "no number has a comma"
        if sheet.separator == ",":
            reason = "as commas separate columns"
        reason = _reason(form.decimal, reason)
        self.reading.append(Reading("decimal sign", self._decimal, reason, "decimal"))
        if sheet.comments:
            found = f"{len(sheet.comments)} {sheet.unit}s"
            reason = f"begin with {form.comment or COMMENT}"
            self.reading.append(Reading("comments", found, reason, "comment"))
        reason = _reason(form.skip, "above the first row of numbers")
        self.reading.append(Reading("names", self._at(names), reason, "skip"))
        codes = ", ".join(["empty cells, NaN", *map(str, form.missing)])
        reason = "given" if form.missing else "the default"
        self.reading.append(Reading("not measured", codes, reason, "missing"))
        if sheet.rows and sheet.rows[0].number < names.number:
            found = f"{sheet.unit}s {sheet.rows[0].number} to {names.number - 1}"
            self.reading.append(Reading("left out", found, "above the names", "skip"))
        if units is not None:
            reason = "units below the names"
            self.reading.append(Reading("units", self._at(units), reason, "unit"))

    def _take_headers(self, names: Sequence[str], units: Sequence[str] | None) -> None:
        for position, text in enumerate(names):
            header = Header.parse(text, position)
            unit = units[position].strip().strip("[]()").strip() if units is not None else ""
            self.headers.append(_with_unit(self.label, header, unit, "the row of units"))

    def _classify(self) -> None:
        """Find out which columns have numbers and which dates, by their first cells."""
        if self.headers and not self.headers[0].text:  # so pandas writes an index without a name
            self.index = {0}
        for header in self.headers:
            position = header.position
            cells = ((row.cells or [""])[position].strip() for row in self._rows)
            first = next((cell for cell in cells if cell not in self._gaps), "")
            if is_number(first.replace(",", ".")):
                self.numbers.add(position)
            elif nanoseconds(first) is not None:
                self.stamps.add(position)

    # cells

    def texts(self, position: int) -> list[str]:
        """Return the cells of a column, numbers with decimal points."""
        cells = [(row.cells or [])[position].strip() for row in self._rows]
        if self._decimal == ",":
            points = [cell.replace(",", ".") for cell in cells]
            pairs = zip(cells, points, strict=True)
            cells = [point if is_number(point) else cell for cell, point in pairs]
        return cells

    def times(self, position: int) -> list[Decimal]:
        cells = [(row.cells or [])[position].strip() for row in self._rows]
        stamps: list[Decimal] = []
        for row, cell in enumerate(cells):
            stamp = nanoseconds(cell) if position in self.stamps else None
            if stamp is None:
                if position in self.stamps and cell not in self._gaps:
                    raise UsageError(
                        f"{self._cell(row, position)}: expected a date or duration as in the rows "
                        "before, got other text"
                    )
                number = self._number(row, position, cell)
                if number == "nan":
                    raise UsageError(
                        f"{self._cell(row, position)}: expected a time, got an empty cell"
                    )
                stamp = Decimal(number)
            stamps.append(stamp)
        return stamps

    def values(self, position: int) -> Vector:
        numbers = []
        for row, line in enumerate(self._rows):
            numbers.append(self._number(row, position, (line.cells or [])[position].strip()))
        values = np.array(list(map(float, numbers)))
        self._refuse_infinite(values, self._column(position))
        return values

    def _number(self, row: int, position: int, cell: str) -> str:
        """Return a number as Python writes it; "nan": nothing was measured."""
        if cell in self._gaps:
            return "nan"
        number = cell
        if self._decimal == ",":
            number = cell.replace(",", ".") if "." not in cell else ""
        if number and is_number(number):
            return "nan" if math.isnan(float(number)) else number
        way_out = ""
        if is_number(cell.replace(",", ".")):
            other = "," if self._decimal == "." else "."
            way_out = f'; the decimal separator is {self._decimal!r}, see decimal = "{other}"'
        raise UsageError(
            f"{self._cell(row, position)}: expected a number or an empty cell, got text{way_out}"
        )

    def _column(self, position: int) -> str:
        return f"{position + 1} ({self.headers[position].text!r})"

    def _cell(self, row: int, position: int) -> str:
        return f"{self.label}, {self.place(row)}, column {self._column(position)}"


def _reason(given: object, found: str) -> str:
    return "given" if given is not None else found


def _usual_width(rows: Sequence[_Row]) -> int:
    """Return how many cells most rows at the end have."""
    widths = Counter(row.width for row in rows[-_SAMPLE:] if row.cells is not None)
    return widths.most_common(1)[0][0] if widths else 0


def _is_unit(text: str) -> bool:
    is_marked = len(text) > 1 and text[0] + text[-1] in ("[]", "()")
    return not text or text in NO_UNIT or is_marked or base_unit(text) is not None


def _with_unit(label: str, header: Header, unit: str, source: str) -> Header:
    """Return a column with the unit that is declared beside its name."""
    if not unit:
        return header
    unit = "1" if unit in NO_UNIT else unit
    if header.unit not in (None, unit):
        raise UsageError(
            f"{label}, column {header.text!r}: expected one unit, got {header.unit!r} in its name "
            f"and {unit!r} in {source}"
        )
    return replace(header, unit=unit)


# --- text ---


def _text_table(path: Path, form: TableForm, *, texts: bool) -> TextTable:
    label = f"file {str(path)!r}"
    if form.decimal not in (None, ".", ","):
        raise UsageError(f'decimal: expected "." or ",", got {form.decimal!r}')
    text, encoding = _decoded(path, label)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    mark = form.comment
    if mark is None:
        mark = "" if form.separator == COMMENT else COMMENT
    kept: list[tuple[int, str]] = []
    comments: list[tuple[int, str]] = []
    for number, line in enumerate(lines[form.skip or 0 :], start=1 + (form.skip or 0)):
        if mark and line.lstrip().startswith(mark):
            comments.append((number, line.lstrip()[len(mark) :]))
        elif line.strip():
            kept.append((number, line))
    separator = form.separator
    if separator is None:
        separator = _likely_separator([line for _, line in kept])
    forbidden = f'{form.decimal or "."}"\r\n0123456789'
    if len(separator) != 1 or separator in forbidden:
        raise UsageError(
            f"separator: expected one character other than the decimal separator "
            f"{form.decimal or '.'!r}, got {separator!r}"
        )
    if texts:
        rows = list(_long_rows(kept, separator))
    else:
        rows = [_Row(number, _cells(line, separator)) for number, line in kept]
        # of a row of separators nothing can be said but that it is empty
        rows = [row for row in rows if row.cells is None or any(map(str.strip, row.cells))]
    noted = [_Row(number, _cells(line, separator)) for number, line in comments]
    table = TextTable(path, form, _Sheet(rows, noted, separator=separator), texts=texts)
    if encoding != "utf-8":
        table.reading.insert(0, Reading("encoding", encoding.upper(), "by its first bytes", ""))
    return table


def _decoded(path: Path, label: str) -> tuple[str, str]:
    """Return a text and its encoding: UTF-8, or UTF-16 by its mark or its zeros."""
    content = _content(path)
    encoding = "utf-8"
    for mark, name in _MARKS:
        if content.startswith(mark):
            content = content[len(mark) :]
            encoding = name
            break
    else:
        if len(content) % 2 == 0 and content[:4].count(0) == 2:
            encoding = {0: "utf-16-be", 1: "utf-16-le"}.get(content.index(0), encoding)
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        # not "from error": that one holds the content
        raise UsageError(
            f"{label}: expected UTF-8 or UTF-16 text, got another encoding (byte {error.start}); "
            "save it as UTF-8"
        ) from None
    if "\0" in text:
        raise UsageError(f"{label}: expected UTF-8 or UTF-16 text, got a NUL character")
    return text, encoding


def _likely_separator(lines: Sequence[str]) -> str:
    """Return the separator that splits most lines into equally many cells, at least two."""
    sample = lines[:_SAMPLE] + lines[max(_SAMPLE, len(lines) - _SAMPLE) :]
    plain = [re.sub('"[^"]*"', "", line) for line in sample]
    best = ","
    most = 0
    for separator in _SEPARATORS:
        counts = Counter(line.count(separator) for line in plain)
        if counts:
            cells, agreeing = counts.most_common(1)[0]
            if cells and agreeing > most:
                best = separator
                most = agreeing
    return best


def _cells(line: str, separator: str) -> list[str] | None:
    """Split a line; None: it cannot be split, because of its quotes or a cell beyond all size."""
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator, strict=True), [])
    except csv.Error:
        return None


def _long_rows(lines: Sequence[tuple[int, str]], separator: str) -> Iterator[_Row]:
    """Yield rows whose cells may span several lines, between quotes."""
    begin = 0
    text = ""
    for number, line in lines:
        begin = begin if text else number
        text = f"{text}\n{line}" if text else line
        if text.count('"') % 2 == 0:
            rows = csv.reader(text.splitlines(keepends=True), delimiter=separator, strict=True)
            try:
                yield _Row(begin, next(rows, []))
            except csv.Error:
                yield _Row(begin, None)
            text = ""
    if text:
        yield _Row(begin, None)


# --- Excel ---


def _excel_table(path: Path, form: TableForm, *, texts: bool) -> TextTable:
    label = f"file {str(path)!r}"
    try:
        import openpyxl
        from openpyxl.utils.exceptions import InvalidFileException
    except ImportError as error:
        raise UsageError(
            f"{label}: reading Excel requires openpyxl: pip install 'cosim[excel]', or save the "
            "table as CSV"
        ) from error
    content = _content(path)
    try:
        book = openpyxl.load_workbook(BytesIO(content), read_only=True, data_only=True)
        sheets = {}
        for sheet in book.worksheets:
            if form.sheet in (None, sheet.title):
                sheets[sheet.title] = [
                    [_cell_text(cell) for cell in row] for row in sheet.iter_rows(values_only=True)
                ]
        names = book.sheetnames
    except (InvalidFileException, zipfile.BadZipFile, KeyError, ValueError, OSError) as error:
        raise UsageError(f"{label}: not a valid Excel file (.xlsx)") from error
    if form.sheet is not None and not sheets:
        raise UsageError(f"{label} has no sheet {form.sheet!r}; {nearest(form.sheet, names)}")
    filled = {name: rows for name, rows in sheets.items() if any(map(any, rows))}
    if len(filled) > 1:
        raise UsageError(
            f"{label}: expected one sheet with cells, got {listing(list(filled))}; select one by "
            "sheet"
        )
    rows = []
    comments = []
    mark = form.comment or COMMENT
    skip = form.skip or 0
    for _, of_sheet in list(filled.items())[:1]:
        width = max(place + 1 for row in of_sheet for place, cell in enumerate(row) if cell)
        for number, cells in enumerate(of_sheet[skip:], start=1 + skip):
            row = _Row(number, cells[:width] + [""] * (width - len(cells)))
            if cells and cells[0].startswith(mark) and not any(cells[1:]):
                comments.append(row)
            elif any(cells):
                rows.append(row)
    table = TextTable(path, form, _Sheet(rows, comments, "row"), texts=texts)
    reason = _reason(form.sheet, "the only one with cells")
    table.reading.insert(0, Reading("sheet", ", ".join(filled), reason, "sheet"))
    return table


def _cell_text(cell: object) -> str:
    """Return the value of a cell as a text table has it."""
    match cell:
        case None:
            return ""
        case timedelta():
            seconds = cell.seconds + Decimal(cell.microseconds) / 1_000_000
            minutes, rest = divmod(seconds, 60)
            hours, minutes = divmod(int(minutes), 60)
            return f"{cell.days} days {hours:02}:{minutes:02}:{rest:09.6f}"
        case datetime():
            return cell.isoformat(sep=" ")
        case date():
            return cell.isoformat()
        case float():
            return repr(cell)
        case _:
            return str(cell).strip()


# --- Parquet ---


class ParquetTable(Table):
    """A Parquet file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError as error:
            raise UsageError(
                f"{self.label}: reading Parquet requires pyarrow: pip install 'cosim[parquet]', "
                "or save the table as CSV"
            ) from error
        self._arrow = pyarrow
        content = _content(path)
        with self._only_parquet():
            self._file = pyarrow.parquet.ParquetFile(pyarrow.BufferReader(content))
            self._schema = self._file.schema_arrow
            self._names: list[str] = list(self._schema.names)
            rows = self._file.metadata.num_rows
        types = pyarrow.types
        for position, column in enumerate(self._schema.types):
            if types.is_timestamp(column) or types.is_duration(column):
                self.stamps.add(position)
            elif types.is_integer(column) or types.is_floating(column):
                self.numbers.add(position)
        entries = self._pandas_index()
        self.index = {position for position, name in enumerate(self._names) if name in entries}
        # pandas keeps an index of evenly spaced integers, row numbers or others, only there
        self._ranges: dict[int, range] = {}
        for entry in entries:
            if isinstance(entry, dict) and isinstance(entry.get("name"), str):
                with suppress(KeyError, TypeError, ValueError, OverflowError):  # of another tool
                    numbers = range(entry["start"], entry["stop"], entry["step"])
                    header = Header.parse(entry["name"], 0)
                    named = header.times is not None or header.time_unit is not None
                    if len(numbers) == rows and (named or numbers.step > 1):
                        self._ranges[len(self._names)] = numbers
                        self._names.append(entry["name"])
        self.index |= self._ranges.keys()
        if rows * max(1, len(self._names)) * _BYTES > LARGEST:
            raise UsageError(
                f"{self.label}: expected at most {LARGEST // _BYTES} numbers, got {rows} rows of "
                f"{len(self._names)} columns"
            )
        units = self._declared_units()
        for position, name in enumerate(self._names):
            header = Header.parse(name, position)
            unit = units.get(position, "")
            self.headers.append(_with_unit(self.label, header, unit, "its metadata"))

    @contextmanager
    def _only_parquet(self) -> Iterator[None]:
        try:
            yield
        except (self._arrow.ArrowException, OSError, UnicodeDecodeError) as error:
            raise UsageError(f"{self.label}: not a valid Parquet file") from error

    def _pandas_index(self) -> list[Any]:
        """Return what pandas wrote of the index: names of columns, and what makes a range."""
        written = (self._schema.metadata or {}).get(b"pandas", b"null")
        try:
            return list(json.loads(written)["index_columns"])
        except (ValueError, KeyError, TypeError, RecursionError):
            return []  # of another tool

    def _declared_units(self) -> dict[int, str]:
        units = {}
        for position, column in enumerate(self._schema):
            unit = (column.metadata or {}).get(b"unit", b"").decode("utf-8", "replace").strip()
            if unit:
                units[position] = unit
        return units

    def stamp_unit(self, position: int) -> str | None:
        if position not in self.stamps:
            return None
        return str(self._schema.field(position).type.unit)

    def times(self, position: int) -> list[Decimal]:
        stamps = []
        for row, stamp in enumerate(self._column(position, is_time=True)):
            if stamp is None or stamp != stamp:
                raise UsageError(f"{self.label}, {self.place(row)}: expected a time, got none")
            stamps.append(Decimal(repr(stamp)))
        return stamps

    def values(self, position: int) -> Vector:
        column = self._column(position)
        values = np.array([NAN if value is None else float(value) for value in column])
        self._refuse_infinite(values, repr(self._names[position]))
        return values

    def _column(self, position: int, *, is_time: bool = False) -> list[Any]:
        """Return the numbers of a column, None where there is none."""
        if position in self._ranges:
            return list(self._ranges[position])
        is_stamp = is_time and position in self.stamps
        if not is_stamp and position not in self.numbers:
            raise UsageError(
                f"{self.label}: column {self._names[position]!r}: expected numbers, got type "
                f"{self._schema.field(position).type}"
            )
        with self._only_parquet():
            column = self._file.read(columns=[self._names[position]]).column(0)
            numbers: list[Any] = (column.cast("int64") if is_stamp else column).to_pylist()
        return numbers


# --- MAT-files ---

_UNIT: Final = re.compile(r".*\[(?P<unit>[^\[\]|]+)(?:\|[^\[\]]*)?\]\s*", re.DOTALL)


class MatTable(Table):
    """A MAT-file: a trajectory of Dymola or OpenModelica, a converted log, or columns of numbers.

    A trajectory has two rows at each event; the later one counts.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        variables = read_variables(self.label, _content(path))
        self._columns: list[Vector] = []
        if {"Aclass", "name", "dataInfo"} <= variables.keys():
            form = "a trajectory of Dymola or OpenModelica"
            self.same_time = "last"
            with self._only_trajectories():
                self._take_trajectory(variables)
        elif getattr(variables.get("signals"), "dtype", np.dtype(float)).names:
            form = "a log that cosim converted"
            with self._only_trajectories():
                self._take_log(variables)
        else:
            form = "columns of equally many numbers"
            self._take_columns(variables)
        self.reading.append(Reading("variables", form, "by their names and sizes", ""))
        self.numbers = set(range(len(self._columns)))

    @contextmanager
    def _only_trajectories(self) -> Iterator[None]:
        try:
            yield
        except (KeyError, IndexError, ValueError, TypeError) as error:
            raise UsageError(f"{self.label}: a damaged trajectory: {error}") from error

    def _add(self, name: str, unit: str, values: Vector) -> None:
        position = len(self._columns)
        if len(values) != len(self._columns[0] if self._columns else values):
            raise UsageError(
                f"{self.label}, {name!r}: expected {len(self._columns[0])} rows, got {len(values)}"
            )
        header = Header(name, name, None, position)
        self.headers.append(_with_unit(self.label, header, unit, "its description"))
        self._columns.append(np.asarray(values, np.float64))

    def _take_trajectory(self, variables: Mapping[str, Any]) -> None:
        """Take the variables of a simulation; parameters have one value."""
        is_transposed = _texts(variables["Aclass"])[3] == "binTrans"
        names, described = [
            _texts(variables[key].T if is_transposed else variables[key])
            for key in ("name", "description")
        ]
        info = np.asarray(variables["dataInfo"])
        info = info.T if is_transposed else info
        blocks = {}
        for key, block in variables.items():
            if re.fullmatch(r"data_\d+", key):
                blocks[int(key[5:])] = block.T if is_transposed else block
        rows = max(blocks.items(), key=lambda item: item[0] != 1)[1]
        for name, text, (block, column, *_) in zip(names, described, info.tolist(), strict=True):
            unit = _UNIT.fullmatch(text)
            if block == 0:  # the abscissa of all
                values = rows[:, 0]
            else:
                values = blocks[block][:, abs(column) - 1]
                if len(values) != len(rows) and (values == values[0]).all():
                    values = np.full(len(rows), values[0])
            sign = -1.0 if column < 0 else 1.0
            self._add(name, unit["unit"].strip() if unit else "", sign * values)

    def _take_log(self, variables: Mapping[str, Any]) -> None:
        """Take what ``cosim convert`` wrote, at every time that a component has a row."""
        signals = []
        for entry in np.ravel(variables["signals"]):
            keys = ("name", "variable", "time", "unit")
            signals.append({key: "".join(np.ravel(entry[key])) for key in keys})
        clocks = {signal["time"]: np.ravel(variables[signal["time"]]) for signal in signals}
        t = np.unique(np.concatenate(list(clocks.values())))
        self._add("time", "s", t)
        for signal in signals:
            block = np.asarray(variables[signal["variable"]], np.float64)
            spread = np.full((len(t), block.shape[1]), NAN)
            spread[np.searchsorted(t, clocks[signal["time"]])] = block
            self._take_block(signal["name"], signal["unit"], spread)

    def _take_block(self, name: str, unit: str, block: Matrix) -> None:
        """Take the columns of a matrix as elements of a vector."""
        for column in range(block.shape[1]):
            element = name if block.shape[1] == 1 else f"{name}[{column}]"
            self._add(element, unit, block[:, column])

    def _take_columns(self, variables: Mapping[str, Any]) -> None:
        """Take the variables that have as many rows as most of them."""
        blocks = {}
        for name, value in variables.items():
            if isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.ndim == 2:
                blocks[name] = value.T if value.shape[0] == 1 else value
        counts = Counter(len(block) for block in blocks.values() if len(block) > 1)
        rows = counts.most_common(1)[0][0] if counts else 0
        for name, block in blocks.items():
            if len(block) == rows:
                self._take_block(name, "", block)

    def times(self, position: int) -> list[Decimal]:
        return [Decimal(repr(t)) for t in self._columns[position].tolist()]

    def values(self, position: int) -> Vector:
        self._refuse_infinite(self._columns[position], repr(self.headers[position].text))
        return self._columns[position]


def _texts(characters: Any) -> list[str]:
    """Return the rows of a matrix of characters."""
    return ["".join(row).strip("\0 ") for row in characters.tolist()]
