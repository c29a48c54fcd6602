"""Rows of two runs at the instants that they share, one window of time after another.

A window ends before an instant that is not whole yet, so that the rows of a jump stay together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.recorded.joined_rows import numbered_instants
from cosim.errors import LogError
from cosim.log.reading.rows import TimedRows

MOST_ROWS = 2**24  # of one instant


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


@final
class WaitingRows:
    """Rows that have been read and not yet taken.

    Parameters
    ----------
    blocks : iterator of (times [ns], rows)
        In order of time; one at least, which may have no rows.

    Raises
    ------
    LogError
        If there are more rows of one instant than can be kept.
    """

    def __init__(self, blocks: Iterator[tuple[Nanoseconds, Matrix]]) -> None:
        self._blocks = blocks
        self.times: Nanoseconds
        self.times, self._rows = next(blocks)
        self._next = self._next_block()
        if self._next is not None and not len(self.times):
            self._read_on(*self._next)

    @property
    def whole_before(self) -> float:
        """The instant before which all rows are here; infinite: these are all."""
        return np.inf if self._next is None else int(self.times[-1])

    def take(self, end: float) -> tuple[Nanoseconds, Matrix]:
        """Take the rows before an instant, and read on where none are left before it."""
        count = len(self.times)
        if end < np.inf:
            count = int(np.searchsorted(self.times, int(end)))
        taken = self.times[:count], self._rows[:count]
        self.times = self.times[count:]
        self._rows = self._rows[count:]
        # Rows of a single instant may have more after them: nothing could be taken but with those.
        if self._next is not None and (not len(self.times) or self.times[0] == self.times[-1]):
            self._read_on(*self._next)
        return taken

    def _read_on(self, times: Nanoseconds, rows: Matrix) -> None:
        if len(self.times) + len(times) > MOST_ROWS:
            raise LogError(
                f"more than {MOST_ROWS} rows at t = {int(times[0]) / 1e9} s: too many to be "
                "compared in memory"
            )
        self.times = np.concatenate([self.times, times])
        self._rows = np.concatenate([self._rows, rows])
        self._next = self._next_block()

    def _next_block(self) -> tuple[Nanoseconds, Matrix] | None:
        """Return the next block with rows; None: there is none."""
        return next((block for block in self._blocks if len(block[0])), None)


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
