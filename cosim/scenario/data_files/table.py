"""A table: columns by their places, what was found in its file, and what is given of its form.

A message tells where a file is no table, and never what stands there: whoever runs a scenario of
another may be able to read what that other is not.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Final, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError
from cosim.files import read_bounded
from cosim.instants import EXACT
from cosim.scenario.data_files.headers import NO_UNIT, Header, find_headers

LARGEST: Final = 2**28  # bytes

TimeOffset: TypeAlias = float | Literal["first"]
SameTime: TypeAlias = Literal["last", "spread"]


class Reading(NamedTuple):
    """What was found in a file, and the key that says it otherwise."""

    what: str
    found: str
    reason: str
    key: str


@dataclass(frozen=True, slots=True)
class TableForm:
    """What is given of the form of a table; see the keys of the kind field-data.

    Parameters
    ----------
    separator, decimal, comment, sheet : str or None
    skip : int or None
        Lines before the names of the columns; None: they are found.
    missing : tuple of numbers and texts
        That stand for no measured value.
    """

    separator: str | None = None
    decimal: str | None = None
    skip: int | None = None
    comment: str | None = None
    missing: tuple[float | str, ...] = ()
    sheet: str | None = None

    def __post_init__(self) -> None:
        if self.decimal not in (None, ".", ","):
            raise UsageError(f'decimal: expected "." or ",", got {self.decimal!r}')
        if self.skip is not None and self.skip < 0:
            raise UsageError(f"skip: expected a number of lines, got {self.skip}")

    @property
    def missing_texts(self) -> frozenset[str]:
        """The cells that are no measured values."""
        return frozenset(code for code in self.missing if isinstance(code, str))


@dataclass(frozen=True, kw_only=True)
class FieldForm:
    """What is given of field data; see :func:`cosim.read_field_data`.

    Raises
    ------
    UsageError
        If ``offset`` or ``same_time`` is none.
    """

    time: str | None = None
    time_unit: str | None = None
    offset: TimeOffset | None = None
    same_time: SameTime | None = None
    columns: Mapping[str, str | Sequence[str]] | None = None
    table: TableForm = TableForm()

    def __post_init__(self) -> None:
        """Check what is no key of a table."""
        offset = self.offset
        is_instant = isinstance(offset, int | float) and not isinstance(offset, bool)
        if offset is not None and offset != "first" and not (is_instant and math.isfinite(offset)):
            raise UsageError(f'offset: expected a finite number or "first", got {offset!r}')
        if self.same_time not in (None, *get_args(SameTime)):
            raise UsageError(f'same_time: expected "last" or "spread", got {self.same_time!r}')


class DataTable:
    """Columns of numbers, each with its place from 0.

    ``headers`` are the columns with a name, ``index`` those that were the index of a frame,
    ``stamps`` those of dates or durations, ``numbers`` those of numbers. ``same_time`` says what is
    done with rows of one time where nobody says it.
    """

    hint = ""
    same_time: str | None = None

    def __init__(self, path: Path) -> None:
        self.label = f"file {str(path)!r}"
        self.headers: list[Header] = []
        self.index: set[int] = set()
        self.stamps: set[int] = set()
        self.numbers: set[int] = set()
        self.reading: list[Reading] = []

    def tell(self, what: str, found: str, reason: str, key: str, given: object = None) -> None:
        """Note what was found and why: because its key says so, where that is ``given``."""
        self.reading.append(Reading(what, found, "given" if given is not None else reason, key))

    def place(self, row: int) -> str:
        """Return how messages name a row."""
        return f"row {row + 1}"

    def stamp_unit(self, position: int) -> str | None:
        """Return the unit of dates or durations; None: the times are numbers."""
        return "ns" if position in self.stamps else None

    def times(self, position: int) -> list[Decimal]:
        """Return the time stamps of a column, in its unit.

        Raises
        ------
        UsageError
            If one is missing, or is none.
        """
        raise NotImplementedError

    def values(self, position: int) -> Vector:
        """Return the numbers of a column; NaN: not measured.

        Raises
        ------
        UsageError
            If it has something else, or an infinite number.
        """
        raise NotImplementedError

    def find(self, names: Iterable[str] | None) -> list[Header]:
        """Return columns by their names, or all; see :func:`find_headers`."""
        if names is not None:
            return find_headers(self.label, self.headers, names)
        name, count = Counter(header.text for header in self.headers).most_common(1)[0]
        if count > 1:
            raise UsageError(
                f"{self.label}: expected unique column names, got {count} columns {name!r}"
            )
        return self.headers

    def columns(self, headers: Sequence[Header]) -> Matrix:
        """Return columns without gaps side by side, shape (N, number of ``headers``).

        Raises
        ------
        UsageError
            If a cell is empty, or no finite number.
        """
        columns = [self.values(header.position) for header in headers]
        for header, column in zip(headers, columns, strict=True):
            empty = np.flatnonzero(np.isnan(column))
            if empty.size:
                raise UsageError(
                    f"{self.label}, {self.place(int(empty[0]))}, column {header.text!r}: expected "
                    "a number, got an empty cell"
                )
        return np.stack(columns, axis=1)

    def _add_header(self, header: Header, unit: str, source: str) -> None:
        """Add a column with the unit that is declared beside its name, if one is."""
        unit = "1" if unit in NO_UNIT else unit
        if unit and header.unit not in (None, unit):
            raise UsageError(
                f"{self.label}, column {header.text!r}: expected one unit, got {header.unit!r} in "
                f"its name and {unit!r} in {source}"
            )
        self.headers.append(replace(header, unit=unit or header.unit))

    def _refuse_infinite(self, values: Vector, name: str) -> None:
        infinite = np.flatnonzero(np.isinf(values))
        if infinite.size:
            row = int(infinite[0])
            raise UsageError(
                f"{self.label}, {self.place(row)}, column {name}: expected a finite number, got "
                f"{values[row]}"
            )

    def _refuse_rounded(self, values: Vector, written: Sequence[object], name: str) -> None:
        """Refuse integers that are no float64; ``written`` is what ``values`` were made of."""
        for row in np.flatnonzero(np.abs(values) >= EXACT).tolist():
            digits = str(written[row])
            if digits.lstrip("+-").isdigit() and Decimal(digits) != Decimal(values[row]):
                raise UsageError(
                    f"{self.label}, {self.place(row)}, column {name}: expected an integer that a "
                    "float64 represents (up to 2**53), got a larger one; write it in fewer digits, "
                    "or leave its column out by columns"
                )


def content_of(path: Path) -> bytes:
    """Return the bytes of a file.

    Raises
    ------
    UsageError
        If it cannot be read, or is too large.
    """
    try:
        return read_bounded(path, LARGEST)
    except OSError as error:
        raise UsageError(f"file {str(path)!r} cannot be read: {error.strerror}") from error
