"""Tables of samples as the field writes them, by the endings of their names."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from cosim.errors import UsageError
from cosim.scenario.data_files.headers import is_number
from cosim.scenario.data_files.table import DataTable, TableForm
from cosim.scenario.data_files.text_table import TextTable, excel_table, text_table
from cosim.scenario.data_files.typed_table import MatTable, ParquetTable

EXCEL: Final = (".xlsx", ".xlsm")


def read_table(path: Path, form: TableForm | None = None) -> DataTable:
    """Read a table by the ending of its name; all that is none of the others is text.

    Raises
    ------
    UsageError
        If the file cannot be read, is too large, is no table, or a library is missing.
    """
    form = form or TableForm()
    table: DataTable
    match path.suffix.lower():
        case ".parquet":
            table = ParquetTable(path)
        case ".mat":
            table = MatTable(path)
        case _:
            table = _table_of_cells(path, form, is_text=False)
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
    return _table_of_cells(path, TableForm(), is_text=True)


def _table_of_cells(path: Path, form: TableForm, *, is_text: bool) -> TextTable:
    read = excel_table if path.suffix.lower() in EXCEL else text_table
    return read(path, form, is_text=is_text)
