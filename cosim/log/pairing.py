"""Rows of two runs at the instants that they share, a window of time after another.

A window ends before an instant that is not whole yet, so that the rows of a jump stay together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Nanoseconds
from cosim.errors import LogError
from cosim.log.stream import TimedRows

_MOST_ROWS = 2**24  # of one instant
_INSTANT = np.dtype([("time", "<i8"), ("count", "<i8")])


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
        If one has more rows of one instant than can be compared.
    """
    first = _Buffer(a)
    second = _Buffer(b)
    while first.times.size or second.times.size:
        end = min(first.whole_before, second.whole_before)
        rows_a = first.take(end)
        rows_b = second.take(end)
        if len(rows_a[0]) or len(rows_b[0]):
            yield Window(rows_a, rows_b, _shared_rows(rows_a[0], rows_b[0]))


@final
class _Buffer:
    """Rows that have been read and not yet taken."""

    def __init__(self, blocks: Iterator[TimedRows]) -> None:
        self._blocks = blocks
        self.times: Nanoseconds
        self.times, self._rows = next(blocks)  # there is always one, which may have no rows
        self._next = self._next_block()
        if self._next is not None and not len(self.times):
            self._read_on(*self._next)

    @property
    def whole_before(self) -> float:
        """The instant before which all rows are here; infinite: these are all."""
        return np.inf if self._next is None else int(self.times[-1])

    def take(self, end: float) -> TimedRows:
        """Take the rows before an instant, and read on where none are left before it."""
        count = len(self.times)
        if end < np.inf:
            count = int(np.searchsorted(self.times, int(end)))
        taken = self.times[:count], self._rows[:count]
        self.times = self.times[count:]
        self._rows = self._rows[count:]
        # Rows of a single instant may have more behind them: nothing could be taken but with those.
        if self._next is not None and (not len(self.times) or self.times[0] == self.times[-1]):
            self._read_on(*self._next)
        return taken

    def _read_on(self, times: Nanoseconds, rows: Matrix) -> None:
        if len(self.times) + len(times) > _MOST_ROWS:
            raise LogError(
                f"more than {_MOST_ROWS} rows at t = {int(times[0]) / 1e9} s: too many to compare"
            )
        self.times = np.concatenate([self.times, times])
        self._rows = np.concatenate([self._rows, rows])
        self._next = self._next_block()

    def _next_block(self) -> TimedRows | None:
        """Return the next block with rows; None: there is none."""
        return next((block for block in self._blocks if len(block[0])), None)


def _shared_rows(
    times_a: Nanoseconds, times_b: Nanoseconds
) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Return the rows of a and of b that stand for the same instants."""
    if np.array_equal(times_a, times_b):
        return None
    instants_a = _instants(times_a)
    instants_b = _instants(times_b)
    _, rows_a, rows_b = np.intersect1d(
        instants_a, instants_b, assume_unique=True, return_indices=True
    )
    return rows_a, rows_b


def _instants(time_ns: Nanoseconds) -> NDArray[np.void]:
    """Return the times, the rows of one instant numbered, so that each limit of a jump is found.

    The times are in order: bisection finds the first row of an instant.
    """
    first_rows = np.searchsorted(time_ns, time_ns)
    instants = np.empty(len(time_ns), dtype=_INSTANT)
    instants["time"] = time_ns
    instants["count"] = np.arange(len(time_ns)) - first_rows
    return instants
