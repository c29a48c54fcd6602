"""Look-up table: a static function of one or two inputs, given by its values on a grid.

Between the grid's points it is linear in each input; with two inputs it is bilinear in each cell::

    y = (1 - w1) ((1 - w2) y[i, j] + w2 y[i, j+1]) + w1 ((1 - w2) y[i+1, j] + w2 y[i+1, j+1])

with ``w = (u - u[i])/(u[i+1] - u[i])``: exactly the value of the grid at its points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.arrays import Matrix, Vector, frozen
from cosim.blocks.static import CompiledStatic
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.blocks.functions import Extrapolation, look_up_step


class LookUpTable(CompiledStatic):
    """``y = f(u)`` or ``y = f(u1, u2)``, interpolated linearly.

    Parameters
    ----------
    grid : sequence of Vector
        Increasing points of each input, one or two vectors of at least two.
    values : Matrix
        y on the grid, shape (N,) or (N1, N2).
    extrapolation : {"error", "hold", "linear"}
        Outside of the grid: y is not defined there, or the inputs are taken at its border, or the
        border's cell goes on.
    unit : str, optional
        The unit of y.

    Raises
    ------
    UsageError
        If grid and values are no table.
    """

    def __init__(
        self,
        grid: Sequence[Vector],
        values: Matrix,
        *,
        extrapolation: Extrapolation = "error",
        unit: str | None = None,
    ) -> None:
        self.names = ("u",) if len(grid) == 1 else ("u1", "u2")
        _check(self.names, grid, values)
        self.grid = tuple(frozen(points, 1) for points in grid)
        self.values = frozen(values, len(grid))
        self.extrapolation = extrapolation
        inputs = tuple(Signal(name) for name in self.names)
        y = Signal("y", 1, unit, "inherited")
        interface = Interface(inputs, (y,), {"y": self.names})
        step = look_up_step(self.grid, self.values, extrapolation)
        super().__init__(interface, step, self._beyond)

    def _beyond(self, u: Vector) -> str:
        covered = []
        for name, points, value in zip(self.names, self.grid, u, strict=True):
            lower = points[0]
            upper = points[-1]
            covered.append(f"{name} from {lower} to {upper} (got {value})")
        return (
            f'look-up table: covers {", ".join(covered)}; set extrapolation = "hold" or '
            '"linear" to go beyond'
        )


def _check(names: Sequence[str], grid: Sequence[Vector], values: Matrix) -> None:
    if len(grid) not in (1, 2):
        raise UsageError(f"look-up table: expected one or two inputs, got {len(grid)}")
    needed = tuple(len(points) for points in grid)
    if values.shape != needed:
        raise UsageError(
            f"look-up table: y: expected shape {needed}, one value for each point of "
            f"{' and '.join(names)}, got {values.shape}"
        )
    for name, points in zip(names, grid, strict=True):
        _check_points(name, points)
    if not np.isfinite(values).all():
        raise UsageError("look-up table: y: expected finite numbers, got NaN or infinity")


def _check_points(name: str, points: Vector) -> None:
    """Check the points of an input: two or more, finite and increasing."""
    if len(points) < 2:
        raise UsageError(f"look-up table: {name}: expected at least 2 points, got {len(points)}")
    # the width of a cell, too, must be a number
    if not (np.isfinite(points).all() and np.isfinite(np.ptp(points))):
        raise UsageError(f"look-up table: {name}: expected finite points and a finite range")
    not_increasing = np.flatnonzero(np.diff(points) <= 0.0)
    if not_increasing.size:
        index = int(not_increasing[0]) + 1
        before = points[index - 1]
        raise UsageError(
            f"look-up table: {name}: expected increasing points, got {name}[{index}] = "
            f"{points[index]} after {before}"
        )
