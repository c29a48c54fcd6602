"""Signals of several components in one table: joined on time.

The table has a row at every instant at which one of its components has one, and no value where a
component has none there: of signals of one rate every value is there. Rows of one instant, as the
limits of a jump are, pair up in their order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import NAN, Matrix, Nanoseconds
from cosim.core.recording import Recording
from cosim.core.selection import SelectedColumn
from cosim.errors import LogError

MOST_ROWS = 2**24  # of one instant
_INSTANT = np.dtype([("time", "<i8"), ("count", "<i8")])


@dataclass(frozen=True, slots=True)
class JoinedRows:
    """Some rows of a table of signals.

    Parameters
    ----------
    time_ns : Nanoseconds, shape (n,)
    values : Matrix, shape (n, columns)
        NaN where there is no value.
    missing : bool array, shape (n, columns), or None
        Where the component of a column has no row; None: nowhere.
    """

    time_ns: Nanoseconds
    values: Matrix
    missing: NDArray[np.bool_] | None

    def __len__(self) -> int:
        return len(self.time_ns)

    def part(self, begin: int, end: int) -> JoinedRows:
        """Return the rows from ``begin`` to before ``end``."""
        missing = None if self.missing is None else self.missing[begin:end]
        return JoinedRows(self.time_ns[begin:end], self.values[begin:end], missing)


def joined_rows(run: Recording, columns: Sequence[SelectedColumn]) -> Iterator[JoinedRows]:
    """Yield a table of signals, some rows at a time, in order of time.

    Nothing is kept but what has been read of one component and not yet of another.

    Raises
    ------
    LogError
        If a file is damaged.
    """
    components = list(dict.fromkeys(column.component for column in columns))
    buffers = [WaitingRows(run.blocks(name)) for name in components]
    places = [_places(columns, name) for name in components]
    while any(len(buffer.times) for buffer in buffers):
        end = min(buffer.whole_before for buffer in buffers)
        parts = [buffer.take(end) for buffer in buffers]
        if any(len(times) for times, _ in parts):
            yield _join(parts, places, len(columns))


def _places(
    columns: Sequence[SelectedColumn], component: str
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return which columns of the table a component has, and where these are in its rows."""
    own = [place for place, column in enumerate(columns) if column.component == component]
    sources = [columns[place].column for place in own]
    return np.array(own, dtype=np.intp), np.array(sources, dtype=np.intp)


def _join(
    parts: Sequence[tuple[Nanoseconds, Matrix]],
    places: Sequence[tuple[NDArray[np.intp], NDArray[np.intp]]],
    width: int,
) -> JoinedRows:
    """Join the rows of components in one window of time."""
    first = parts[0][0]
    if all(np.array_equal(times, first) for times, _ in parts[1:]):
        values = np.empty((len(first), width))
        for (_, rows), (own, sources) in zip(parts, places, strict=True):
            values[:, own] = rows[:, sources]
        return JoinedRows(first, values, None)
    time_ns, positions = _union([times for times, _ in parts])
    values = np.full((len(time_ns), width), NAN)
    missing = np.ones((len(time_ns), width), dtype=np.bool_)
    for (_, rows), (own, sources), at in zip(parts, places, positions, strict=True):
        values[np.ix_(at, own)] = rows[:, sources]
        missing[np.ix_(at, own)] = False
    return JoinedRows(time_ns, values, missing)


def _union(
    times: Sequence[Nanoseconds],
) -> tuple[Nanoseconds, list[NDArray[np.intp]]]:
    """Return all instants in order, and where those of each component are among them."""
    bounds = np.cumsum([len(part) for part in times])[:-1]
    if all((part[1:] > part[:-1]).all() for part in times):
        union, where = np.unique(np.concatenate(times), return_inverse=True)
        return union, np.split(where, bounds)
    instants = np.concatenate([numbered_instants(part) for part in times])
    all_instants, where = np.unique(instants, return_inverse=True)
    time_ns: Nanoseconds = all_instants["time"].copy()
    return time_ns, np.split(where, bounds)


# --- rows that wait for those of others ---


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
        # Rows of a single instant may have more behind them: nothing could be taken but with those.
        if self._next is not None and (not len(self.times) or self.times[0] == self.times[-1]):
            self._read_on(*self._next)
        return taken

    def _read_on(self, times: Nanoseconds, rows: Matrix) -> None:
        if len(self.times) + len(times) > MOST_ROWS:
            raise LogError(
                f"more than {MOST_ROWS} rows at t = {int(times[0]) / 1e9} s: too many to be kept "
                "together"
            )
        self.times = np.concatenate([self.times, times])
        self._rows = np.concatenate([self._rows, rows])
        self._next = self._next_block()

    def _next_block(self) -> tuple[Nanoseconds, Matrix] | None:
        """Return the next block with rows; None: there is none."""
        return next((block for block in self._blocks if len(block[0])), None)


def numbered_instants(time_ns: Nanoseconds) -> NDArray[np.void]:
    """Return the times, the rows of one instant numbered, so that each limit of a jump is found.

    The times are in order: bisection finds the first row of an instant.
    """
    first_rows = np.searchsorted(time_ns, time_ns)
    instants = np.empty(len(time_ns), dtype=_INSTANT)
    instants["time"] = time_ns
    instants["count"] = np.arange(len(time_ns)) - first_rows
    return instants
