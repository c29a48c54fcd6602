"""Inputs that are overridden, with values of their own or by faults.

An override has as many values as its input has elements, and each is one that the input takes. A
fault gives an element a gain and a value anew at every communication point; see
:mod:`cosim.core.stages.faults`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix
from cosim.core.arguments import kind_of
from cosim.core.signals import Signal
from cosim.core.stages.faults import Fault, FaultInstant
from cosim.core.structure.ports import ConnectionEnd
from cosim.errors import GraphError

OverrideValue: TypeAlias = float | Sequence[float] | NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ActiveFault:
    """The fault of an element, and the number of the communication point at which it began."""

    fault: Fault
    begin: int

    def copy(self) -> ActiveFault:
        """Return one that goes on from here on its own."""
        return ActiveFault(self.fault.copy(), self.begin)


@dataclass(frozen=True, slots=True)
class SavedOverrides:
    """The overrides of a component at a communication point.

    Parameters
    ----------
    values : dict of column to float
    faults : dict of column to ActiveFault
    table : dict of column to (gain, value)
        Of these faults.
    """

    values: dict[int, float]
    faults: dict[int, ActiveFault]
    table: dict[int, tuple[float, float]]


class Overrides:
    """Inputs of a component that are overridden, whatever drives them.

    They stand where compiled code reads them, too.

    Parameters
    ----------
    n_u : int
        Number of input elements.

    Attributes
    ----------
    faults : dict of column to ActiveFault
        Of those elements that have no value of their own.
    """

    def __init__(self, n_u: int) -> None:
        self.faults: dict[int, ActiveFault] = {}
        self._places: dict[int, int] = {}  # of columns
        self._columns = np.zeros(n_u + 1, np.int32)  # how many, then the columns
        self._gains = np.zeros(n_u + 1)
        self._values = np.zeros(n_u + 1)
        self.columns_address = self._columns.ctypes.data
        self.gains_address = self._gains.ctypes.data
        self.values_address = self._values.ctypes.data

    def __bool__(self) -> bool:
        return bool(self._places)

    def __contains__(self, column: int) -> bool:
        return column in self._places

    def __setitem__(self, column: int, value: float) -> None:
        """Override an element with a value."""
        place = self._place(column)
        self._gains[place] = 0.0
        self._values[place] = value
        if self.faults:
            self.faults.pop(column, None)

    def __delitem__(self, column: int) -> None:
        left = self.save()
        left.values.pop(column, None)
        left.faults.pop(column, None)
        self.restore(left)

    def _place(self, column: int) -> int:
        """Return the place of a column, which it may not have had."""
        place = self._places.get(column)
        if place is None:
            place = len(self._places)
            self._places[column] = place
            self._columns[place + 1] = column
            self._columns[0] = place + 1
        return place

    def _set(self, column: int, gain: float, value: float) -> None:
        place = self._place(column)
        self._gains[place] = gain
        self._values[place] = value

    def add_fault(self, column: int, active: ActiveFault, instant: FaultInstant) -> None:
        """Override an element by a fault."""
        self.faults[column] = active
        self._set(column, *active.fault.at(instant))

    def vary(self, column: int, instant: FaultInstant) -> None:
        """Determine the fault of an element at the next communication point."""
        self._set(column, *self.faults[column].fault.at(instant))

    @property
    def varies(self) -> bool:
        """Whether a fault is determined anew at every communication point."""
        return any(active.fault.varies for active in self.faults.values())

    def clear(self) -> None:
        """Release all of them."""
        self._places.clear()
        self.faults.clear()
        self._columns[0] = 0

    def values(self) -> dict[int, float]:
        """Return the values by column, of those that have values of their own."""
        own = self._places.items()
        return {column: float(self._values[i]) for column, i in own if column not in self.faults}

    def copy(self, signals: Matrix, rows: slice) -> None:
        """Fill the columns of some rows, behind what their sources gave."""
        for column, place in self._places.items():
            gain = self._gains[place]
            if gain == 0.0:
                signals[rows, column] = self._values[place]
            else:
                signals[rows, column] = gain * signals[rows, column] + self._values[place]

    def save(self) -> SavedOverrides:
        """Copy all of them."""
        faults = {column: active.copy() for column, active in self.faults.items()}
        return SavedOverrides(self.values(), faults, self._table(self.faults))

    def _table(self, columns: Iterable[int]) -> dict[int, tuple[float, float]]:
        """Return gain and value by column."""
        table = {}
        for column in columns:
            place = self._places[column]
            table[column] = (float(self._gains[place]), float(self._values[place]))
        return table

    def restore(self, saved: SavedOverrides) -> None:
        """Go back to saved ones."""
        self.clear()
        for column, value in saved.values.items():
            self[column] = value
        for column, active in saved.faults.items():
            self.faults[column] = active.copy()
            self._set(column, *saved.table[column])


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
        raise GraphError(f"override of '{to}': expected numbers, got {kind_of(value)}")
    if end.signal.type != "boolean" and _has_truth(value, array):
        raise GraphError(
            f"override of '{to}': expected numbers, got true or false (the signal is not Boolean)"
        )
    if array.dtype.kind in "iu" and values != array.reshape(-1).tolist():
        raise GraphError(
            f"override of '{to}': expected integers that float64 represents exactly, got {value}"
        )
    if len(values) != end.size or array.ndim > 1:
        needed = "1 value" if end.size == 1 else f"{end.size} values, one per element"
        found = f"an array of shape {array.shape}" if array.ndim > 1 else f"{len(values)} values"
        raise GraphError(f"override of '{to}': expected {needed}, got {found}")
    return values


def _has_truth(value: OverrideValue, array: NDArray[Any]) -> bool:
    """Whether a value is true or false, or has such an element, given as an array too."""
    if isinstance(value, list | tuple):
        return any(isinstance(element, bool | np.bool_) for element in value)
    return array.dtype.kind == "b"


def _check_value(to: str, value: float, signal: Signal) -> None:
    if math.isnan(value) and signal.optional:
        return
    if not math.isfinite(value):
        raise GraphError(f"override of '{to}': expected a finite number, got {value}")
    if signal.type == "boolean" and value not in (0.0, 1.0):
        raise GraphError(f"override of '{to}': expected 0 or 1 (Boolean), got {value}")
    if signal.type == "integer" and value != math.floor(value):
        raise GraphError(f"override of '{to}': expected an integer, got {value}")
