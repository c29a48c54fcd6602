"""Tables: signals and functions by their points, from arrays or a file."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, TypeAlias

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix, Vector
from cosim.blocks import source
from cosim.blocks.declared import with_units
from cosim.blocks.look_up import LookUpTable
from cosim.core.clock import Clock
from cosim.core.contracts import Component
from cosim.core.signals import PortUnit
from cosim.errors import UsageError
from cosim.native.blocks.functions import Extrapolation
from cosim.scenario.data_files.table import TableForm, second_of
from cosim.scenario.data_files.table import unit_of as header_unit
from cosim.scenario.data_files.tables import read_table
from cosim.scenario.document.schema import NumberRow, NumberRows, matrix
from cosim.scenario.kinds.base import BuildContext, Kind

UNSEEN: Final = 0.01  # of a column's range

Points: TypeAlias = tuple[list[Vector], Matrix]  # of each input, and the values on their grid


# --- a signal ---


class TableKind(TableForm, Kind):
    """y = interpolated points from arrays or a CSV file with a header line."""

    ports: ClassVar[str] = "-> y"
    is_function_of_time: ClassVar[bool] = True
    kind: Literal["table"]
    t: NumberRow | None = Field(
        None, description='times [s], increasing; with "zero-order" two may be equal: a jump'
    )
    y: NumberRow | NumberRows | None = Field(
        None, description="values at these times, or rows of values"
    )
    file: str | None = Field(
        None,
        description="CSV file in place of t and y; its first line names the columns, also with "
        "units, such as t [ms]",
    )
    time: str = Field("t", description="column of the times")
    columns: tuple[str, ...] | None = Field(
        None, description="columns of the values; default: all others"
    )
    interpolation: Literal["linear", "zero-order"] = Field(
        "linear", description='between the times: "linear" interpolation, or "zero-order" hold'
    )
    extrapolation: Literal["error", "hold"] = Field(
        "error",
        description='before the first and after the last time: "error", or "hold" (nearest value)',
    )

    @property
    def computable(self) -> bool:
        """A file is not in the log."""
        return self.file is None or self._is_allowed

    def build(self, name: str, context: BuildContext) -> Component:
        if (self.file is None) == (self.t is None or self.y is None):
            raise UsageError("table: expected either t and y, or file")
        unit: str | tuple[str, ...] | None = None
        if self.file is not None:
            t, y, unit = self._read(context.file(self.file))
        else:
            rows = [row if isinstance(row, tuple) else (row,) for row in self.y or ()]
            t = np.array(self.t)
            y = matrix(tuple(rows), "y")
        hold = self.interpolation == "zero-order"
        clock = context.clock
        source.check_points(t, y, hold=hold)
        t = clock.at_points(t)
        if hold:
            t = held_from_points(t, y, clock)
        else:
            for note in unseen_rows(t, y, clock):
                context.warn(name, note)
        extrapolate = self.extrapolation == "hold"
        covers = t[0] <= clock.start_time <= clock.stop <= t[-1]
        if not (extrapolate or covers):
            raise UsageError(
                f"table: expected times from {clock.start_time} s to {clock.stop} s (the run), got "
                f'{t[0]} s to {t[-1]} s; extrapolation = "hold" keeps the nearest value'
            )
        return source.Table(t, y, hold=hold, extrapolate=extrapolate, unit=unit or self.unit_name)

    def _read(self, path: Path) -> tuple[Vector, Matrix, str | tuple[str, ...] | None]:
        """Return times [s], values and their units."""
        table = read_table(path, self)
        (clock,) = table.find([self.time])
        parts = [header for header in table.find(self.columns) if header != clock]
        second = second_of(table.label, clock)
        t = table.columns([clock])[:, 0]
        if second != 1:
            t = np.array([float(Decimal(repr(time)) * second) for time in t.tolist()])
        return t, table.columns(parts), header_unit(table.label, "y", parts)


def held_from_points(t: Vector, y: Matrix, clock: Clock) -> Vector:
    """Return the instants of a held table, those that are communication points exactly so.

    Parameters
    ----------
    t : Vector, shape (N,)
        Increasing [s]; one that differs from a communication point by the rounding of doubles, or
        that is its whole nanosecond, is that point.
    y : Matrix, shape (N, n)

    Raises
    ------
    UsageError
        If a value changes between two communication points of the run.
    """
    on_grid = clock.is_point_or_stamp(t)
    changes = np.zeros(len(t), np.bool_)
    changes[1:] = (y[1:] != y[:-1]).any(axis=1)
    in_run = (t > clock.start_time) & (t <= clock.stop)
    wrong = np.flatnonzero(changes & in_run & ~on_grid)
    if wrong.size:
        first = int(wrong[0])
        instant = float(t[first])
        before, after = clock.points_around(instant)
        others = f" ({wrong.size} such instants)" if wrong.size > 1 else ""
        raise UsageError(
            f"table: y jumps at t[{first}] = {instant!r} s, between two communication points; "
            f"expected {before!r} s or {after!r} s{others}"
        )
    held: Vector = np.where(on_grid, clock.nearest_points(t), t)
    return held


def unseen_rows(t: Vector, y: Matrix, clock: Clock) -> list[str]:
    """Return what is to be known of rows that a linearly interpolated table has between points.

    The signal is a straight line from one communication point to the next, so what the table does
    between them is lost.

    Parameters
    ----------
    t : Vector, shape (N,)
    y : Matrix, shape (N, n)

    Returns
    -------
    list of str
        Empty where no row is farther from the line than a hundredth of the range of its column.
    """
    in_run = (t > clock.start_time) & (t < clock.stop)
    between = in_run & ~clock.is_point_or_stamp(t)
    times = t[between]
    before = clock.start_time + np.floor((times - clock.start_time) / clock.h) * clock.h
    distances = np.zeros(len(times))
    for column in y.T:
        first = np.interp(before, t, column)
        last = np.interp(before + clock.h, t, column)
        line = first + (last - first) * (times - before) / clock.h
        tallest = np.ptp(column) or 1.0
        distances = np.maximum(distances, np.abs(column[between] - line) / tallest)
    unseen = np.count_nonzero(distances > UNSEEN)
    if not unseen:
        return []
    row = int(distances.argmax())
    return [
        f"{unseen} rows between communication points are not seen: the signal is a straight line "
        f"there, and at t = {float(times[row])!r} s it is {distances[row]:.2g} of the table's "
        "range away from the row; a smaller step shows them"
    ]


# --- a function ---


class LookUpTableKind(TableForm, Kind):
    """y = f(u) or f(u1, u2), linear between breakpoints from arrays or a CSV file."""

    ports: ClassVar[str] = "u, or u1, u2 -> y"
    kind: Literal["look-up-table"]
    u: NumberRow | None = Field(None, description="breakpoints of u, increasing")
    u1: NumberRow | None = Field(None, description="breakpoints of u1, increasing")
    u2: NumberRow | None = Field(None, description="breakpoints of u2, increasing")
    y: NumberRow | NumberRows | None = Field(
        None, description="values at the breakpoints; with two inputs one row per entry of u1"
    )
    file: str | None = Field(
        None,
        description="CSV or another table in place of the arrays: columns of the inputs, then y",
    )
    columns: tuple[str, ...] | None = Field(
        None, description="names of the columns; default: all columns of the file"
    )
    extrapolation: Extrapolation = Field(
        "error", description='outside the breakpoints: "error", "hold" (nearest value), or "linear"'
    )

    @property
    def computable(self) -> bool:
        """A file is not in the log."""
        return self.file is None or self._is_allowed

    def build(self, name: str, context: BuildContext) -> Component:
        given = {key: getattr(self, key) for key in ("u", "u1", "u2", "y")}
        given = {key: rows for key, rows in given.items() if rows is not None}
        units: dict[str, PortUnit] = {}
        if self.file is None:
            grid, values = _points(given)
        elif given:
            raise UsageError("look-up table: expected either file or arrays, got both")
        else:
            grid, values, units = self._read(context.file(self.file))
        unit = None if "y" in units else self.unit_name
        table = LookUpTable(grid, values, extrapolation=self.extrapolation, unit=unit)
        return with_units(table, units)

    def _read(self, path: Path) -> tuple[list[Vector], Matrix, dict[str, PortUnit]]:
        """Return breakpoints, values and the units of the ports."""
        table = read_table(path, self)
        headers = table.find(self.columns)
        if len(headers) not in (2, 3):
            raise UsageError(
                f"{table.label}: expected one or two columns of inputs and one of y, got "
                f"{len(headers)}; select them with columns"
            )
        columns = table.columns(headers)
        ports = ("u", "y") if len(headers) == 2 else ("u1", "u2", "y")
        pairs = zip(ports, headers, strict=True)
        units: dict[str, PortUnit] = {
            port: header.unit for port, header in pairs if header.unit is not None
        }
        if len(headers) == 2:
            return [columns[:, 0]], columns[:, 1], units
        return *_gridded(columns, table.label), units


def _points(given: Mapping[str, Any]) -> Points:
    """Return the points of the arrays of a table, by their keys."""
    if tuple(given) not in (("u", "y"), ("u1", "u2", "y")):
        listed = ", ".join(given) or "nothing"
        raise UsageError(f"look-up table: expected u and y, or u1, u2 and y, or file, got {listed}")
    grid = [np.array(row) for key, row in given.items() if key != "y"]
    is_rows = any(isinstance(row, tuple) for row in given["y"])
    if is_rows != (len(grid) == 2):
        raise UsageError(
            "look-up table: y: expected one number per entry of u, or one row per entry of u1 "
            "with one number per entry of u2"
        )
    return grid, matrix(given["y"], "y") if is_rows else np.array(given["y"])


def _gridded(rows: Matrix, label: str) -> Points:
    """Return rows (u1, u2, y) as a grid; each of its points is there once, in any order."""
    u1 = np.unique(rows[:, 0])
    u2 = np.unique(rows[:, 1])
    pairs = len(u1) * len(u2)
    in_order = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    grid = np.column_stack([np.repeat(u1, len(u2)), np.tile(u2, len(u1))])
    if np.array_equal(in_order[:, :2], grid):
        return [u1, u2], in_order[:, 2].reshape(len(u1), len(u2))
    raise UsageError(
        f"{label}: expected each pair of {len(u1)} x {len(u2)} breakpoints once ({pairs} "
        f"rows), got {len(rows)} rows"
    )
