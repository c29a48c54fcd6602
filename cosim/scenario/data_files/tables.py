"""Tables of samples as the field writes them, by the endings of their names; Parquet is here."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from cosim.errors import UsageError
from cosim.scenario.data_files.mat_file import MatTable
from cosim.scenario.data_files.table import (
    AS_FOUND,
    LARGEST,
    DataTable,
    Header,
    TableForm,
    content_of,
    is_number,
)
from cosim.scenario.data_files.text_table import TextTable

_BYTES: Final = 8  # of a number


def read_table(
    path: Path, form: TableForm = AS_FOUND, missing: Sequence[float | str] = ()
) -> DataTable:
    """Read a table by the ending of its name; all that is none of the others is text.

    Parameters
    ----------
    path : Path
    form : TableForm, optional
    missing : sequence of numbers and texts
        That stand for no measured value; a cell may have such a text.

    Raises
    ------
    UsageError
        If the file cannot be read, is too large, is no table, or a library is missing.
    """
    table: DataTable
    match path.suffix.lower():
        case ".parquet":
            table = ParquetTable(path)
        case ".mat":
            table = MatTable(path)
        case _:
            table = TextTable(path, form, missing)
    named = [header for header in table.headers if header.text]
    if sum(bool(header.text) or header.is_index for header in table.headers) < 2:
        raise UsageError(
            f"{table.label}: expected at least two named columns (times and samples), got "
            f"{len(named)}{table.hint}"
        )
    if all(is_number(header.name) for header in named):
        raise UsageError(f"{table.label}: expected column names in line 1, got numbers")
    return table


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
            schema = self._file.schema_arrow
            names: list[str] = list(schema.names)
            rows = self._file.metadata.num_rows
        self._types = schema.types
        # null is that of a column of empty cells
        numeric = [pyarrow.types.is_integer, pyarrow.types.is_floating, pyarrow.types.is_null]
        entries = _pandas_index(schema)
        for position, (name, column) in enumerate(zip(names, schema, strict=True)):
            kind = column.type
            is_stamp = pyarrow.types.is_timestamp(kind) or pyarrow.types.is_duration(kind)
            header = replace(
                Header.parse(name, position),
                is_number=any(is_kind(kind) for is_kind in numeric),
                stamp_unit=kind.unit if is_stamp else None,
                is_index=name in entries,
            )
            unit = (column.metadata or {}).get(b"unit", b"").decode("utf-8", "replace").strip()
            self.add_header(header, unit, "its metadata")
        # pandas keeps an index of evenly spaced integers, row numbers or others, only there
        self._ranges: dict[int, range] = {}
        for entry in entries:
            try:
                numbers = range(entry["start"], entry["stop"], entry["step"])
                header = Header.parse(entry["name"], len(self.headers))
                is_counted = len(numbers) == rows
            except (KeyError, TypeError, AttributeError, ValueError, OverflowError):
                continue  # of another tool
            is_named = header.times is not None or header.time_unit is not None
            if is_counted and (is_named or numbers.step > 1):
                self._ranges[header.position] = numbers
                self.add_header(replace(header, is_index=True))
        if rows * len(self.headers) * _BYTES > LARGEST:
            raise UsageError(
                f"{self.label}: expected at most {LARGEST // _BYTES} numbers, got {rows} rows of "
                f"{len(self.headers)} columns"
            )

    @contextmanager
    def _only_parquet(self) -> Iterator[None]:
        try:
            yield
        except (self._arrow.ArrowException, OSError, UnicodeDecodeError) as error:
            raise UsageError(f"{self.label}: not a valid Parquet file") from error

    def numbers_of(self, position: int) -> Sequence[Any]:
        """Return the numbers of a column, or what dates and durations count; None for null."""
        if position in self._ranges:
            return self._ranges[position]
        header = self.headers[position]
        if not header.is_number and header.stamp_unit is None:
            raise UsageError(
                f"{self.label}: column {header.text!r}: expected numbers, got type "
                f"{self._types[position]}"
            )
        names = self._file.schema_arrow.names
        name = names[position]
        with self._only_parquet():
            column = self._file.read(columns=[name]).column(names[:position].count(name))
            numbers = column if header.stamp_unit is None else column.cast("int64")
            return list(numbers.to_pylist())


def _pandas_index(schema: Any) -> list[Any]:
    """Return what pandas wrote of the index: names of columns, and what makes a range."""
    try:
        return list(json.loads((schema.metadata or {})[b"pandas"])["index_columns"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return []  # of another tool
