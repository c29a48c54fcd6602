"""Signals of several components in one table: joined on time.

The table has a row at every instant at which one of its components has one; where another component
has none, its values are missing. Signals of one rate have no missing values. In logs of cosim a
component has one row at an instant; several rows of one instant are paired in their order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import floor
from typing import Protocol, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import NAN, Matrix, Nanoseconds
from cosim.core.recorded.selection import SelectedColumn
from cosim.core.signals import Channel
from cosim.instants import StepNs

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


class TableSource(Protocol):
    """What a table is made of."""

    @property
    def label(self) -> str:
        """What was recorded to."""
        ...

    @property
    def status(self) -> str:
        """How the run ended."""
        ...

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name."""
        ...

    @property
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""
        ...

    def blocks_of(self, components: Sequence[str]) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield names, times and rows of components as they come, each in order of time."""
        ...


def joined_rows(run: TableSource, columns: Sequence[SelectedColumn]) -> Iterator[JoinedRows]:
    """Yield a table of signals, some rows at a time, in order of time.

    Nothing is kept but rows of one component that wait for those of another: of a file little, as
    its chunks are in order of time.

    Raises
    ------
    LogError
        If a file is damaged.
    """
    components = list(dict.fromkeys(column.component for column in columns))
    places = [_places(columns, name) for name in components]
    pending: dict[str, _PendingRows] = {}
    for name in components:
        pending[name] = _PendingRows(floor(run.channels[name].period * run.step_ns))
    taken_before = -np.inf
    for name, times, rows in run.blocks_of(components):
        pending[name].add(times, rows)
        end = min(own.whole_before for own in pending.values())
        if end > taken_before:
            taken_before = end
            yield from _joined_before(end, pending, places, len(columns))
    yield from _joined_before(np.inf, pending, places, len(columns))


def _joined_before(
    end: float,
    pending: Mapping[str, _PendingRows],
    places: Sequence[tuple[NDArray[np.intp], NDArray[np.intp]]],
    width: int,
) -> Iterator[JoinedRows]:
    """Yield the rows before an instant, if there are any."""
    parts = [own.take(end) for own in pending.values()]
    if any(len(times) for times, _ in parts):
        yield _join(parts, places, width)


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
class _PendingRows:
    """Rows of a component that have come, and not yet those of all others at their instants."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._parts: list[tuple[Nanoseconds, Matrix]] = []
        self._width = 0
        self.whole_before = -np.inf  # [ns]; no row before this instant is still to come

    def add(self, times: Nanoseconds, rows: Matrix) -> None:
        """Add the next rows."""
        self._width = rows.shape[1]
        if len(times):
            self._parts.append((times, rows))
            self.whole_before = int(times[-1]) + self._period_ns

    def take(self, end: float) -> tuple[Nanoseconds, Matrix]:
        """Take the rows before an instant; those of the component are periodic."""
        taken: list[tuple[Nanoseconds, Matrix]] = []
        kept: list[tuple[Nanoseconds, Matrix]] = []
        for times, rows in self._parts:
            count = len(times) if end == np.inf else int(np.searchsorted(times, int(end)))
            taken.append((times[:count], rows[:count]))
            if count < len(times):
                kept.append((times[count:], rows[count:]))
        self._parts = kept
        if len(taken) == 1:
            return taken[0]
        no_times = np.empty(0, np.int64)
        no_rows = np.empty((0, self._width))
        all_times = np.concatenate([no_times, *(times for times, _ in taken)])
        return all_times, np.concatenate([no_rows, *(rows for _, rows in taken)])


def numbered_instants(time_ns: Nanoseconds) -> NDArray[np.void]:
    """Return the times, the rows of one instant numbered, so that each limit of a jump is found.

    The times are in order: bisection finds the first row of an instant.
    """
    first_rows = np.searchsorted(time_ns, time_ns)
    instants = np.empty(len(time_ns), dtype=_INSTANT)
    instants["time"] = time_ns
    instants["count"] = np.arange(len(time_ns)) - first_rows
    return instants
