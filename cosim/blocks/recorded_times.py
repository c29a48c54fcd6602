"""The instants of a component's recorded rows; of a regular grid no more than where it begins."""

from __future__ import annotations

from typing import Protocol, TypeAlias, TypeGuard, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Nanoseconds, Vector
from cosim.core.recorded.run import RecordedRun
from cosim.core.recording import Recording
from cosim.instants import NANOSECONDS, Grid

RowNumbers: TypeAlias = NDArray[np.int64]  # shape (k,)


class RecordedTimes(Protocol):
    """The instants of N rows, in their order."""

    def __len__(self) -> int: ...

    def nanoseconds(self, begin: int, stop: int) -> Nanoseconds:
        """Return those of the rows from ``begin`` to ``stop`` [ns]."""
        ...

    def seconds(self, begin: int, stop: int) -> Vector:
        """Return those of the rows from ``begin`` to ``stop`` [s]."""
        ...

    def last_not_after(self, t: Vector) -> RowNumbers:
        """Return the number of the last row that is not after each time [s]; -1: there is none."""
        ...

    def span(self, begin: int, stop: int) -> tuple[int, int]:
        """Return these bounds, moved so that rows of one instant stay together."""
        ...


@final
class RegularTimes:
    """Instants at equal distances.

    Parameters
    ----------
    first_ns, period_ns : int
        [ns]
    count : int
    """

    def __init__(self, first_ns: int, period_ns: int, count: int) -> None:
        self._period_ns = period_ns
        self._grid = Grid(first_ns, period_ns)
        self._count = count

    def __len__(self) -> int:
        return self._count

    def nanoseconds(self, begin: int, stop: int) -> Nanoseconds:
        """Return those of the rows from ``begin`` to ``stop`` [ns]."""
        return self._grid.stamp(np.arange(begin, stop, dtype=np.int64))

    def seconds(self, begin: int, stop: int) -> Vector:
        """Return those of the rows from ``begin`` to ``stop`` [s]."""
        return self._grid.time(np.arange(begin, stop, dtype=np.int64))

    def last_not_after(self, t: Vector) -> RowNumbers:
        """Return the number of the last row that is not after each time [s]; -1: there is none."""
        last = self._count - 1
        guesses = np.floor((t * NANOSECONDS - self._grid.start_ns) / self._period_ns)
        numbers: RowNumbers = np.clip(guesses, -1, last).astype(np.int64)
        # A guess is rounded: it is compared with the times themselves, as a search compares them.
        while (late := (numbers >= 0) & (self._grid.time(numbers) > t)).any():
            numbers -= late
        while (early := (numbers < last) & (self._grid.time(numbers + 1) <= t)).any():
            numbers += early
        return numbers

    def span(self, begin: int, stop: int) -> tuple[int, int]:
        """Return these bounds: no two rows have the same instant."""
        return begin, stop


@final
class GivenTimes:
    """Instants of any distances.

    Parameters
    ----------
    time_ns : Nanoseconds, shape (N,)
        Their stamps.
    time : Vector, shape (N,)
        What these stand for [s].
    """

    def __init__(self, time_ns: Nanoseconds, time: Vector) -> None:
        self._time_ns = time_ns
        self._time = time

    def __len__(self) -> int:
        return len(self._time)

    def nanoseconds(self, begin: int, stop: int) -> Nanoseconds:
        """Return those of the rows from ``begin`` to ``stop`` [ns]."""
        return self._time_ns[begin:stop]

    def seconds(self, begin: int, stop: int) -> Vector:
        """Return those of the rows from ``begin`` to ``stop`` [s]."""
        return self._time[begin:stop]

    def last_not_after(self, t: Vector) -> RowNumbers:
        """Return the number of the last row that is not after each time [s]; -1: there is none."""
        numbers: RowNumbers = np.searchsorted(self._time, t, side="right") - 1
        return numbers

    def span(self, begin: int, stop: int) -> tuple[int, int]:
        """Return these bounds, moved so that rows of one instant stay together."""
        first = np.searchsorted(self._time_ns, self._time_ns[begin])
        last = np.searchsorted(self._time_ns, self._time_ns[stop - 1], side="right")
        return int(first), int(last)


def instants_of(recording: Recording, time_ns: Nanoseconds) -> Vector:
    """Return what the stamps of communication points stand for [s].

    Where the step is a fraction, such as 1/60 s, they are the whole nanoseconds next to that.
    """
    if _has_fractions(recording):
        return recording.grid.time(recording.grid.number(time_ns))
    return time_ns / NANOSECONDS


def _has_fractions(recording: Recording) -> TypeGuard[RecordedRun]:
    return isinstance(recording, RecordedRun) and not isinstance(recording.step_ns, int)


@final
class TimesFinder:
    """Finds out from the rows of a recording, as they come, whether their times are regular."""

    def __init__(self) -> None:
        self._first_ns = 0
        self._period_ns = 0
        self._count = 0
        self._is_regular = True

    def add(self, time_ns: Nanoseconds) -> None:
        """Add the times of the next rows [ns]."""
        if not len(time_ns):
            return
        if not self._count:
            self._first_ns = int(time_ns[0])
        if not self._period_ns and self._count + len(time_ns) > 1:
            second = time_ns[1] if not self._count else time_ns[0]
            self._period_ns = int(second) - self._first_ns
        numbers = np.arange(self._count, self._count + len(time_ns))
        expected = self._first_ns + self._period_ns * numbers
        self._is_regular &= np.array_equal(time_ns, expected)
        self._count += len(time_ns)

    def times(self, recording: Recording, component: str) -> RecordedTimes:
        """Return the times of all rows of a component, when they have been added."""
        is_regular = self._is_regular and (self._period_ns or self._count < 2)
        if is_regular and not _has_fractions(recording):
            return RegularTimes(self._first_ns, max(self._period_ns, 1), self._count)
        time_ns = recording.time_ns(component)
        return GivenTimes(time_ns, instants_of(recording, time_ns))
