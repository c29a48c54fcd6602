"""Tables whose columns have types: Parquet, and MAT-files."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from decimal import Decimal
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import NAN, Matrix, Vector
from cosim.errors import UsageError
from cosim.scenario.data_files.headers import Header
from cosim.scenario.data_files.mat_file import read_variables
from cosim.scenario.data_files.table import LARGEST, Reading, Table, content_of, with_unit

_BYTES: Final = 8  # of a number


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
        content = content_of(path)
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
            self.headers.append(with_unit(self.label, header, unit, "its metadata"))

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
        """Return the unit of the type of dates or durations."""
        if position not in self.stamps:
            return None
        return str(self._schema.field(position).type.unit)

    def times(self, position: int) -> list[Decimal]:
        """Return numbers, or what dates and durations count."""
        stamps = []
        for row, stamp in enumerate(self._column(position, is_time=True)):
            if stamp is None or stamp != stamp:
                raise UsageError(f"{self.label}, {self.place(row)}: expected a time, got none")
            stamps.append(Decimal(repr(stamp)))
        return stamps

    def values(self, position: int) -> Vector:
        """Return the numbers of a column; NaN for null."""
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
        variables = read_variables(self.label, content_of(path))
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
        self.headers.append(with_unit(self.label, header, unit, "its description"))
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
        """Return numbers, or what dates and durations count."""
        return [Decimal(repr(t)) for t in self._columns[position].tolist()]

    def values(self, position: int) -> Vector:
        """Return the numbers of a column; NaN for null."""
        self._refuse_infinite(self._columns[position], repr(self.headers[position].text))
        return self._columns[position]


def _texts(characters: Any) -> list[str]:
    """Return the rows of a matrix of characters."""
    return ["".join(row).strip("\0 ") for row in characters.tolist()]
