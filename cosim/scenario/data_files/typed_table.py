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
from cosim.scenario.data_files.mat_file import OtherVariable, variables_of
from cosim.scenario.data_files.table import LARGEST, DataTable, content_of

_BYTES: Final = 8  # of a number


class ParquetTable(DataTable):
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
            self._add_header(Header.parse(name, position), units.get(position, ""), "its metadata")

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
        self._refuse_rounded(values, column, repr(self._names[position]))
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


class MatTable(DataTable):
    """A MAT-file: a trajectory of Dymola or OpenModelica, a converted log, or columns of numbers.

    A trajectory has two rows at each event; the later one counts.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        variables = variables_of(self.label, content_of(path))
        matrices: dict[str, Matrix] = {}
        others: dict[str, OtherVariable] = {}
        for name, value in variables.items():
            if isinstance(value, OtherVariable):
                others[name] = value
            else:
                matrices[name] = value
        self._columns: list[tuple[Matrix, int, float]] = []  # a matrix, a column of it, its sign
        self._rows = 0
        try:
            if {"Aclass", "name"} <= others.keys() and "dataInfo" in matrices:
                form = "a trajectory of Dymola or OpenModelica"
                self._take_trajectory(matrices, others)
            elif "signals" in others and others["signals"].structs:
                form = "a log that cosim converted"
                self._take_log(matrices, others["signals"])
            else:
                form = "matrices of equally many rows"
                self._take_matrices(matrices)
        except (KeyError, IndexError, ValueError) as error:
            raise UsageError(f"{self.label}: a damaged trajectory: {error}") from error
        self.tell("variables", form, "by their names and sizes", "")
        self.numbers = set(range(len(self._columns)))

    def _add(self, name: str, unit: str, column: tuple[Matrix, int, float]) -> None:
        header = Header(name, name, None, len(self._columns))
        self._add_header(header, unit, "its description")
        self._columns.append(column)

    def _take_trajectory(
        self, matrices: Mapping[str, Matrix], others: Mapping[str, OtherVariable]
    ) -> None:
        """Take the variables of a simulation; parameters have one value."""
        self.same_time = "last"
        is_transposed = others["Aclass"].rows[3].strip("\0 ") == "binTrans"
        names, texts = [others[key].rows for key in ("name", "description")]
        blocks = dict(matrices)
        if is_transposed:
            names = tuple(map("".join, zip(*names, strict=True)))
            texts = tuple(map("".join, zip(*texts, strict=True)))
            blocks = {name: matrix.T for name, matrix in matrices.items()}
        self._rows = len(blocks["data_2"])
        info = blocks["dataInfo"].astype(np.int64).tolist()
        for name, text, (block, column, *_) in zip(names, texts, info, strict=True):
            unit = _UNIT.fullmatch(text.strip("\0 "))
            data = blocks[f"data_{block or 2}"]  # 0: the time, which is that of all
            if not 0 < abs(column) <= data.shape[1] or len(data) not in (2, self._rows):
                raise ValueError(f"{name.strip()!r} is in a column that is not there")
            sign = -1.0 if column < 0 else 1.0
            shown = (data, abs(column) - 1, sign)
            self._add(name.strip("\0 "), unit["unit"].strip() if unit else "", shown)

    def _take_log(self, matrices: Mapping[str, Matrix], described: OtherVariable) -> None:
        """Take what ``cosim convert`` wrote, at every time that a component has a row."""
        signals = []
        for entry in described.structs:
            texts = {}
            for key in ("name", "variable", "time", "unit"):
                value = entry[key]
                texts[key] = "".join(value.rows) if isinstance(value, OtherVariable) else ""
            signals.append(texts)
        t = np.unique(np.concatenate([matrices[signal["time"]].ravel() for signal in signals]))
        self._rows = len(t)
        self._add("time", "s", (t[:, np.newaxis], 0, 1.0))
        for signal in signals:
            rows = matrices[signal["variable"]]
            spread = np.full((len(t), rows.shape[1]), NAN)
            spread[np.searchsorted(t, matrices[signal["time"]].ravel())] = rows
            self._take_columns(signal["name"], signal["unit"], spread)

    def _take_columns(self, name: str, unit: str, matrix: Matrix) -> None:
        """Take the columns of a matrix as the elements of a vector."""
        for column in range(matrix.shape[1]):
            element = name if matrix.shape[1] == 1 else f"{name}[{column}]"
            self._add(element, unit, (matrix, column, 1.0))

    def _take_matrices(self, matrices: Mapping[str, Matrix]) -> None:
        """Take the matrices that have as many rows as most of them."""
        upright = {name: m.T if m.shape[0] == 1 else m for name, m in matrices.items()}
        counts = Counter(len(matrix) for matrix in upright.values() if len(matrix) > 1)
        self._rows = counts.most_common(1)[0][0] if counts else 0
        for name, matrix in upright.items():
            if len(matrix) == self._rows:
                self._take_columns(name, "", matrix)

    def times(self, position: int) -> list[Decimal]:
        """Return numbers."""
        return [Decimal(repr(t)) for t in self.values(position).tolist()]

    def values(self, position: int) -> Vector:
        """Return the numbers of a column; a parameter has its value at all times."""
        matrix, column, sign = self._columns[position]
        values: Vector = sign * matrix[:, column]
        name = repr(self.headers[position].text)
        if len(values) != self._rows:
            if values[0] != values[-1]:
                raise UsageError(
                    f"{self.label}: {name}: expected one value of a parameter, got two"
                )
            values = np.full(self._rows, values[0])
        self._refuse_infinite(values, name)
        return values
