"""Tables of numbers from CSV files: a line of names, then rows of numbers separated by commas.

A message tells where a file is no such table, and never what stands there: whoever runs a scenario
of another may be able to read what that other is not.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError, nearest
from cosim.files import read_bounded

LARGEST: Final = 2**28  # bytes
MOST_COLUMNS: Final = 100_000
SEPARATORS: Final = {";": "semicolons", "\t": "tabs", "|": "bars"}


@dataclass(frozen=True, slots=True)
class NamedColumns:
    """Columns of numbers by name.

    Parameters
    ----------
    file : str
        As it is named in messages.
    names : tuple of str
    values : Matrix, shape (N, number of names)
    """

    file: str
    names: tuple[str, ...]
    values: Matrix

    def column(self, name: str) -> Vector:
        """Return a column, shape (N,).

        Raises
        ------
        UsageError
            If there is none of that name, or there are several.
        """
        return self.columns([name])[:, 0]

    def columns(self, names: Sequence[str]) -> Matrix:
        """Return columns side by side, shape (N, number of ``names``).

        Raises
        ------
        UsageError
            If there is none of a name, or there are several.
        """
        position = {name: index for index, name in enumerate(self.names)}
        for name in names:
            if name not in position:
                suggestion = nearest(name, self.names)
                raise UsageError(f"file {self.file} has no column {name!r}; {suggestion}")
        selected: Matrix = self.values[:, [position[name] for name in names]]
        return selected


def read_csv(path: Path) -> NamedColumns:
    """Read a table of numbers in UTF-8; empty lines are left out.

    Raises
    ------
    UsageError
        If the file cannot be read, or is no such table.
    """
    file = repr(str(path))
    lines = read_lines(path, file)
    names = _names(lines[0], file)
    rows = [line for line in lines[1:] if line.strip()]
    if not rows:
        raise UsageError(f"file {file}: expected a header line and rows of numbers, got no rows")
    try:
        values = np.loadtxt(rows, delimiter=",", ndmin=2, comments=None, quotechar='"')
    except ValueError:
        values = np.empty((0, 0))  # its message would quote the file
    if values.shape != (len(rows), len(names)):
        problem = _first_problem(lines, len(names))
        raise UsageError(f"file {file}: expected comma-separated numbers: {problem}")
    _check_names(names, file)
    return NamedColumns(file, names, values)


def read_lines(path: Path, file: str) -> list[str]:
    """Return the lines of a text in UTF-8; ``file`` is its name in messages.

    Raises
    ------
    UsageError
        If the file cannot be read, is too large, or is no text.
    """
    try:
        content = read_bounded(path, LARGEST)
        text = content.decode("utf-8-sig")  # Excel writes a byte order mark
    except OSError as error:
        raise UsageError(f"file {file} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        # not "from error": that one holds the content
        raise UsageError(
            f"file {file}: expected UTF-8 text, got another encoding (byte {error.start})"
        ) from None
    if "\0" in text:
        raise UsageError(f"file {file}: expected UTF-8 text, got a NUL character")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _names(line: str, file: str) -> tuple[str, ...]:
    cells = _cells(line)
    if cells is None:
        raise UsageError(f"file {file}: expected comma-separated numbers: line 1 cannot be split")
    if len(cells) > MOST_COLUMNS:
        raise UsageError(f"file {file}: expected at most {MOST_COLUMNS} columns, got {len(cells)}")
    if len(cells) == 1:
        for separator, name in SEPARATORS.items():
            if separator in line:
                raise UsageError(
                    f"file {file}: expected comma-separated numbers: line 1 has {name}; save it "
                    "with commas as separators and decimal points"
                )
        raise UsageError(f"file {file}: expected at least two comma-separated columns, got one")
    return tuple(cell.strip() for cell in cells)


def _check_names(names: tuple[str, ...], file: str) -> None:
    """Refuse rows of numbers without names that tell them apart."""
    if all(is_number(name) for name in names):
        raise UsageError(
            f"file {file}: expected the names of {len(names)} columns in line 1, got numbers"
        )
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise UsageError(f"file {file}: expected unique column names, got {count} columns {name!r}")


def _first_problem(lines: Sequence[str], columns: int) -> str:
    """Return where a table is none, as line and column, both from 1."""
    for number, line in enumerate(lines[1:], start=2):
        if line.strip():
            for problem in _problems(line, columns):
                return f"line {number}{problem}"
    return "a cell spans several lines"


def _problems(line: str, columns: int) -> Iterator[str]:
    cells = _cells(line)
    if cells is None:
        yield " cannot be split"
        return
    for column, cell in enumerate(cells, start=1):
        if not is_number(cell):
            found = "text" if cell.strip() else "an empty cell"
            yield f", column {column}: expected a number, got {found}"
    if len(cells) != columns:
        yield f": expected {columns} columns as in line 1, got {len(cells)}"


def _cells(line: str) -> list[str] | None:
    """Split a line; None: it cannot be split, because of its quotes or a cell beyond all size."""
    try:
        return next(csv.reader([line], strict=True), [])
    except csv.Error:
        return None


def is_number(cell: str) -> bool:
    """Return whether a cell is a number as numpy reads it: as Python, but without underscores."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell and cell.isascii()
