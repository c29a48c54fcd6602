"""Runs as tables of pandas, polars and xarray, which are imported only when they are used.

All three follow :mod:`cosim.core.recorded.joined_rows`: they have a row at every instant at which
one of the chosen components has one. Where another component has no row there is NaN, or in polars
null, as polars distinguishes a missing value from NaN.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.recorded.joined_rows import JoinedRows, TableSource, joined_rows
from cosim.core.recorded.selection import SelectedColumn, select_signals, selected_columns
from cosim.core.recorded.signals import RecordedPort
from cosim.errors import UsageError
from cosim.instants import NANOSECONDS
from cosim.units import units_text

if TYPE_CHECKING:
    import pandas
    import polars
    import xarray

TIME: Final = "t"  # name of the column of instants [s]


def to_pandas(run: TableSource, signals: Iterable[str] | str | None) -> pandas.DataFrame:
    """Return chosen signals as a frame: a column an element, the index is the time [s].

    Raises
    ------
    UsageError
        If there is no pandas.
    LogError
        If a signal is unknown, or a file is damaged.
    """
    pandas_ = _library("pandas")
    columns = selected_columns(select_signals(run.channels, signals, source=run.label))
    table = _whole(run, columns)
    index = pandas_.Index(_seconds(table), name=TIME)
    names = [column.name for column in columns]
    return pandas_.DataFrame(table.values, index=index, columns=names)


def to_polars(run: TableSource, signals: Iterable[str] | str | None) -> polars.DataFrame:
    """Return chosen signals as a frame: a column an element, after that of the time [s].

    Raises
    ------
    UsageError
        If there is no polars.
    LogError
        If a signal is unknown, or a file is damaged.
    """
    polars_ = _library("polars")
    columns = selected_columns(select_signals(run.channels, signals, source=run.label))
    table = _whole(run, columns)
    series = [polars_.Series(TIME, _seconds(table))]
    for number, column in enumerate(columns):
        values = polars_.Series(column.name, np.ascontiguousarray(table.values[:, number]))
        if table.missing is not None and table.missing[:, number].any():
            values = values.scatter(np.flatnonzero(table.missing[:, number]), None)
        series.append(values)
    return polars_.DataFrame(series)


def to_xarray(run: TableSource, signals: Iterable[str] | str | None) -> xarray.Dataset:
    """Return chosen signals as variables over the time [s], those of several elements in 2-D.

    Their attributes have the units, and what the signals are.

    Raises
    ------
    UsageError
        If there is no xarray.
    LogError
        If a signal is unknown, or a file is damaged.
    """
    xarray_ = _library("xarray")
    selection = select_signals(run.channels, signals, source=run.label)
    columns = selected_columns(selection)
    table = _whole(run, columns)
    places = {(column.component, column.column): i for i, column in enumerate(columns)}
    variables: dict[str, Any] = {}
    for name, port in selection.items():
        own = [places[port.channel.name, i] for i in range(port.columns.start, port.columns.stop)]
        if port.size == 1:
            variables[name] = (TIME, table.values[:, own[0]], _attributes(port))
        else:
            dimensions = (TIME, f"element of {name}")
            variables[name] = (dimensions, table.values[:, own], _attributes(port))
    time = (TIME, _seconds(table), {"units": "s", "long_name": "simulation time"})
    return xarray_.Dataset(variables, {TIME: time}, {"source": run.label, "status": run.status})


def _whole(run: TableSource, columns: tuple[SelectedColumn, ...]) -> JoinedRows:
    """Return all rows of a table."""
    parts = list(joined_rows(run, columns))
    if len(parts) == 1:
        return parts[0]
    time_ns = np.concatenate([np.empty(0, np.int64), *(part.time_ns for part in parts)])
    values = np.concatenate([np.empty((0, len(columns))), *(part.values for part in parts)])
    missing = None
    if any(part.missing is not None for part in parts):
        missing = np.concatenate([_missing(part) for part in parts])
    return JoinedRows(time_ns, values, missing)


def _missing(part: JoinedRows) -> Any:
    return np.zeros(part.values.shape, np.bool_) if part.missing is None else part.missing


def _seconds(table: JoinedRows) -> Vector:
    return table.time_ns / NANOSECONDS


def _attributes(port: RecordedPort) -> dict[str, str]:
    """Return what a signal is, in the names of the CF conventions where these have one."""
    signal = port.described
    attributes = {"units": units_text(port.measures), "long_name": signal.description}
    attributes |= {"role": signal.role, "variability": signal.variability, "type": signal.type}
    return {key: text for key, text in attributes.items() if text}


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise UsageError(
            f"to_{name} needs {name}, which is not installed: pip install {name}, or, in a clone "
            f"of cosim, pip install -e '.[{name}]'"
        ) from error
