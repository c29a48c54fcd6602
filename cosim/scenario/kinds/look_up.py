"""Look-up table: a static function by its values."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix, Vector
from cosim.blocks.declared import with_units
from cosim.blocks.look_up import LookUpTable
from cosim.core.contracts import Component
from cosim.core.signals import PortUnit
from cosim.errors import UsageError
from cosim.native.blocks.functions import Extrapolation
from cosim.scenario.data_files.tables import read_table
from cosim.scenario.document.schema import NumberRow, NumberRows, matrix
from cosim.scenario.kinds.base import BuildContext, Kind
from cosim.scenario.kinds.table_keys import TableKeys

Points = tuple[list[Vector], Matrix]  # of each input, and the values on their grid


class LookUpTableKind(TableKeys, Kind):
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
        "error",
        description='outside the breakpoints: "error", "hold" (nearest value), or "linear"',
    )

    @property
    def computable(self) -> bool:
        """A file is not in the log."""
        return self.file is None or self._is_allowed

    def build(self, name: str, context: BuildContext) -> Component:
        arrays = (self.u, self.u1, self.u2, self.y)
        if self.file is not None:
            if any(array is not None for array in arrays):
                raise UsageError("look-up table: expected either file or arrays, got both")
            grid, values, units = self._read(context.file(self.file))
        else:
            grid, values = self._arrays()
            units = {}
        unit = None if "y" in units else self.unit_name
        table = LookUpTable(grid, values, extrapolation=self.extrapolation, unit=unit)
        return with_units(table, units)

    def _arrays(self) -> Points:
        given = {"u": self.u, "u1": self.u1, "u2": self.u2}
        points = {name: np.array(row) for name, row in given.items() if row is not None}
        if tuple(points) not in (("u",), ("u1", "u2")) or self.y is None:
            names = list(points)
            if self.y is not None:
                names.append("y")
            listed = ", ".join(names) or "nothing"
            raise UsageError(
                f"look-up table: expected u and y, or u1, u2 and y, or file, got {listed}"
            )
        is_rows = any(isinstance(row, tuple) for row in self.y)
        if is_rows != ("u1" in points):
            raise UsageError(
                "look-up table: y: expected one number per entry of u, or one row per entry of u1 "
                "with one number per entry of u2"
            )
        if not is_rows:
            return list(points.values()), np.array(self.y)
        rows = tuple(row for row in self.y if isinstance(row, tuple))
        return list(points.values()), matrix(rows, "y")

    def _read(self, path: Path) -> tuple[list[Vector], Matrix, dict[str, PortUnit]]:
        """Return breakpoints, values and the units of the ports."""
        table = read_table(path, self.form)
        headers = table.find(self.columns)
        if len(headers) not in (2, 3):
            raise UsageError(
                f"{table.label}: expected one or two columns of inputs and one of y, got "
                f"{len(headers)}; select them with columns"
            )
        columns = table.columns(headers)
        ports = ("u", "y") if len(headers) == 2 else ("u1", "u2", "y")
        units: dict[str, PortUnit] = {
            port: header.unit
            for port, header in zip(ports, headers, strict=True)
            if header.unit is not None
        }
        if len(headers) == 2:
            return [columns[:, 0]], columns[:, 1], units
        return *_gridded(columns, table.label), units


def _gridded(rows: Matrix, label: str) -> Points:
    """Return rows (u1, u2, y) as a grid; each of its points is there once, in any order."""
    u1 = np.unique(rows[:, 0])
    u2 = np.unique(rows[:, 1])
    pairs = len(u1) * len(u2)
    if pairs == len(rows):
        values = np.full((len(u1), len(u2)), np.nan)
        first = np.searchsorted(u1, rows[:, 0])
        second = np.searchsorted(u2, rows[:, 1])
        values[first, second] = rows[:, 2]
        different = np.unique(first * len(u2) + second)
        if len(different) == pairs:
            return [u1, u2], values
    raise UsageError(
        f"{label}: expected each pair of {len(u1)} x {len(u2)} breakpoints once ({pairs} "
        f"rows), got {len(rows)} rows"
    )
