"""Cases from a table: a column for each key, a row for each case.

The cells of text and of Excel, and texts of a Parquet file, are TOML where they can be, else
strings, as the values of ``--set``. In an empty cell the scenario's own value is left as it is. A
column ``replay`` has logs, one with the name of a component what takes its place.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from cosim.errors import UsageError, quoted
from cosim.files import file_type
from cosim.log.conversion.parquet import need_pyarrow
from cosim.scenario.data_files.headers import is_number
from cosim.scenario.data_files.tables import read_texts
from cosim.scenario.data_files.text_table import is_unit
from cosim.scenario.document.edits import parse_value, plain
from cosim.studies.contracts import RECORDING, SWAP
from cosim.studies.study_file import absolute, varied_key

ColumnValues: TypeAlias = np.ndarray[Any, Any] | list[Any]
_FLOAT: Final = re.compile(r"[+-]?(0|[1-9]\d*)(\.\d+([eE][+-]?\d+)?|[eE][+-]?\d+)", re.ASCII)
_INTEGER: Final = re.compile(r"[+-]?(0|[1-9]\d{0,17})", re.ASCII)
NO_ROWS: Final = "has no rows; expected a header line of keys and one row per case"


def read_cases(path: Path) -> dict[str, ColumnValues]:
    """Read the columns of a table of cases, by dotted key.

    None stands for an empty cell.

    Raises
    ------
    UsageError
        If the file cannot be read, or is no such table.
    """
    file = repr(str(path))
    if file_type(path) != "table" or path.suffix.lower() == ".mat":
        raise UsageError(
            f"cases: expected a path that ends in .csv, .txt, .xlsx or .parquet, got {file}"
        )
    if path.suffix.lower() == ".parquet":
        names, columns = _read_parquet(path, file)
    else:
        names, columns = _read_cells_of(path, file)
    found: dict[str, ColumnValues] = {}
    for name, values in zip(names, columns, strict=True):
        key = _key(name)
        if not key or key in found:
            problem = f"two columns {name!r}" if key else "a column without a name"
            hint = "" if key else " (of pandas: to_csv(..., index=False))"
            raise UsageError(f"file {file} has {problem}; expected one key per column{hint}")
        found[key] = _paths(key, values, path.parent, file)
    return found


def _key(name: str) -> str:
    """Return the key of a column; one without a dot is a component that is swapped."""
    key = name.strip()
    if key in ("replay", RECORDING):
        return RECORDING
    return varied_key(key) if key else key


def _paths(key: str, values: ColumnValues, folder: Path, file: str) -> ColumnValues:
    """Return the values of a column; of paths, absolute ones."""
    if key != RECORDING and not key.startswith(SWAP):
        return values
    paths: list[str | None] = []
    for value in values if isinstance(values, list) else values.tolist():
        if value is not None and not isinstance(value, str):
            raise UsageError(
                f"file {file}, column {key.removeprefix(SWAP)!r}: expected a path, or a key with "
                f"a dot for a parameter, got {quoted(value)}"
            )
        paths.append(None if value is None else absolute(value, folder))
    return paths


# --- text and Excel ---


def _read_cells_of(path: Path, file: str) -> tuple[list[str], list[ColumnValues]]:
    table = read_texts(path)
    names = [header.text for header in table.headers]
    columns = [table.texts(header.position) for header in table.headers]
    if not columns or not columns[0]:
        raise UsageError(f"file {file} {NO_ROWS}")
    words = [cells for cells in columns if cells[0].strip() and not is_number(cells[0])]
    rest = [cell for cells in words for cell in cells[1:] if cell]
    if rest and all(map(is_number, rest)) and all(is_unit(cells[0].strip()) for cells in words):
        raise UsageError(
            f"file {file}, {table.place(0)}: expected values as in the rows below, got units; take "
            "that row out, values are in the units of their keys"
        )
    pairs = zip(names, columns, strict=True)
    return names, [_read_cells(cells, f"file {file}", name) for name, cells in pairs]


def _read_cells(texts: Sequence[str], file: str, name: str) -> ColumnValues:
    """Return the values of the cells of a column."""
    cells = [text.strip() for text in texts]
    if all(map(_FLOAT.fullmatch, cells)):
        return np.array(list(map(float, cells)))
    if all(map(_INTEGER.fullmatch, cells)):
        return np.array(list(map(int, cells)), np.int64)
    try:
        values = [_parsed(cell) if cell else None for cell in cells]
    except UsageError as error:
        raise UsageError(f"{file}, column {name!r}: {error}") from error
    return packed(values)


@lru_cache(maxsize=1024)  # columns of words have few different ones
def _parsed(cell: str) -> Any:
    return plain(parse_value(cell))


# --- Parquet ---


def _read_parquet(path: Path, file: str) -> tuple[list[str], list[ColumnValues]]:
    need_pyarrow()
    import pyarrow
    from pyarrow import parquet

    try:
        table = parquet.read_table(path)
        names = list(table.column_names)
        if not table.num_rows:
            raise UsageError(f"file {file} {NO_ROWS}")
        pairs = zip(names, table.columns, strict=True)
        return names, [_read_column(column, file, name) for name, column in pairs]
    except (OSError, pyarrow.ArrowException, UnicodeDecodeError) as error:
        reason = str(error).partition("\n")[0]
        raise UsageError(f"file {file} cannot be read as Parquet: {reason}") from error


def _read_column(column: Any, file: str, name: str) -> ColumnValues:
    import pyarrow

    values = column.to_pylist()
    if pyarrow.types.is_decimal(column.type):  # as the same digits in a CSV file
        values = [None if value is None else float(value) for value in values]
    if any(isinstance(value, str) for value in values):
        cells = ["" if value is None else str(value) for value in values]
        return _read_cells(cells, f"file {file}", name)
    try:
        return packed([None if value is None else plain(value) for value in values])
    except UsageError as error:
        raise UsageError(f"file {file}, column {name!r}: {error}") from error


def packed(values: Sequence[Any]) -> ColumnValues:
    """Return values as an array where all are numbers of one type that it holds."""
    kinds = {type(value) for value in values}
    if kinds == {float}:
        return np.array(values, np.float64)
    if kinds == {int} and all(-(2**63) <= value < 2**63 for value in values):
        return np.array(values, np.int64)
    return list(values)
