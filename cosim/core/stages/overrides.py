"""Inputs that are overridden: their values, and what these must be.

There are as many values as elements, and each is one that its input takes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix
from cosim.core.arguments import kind_of
from cosim.core.signals import Signal
from cosim.core.structure.ports import ConnectionEnd
from cosim.errors import GraphError

LARGEST_WHOLE: Final = 2.0**53  # up to here every integer is a float64

OverrideValue: TypeAlias = float | Sequence[float] | NDArray[np.float64]


class Overrides:
    """Inputs of a component that have values of their own, whatever drives them.

    They stand where compiled code reads them, too.

    Parameters
    ----------
    n_u : int
        Number of input elements.
    """

    def __init__(self, n_u: int) -> None:
        self._places: dict[int, int] = {}  # of columns
        self._columns = np.zeros(n_u + 1, np.int32)  # how many, then the columns
        self._values = np.zeros(n_u + 1)
        self.columns_address = self._columns.ctypes.data
        self.values_address = self._values.ctypes.data

    def __bool__(self) -> bool:
        return bool(self._places)

    def __contains__(self, column: int) -> bool:
        return column in self._places

    def __setitem__(self, column: int, value: float) -> None:
        place = self._places.get(column)
        if place is None:
            place = len(self._places)
            self._places[column] = place
            self._columns[place + 1] = column
            self._columns[0] = place + 1
        self._values[place] = value

    def __delitem__(self, column: int) -> None:
        left = self.values()
        del left[column]
        self.clear()
        for other, value in left.items():
            self[other] = value

    def clear(self) -> None:
        """Release all of them."""
        self._places.clear()
        self._columns[0] = 0

    def values(self) -> dict[int, float]:
        """Return the values by column."""
        return {column: float(self._values[place]) for column, place in self._places.items()}

    def copy(self, signals: Matrix, rows: slice) -> None:
        """Fill the columns of some rows."""
        for column, place in self._places.items():
            signals[rows, column] = self._values[place]


def checked_values(to: str, value: OverrideValue, end: ConnectionEnd) -> list[float]:
    """Return the elements of an override.

    Raises
    ------
    GraphError
        If they are no numbers, not as many as the input has elements, or not what it takes.
    """
    if isinstance(value, float) and end.size == 1:  # as most are
        _check_value(to, value, end.signal)
        return [value]
    values = _as_list(to, value, end)
    for number in values:
        _check_value(to, number, end.signal)
    return values


def _as_list(to: str, value: OverrideValue, end: ConnectionEnd) -> list[float]:
    try:
        array: NDArray[Any] = np.asarray(value)
        is_number = array.dtype.kind in "fiub"
        values: list[float] = array.astype(np.float64).reshape(-1).tolist() if is_number else []
    except (TypeError, ValueError):  # a ragged list, or no numbers
        is_number = False
        values = []
    if not is_number:
        raise GraphError(f"override of '{to}': found {kind_of(value)}; needed numbers")
    if len(values) != end.size or array.ndim > 1:
        found = f"shape {array.shape}" if array.ndim > 1 else f"{len(values)} values"
        raise GraphError(f"override of '{to}': found {found}; needed {end.size}, one an element")
    return values


def _check_value(to: str, value: float, signal: Signal) -> None:
    if math.isnan(value) and signal.optional:
        return
    if not math.isfinite(value):
        raise GraphError(f"override of '{to}': found {value}; needed a finite number")
    if signal.type == "boolean" and value not in (0.0, 1.0):
        raise GraphError(f"override of '{to}': found {value}; it is Boolean: needed 0 or 1")
    if signal.type == "integer" and (value != math.floor(value) or abs(value) > LARGEST_WHOLE):
        raise GraphError(
            f"override of '{to}': found {value}; it is an integer: needed a whole number within "
            "2**53"
        )
