"""Rows of two runs at the instants that they share, a window of time after another.

A window ends before an instant that is not whole yet, so that the rows of a jump stay together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Nanoseconds
from cosim.core.joined_rows import WaitingRows, numbered_instants
from cosim.log.stream import TimedRows


@dataclass(frozen=True, slots=True)
class Window:
    """What two runs have in a window of time.

    Parameters
    ----------
    a, b : TimedRows
        All rows of each.
    shared : (n,) arrays of rows of a and of b, or None
        Those of the same instants; None: all, one by one.
    """

    a: TimedRows
    b: TimedRows
    shared: tuple[NDArray[np.intp], NDArray[np.intp]] | None


def windows(a: Iterator[TimedRows], b: Iterator[TimedRows]) -> Iterator[Window]:
    """Yield the windows of two runs, whose blocks are in order of time.

    Raises
    ------
    LogError
        If one has more rows of one instant than can be kept.
    """
    first = WaitingRows(a)
    second = WaitingRows(b)
    while first.times.size or second.times.size:
        end = min(first.whole_before, second.whole_before)
        rows_a = first.take(end)
        rows_b = second.take(end)
        if len(rows_a[0]) or len(rows_b[0]):
            yield Window(rows_a, rows_b, _shared_rows(rows_a[0], rows_b[0]))


def _shared_rows(
    times_a: Nanoseconds, times_b: Nanoseconds
) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Return the rows of a and of b that stand for the same instants."""
    if np.array_equal(times_a, times_b):
        return None
    instants_a = numbered_instants(times_a)
    instants_b = numbered_instants(times_b)
    _, rows_a, rows_b = np.intersect1d(
        instants_a, instants_b, assume_unique=True, return_indices=True
    )
    return rows_a, rows_b
