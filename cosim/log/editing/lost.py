"""Find which rows of a run are missing from what was recovered of its log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Nanoseconds
from cosim.instants import Grid


@dataclass(frozen=True, slots=True)
class Interval:
    """Rows that are missing, one after the other.

    Parameters
    ----------
    first_ns, last_ns : int
        Instants of the first and the last of them [ns].
    count : int
        How many there are.
    """

    first_ns: int
    last_ns: int
    count: int


@dataclass(frozen=True, slots=True)
class RecoveredRows:
    """The rows of a component that are there, and the intervals without.

    Parameters
    ----------
    count : int
    lost : tuple of Interval
    """

    count: int
    lost: tuple[Interval, ...]


def missing_rows(time_ns: Nanoseconds, grid: Grid, period: int, end_ns: int) -> RecoveredRows:
    """Return which rows of a component are missing up to ``end_ns``.

    Parameters
    ----------
    time_ns : Nanoseconds, shape (n,)
        Of the rows that are there, ascending.
    grid : Grid
        The communication points of the run; the first row is at its start.
    period : int
        Communication steps between two rows.
    end_ns : int
    """
    # As if there were rows just outside: then every gap is between two.
    outside = np.array([-1, grid.number(end_ns) // period + 1])
    bounded = np.insert(outside, 1, grid.number(time_ns) // period)
    lost = []
    for gap in np.flatnonzero(np.diff(bounded) > 1).tolist():
        first = int(bounded[gap]) + 1
        last = int(bounded[gap + 1]) - 1
        stamps = (grid.stamp(first * period), grid.stamp(last * period))
        lost.append(Interval(*stamps, last - first + 1))
    return RecoveredRows(len(time_ns), tuple(lost))


def is_beginning(rows: Mapping[str, RecoveredRows]) -> bool:
    """Return whether no component has lost a row."""
    return all(not own.lost for own in rows.values())
