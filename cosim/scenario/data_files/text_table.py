"""Tables of cells: text of many forms, and sheets of Excel.

Of a text the separator, the decimal sign, what stands before the names of the columns and a row of
units below them are found, unless they are given; of Excel all but the separator. Then both are
the same rows of cells.
"""

from __future__ import annotations

import codecs
import csv
import re
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from io import BytesIO
from itertools import chain, islice, takewhile
from pathlib import Path
from typing import Any, Final, NamedTuple

from cosim.errors import UsageError, listing, nearest
from cosim.filters import ignored_warnings
from cosim.instants import NANOSECONDS
from cosim.scenario.data_files.table import (
    AS_FOUND,
    LARGEST,
    NO_UNIT,
    DataTable,
    Header,
    TableForm,
    content_of,
    is_number,
    is_time_word,
)
from cosim.units import base_unit

MOST_COLUMNS: Final = 100_000
_COMMENT: Final = "#"
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


def _is_value(cell: str) -> bool:
    """Return whether a cell is a number, a date or a duration."""
    cell = cell.strip()
    return is_number(cell.replace(",", ".")) or _is_stamp(cell)


def _is_unit(text: str) -> bool:
    """Return whether a cell below a name is a unit, or none of its own."""
    is_marked = len(text) > 1 and text[0] + text[-1] in ("[]", "()")
    is_known = base_unit(text) is not None or is_time_word(text)
    return not text or text in NO_UNIT or is_marked or is_known


# --- rows of cells ---


class CellRow(NamedTuple):
    """The number of a row, from 1, and its cells; none: the line cannot be split."""

    number: int
    cells: list[str]


@dataclass(frozen=True, slots=True)
class Sheet:
    """The rows of a file, comments apart; ``unit`` names a row in messages.

    ``source`` is what was found of the file itself, the arguments of :meth:`DataTable.tell`.
    """

    label: str
    rows: list[CellRow]
    comments: list[CellRow]
    source: tuple[Any, ...]
    unit: str = "line"
    separator: str | None = None

    def at(self, row: CellRow) -> str:
        """Return how messages name a row."""
        return f"{self.unit} {row.number}"

    @property
    def width(self) -> int:
        """How many cells most rows have."""
        widths = Counter(len(row.cells) for row in self.rows[-_SAMPLE:] if row.cells)
        width = max(widths, key=lambda width: widths[width], default=0)
        if width > MOST_COLUMNS:
            raise UsageError(f"{self.label}: expected at most {MOST_COLUMNS} columns, got {width}")
        return width

    def check_widths(self, names: CellRow, rows: Iterable[CellRow]) -> None:
        """Refuse rows of another width than the names have."""
        width = len(names.cells)
        for row in rows:
            found = len(row.cells)
            if not found:
                raise UsageError(
                    f"{self.label}: {self.at(row)} cannot be split: text beside quotes, or a cell "
                    "that spans several lines"
                )
            if found != width:
                hint = "; quote a cell that contains the separator" if found > width else ""
                raise UsageError(
                    f"{self.label}, {self.at(row)}: expected {width} cells, got {found}{hint}"
                )

    def decimal(self, columns: Iterable[Iterable[str]]) -> str:
        """Return the decimal sign of cells: a comma where it is in numbers, and no point is.

        Raises
        ------
        UsageError
            If it may separate thousands.
        """
        commas: list[str] = []
        for cell in chain.from_iterable(columns):
            if self.separator == "," or ("." in cell and is_number(cell)):
                return "."
            if "," in cell and is_number(cell.replace(",", ".", 1)):
                commas.append(cell)
        if commas and all(map(_THOUSANDS.fullmatch, commas)):
            raise UsageError(
                f"{self.label}: expected commas that are decimal signs or separate thousands, got "
                'three digits behind each; decimal = "," reads them as decimal signs'
            )
        return "," if commas else "."


def read_sheet(path: Path, form: TableForm, *, spanning: bool = False) -> Sheet:
    """Read the rows of a text, or of the sheet of a workbook; see :func:`text_sheet`."""
    if path.suffix.lower() in (".xlsx", ".xlsm"):
        return excel_sheet(path, form)
    return text_sheet(path, form, spanning=spanning)


def read_texts(path: Path) -> list[tuple[str, list[str]]]:
    """Read columns of texts, which may span several lines, by their names in the first row.

    Numbers have decimal points.

    Raises
    ------
    UsageError
        If the file cannot be read, is too large, is no table, or a library is missing.
    """
    sheet = read_sheet(path, AS_FOUND, spanning=True)
    width = sheet.width
    wide = [place for place, row in enumerate(sheet.rows) if len(row.cells) == width]
    if sheet.separator is None:  # the rows of a workbook are filled up
        wide = [place for place in wide if sheet.rows[place].cells[-1].strip()] or wide
    names, *rows = sheet.rows[wide[0] :] if wide else [CellRow(1, [])]
    sheet.check_widths(names, rows)
    columns = [[row.cells[place].strip() for row in rows] for place in range(len(names.cells))]
    if sheet.decimal(columns) == ",":
        columns = [list(map(_with_point, column)) for column in columns]
    return list(zip((name.strip() for name in names.cells), columns, strict=True))


def _with_point(cell: str) -> str:
    point = cell.replace(",", ".")
    return point if is_number(point) else cell


class TextTable(DataTable):
    """Names of columns, and rows of cells below them; texts of ``missing`` are empty cells."""

    def __init__(self, path: Path, form: TableForm, missing: Sequence[float | str] = ()) -> None:
        super().__init__(path)
        self._sheet = sheet = read_sheet(path, form)
        self._gaps = {"", *(code for code in missing if isinstance(code, str))}
        has_blanks = any(" " in cell.strip() for row in sheet.rows[-1:] for cell in row.cells)
        if sheet.separator not in (None, " ") and has_blanks:
            self.hint = f' (separated by {sheet.separator!r}; separator = " " splits at blanks)'
        width = self._trimmed_width()
        found: set[int] = set()
        for row in sheet.rows[-_SAMPLE:]:
            if len(row.cells) == width:
                found |= {place for place, cell in enumerate(row.cells) if _is_value(cell)}
        self._numeric = sorted(found)  # columns with numbers or times
        rows = sheet.rows if form.skip is not None else self._from_names(width)
        names, *self._rows = rows or [CellRow(1, [])]
        sheet.check_widths(names, self._rows)
        units = None
        if self._rows and self._numeric and self._are_units(self._rows[0], names):
            units = self._rows.pop(0)
        if self._rows and len(names.cells) > 1 and not self._numeric:
            raise UsageError(f"{self.label}: expected rows of numbers, got text")
        self._decimal = form.decimal or sheet.decimal(map(self._stripped, self._numeric))
        self._tell(form, missing, names, units)
        for position, text in enumerate(names.cells):
            unit = units.cells[position].strip().strip("[]()").strip() if units is not None else ""
            given = (cell for cell in self._stripped(position) if cell not in self._gaps)
            first = next(given, "")
            header = replace(
                Header.parse(text, position),
                is_number=is_number(first.replace(",", ".")),
                stamp_unit=None if nanoseconds(first) is None else "ns",
                is_index=not position and not text.strip(),  # so pandas writes one without a name
            )
            self.add_header(header, unit, "the row of units")

    # what stands where

    def _trimmed_width(self) -> int:
        """Return how many cells most rows have, without a separator at the end of each line."""
        width = self._sheet.width
        wide = [row.cells for row in self._sheet.rows if len(row.cells) == width]
        if not width or any(cells[-1].strip() for cells in wide):
            return width
        for cells in wide:
            del cells[-1]
        return width - 1

    def _from_names(self, width: int) -> list[CellRow]:
        """Return the row of the names, perhaps in a comment, as of numpy, and what is below it.

        Raises
        ------
        UsageError
            If there is none, it has numbers too, or there are numbers above the names.
        """
        sheet = self._sheet
        rows = sheet.rows
        wide = [row for row in rows if len(row.cells) == width]
        if not self._numeric:
            return rows[rows.index(wide[0]) :] if wide else rows
        first = next(filter(self._is_data, wide))
        above = wide[: wide.index(first)]
        if not above and rows[0] is not first:
            before = rows[rows.index(first) - 1]
            raise UsageError(
                f"{self.label}: expected {width} names of columns above {sheet.at(first)}, "
                f"which has {width} cells, got {len(before.cells)} in {sheet.at(before)}"
            )
        in_comments = not above
        if in_comments:
            comments = [row for row in sheet.comments if row.number < first.number]
            above = list(takewhile(lambda row: len(row.cells) == width, reversed(comments)))[::-1]
            rows = [*above, *rows]
        if not above:
            raise UsageError(
                f"{self.label}: expected column names in {sheet.at(first)}, got numbers; skip says "
                "how many lines stand before the names"
            )
        names = above[-1]
        way_out = f"skip = {names.number - 1} reads"
        for row in [] if in_comments else rows[: rows.index(names)]:
            if len(row.cells) > 1 and _is_value(row.cells[0]):
                raise UsageError(
                    f"{self.label}, {sheet.at(row)}: expected no row of numbers above the names of "
                    f"the columns, in {sheet.at(names)}; {way_out} the table that begins there"
                )
        if len(above) > 1 and self._values_in(names):
            raise UsageError(
                f"{self.label}, {sheet.at(names)}: expected names of columns or numbers, got both; "
                f"{way_out} names there"
            )
        if len(above) > 1 and self._are_units(names, above[-2]):
            names = above[-2]
        return rows[rows.index(names) :]

    def _values_in(self, row: CellRow) -> list[int]:
        """Return the columns of numbers that have one in a row."""
        cells = row.cells
        return [place for place in self._numeric if place < len(cells) and _is_value(cells[place])]

    def _is_data(self, row: CellRow) -> bool:
        """Whether a row has numbers where the last rows have them, and no text before them."""
        values = self._values_in(row)
        first = self._numeric[0]
        return bool(values) and (values[0] == first or row.cells[first].strip() in self._gaps)

    def _are_units(self, row: CellRow, above: CellRow) -> bool:
        """Whether a row has the units of the names above it."""
        units = [unit.strip() for unit in row.cells]
        named = list(zip(above.cells, units, strict=False))
        is_beside = all(name.strip() for name, unit in named if unit)
        is_as_wide = len(units) == len(above.cells)
        if not (is_as_wide and is_beside) or self._is_data(row):
            return False
        if any(map(_is_stamp, above.cells)):
            return False
        if any(Header.parse(name, 0).times for name in above.cells):  # then any text is a unit
            return not any(Header.parse(unit, 0).times and unit != "t" for unit in units)
        if self._values_in(above):
            return False
        if any(map(is_time_word, units)):  # German words begin with a capital: Bar
            units = [unit if _is_unit(unit) else unit.lower() for unit in units]
        return all(map(_is_unit, units)) and not any(Header.parse(unit, 0).times for unit in units)

    # what is told

    def place(self, row: int) -> str:
        """Return the line, or the row of the sheet."""
        return self._sheet.at(self._rows[row])

    def cell(self, row: int, position: int) -> str:
        """Return how messages name a cell, with the number of its column."""
        column = f"{position + 1} ({self.headers[position].text!r})"
        return f"{self.label}, {self.place(row)}, column {column}"

    def _tell(
        self, form: TableForm, missing: Sequence[float | str], names: CellRow, units: CellRow | None
    ) -> None:
        """Note what was found."""
        sheet = self._sheet
        if sheet.separator is not None:
            name = _NAMES.get(sheet.separator, sheet.separator)
            is_found = any(len(row.cells) > 1 for row in sheet.rows)
            reason = "splits the lines equally" if is_found else "the default"
            self.tell("separator", name, reason, "separator", form.separator)
        reason = "as in its numbers" if self._decimal == "," else "no number has a comma"
        if sheet.separator == ",":
            reason = "as commas separate columns"
        self.tell("decimal sign", self._decimal, reason, "decimal", form.decimal)
        if sheet.comments:
            found = f"{len(sheet.comments)} {sheet.unit}s"
            self.tell("comments", found, f"begin with {form.comment or _COMMENT}", "comment")
        self.tell("names", sheet.at(names), "above the first row of numbers", "skip", form.skip)
        codes = ", ".join(["empty cells, NaN", *map(str, missing)])
        self.tell("not measured", codes, "the default", "missing", missing or None)
        if sheet.rows and sheet.rows[0].number < names.number:
            found = f"{sheet.unit}s {sheet.rows[0].number} to {names.number - 1}"
            self.tell("left out", found, "above the names", "skip")
        if units is not None:
            self.tell("units", sheet.at(units), "units below the names", "unit")
        if sheet.source:
            self.tell(*sheet.source)

    # cells

    def _stripped(self, position: int) -> Iterator[str]:
        return (row.cells[position].strip() for row in self._rows)

    def numbers_of(self, position: int) -> Sequence[Decimal | str | None]:
        """Return the numbers of a column as Python writes them, or the ns of dates."""
        read = self._number if self.headers[position].stamp_unit is None else self._stamp
        return [
            None if cell in self._gaps else read(row, position, cell)
            for row, cell in enumerate(self._stripped(position))
        ]

    def _stamp(self, row: int, position: int, cell: str) -> Decimal:
        """Return a date or a duration in ns."""
        stamp = nanoseconds(cell)
        if stamp is None:
            raise self._no_stamp(row, position, cell)
        return stamp

    def _no_stamp(self, row: int, position: int, cell: str) -> UsageError:
        got = repr(cell) if _LIKE_A_DATE.fullmatch(cell) else "other text"
        return UsageError(
            f"{self.cell(row, position)}: expected a date of the calendar in ISO 8601 "
            f"(YYYY-MM-DDThh:mm:ss), or a duration, got {got}; convert the column, such as by "
            "pandas.to_datetime"
        )

    def _number(self, row: int, position: int, cell: str) -> str:
        """Return a number as Python writes it."""
        number = cell
        if self._decimal == ",":
            number = cell.replace(",", ".") if "." not in cell else ""
        if is_number(number):
            return number
        if _LIKE_A_DATE.fullmatch(cell):
            raise self._no_stamp(row, position, cell)
        way_out = ""
        if is_number(cell.replace(",", ".")):
            other = "," if self._decimal == "." else "."
            way_out = f'; the decimal separator is {self._decimal!r}, see decimal = "{other}"'
            if _THOUSANDS.fullmatch(cell):
                way_out += ", unless commas separate thousands"
        raise UsageError(
            f"{self.cell(row, position)}: expected a number or an empty cell, got text{way_out}"
        )


# --- text ---


def text_sheet(path: Path, form: TableForm, *, spanning: bool) -> Sheet:
    """Read the rows of a text.

    With ``spanning`` a cell may span several lines, and an empty row counts.
    """
    text, encoding = _decoded(path)
    mark = _COMMENT if form.comment is None else form.comment
    kept: list[tuple[int, str]] = []
    comments: list[tuple[int, str]] = []
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for number, line in enumerate(lines[form.skip or 0 :], start=1 + (form.skip or 0)):
        if mark and line.lstrip().startswith(mark):
            comments.append((number, line.lstrip()[len(mark) :].strip(" ")))
        elif line.strip():
            kept.append((number, line))
    separator = form.separator
    if separator is None:
        separator = _likely_separator([line for _, line in kept])
    decimal = form.decimal or "."
    is_quoted = separator == "," and any('"' in line for _, line in kept)
    forbidden = f'{"" if is_quoted else decimal}"\r\n0123456789'
    if len(separator) != 1 or separator in forbidden:
        raise UsageError(
            "separator: expected one character other than the decimal separator "
            f"{decimal!r}, got {separator!r}"
        )
    rows = list(_split(kept, separator, spanning=spanning))
    if not spanning:  # of a row of separators nothing can be said but that it is empty
        rows = [row for row in rows if not row.cells or any(map(str.strip, row.cells))]
    noted = list(_split(comments, separator, spanning=False))
    found = ("encoding", encoding.upper(), "by its first bytes", "")
    source = () if encoding == "utf-8" else found
    return Sheet(f"file {str(path)!r}", rows, noted, source, separator=separator)


def _decoded(path: Path) -> tuple[str, str]:
    """Return a text and its encoding: UTF-8, or UTF-16 by its mark."""
    content = content_of(path)
    label = f"file {str(path)!r}: expected UTF-8 or UTF-16 text"
    is_utf_16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    encoding = "utf-16" if is_utf_16 else "utf-8"
    try:
        text = content.decode(encoding).removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        # not "from error": that one holds the content
        raise UsageError(
            f"{label}, got another encoding (byte {error.start}); save it as UTF-8"
        ) from None
    if "\0" in text:
        raise UsageError(f"{label}, got a NUL character")
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


def _split(
    lines: Sequence[tuple[int, str]], separator: str, *, spanning: bool
) -> Iterator[CellRow]:
    """Yield rows of cells.

    Without cells: the row cannot be split, because of its quotes or a cell beyond all size.
    """
    is_blank = separator == " "  # then columns may be aligned
    pending: list[str] = []
    begin = 0
    is_open = False
    for number, whole in lines:
        line = whole.strip(" ") if is_blank else whole
        if not pending and '"' not in line:  # in less time than by a reader of its own
            yield CellRow(number, re.split(" +", line) if is_blank else line.split(separator))
            continue
        begin = begin if pending else number
        pending.append(f"{line}\n")
        is_open ^= spanning and line.count('"') % 2 == 1
        if not is_open:
            reader = csv.reader(
                pending, delimiter=separator, strict=True, skipinitialspace=is_blank
            )
            try:
                cells = next(reader, [])
            except csv.Error:
                cells = []
            yield CellRow(begin, cells)
            pending = []
    if pending:
        yield CellRow(begin, [])


# --- Excel ---


def excel_sheet(path: Path, form: TableForm) -> Sheet:
    """Read the sheet of a workbook, by openpyxl; all its rows are as wide as the widest."""
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
            pages = [page for page in book.worksheets if form.sheet in (None, page.title)]
            sheets = {page.title: _cells_of(page) for page in pages}
            unknown = None
            if any(None in row for cells in sheets.values() for row in cells):
                formulas = openpyxl.load_workbook(stream, read_only=True)
                unknown = _formula_in(formulas, sheets, form.skip or 0)
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
    filled = [name for name, cells in sheets.items() if any(map(any, cells))]
    if len(filled) > 1:
        raise UsageError(
            f"{label}: expected one sheet with cells, got {listing(filled)}; select one by sheet"
        )
    rows, comments = _rows_of(sheets[filled[0]] if filled else [], form)
    reason = "given" if form.sheet is not None else "the only one with cells"
    return Sheet(label, rows, comments, ("sheet", ", ".join(filled), reason, "sheet"), "row")


def _rows_of(
    cells: Sequence[Sequence[str | None]], form: TableForm
) -> tuple[list[CellRow], list[CellRow]]:
    """Return rows, and those in which a comment stands alone, all as wide as the widest."""
    width = max((place + 1 for row in cells for place, cell in enumerate(row) if cell), default=0)
    mark = form.comment or _COMMENT
    rows: list[CellRow] = []
    comments: list[CellRow] = []
    for number, row in enumerate(cells, start=1):
        padded = [cell or "" for cell in row[:width]] + [""] * (width - len(row))
        if number > (form.skip or 0) and any(row):
            is_comment = padded[0].startswith(mark) and not any(padded[1:])
            (comments if is_comment else rows).append(CellRow(number, padded))
    return rows, comments


def _cells_of(page: Any) -> list[list[str | None]]:
    """Return the cells of a sheet as a text table has them; None: there is no value."""
    rows = []
    for row in page.iter_rows():
        cells: list[str | None] = []
        for cell in row:
            match cell.value:
                case None:  # "str": the value of a formula is an empty text
                    is_there = hasattr(cell, "coordinate")  # else it is not in the file
                    cells.append(None if is_there and cell.data_type != "str" else "")
                case timedelta() as duration:
                    clock = datetime.min + timedelta(0, duration.seconds, duration.microseconds)
                    time = clock.time().isoformat("microseconds")
                    cells.append(f"{duration.days} days {time}")
                case value:
                    cells.append(str(value).strip())
        rows.append(cells)
    return rows


def _formula_in(book: Any, sheets: dict[str, list[list[str | None]]], skip: int) -> str | None:
    """Return the first place that has a formula and no value, in rows that are not skipped."""
    for title, cells in sheets.items():
        rows = zip(book[title].iter_rows(), cells, strict=True)
        for formulas, values in islice(rows, skip, None):
            for formula, value in zip(formulas, values, strict=True):
                if value is None and formula.data_type == "f":
                    return f"sheet {title!r}, cell {formula.coordinate}"
    return None
