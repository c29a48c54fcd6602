"""The rows of a run in memory, which grows with it."""

from __future__ import annotations

import mmap
import sys
from typing import Final, final

import numpy as np

from cosim.arrays import Matrix

MEMORY_BYTES: Final = 2**30  # of rows that are taken at a time


@final
class GrowingRows:
    """The rows of a run, written where they stay; memory is taken as it is needed.

    Parameters
    ----------
    width : int
        Columns of a row.

    Attributes
    ----------
    count : int
        How many rows there are.
    """

    def __init__(self, width: int = 0) -> None:
        self.count = 0
        self._width = width
        self._parts: list[Matrix] = []  # what is full
        self._memory = np.empty((0, width))
        self._begin = 0  # rows of the memory that are kept
        self._end = 0

    def place(self, steps: int, expected: int) -> Matrix:
        """Return rows for some steps; row 0 is the last row that there is, or the first.

        ``expected`` is how many steps are still to come: memory that the run will fill anyway is
        taken at once, and untouched costs nothing.
        """
        begin = max(self._end - 1, 0)
        end = begin + steps + 1
        if end > len(self._memory):
            self._take(max(steps, min(expected, MEMORY_BYTES // (8 * self._width + 1))))
            begin = max(self._end - 1, 0)
            end = begin + steps + 1
        return self._memory[begin:end]

    def _take(self, steps: int) -> None:
        """Take memory for more rows, and begin it with the last one."""
        memory = untouched_rows(steps + 1, self._width)
        if self.count:
            memory[0] = self._memory[self._end - 1]
            self._parts.append(self._memory[self._begin : self._end])
            self._begin = 1
            self._end = 1
        self._memory = memory

    def append(self, signals: Matrix, first: int) -> None:
        """Keep the rows from ``first`` on, where row 0 is the last that there is, or the first."""
        steps = len(signals) - 1
        place = self.place(steps, steps)
        if place.ctypes.data != signals.ctypes.data:
            place[first:] = signals[first:]
        if not self.count:
            self._begin = first
            self._end = first
        self._end += steps + 1 - first
        self.count += steps + 1 - first

    def all(self) -> Matrix:
        """Return all rows, shape (count, width)."""
        last = self._memory[self._begin : self._end]
        if not self._parts:
            return last
        whole = np.concatenate([*self._parts, last])
        self._parts = []
        self._memory = whole
        self._begin = 0
        self._end = len(whole)
        return whole


def untouched_rows(count: int, width: int) -> Matrix:
    """Return memory for rows that are written once, one behind the other.

    numpy asks the system for huge pages where an array is large. On a virtual machine their first
    touch costs several times as much as that of ordinary pages, and more than the steps.
    """
    size = max(1, 8 * count * width)
    if sys.platform == "win32":
        memory = mmap.mmap(-1, size)
    else:
        memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
    return np.frombuffer(memory, np.float64, count * width).reshape(count, width)
