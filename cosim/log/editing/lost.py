"""Find which rows of a run are missing from what was recovered of its log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Nanoseconds


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


def missing_rows(time_ns: Nanoseconds, period_ns: int, start_ns: int, end_ns: int) -> RecoveredRows:
    """Return which rows of a component are missing from ``start_ns`` to ``end_ns``.

    Parameters
    ----------
    time_ns : Nanoseconds, shape (n,)
        Of the rows that are there, ascending.
    period_ns : int
        Between two rows.
    start_ns, end_ns : int
        Of the run; the first row is at its start.
    """
    last_due = start_ns + (end_ns - start_ns) // period_ns * period_ns
    # As if there were rows just outside: then every gap is between two.
    bounded = np.concatenate([[start_ns - period_ns], time_ns, [last_due + period_ns]])
    gaps = np.flatnonzero(np.diff(bounded) > period_ns)
    lost = []
    for gap in gaps.tolist():
        first = int(bounded[gap]) + period_ns
        last = int(bounded[gap + 1]) - period_ns
        lost.append(Interval(first, last, (last - first) // period_ns + 1))
    return RecoveredRows(len(time_ns), tuple(lost))


def is_beginning(rows: Mapping[str, RecoveredRows]) -> bool:
    """Return whether no component has lost a row."""
    return all(not own.lost for own in rows.values())
