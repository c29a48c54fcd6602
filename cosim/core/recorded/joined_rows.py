"""Signals of several components in one table: joined on time; frames of pandas, polars and xarray.

The table has a row at every instant at which one of its components has one; where another component
has none, its values are missing: NaN, or in polars null, as polars distinguishes a missing value
from NaN. Signals of one rate have no missing values. In logs of cosim a component has one row at an
instant; several rows of one instant are paired in their order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import floor
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import NAN, Matrix, Nanoseconds, Vector, is_absent
from cosim.core.recorded.selection import SelectedColumn, select_signals, selected_columns
from cosim.core.recorded.signals import RecordedPort
from cosim.core.recording import Recording, TimedRows, joined
from cosim.errors import optional_library
from cosim.instants import NANOSECONDS
from cosim.units import units_text

if TYPE_CHECKING:
    import pandas
    import polars
    import xarray

TIME: Final = "t"  # name of the column of instants [s]
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
        Where a column has no row: its component has none, or a cell is empty; None: nowhere.
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

    Nothing is kept but rows of one component that wait for those of another: of a file little, as
    its chunks are in order of time.

    Raises
    ------
    LogError
        If a file is damaged.
    """
    components = list(dict.fromkeys(column.component for column in columns))
    gaps = [number for number, column in enumerate(columns) if column.signal.optional]
    places = [_places(columns, name) for name in components]
    waiting: dict[str, list[TimedRows]] = {name: [] for name in components}
    # none of a component that is before this instant [ns] is still to come: they are periodic
    whole_before = dict.fromkeys(components, -np.inf)
    taken_before = -np.inf
    for name, times, rows in run.blocks_of(components):
        waiting[name].append((times, rows))
        if len(times):
            period_ns = floor(run.channels[name].period * run.step_ns)
            whole_before[name] = int(times[-1]) + period_ns
        end = min(whole_before.values())
        if end > taken_before:
            taken_before = end
            parts = [_take(own, end) for own in waiting.values()]
            yield from _without_gaps(_join(parts, places, len(columns)), gaps)
    parts = [_take(own, np.inf) for own in waiting.values()]
    yield from _without_gaps(_join(parts, places, len(columns)), gaps)


def _without_gaps(parts: Iterable[JoinedRows], gaps: Sequence[int]) -> Iterator[JoinedRows]:
    """Say where cells are empty of columns that may have gaps; leave out rows of nothing else."""
    for part in parts:
        is_empty = is_absent(part.values[:, gaps])
        if not is_empty.any():
            yield part
            continue
        missing = np.zeros(part.values.shape, np.bool_) if part.missing is None else part.missing
        missing[:, gaps] |= is_empty
        there = ~missing.all(axis=1)
        if there.any():
            yield JoinedRows(part.time_ns[there], part.values[there], missing[there])


def _places(
    columns: Sequence[SelectedColumn], component: str
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return which columns of the table a component has, and where these are in its rows."""
    own = [place for place, column in enumerate(columns) if column.component == component]
    sources = [columns[place].column for place in own]
    return np.array(own, dtype=np.intp), np.array(sources, dtype=np.intp)


def _take(waiting: list[TimedRows], end: float) -> TimedRows:
    """Take the rows before an instant; the others go on waiting."""
    times, rows = joined(waiting)
    count = len(times) if end == np.inf else int(np.searchsorted(times, int(end)))
    waiting[:] = [(times[count:], rows[count:])]
    return times[:count], rows[:count]


def _join(
    parts: Sequence[TimedRows],
    places: Sequence[tuple[NDArray[np.intp], NDArray[np.intp]]],
    width: int,
) -> Iterator[JoinedRows]:
    """Join the rows of components in one window of time, if there are any."""
    all_times = [times for times, _ in parts]
    first = all_times[0]
    if not any(map(len, all_times)):
        return
    if all(np.array_equal(times, first) for times in all_times):
        values = np.empty((len(first), width))
        for (_, rows), (own, sources) in zip(parts, places, strict=True):
            values[:, own] = rows[:, sources]
        yield JoinedRows(first, values, None)
        return
    several = any((times[1:] == times[:-1]).any() for times in all_times)
    instants = [numbered_instants(times) if several else times for times in all_times]
    union, where = np.unique(np.concatenate(instants), return_inverse=True)
    positions = np.split(where, np.cumsum([len(times) for times in all_times])[:-1])
    values = np.full((len(union), width), NAN)
    missing = np.ones((len(union), width), dtype=np.bool_)
    for (_, rows), (own, sources), at in zip(parts, places, positions, strict=True):
        values[np.ix_(at, own)] = rows[:, sources]
        missing[np.ix_(at, own)] = False
    yield JoinedRows(union["time"].copy() if several else union, values, missing)


def numbered_instants(time_ns: Nanoseconds) -> NDArray[np.void]:
    """Return the times, the rows of one instant numbered, so that each limit of a jump is found.

    The times are in order: bisection finds the first row of an instant.
    """
    first_rows = np.searchsorted(time_ns, time_ns)
    instants = np.empty(len(time_ns), dtype=_INSTANT)
    instants["time"] = time_ns
    instants["count"] = np.arange(len(time_ns)) - first_rows
    return instants


# --- frames of other libraries, which are imported only when they are used ---


def to_pandas(run: Recording, signals: Iterable[str] | str | None) -> pandas.DataFrame:
    """Return chosen signals as a frame: a column an element, the index is the time [s]."""
    module = optional_library("pandas", "to_pandas needs", "pandas")
    _, columns, table = _chosen(run, signals)
    index = module.Index(_seconds(table), name=TIME)
    names = [column.name for column in columns]
    return module.DataFrame(table.values, index=index, columns=names)


def to_polars(run: Recording, signals: Iterable[str] | str | None) -> polars.DataFrame:
    """Return chosen signals as a frame: a column an element, after that of the time [s]."""
    module = optional_library("polars", "to_polars needs", "polars")
    _, columns, table = _chosen(run, signals)
    series = [module.Series(TIME, _seconds(table))]
    for number, column in enumerate(columns):
        values = module.Series(column.name, np.ascontiguousarray(table.values[:, number]))
        if table.missing is not None and table.missing[:, number].any():
            values = values.scatter(np.flatnonzero(table.missing[:, number]), None)
        series.append(values)
    return module.DataFrame(series)


def to_xarray(run: Recording, signals: Iterable[str] | str | None) -> xarray.Dataset:
    """Return chosen signals as variables over the time [s], those of several elements in 2-D.

    Their attributes have the units, and what the signals are.
    """
    module = optional_library("xarray", "to_xarray needs", "xarray")
    selection, columns, table = _chosen(run, signals)
    places = {(column.component, column.column): i for i, column in enumerate(columns)}
    variables: dict[str, Any] = {}
    for name, port in selection.items():
        own = [places[port.channel.name, i] for i in range(port.columns.start, port.columns.stop)]
        dimensions = (TIME,) if port.size == 1 else (TIME, f"element of {name}")
        values = table.values[:, own[0] if port.size == 1 else own]
        variables[name] = (dimensions, values, _attributes(port))
    time = (TIME, _seconds(table), {"units": "s", "long_name": "simulation time"})
    return module.Dataset(variables, {TIME: time}, {"source": run.label, "status": run.status})


def _chosen(
    run: Recording, signals: Iterable[str] | str | None
) -> tuple[Mapping[str, RecordedPort], Sequence[SelectedColumn], JoinedRows]:
    """Return chosen signals, their elements, and all rows of these."""
    selection = select_signals(run.channels, signals, source=run.label)
    columns = selected_columns(selection)
    parts = list(joined_rows(run, columns))
    if len(parts) == 1:
        return selection, columns, parts[0]
    time_ns = np.concatenate([np.empty(0, np.int64), *(part.time_ns for part in parts)])
    values = np.concatenate([np.empty((0, len(columns))), *(part.values for part in parts)])
    missing = np.zeros(values.shape, np.bool_)
    start = 0
    for part in parts:
        if part.missing is not None:
            missing[start : start + len(part)] = part.missing
        start += len(part)
    return selection, columns, JoinedRows(time_ns, values, missing)


def _seconds(table: JoinedRows) -> Vector:
    return table.time_ns / NANOSECONDS


def _attributes(port: RecordedPort) -> dict[str, str]:
    """Return what a signal is, in the names of the CF conventions where these have one."""
    signal = port.described
    attributes = {"units": units_text(port.measures), "long_name": signal.description}
    attributes |= {"role": signal.role, "variability": signal.variability, "type": signal.type}
    return {key: text for key, text in attributes.items() if text}
