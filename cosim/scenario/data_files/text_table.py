"""Tables of cells: text of many forms, and sheets of Excel.

Of a text the separator, the decimal sign, what stands before the names of the columns and a row of
units below them are found, unless they are given; of Excel all but the separator. Then both are
the same rows of cells.
"""

from __future__ import annotations

import codecs
import csv
import math
import re
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from io import BytesIO, StringIO
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError, listing, nearest
from cosim.filters import ignored_warnings
from cosim.instants import NANOSECONDS
from cosim.scenario.data_files.headers import NO_UNIT, Header, is_number, is_time_word
from cosim.scenario.data_files.table import LARGEST, DataTable, TableForm, content_of
from cosim.units import base_unit

MOST_COLUMNS: Final = 100_000
COMMENT: Final = "#"
_SEPARATORS: Final = ("\t", ";", "|", ",")
_NAMES: Final = {"\t": "tab", " ": "blank"}
_SAMPLE: Final = 50  # lines at each end that show how a file is made
_THOUSANDS: Final = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+", re.ASCII)
_DURATION: Final = re.compile(
    r"(?:(?P<days>-?\d{1,9}) days?)?\s*(?:\+?(?P<h>\d{1,9}):(?P<min>\d\d):(?P<s>\d\d(?:\.\d+)?))?"
)
_DATE: Final = re.compile(
    r"(?P<day>\d{4}-\d\d-\d\d)(?:[T ](?P<time>\d\d:\d\d(?::\d\d)?)(?:[.,](?P<fraction>\d+))?"
    r" ?(?P<zone>Z|UTC|[+-]\d\d(?::?\d\d)?)?)?"
)
_LIKE_A_DATE: Final = re.compile(
    r"(\d{4}[-./]\d\d?[-./]\d\d?|\d\d?[-./]\d\d?[-./]\d{4})"
    r"([T ,]*\d\d?:\d\d(:\d\d([.,]\d+)?)?)?( ?([AP]M|[A-Z]{1,4}|[+-]\d\d:?\d\d))?",
    re.ASCII | re.IGNORECASE,
)
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def nanoseconds(text: str) -> Decimal | None:
    """Return a duration, or a date since 1970, in ns, with all its digits; None: it is neither."""
    day = _DATE.fullmatch(text)
    if day is not None:
        try:
            instant = datetime.fromisoformat(
                f"{day['day']}T{day['time'] or '00:00'}{(day['zone'] or 'Z').replace('UTC', 'Z')}"
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


def _is_stamp(cell: str) -> bool:
    """Return whether a cell is a date, of ISO 8601 or not, or a duration."""
    return nanoseconds(cell) is not None or _LIKE_A_DATE.fullmatch(cell) is not None


# --- rows of cells ---


@dataclass(slots=True)
class _Row:
    """A row of cells and its number from 1; without cells: the line cannot be split."""

    number: int
    cells: list[str]

    @property
    def width(self) -> int:
        return len(self.cells)


@dataclass(frozen=True, slots=True)
class _Sheet:
    """The rows of a file, comments apart; ``unit`` names a row in messages."""

    rows: list[_Row]
    comments: list[_Row]
    unit: str = "line"
    separator: str | None = None


class TextTable(DataTable):
    """Names of columns, and rows of cells below them.

    ``is_text``: the cells need not be numbers, and there are no units.
    """

    def __init__(self, path: Path, form: TableForm, sheet: _Sheet, *, is_text: bool) -> None:
        super().__init__(path)
        self._unit = sheet.unit
        self._gaps = form.missing_texts | {""}
        self._separator = sheet.separator
        if sheet.separator is not None:
            self.hint = f" (separated by {sheet.separator!r})"
            last = sheet.rows[-1].cells[:1] if sheet.rows else []
            aligned = [part for cell in last for part in cell.split(" ") if part]
            if len(aligned) > 1 and all(map(is_number, aligned)):
                self.hint += '; separator = " " splits at blanks'
        widths = Counter(row.width for row in sheet.rows[-_SAMPLE:] if row.cells)
        width = max(widths, key=lambda width: widths[width], default=0)
        if width > MOST_COLUMNS:
            raise UsageError(f"{self.label}: expected at most {MOST_COLUMNS} columns, got {width}")
        wide = [row.cells for row in sheet.rows if row.width == width]
        if width and not is_text and not any(cells[-1].strip() for cells in wide):
            for cells in wide:  # a separator at the end of each line
                del cells[-1]
            width -= 1
        self._numeric = self._columns_of_numbers(sheet.rows, width)
        if is_text or form.skip is not None:
            above, data = self._given_names(sheet.rows, form, width, is_text=is_text)
        else:
            above, data = self._found_names(sheet, width)
        names = above[-1] if above else _Row(1, [])
        units = None
        if len(above) > 1 and self._are_units(above[-1], above[-2]):
            names = above[-2]
            units = above[-1]
        self._rows = sheet.rows[data:]
        self._check_widths([row for row in sheet.rows[:data] if row.number > names.number], names)
        self._check_widths(self._rows, names)
        if self._rows and names.width > 1 and not (self._numeric or is_text):
            raise UsageError(f"{self.label}: expected rows of numbers, got text")
        self._decimal = form.decimal or self._likely_decimal(sheet.separator, is_text=is_text)
        self._tell(sheet, form, names, units)
        self._take_headers(names, units)
        if not is_text:
            self._classify()

    # what stands where

    def _is_value(self, cell: str) -> bool:
        cell = cell.strip()
        return _is_stamp(cell) or is_number(cell.replace(",", "."))

    def _columns_of_numbers(self, rows: Sequence[_Row], width: int) -> list[int]:
        """Return the columns that have numbers or times in the last rows."""
        found: set[int] = set()
        for row in rows[-_SAMPLE:]:
            if row.width == width:
                found |= {place for place, cell in enumerate(row.cells) if self._is_value(cell)}
        return sorted(found)

    def _values_in(self, row: _Row) -> list[int]:
        """Return the columns of numbers that have one in a row."""
        cells = row.cells
        return [
            place for place in self._numeric if place < len(cells) and self._is_value(cells[place])
        ]

    def _is_data(self, row: _Row) -> bool:
        """Whether a row has numbers where the last rows have them, and no text before them."""
        values = self._values_in(row)
        first = self._numeric[0] if self._numeric else 0
        return bool(values) and (values[0] == first or row.cells[first].strip() in self._gaps)

    def _given_names(
        self, rows: Sequence[_Row], form: TableForm, width: int, *, is_text: bool
    ) -> tuple[list[_Row], int]:
        """Return the row of the names, with what may be units below it, and where the data begin.

        The names are in the first row that is not skipped or, of texts, has as many cells as those
        below.
        """
        first = 0
        if form.skip is None:
            wide = [place for place, row in enumerate(rows) if row.width == width]
            if self._separator is None:  # the rows of a sheet are filled up
                wide = [place for place in wide if rows[place].cells[-1].strip()] or wide
            first = wide[0] if wide else 0
        above = list(rows[first : first + 2])
        if len(above) > 1 and (is_text or not self._are_units(above[1], above[0])):
            del above[1]
        return above, first + len(above)

    def _found_names(self, sheet: _Sheet, width: int) -> tuple[list[_Row], int]:
        """Return the rows above the first row of numbers that are as wide, and where that is.

        Raises
        ------
        UsageError
            If there are none, a row has names and numbers, or there are numbers above the names.
        """
        rows = sheet.rows
        above: list[_Row] = []
        data = len(rows)
        for place, row in enumerate(rows):
            if row.width == width:
                if self._is_data(row):
                    data = place
                    break
                above.append(row)
        if not self._numeric and above:
            return above[:1], rows.index(above[0]) + 1
        if not above and data < len(rows):
            return self._commented(sheet, data), data
        for row in rows[:data]:
            begins_so = row.width > 1 and self._is_value(row.cells[0])
            if begins_so and row.number < above[-1].number:
                raise UsageError(
                    f"{self.label}, {self._at(row)}: expected no row of numbers above the names of "
                    f"the columns, in {self._at(above[-1])}; skip = "
                    f"{above[-1].number - 1} reads the table that begins there"
                )
        if len(above) > 1 and self._values_in(above[-1]):
            raise UsageError(
                f"{self.label}, {self._at(above[-1])}: expected names of columns or numbers, "
                f"got both; skip = {above[-1].number - 1} reads names there"
            )
        return above, data

    def _commented(self, sheet: _Sheet, data: int) -> list[_Row]:
        """Return the comments above the first row that are as wide: numpy writes names so.

        Raises
        ------
        UsageError
            If there are none.
        """
        first = sheet.rows[data]
        if data:
            before = sheet.rows[data - 1]
            raise UsageError(
                f"{self.label}: expected {first.width} names of columns above {self._at(first)}, "
                f"which has {first.width} cells, got {before.width} in {self._at(before)}"
            )
        above = [row for row in sheet.comments if row.number < first.number]
        above = above if above and above[-1].width == first.width else []
        if not above:
            raise UsageError(
                f"{self.label}: expected column names in {self._at(first)}, got numbers; skip says "
                "how many lines stand before the names"
            )
        return above

    def _are_units(self, row: _Row, above: _Row) -> bool:
        """Whether a row has the units of the names above it."""
        units = [unit.strip() for unit in row.cells]
        named = list(zip(above.cells, units, strict=False))
        is_beside = row.width == above.width and all(name.strip() for name, unit in named if unit)
        if not is_beside or self._is_data(row) or any(map(_is_stamp, above.cells)):
            return False
        if any(Header.parse(name, 0).times for name in above.cells):  # then any text is a unit
            return not any(Header.parse(unit, 0).times and unit != "t" for unit in units)
        if self._values_in(above):
            return False
        if any(map(is_time_word, units)):  # German words begin with a capital: Bar
            units = [unit if is_unit(unit) else unit.lower() for unit in units]
        return all(map(is_unit, units)) and not any(Header.parse(unit, 0).times for unit in units)

    def _check_widths(self, rows: Sequence[_Row], names: _Row) -> None:
        """Refuse rows of another width than the names have."""
        for row in rows:
            if not row.cells:
                raise UsageError(
                    f"{self.label}: {self._at(row)} cannot be split: text beside quotes, or a cell "
                    "that spans several lines"
                )
            if row.width != names.width:
                hint = (
                    "; quote a cell that contains the separator" if row.width > names.width else ""
                )
                raise UsageError(
                    f"{self.label}, {self._at(row)}: expected {names.width} cells, got {row.width}"
                    f"{hint}"
                )

    def _likely_decimal(self, separator: str | None, *, is_text: bool) -> str:
        """Return the decimal sign: a comma where it is in numbers, and no point is.

        Raises
        ------
        UsageError
            If it may separate thousands.
        """
        if separator == ",":
            return "."
        commas: list[str] = []
        columns = range(self._rows[0].width) if is_text and self._rows else self._numeric
        for number in chain.from_iterable(map(self._stripped, columns)):
            if "." in number and is_number(number):
                return "."
            if "," in number and is_number(number.replace(",", ".", 1)):
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

    def _at(self, row: _Row) -> str:
        return f"{self._unit} {row.number}"

    def place(self, row: int) -> str:
        """Return the line, or the row of the sheet."""
        return self._at(self._rows[row])

    def _tell(self, sheet: _Sheet, form: TableForm, names: _Row, units: _Row | None) -> None:
        """Note what was found."""
        if sheet.separator is not None:
            name = _NAMES.get(sheet.separator, sheet.separator)
            self.tell("separator", name, "splits the lines equally", "separator", form.separator)
        reason = "as in its numbers" if self._decimal == "," else "no number has a comma"
        if sheet.separator == ",":
            reason = "as commas separate columns"
        self.tell("decimal sign", self._decimal, reason, "decimal", form.decimal)
        if sheet.comments:
            found = f"{len(sheet.comments)} {sheet.unit}s"
            self.tell("comments", found, f"begin with {form.comment or COMMENT}", "comment")
        self.tell("names", self._at(names), "above the first row of numbers", "skip", form.skip)
        codes = ", ".join(["empty cells, NaN", *map(str, form.missing)])
        self.tell("not measured", codes, "the default", "missing", form.missing or None)
        if sheet.rows and sheet.rows[0].number < names.number:
            found = f"{sheet.unit}s {sheet.rows[0].number} to {names.number - 1}"
            self.tell("left out", found, "above the names", "skip")
        if units is not None:
            self.tell("units", self._at(units), "units below the names", "unit")

    def _take_headers(self, names: _Row, units: _Row | None) -> None:
        for position, text in enumerate(names.cells):
            header = Header.parse(text, position)
            unit = units.cells[position].strip().strip("[]()").strip() if units is not None else ""
            self._add_header(header, unit, "the row of units")

    def _classify(self) -> None:
        """Find out which columns have numbers and which dates, by their first cells."""
        if self.headers and not self.headers[0].text:  # so pandas writes an index without a name
            self.index = {0}
        for header in self.headers:
            position = header.position
            cells = (row.cells[position].strip() for row in self._rows)
            first = next((cell for cell in cells if cell not in self._gaps), "")
            if is_number(first.replace(",", ".")):
                self.numbers.add(position)
            elif nanoseconds(first) is not None:
                self.stamps.add(position)

    # cells

    def _stripped(self, position: int) -> list[str]:
        return [row.cells[position].strip() for row in self._rows]

    def texts(self, position: int) -> list[str]:
        """Return the cells of a column, numbers with decimal points."""
        cells = self._stripped(position)
        if self._decimal == ",":
            points = [cell.replace(",", ".") for cell in cells]
            pairs = zip(cells, points, strict=True)
            cells = [point if is_number(point) else cell for cell, point in pairs]
        return cells

    def times(self, position: int) -> list[Decimal]:
        """Return numbers, or the nanoseconds of dates and durations."""
        stamps: list[Decimal] = []
        column = self._column(position)
        for row, cell in enumerate(self._stripped(position)):
            stamp = nanoseconds(cell) if position in self.stamps else None
            if stamp is None:
                if _LIKE_A_DATE.fullmatch(cell):
                    raise UsageError(
                        f"{self._cell(row, column)}: expected a date of the calendar in ISO 8601 "
                        f"(YYYY-MM-DDThh:mm:ss), got {cell!r}; convert the column, such as by "
                        "pandas.to_datetime"
                    )
                if position in self.stamps and cell not in self._gaps:
                    raise UsageError(
                        f"{self._cell(row, column)}: expected a date or duration as in the rows "
                        "before, got other text"
                    )
                number = self._number(row, column, cell)
                if number == "nan":
                    raise UsageError(
                        f"{self._cell(row, column)}: expected a time, got an empty cell"
                    )
                stamp = Decimal(number)
            stamps.append(stamp)
        return stamps

    def values(self, position: int) -> Vector:
        """Return the numbers of a column; NaN in empty cells."""
        cells = enumerate(self._stripped(position))
        column = self._column(position)
        numbers = [self._number(row, column, cell) for row, cell in cells]
        values = np.array(list(map(float, numbers)))
        self._refuse_infinite(values, column)
        self._refuse_rounded(values, numbers, column)
        return values

    def _number(self, row: int, column: str, cell: str) -> str:
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
            if self._separator == ",":
                way_out += ', and separator = ","'
            if _THOUSANDS.fullmatch(cell):
                way_out += ", unless commas separate thousands"
        raise UsageError(
            f"{self._cell(row, column)}: expected a number or an empty cell, got text{way_out}"
        )

    def _column(self, position: int) -> str:
        return f"{position + 1} ({self.headers[position].text!r})"

    def _cell(self, row: int, column: str) -> str:
        return f"{self.label}, {self.place(row)}, column {column}"


def is_unit(text: str) -> bool:
    """Return whether a cell below a name is a unit, or none of its own."""
    is_marked = len(text) > 1 and text[0] + text[-1] in ("[]", "()")
    is_known = base_unit(text) is not None or is_time_word(text)
    return not text or text in NO_UNIT or is_marked or is_known


# --- text ---


def text_table(path: Path, form: TableForm, *, is_text: bool) -> TextTable:
    """Read a text; see :func:`cosim.scenario.data_files.tables.read_table`."""
    label = f"file {str(path)!r}"
    text, encoding = _decoded(path, label)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    mark = form.comment
    if mark is None:
        mark = "" if form.separator == COMMENT else COMMENT
    kept: list[tuple[int, str]] = []
    comments: list[tuple[int, str]] = []
    for number, line in enumerate(lines[form.skip or 0 :], start=1 + (form.skip or 0)):
        if mark and line.lstrip().startswith(mark):
            comments.append((number, line.lstrip()[len(mark) :].strip(" ")))
        elif line.strip():
            kept.append((number, line))
    separator = form.separator
    if separator is None:
        separator = _likely_separator([line for _, line in kept])
    is_quoted = separator == "," and any('"' in line for _, line in kept)
    forbidden = f'{"" if is_quoted else form.decimal or "."}"\r\n0123456789'
    if len(separator) != 1 or separator in forbidden:
        raise UsageError(
            f"separator: expected one character other than the decimal separator "
            f"{form.decimal or '.'!r}, got {separator!r}"
        )
    if is_text:
        rows = list(_long_rows(kept, separator))
    else:
        rows = [_Row(number, _cells(line, separator)) for number, line in kept]
        # of a row of separators nothing can be said but that it is empty
        rows = [row for row in rows if not row.cells or any(map(str.strip, row.cells))]
    noted = [_Row(number, _cells(line, separator)) for number, line in comments]
    table = TextTable(path, form, _Sheet(rows, noted, separator=separator), is_text=is_text)
    if encoding != "utf-8":
        table.tell("encoding", encoding.upper(), "by its first bytes", "")
    return table


def _decoded(path: Path, label: str) -> tuple[str, str]:
    """Return a text and its encoding: UTF-8, or UTF-16 by its mark or its zeros."""
    content = content_of(path)
    encoding = "utf-8"
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif len(content) % 2 == 0 and content[:4].count(0) == 2:
        encoding = {0: "utf-16-be", 1: "utf-16-le"}.get(content.index(0), encoding)
    try:
        text = content.decode(encoding).removeprefix("\ufeff")
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
    sample = [*lines[:_SAMPLE], *lines[max(_SAMPLE, len(lines) - _SAMPLE) :]]
    plain = [re.sub('"[^"]*"', "", line) for line in sample]
    agreeing: dict[str, int] = {}
    for separator in _SEPARATORS:
        for count, agree in Counter(line.count(separator) for line in plain).most_common(1):
            agreeing[separator] = agree if count else 0
    most = max(agreeing.values(), default=0)
    return next((name for name, agree in agreeing.items() if most and agree == most), ",")


def _cells(text: str, separator: str) -> list[str]:
    """Split a row; []: it cannot be split, because of its quotes or a cell beyond all size."""
    is_blank = separator == " "  # then columns may be aligned
    text = text.strip(" ") if is_blank else text
    if '"' not in text:
        return re.split(" +", text) if is_blank else text.split(separator)
    try:
        reader = csv.reader(
            StringIO(text), delimiter=separator, strict=True, skipinitialspace=is_blank
        )
        return next(reader, [])
    except csv.Error:
        return []


def _long_rows(lines: Sequence[tuple[int, str]], separator: str) -> Iterator[_Row]:
    """Yield rows whose cells may span several lines, between quotes."""
    pending: list[str] = []  # lines of a row whose last quote is open
    begin = 0
    for number, line in lines:
        begin = begin if pending else number
        is_closing = line.count('"') % 2 == (1 if pending else 0)
        pending.append(line)
        if is_closing:
            yield _Row(begin, _cells("\n".join(pending), separator))
            pending = []
    if pending:
        yield _Row(begin, [])


# --- Excel ---


def excel_table(path: Path, form: TableForm, *, is_text: bool) -> TextTable:
    """Read the sheet of a workbook, by openpyxl."""
    label = f"file {str(path)!r}"
    try:
        import openpyxl
    except ImportError as error:
        raise UsageError(
            f"{label}: reading Excel requires openpyxl: pip install 'cosim[excel]', or save the "
            "table as CSV"
        ) from error
    stream = BytesIO(content_of(path))
    try:
        with zipfile.ZipFile(stream) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > LARGEST:
            raise OverflowError
        with ignored_warnings():  # of styles and the like
            book = openpyxl.load_workbook(stream, read_only=True, data_only=True)
            sheets, empty = _cells_of(book, form)
            formulas = openpyxl.load_workbook(stream, read_only=True) if empty else book
            unknown = _formula_in(formulas, empty, form)
    except OverflowError:
        raise UsageError(f"{label}: expected at most {LARGEST} bytes of sheets, got more") from None
    except Exception as error:  # openpyxl raises whatever a damaged byte leads to
        raise UsageError(f"{label}: not a valid Excel file (.xlsx)") from error
    if form.sheet is not None and not sheets:
        raise UsageError(
            f"{label} has no sheet {form.sheet!r}; {nearest(form.sheet, book.sheetnames)}"
        )
    if unknown is not None:
        raise UsageError(
            f"{label}, {unknown}: expected a value, got a formula whose value is not in the "
            "file; open and save it in Excel or LibreOffice"
        )
    filled = {name: cells for name, cells in sheets.items() if any(map(any, cells))}
    if len(filled) > 1:
        raise UsageError(
            f"{label}: expected one sheet with cells, got {listing(list(filled))}; select one by "
            "sheet"
        )
    of_sheet = next(iter(filled.values()), [])
    table = TextTable(path, form, _sheet_of(of_sheet, form), is_text=is_text)
    table.tell("sheet", ", ".join(filled), "the only one with cells", "sheet", form.sheet)
    return table


def _cells_of(
    book: Any, form: TableForm
) -> tuple[dict[str, list[list[str]]], set[tuple[str, str]]]:
    """Return the cells of the sheets, and the places of those without a value."""
    sheets: dict[str, list[list[str]]] = {}
    empty: set[tuple[str, str]] = set()
    for sheet in book.worksheets:
        if form.sheet in (None, sheet.title):
            rows = sheets[sheet.title] = []
            for row in sheet.iter_rows():
                rows.append([_cell_text(cell.value) for cell in row])
                for cell in row:  # "str": the value of a formula is an empty text
                    is_empty = cell.value is None and cell.data_type != "str"
                    if is_empty and hasattr(cell, "coordinate"):  # else it is not in the file
                        empty.add((sheet.title, cell.coordinate))
    return sheets, empty


def _formula_in(book: Any, places: set[tuple[str, str]], form: TableForm) -> str | None:
    """Return the first of these places that has a formula, in rows that are not skipped."""
    for sheet in book.worksheets if places else ():
        for cell in chain.from_iterable(sheet.iter_rows(min_row=(form.skip or 0) + 1)):
            if cell.data_type == "f" and (sheet.title, cell.coordinate) in places:
                return f"sheet {sheet.title!r}, cell {cell.coordinate}"
    return None


def _sheet_of(cells: Sequence[list[str]], form: TableForm) -> _Sheet:
    """Return the rows of a sheet, all as wide as the widest; a comment stands alone in its row."""
    width = max((place + 1 for row in cells for place, cell in enumerate(row) if cell), default=0)
    mark = form.comment or COMMENT
    rows: list[_Row] = []
    comments: list[_Row] = []
    for number, row in enumerate(cells, start=1):
        padded = row[:width] + [""] * (width - len(row))
        if number <= (form.skip or 0) or not any(row):
            continue
        is_comment = padded[0].startswith(mark) and not any(padded[1:])
        (comments if is_comment else rows).append(_Row(number, padded))
    return _Sheet(rows, comments, "row")


def _cell_text(cell: object) -> str:
    """Return the value of a cell as a text table has it."""
    match cell:
        case None:
            return ""
        case timedelta():
            clock = datetime.min + timedelta(0, cell.seconds, cell.microseconds)
            return f"{cell.days} days {clock.time().isoformat('microseconds')}"
    return str(cell).strip()
