"""Cases from a table: a column for each key, a row for each case.

The cells of text and of Excel, and texts of a Parquet file, are TOML where they can be, else
strings, as the values of ``--set``. In an empty cell the scenario's own value is left as it is. A
column ``replay`` has logs, one with the name of a component what takes its place.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import UsageError, optional_library
from cosim.files import file_type
from cosim.scenario.data_files.text_table import read_texts
from cosim.scenario.document.document import parse_value, plain
from cosim.studies.contracts import RECORDING, SWAP
from cosim.studies.study_file import absolute, varied_key

_FLOAT: Final = re.compile(r"[+-]?(0|[1-9]\d*)(\.\d+([eE][+-]?\d+)?|[eE][+-]?\d+)", re.ASCII)
_INTEGER: Final = re.compile(r"[+-]?(0|[1-9]\d{0,17})", re.ASCII)


def read_cases(path: Path) -> dict[str, NDArray[Any]]:
    """Read the columns of a table of cases, by dotted key.

    None stands for an empty cell.

    Raises
    ------
    UsageError
        If the file cannot be read, or is no such table.
    """
    file = f"file {str(path)!r}"
    suffix = path.suffix.lower()
    if file_type(path) != "table" or suffix == ".mat":
        raise UsageError(
            f"cases: expected a path that ends in .csv, .txt, .xlsx or .parquet, got {str(path)!r}"
        )
    columns = _of_parquet(path, file) if suffix == ".parquet" else read_texts(path)
    if not columns or not len(columns[0][1]):
        raise UsageError(f"{file} has no rows; expected a header line of keys and a row per case")
    found: dict[str, NDArray[Any]] = {}
    for name, cells in columns:
        key = RECORDING if name.strip() == "replay" else name.strip()
        if key and key != RECORDING:
            key = varied_key(key)
        if not key or key in found:
            problem = f"two columns {name!r}" if key else "a column without a name"
            hint = "" if key else " (of pandas: to_csv(..., index=False))"
            raise UsageError(f"{file} has {problem}; expected one key per column{hint}")
        try:
            values = [_value(cell) for cell in cells]
        except UsageError as error:
            raise UsageError(f"{file}, column {name!r}: {error}") from error
        is_path = key == RECORDING or key.startswith(SWAP)
        found[key] = packed(absolute(values, path.parent) if is_path else values)
    return found


def _of_parquet(path: Path, file: str) -> list[tuple[str, Sequence[Any]]]:
    optional_library("pyarrow", "Parquet files need", "parquet")
    import pyarrow
    from pyarrow import parquet

    try:
        table = parquet.read_table(path)
        return list(zip(table.column_names, (c.to_pylist() for c in table.columns), strict=True))
    except (OSError, pyarrow.ArrowException, UnicodeDecodeError) as error:
        reason = str(error).partition("\n")[0]
        raise UsageError(f"{file} cannot be read as Parquet: {reason}") from error


def _value(cell: Any) -> Any:
    """Return the value of a cell; a text is read as TOML, a decimal as its digits in a CSV file."""
    if isinstance(cell, Decimal):
        return float(cell)
    if not isinstance(cell, str):
        return None if cell is None else plain(cell)
    text = cell.strip()
    for form, number in ((_FLOAT, float), (_INTEGER, int)):
        if form.fullmatch(text):
            return number(text)
    return _parsed(text) if text else None


@lru_cache(maxsize=1024)  # columns of words have few different ones
def _parsed(text: str) -> Any:
    return plain(parse_value(text))


def packed(values: Sequence[Any]) -> NDArray[Any]:
    """Return values as an array: of objects, unless all are numbers of one type that it holds."""
    kinds = {type(value) for value in values}
    if kinds == {float}:
        return np.array(values, np.float64)
    if kinds == {int} and all(-(2**63) <= value < 2**63 for value in values):
        return np.array(values, np.int64)
    return np.fromiter(values, object, len(values))
