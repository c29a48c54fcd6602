"""Field data: samples with times of their own, from CSV, Parquet and MCAP files.

The first line of a CSV file, or the names of the columns of a Parquet file, say what the columns
are, with their units: ``t [ms]``, ``y [mm]``, ``x_a[0]``, ``x_a[1]``; a field of a Parquet file may
have its unit in its metadata, too. The times are the index that pandas wrote, where its name or
type is that of times; else the column of a name such as ``t``, ``time`` or ``Timestamp``, else the
one in a unit of time, else the one of time stamps; else the index or the first one, which is said.
Times are numbers, dates (ISO 8601) or durations as pandas writes them (``0 days 00:00:00.02``). An
empty cell and NaN say that nothing was measured; all else that is no finite number is refused, and
so are times that do not ascend. The offset of the times is subtracted before they are rounded: a
time stamp in ns since 1970 has more digits than a double.

A message tells where a file is wrong, and of what stands there only the times.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from decimal import Decimal
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, Protocol, TypeAlias

import numpy as np

from cosim.arrays import NAN
from cosim.blocks.field_data import FieldData, FieldSignal, elements_named
from cosim.errors import UsageError, warn
from cosim.files import read_bounded
from cosim.instants import NANOSECONDS
from cosim.scenario.data_files.csv_file import (
    LARGEST,
    MOST_COLUMNS,
    NO_UNIT,
    Header,
    find_headers,
    is_number,
    read_lines,
    second_of,
    unit_of,
)
from cosim.scenario.data_files.recorded_fields import (
    MCAP,
    check_asked,
    read_samples,
    recorded_data,
)

TimeOffset: TypeAlias = float | Literal["first"]

PARQUET: Final = ".parquet"
_SEPARATORS: Final = ("\t", ";", "|", ",")
_BYTES: Final = 8  # of a number


def read_field_data(
    path: str | Path,
    *,
    time: str | None = None,
    time_unit: str | None = None,
    offset: TimeOffset | None = None,
    columns: Mapping[str, str | Sequence[str]] | None = None,
    separator: str | None = None,
    decimal: str = ".",
) -> FieldData:
    """Read samples with times of their own from a CSV or Parquet file, or an MCAP of another tool.

    Parameters
    ----------
    path : str or Path
        Of a file whose name ends in .parquet or .mcap, or of a CSV file.
    time : str, optional
        Name of the column of the times; by default the index that pandas wrote, if it is of times,
        the column that is named as times are (``t``, ``time``, ``timestamp``, ``date``, ...), has a
        unit of time or has dates, or else the first, with a :class:`cosim.CosimWarning`. Of an MCAP
        "log_time", which is the default, "publish_time", or a field of the messages, such as
        "header.stamp".
    time_unit : str, optional
        Unit of the times; by default the one in the name of their column, or s.
    offset : float or "first", optional
        The time stamp, as the file has it, that is t = 0; of an MCAP in ``time_unit``. "first":
        the first one, of an MCAP the first by which every field has a sample. By default 0, of an
        MCAP "first".
    columns : mapping of signal to the name of a column, or names of several, optional
        By default every other column is a signal of its name, and ``x[0]``, ``x[1]``, ... are the
        elements of ``x``. Of an MCAP the fields, such as ``/drive/state.position``; needed there.
    separator : str, optional
        Between the columns of a CSV file; by default what the first line has: tabs, semicolons,
        bars or commas.
    decimal : str
        The decimal sign of a CSV file, "." or ",".

    Raises
    ------
    UsageError
        If the file cannot be read, is no such table, or has times that do not ascend.
    """
    data = field_data(
        path,
        time=time,
        time_unit=time_unit,
        offset=offset,
        columns=columns,
        separator=separator,
        decimal=decimal,
    )
    warn(data.diagnostics)
    return data


def field_data(
    path: str | Path,
    *,
    time: str | None = None,
    time_unit: str | None = None,
    offset: TimeOffset | None = None,
    columns: Mapping[str, str | Sequence[str]] | None = None,
    separator: str | None = None,
    decimal: str = ".",
) -> FieldData:
    """Read samples as :func:`read_field_data` does; whoever takes them shows their diagnostics."""
    path = Path(path)
    if isinstance(offset, int | float) and not math.isfinite(offset):
        raise UsageError(f'offset: expected a finite number or "first", got {offset}')
    if path.suffix.lower() == MCAP:
        return _read_recorded(path, time, time_unit, offset=offset, columns=columns or {})
    table: _FieldTable
    if path.suffix.lower() == PARQUET:
        table = _ParquetTable(path)
    else:
        table = _CsvTable(path, separator, decimal)
    headers = _Headers(table)
    if time is None:
        clock = headers.clock()
    else:
        (clock,) = find_headers(table.label, headers.all, [time])
    chosen = headers.signals(clock, columns)
    stamps = _TimeStamps(table, offset or 0.0, _seconds(table, clock, time_unit))
    values: dict[int, list[float]] = {}
    for parts in chosen.values():
        for part in parts:
            values[part.position] = []
    table.read(clock, stamps, values)
    if not stamps.t:
        raise UsageError(f"{table.label}: expected rows of numbers, got none")
    signals = []
    for name, parts in chosen.items():
        stacked = np.array([values[part.position] for part in parts]).T
        signals.append(FieldSignal(name, unit_of(table.label, name, parts), stacked))
    notes = () if time is not None else headers.notes(clock, time_unit or "s")
    return FieldData(table.label, np.array(stamps.t), tuple(signals), notes)


def _read_recorded(
    path: Path,
    time: str | None,
    time_unit: str | None,
    *,
    offset: TimeOffset | None,
    columns: Mapping[str, str | Sequence[str]],
) -> FieldData:
    fields = listed_columns(columns)
    check_asked(path, fields)
    names = chain.from_iterable(fields.values())
    samples = read_samples(path, names, time=time, time_unit=time_unit)
    return recorded_data(path, fields, samples, offset=offset, time_unit=time_unit)


def listed_columns(columns: Mapping[str, str | Sequence[str]]) -> dict[str, list[str]]:
    """Return the columns of every signal as a list.

    Raises
    ------
    UsageError
        If a signal has none.
    """
    listed = {}
    for name, wanted in columns.items():
        listed[name] = [wanted] if isinstance(wanted, str) else list(wanted)
    if not all(listed.values()):
        raise UsageError(f"columns: expected a column for each signal, got {dict(columns)}")
    return listed


# --- what the columns are ---


class _Headers:
    """The columns of a table that have a name."""

    def __init__(self, table: _FieldTable) -> None:
        self._label = table.label
        self._table = table
        self.all: list[Header] = []
        self._unnamed: list[Header] = []
        for position, text in enumerate(table.names):
            header = Header.parse(text, position)
            if header.text:
                self.all.append(self._with_unit(header, table.units.get(position)))
            elif position in table.index:
                self._unnamed.append(header)
        if len(self._unnamed + self.all) < 2:
            raise UsageError(
                f"{table.label}: expected at least two named columns (times and samples), got "
                f"{len(self.all)}{table.hint}"
            )
        if all(is_number(header.name) for header in self.all):
            raise UsageError(f"{table.label}: expected column names in line 1, got numbers")

    def _with_unit(self, header: Header, declared: str | None) -> Header:
        """Return a column with the unit that is declared beside its name."""
        if declared is None:
            return header
        unit = "1" if declared in NO_UNIT else declared
        if header.unit not in (None, unit):
            raise UsageError(
                f"{self._label}, column {header.text!r}: expected one unit, got "
                f"{header.unit!r} in its name and {unit!r} in its metadata"
            )
        return replace(header, unit=unit)

    def clock(self) -> Header:
        """Return the column of the times, where none is selected.

        Raises
        ------
        UsageError
            If several may be it.
        """
        candidates = self._candidates()
        if len(candidates) > 1:
            names = ", ".join(repr(header.name) for header in candidates)
            raise UsageError(
                f"{self._label}: expected one column of times, got {names}; select one by time"
            )
        return [*candidates, *self._unnamed, *self._of(self._table.index), *self.all][0]

    def _of(self, positions: Collection[int]) -> list[Header]:
        return [header for header in (*self._unnamed, *self.all) if header.position in positions]

    def _candidates(self) -> list[Header]:
        """Return the columns that say of themselves that they have times, in the first way."""
        stamps = self._of(self._table.stamps)
        timed = [header for header in self.all if header.time_unit is not None]
        named = []
        for header in self.all:
            is_number = header.has_dates and header.position in self._table.numbers
            if header.times is not None and not is_number:
                named.append(header)
        of_times = {header.position for header in (*named, *timed, *stamps)}
        index = [header for header in self._of(self._table.index) if header.position in of_times]
        return index or named or timed or stamps

    def notes(self, clock: Header, unit: str) -> tuple[str, ...]:
        """Return what is to be known where nothing says which column has the times."""
        if self._candidates():
            return ()
        is_index = clock.position in self._table.index
        where = "the index that pandas wrote" if is_index else "the first column"
        name = f", {clock.name!r}" if clock.name else ""
        return (
            f"{self._label}: the times are those of {where}{name}, in {unit}, as no column says "
            "that it has times, by a name such as t or time, a unit of time or dates; time selects "
            "another",
        )

    def signals(
        self, clock: Header, columns: Mapping[str, str | Sequence[str]] | None
    ) -> dict[str, list[Header]]:
        """Return the columns of every signal."""
        if columns is None:
            names = [header.name for header in self.all if header != clock]
            for name, count in Counter(names).most_common(1):
                if count > 1:
                    raise UsageError(
                        f"{self._label}: expected a unique column {name!r}, got {count}"
                    )
            own = {header.name: header for header in self.all if header != clock}
            named = elements_named(names).items()
            return {name: [own[part] for part in parts] for name, parts in named}
        if not columns:
            raise UsageError("columns: expected a column for each signal, got {}")
        listed = listed_columns(columns).items()
        return {name: find_headers(self._label, self.all, parts) for name, parts in listed}


# --- times ---


def _seconds(table: _FieldTable, clock: Header, unit: str | None) -> Decimal:
    """Return the unit of the times in s."""
    own = table.stamp_unit(clock)
    if own is not None and unit is not None:
        raise UsageError(
            f"{table.label}: column {clock.name!r}: expected numbers, as time_unit is {unit!r}, "
            "got dates or durations, which have their unit; leave out time_unit"
        )
    way_out = "select another column by time, another unit by time_unit"
    return second_of(table.label, clock, own or unit, way_out)


class _TimeStamps:
    """Turns time stamps to seconds, one after the other."""

    def __init__(self, table: _FieldTable, offset: TimeOffset, seconds: Decimal) -> None:
        self.t: list[float] = []
        self._label = table.label
        self._offset = None if offset == "first" else Decimal(repr(offset))
        self._seconds = seconds
        self._last = ""

    def add(self, stamp: Decimal, place: str) -> None:
        """Take the next time stamp."""
        t = float(stamp)
        if math.isfinite(t):
            if self._offset is None:
                self._offset = stamp
            t = float((stamp - self._offset) * self._seconds)
        if not math.isfinite(t):
            raise UsageError(f"{self._label}, {place}: expected a finite time, got {t!r} s")
        if self.t and not t > self.t[-1]:
            raise UsageError(
                f"{self._label}, {place}: expected increasing times, got {t!r} s after "
                f"{self.t[-1]!r} s in {self._last}; select another column by time"
            )
        self.t.append(t)
        self._last = place


_DURATION: Final = re.compile(
    r"(?:(?P<days>-?\d{1,9}) days?)?\s*(?:\+?(?P<h>\d{1,9}):(?P<min>\d\d):(?P<s>\d\d(?:\.\d+)?))?"
)
_DATE: Final = re.compile(
    r"(?P<day>\d{4}-\d\d-\d\d)(?:[T ](?P<time>\d\d:\d\d(?::\d\d)?)(?P<fraction>\.\d+)?"
    r"(?P<zone>Z|[+-]\d\d:?\d\d)?)?"
)
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def _nanoseconds(text: str) -> Decimal | None:
    """Return a duration, or a date since 1970, in ns; None: it is neither."""
    date = _DATE.fullmatch(text)
    if date is not None:
        try:
            day = datetime.fromisoformat(
                f"{date['day']}T{date['time'] or '00:00'}{date['zone'] or 'Z'}"
            )
        except ValueError:
            return None
        since = day - _EPOCH
        seconds = 86400 * since.days + since.seconds + Decimal(date["fraction"] or 0)
        return seconds * NANOSECONDS
    duration = _DURATION.fullmatch(text)
    if duration is None or not text:
        return None
    hours = 24 * int(duration["days"] or 0) + int(duration["h"] or 0)
    minutes = 60 * hours + int(duration["min"] or 0)
    return (60 * minutes + Decimal(duration["s"] or 0)) * NANOSECONDS


# --- files ---


class _FieldTable(Protocol):
    """A table in a file: ``label`` names it in messages, ``hint`` says how it was split.

    ``units`` are those that are declared beside the names of columns, ``index`` has the columns
    that were the index of a frame, ``stamps`` those whose type is that of dates or durations.
    """

    label: str
    names: Sequence[str]
    hint: str
    units: Mapping[int, str]
    index: Collection[int]
    stamps: Collection[int]
    numbers: Collection[int]

    def stamp_unit(self, clock: Header) -> str | None:
        """Return the unit of dates or durations; None: the times are numbers."""
        ...

    def read(self, clock: Header, stamps: _TimeStamps, values: dict[int, list[float]]) -> None:
        """Read times, and the columns that ``values`` has by their positions."""
        ...


class _CsvTable:
    """A CSV file."""

    units: Mapping[int, str] = MappingProxyType({})

    def __init__(self, path: Path, separator: str | None, decimal: str) -> None:
        self.label = f"file {str(path)!r}"
        if decimal not in (".", ","):
            raise UsageError(f'decimal: expected "." or ",", got {decimal!r}')
        self._lines = read_lines(path, repr(str(path)))
        self._separator = self._likely_separator() if separator is None else separator
        if len(self._separator) != 1 or self._separator in f'{decimal}"\r\n' + "0123456789":
            raise UsageError(
                f"separator: expected one character other than the decimal separator {decimal!r}, "
                f"got {self._separator!r}"
            )
        self._decimal = decimal
        rows = self._rows()
        self.names: Sequence[str] = next(rows, ("", []))[1]
        self.hint = f" (separated by {self._separator!r})" if any(self.names) else ""
        if len(self.names) > MOST_COLUMNS:
            raise UsageError(
                f"{self.label}: expected at most {MOST_COLUMNS} columns, got {len(self.names)}"
            )
        # pandas writes an index without a name so
        self.index: Collection[int] = [0] if self.names and not self.names[0].strip() else []
        _, cells = next(rows, ("", []))
        self.stamps: Collection[int] = set()
        self.numbers: Collection[int] = set()
        for position, cell in enumerate(cells):
            if is_number(cell.strip().replace(",", ".")):
                self.numbers.add(position)
            elif _nanoseconds(cell.strip()) is not None:
                self.stamps.add(position)

    def _likely_separator(self) -> str:
        """Return the separator in the first line that says something, outside of quotes."""
        header = next((line for line in self._lines if line.strip()), "")
        plain = re.sub('"[^"]*"', "", header)
        return next((separator for separator in _SEPARATORS if separator in plain), ",")

    def _rows(self) -> Iterator[tuple[str, list[str]]]:
        """Yield where each row stands, and its cells; empty lines are left out."""
        rows = csv.reader(self._lines, delimiter=self._separator, strict=True)
        number = 0
        while True:
            try:
                cells = next(rows, None)
            except csv.Error:
                raise UsageError(f"{self.label}: line {number + 1} cannot be split") from None
            if cells is None:
                return
            if rows.line_num > number + 1:
                raise UsageError(
                    f"{self.label}: a cell spans several lines, from line {number + 1}"
                )
            number = rows.line_num
            if any(cell.strip() for cell in cells):
                yield f"line {number}", cells

    def stamp_unit(self, clock: Header) -> str | None:
        return "ns" if clock.position in self.stamps else None

    def read(self, clock: Header, stamps: _TimeStamps, values: dict[int, list[float]]) -> None:
        has_stamps = self.stamp_unit(clock) is not None
        rows = self._rows()
        next(rows)
        for place, cells in rows:
            if len(cells) != len(self.names):
                raise UsageError(
                    f"{self.label}, {place}: expected {len(self.names)} cells, got {len(cells)}"
                )
            stamps.add(self._stamp(cells, clock.position, place, has_stamps=has_stamps), place)
            for position, column in values.items():
                column.append(self._measured(cells, position, place))

    def _stamp(
        self, cells: Sequence[str], position: int, place: str, *, has_stamps: bool
    ) -> Decimal:
        """Return a time: a number, or the nanoseconds of a date or duration."""
        text = cells[position].strip()
        if has_stamps and text:
            nanoseconds = _nanoseconds(text)
            if nanoseconds is None:
                raise UsageError(
                    f"{self._at(position, place)}: expected a date or duration as in the rows "
                    "before, got other text"
                )
            return nanoseconds
        number = self._number(cells, position, place)
        if not number:
            raise UsageError(f"{self._at(position, place)}: expected a time, got an empty cell")
        return Decimal(number)

    def _measured(self, cells: Sequence[str], position: int, place: str) -> float:
        number = self._number(cells, position, place)
        value = float(number) if number else NAN
        if math.isinf(value):
            raise UsageError(f"{self._at(position, place)}: expected a finite number, got {value}")
        return value

    def _number(self, cells: Sequence[str], position: int, place: str) -> str:
        """Return a number as Python writes it; empty: nothing was measured."""
        text = cells[position].strip()
        other = "," if self._decimal == "." else "."
        number = text.replace(",", ".")
        if number and is_number(number) and other not in text:
            return "" if math.isnan(float(number)) else number
        if text:
            way_out = ""
            if is_number(number):
                way_out = f'; the decimal separator is {self._decimal!r}, see decimal = "{other}"'
            raise UsageError(
                f"{self._at(position, place)}: expected a number or an empty cell, got text"
                f"{way_out}"
            )
        return ""

    def _at(self, position: int, place: str) -> str:
        return f"{self.label}, {place}, column {position + 1} ({self.names[position].strip()!r})"


class _ParquetTable:
    """A Parquet file."""

    def __init__(self, path: Path) -> None:
        self.label = f"file {str(path)!r}"
        self.hint = ""
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError as error:
            raise UsageError(
                f"{self.label}: reading Parquet requires pyarrow: pip install 'cosim[parquet]', "
                "or save the table as CSV"
            ) from error
        self._arrow = pyarrow
        try:
            content = read_bounded(path, LARGEST)
        except OSError as error:
            raise UsageError(f"{self.label} cannot be read: {error.strerror}") from error
        with self._only_parquet():
            self._file = pyarrow.parquet.ParquetFile(pyarrow.BufferReader(content))
            self._schema = self._file.schema_arrow
            self.names: Sequence[str] = self._schema.names
            rows = self._file.metadata.num_rows
        self.units: Mapping[int, str] = self._declared_units()
        types = pyarrow.types
        self.stamps: Collection[int] = set()
        self.numbers: Collection[int] = set()
        for position, column in enumerate(self._schema.types):
            if types.is_timestamp(column) or types.is_duration(column):
                self.stamps.add(position)
            elif types.is_integer(column) or types.is_floating(column):
                self.numbers.add(position)
        entries = self._pandas_index()
        index = [position for position, name in enumerate(self.names) if name in entries]
        # pandas keeps an index of evenly spaced integers, row numbers or others, only there
        self._ranges = {}
        for entry in entries:
            if isinstance(entry, dict) and isinstance(entry.get("name"), str):
                with suppress(KeyError, TypeError, ValueError, OverflowError):  # of another tool
                    numbers = range(entry["start"], entry["stop"], entry["step"])
                    header = Header.parse(entry["name"], 0)
                    named = header.times is not None or header.time_unit is not None
                    if len(numbers) == rows and (named or numbers.step > 1):
                        self._ranges[len(self.names)] = numbers
                        self.names = [*self.names, entry["name"]]
        self.index: Collection[int] = [*index, *self._ranges]
        if rows * max(1, len(self.names)) * _BYTES > LARGEST:
            raise UsageError(
                f"{self.label}: expected at most {LARGEST // _BYTES} numbers, got {rows} rows of "
                f"{len(self.names)} columns"
            )

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
        for position, field in enumerate(self._schema):
            unit = (field.metadata or {}).get(b"unit", b"").decode("utf-8", "replace").strip()
            if unit:
                units[position] = unit
        return units

    def stamp_unit(self, clock: Header) -> str | None:
        if clock.position not in self.stamps:
            return None
        return str(self._schema.field(clock.position).type.unit)

    def read(self, clock: Header, stamps: _TimeStamps, values: dict[int, list[float]]) -> None:
        for row, stamp in enumerate(self._column(clock.position, is_time=True), start=1):
            if stamp is None or stamp != stamp:
                raise UsageError(f"{self.label}, row {row}: expected a time, got none")
            stamps.add(Decimal(repr(stamp)), f"row {row}")
        for position, column in values.items():
            for row, value in enumerate(self._column(position), start=1):
                number = NAN if value is None or value != value else float(value)
                if math.isinf(number):
                    raise UsageError(
                        f"{self.label}, row {row}, column {self.names[position]!r}: expected a "
                        f"finite number, got {number}"
                    )
                column.append(number)

    def _column(self, position: int, *, is_time: bool = False) -> list[Any]:
        """Return the numbers of a column, None where there is none."""
        if position in self._ranges:
            return list(self._ranges[position])
        is_stamp = is_time and position in self.stamps
        if not is_stamp and position not in self.numbers:
            raise UsageError(
                f"{self.label}: column {self.names[position]!r}: expected numbers, got type "
                f"{self._schema.field(position).type}"
            )
        with self._only_parquet():
            column = self._file.read(columns=[self.names[position]]).column(0)
            numbers: list[Any] = (column.cast("int64") if is_stamp else column).to_pylist()
        return numbers
