"""Gains of the internal model that follow theta: nodes of a grid, interpolated between them.

Multilinear interpolation, affine in each parameter: the certificate rests on that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector, frozen
from cosim.theory.compensation.internal_model import ParameterBox


@dataclass(frozen=True, eq=False, kw_only=True)
class Stabilization:
    """How the internal model joins the state feedback, at one theta.

    Shapes: ``K_w (n_u, n_w)``, ``X (n_w, n)``, ``B_w (n_w, n_u)``.
    """

    K_w: Matrix
    X: Matrix
    B_w: Matrix

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        for name in ("K_w", "X", "B_w"):
            matrix = getattr(self, name)
            object.__setattr__(self, name, frozen(matrix, 2))

    def less(self, other: Stabilization) -> Stabilization:
        """Return the differences from that at another theta."""
        K_w = self.K_w - other.K_w
        X = self.X - other.X
        B_w = self.B_w - other.B_w
        return Stabilization(K_w=K_w, X=X, B_w=B_w)


@dataclass(frozen=True, eq=False, kw_only=True)
class Schedule:
    """The gains at the nodes of a grid over a box.

    Parameters
    ----------
    box : ParameterBox
    counts : tuple of int
        Into how many parts the interval of each parameter is cut; 0: it is one point.
    K_w, X, B_w : arrays
        Those of :class:`Stabilization` at every node, one behind the other, the last parameter the
        fastest.
    """

    box: ParameterBox
    counts: tuple[int, ...]
    K_w: NDArray[np.float64]
    X: NDArray[np.float64]
    B_w: NDArray[np.float64]

    def at(self, theta: Vector) -> Stabilization:
        """Interpolate the gains."""
        corners = corner_weights(theta, self.box.lower, self.box.upper, self.counts)
        K_w = blended(self.K_w, corners)
        X = blended(self.X, corners)
        B_w = blended(self.B_w, corners)
        return Stabilization(K_w=K_w, X=X, B_w=B_w)

    def in_units(self, units: Vector) -> Schedule:
        """Return it with w in other units, shape ``(n_w,)``."""
        rows = units[:, np.newaxis]
        K_w = self.K_w * units
        X = self.X / rows
        B_w = self.B_w / rows
        return replace(self, K_w=K_w, X=X, B_w=B_w)

    def cells(self) -> list[ParameterBox]:
        """Return the boxes between neighboring nodes."""
        axes = []
        for ends in node_axes(self.box, self.counts):
            above = ends[1:] or ends
            neighbors = zip(ends, above, strict=False)
            axes.append(list(neighbors))
        cells = []
        for sides in product(*axes):
            lower = np.array([side[0] for side in sides])
            upper = np.array([side[1] for side in sides])
            cells.append(ParameterBox(lower, upper))
        return cells


def node_axes(box: ParameterBox, counts: Sequence[int]) -> list[list[float]]:
    """Return the nodes along each parameter."""
    axes = []
    for lower, upper, count in zip(box.lower, box.upper, counts, strict=True):
        axis = np.linspace(lower, upper, count + 1)
        axes.append(axis.tolist())
    return axes


def corner_weights(
    theta: Vector, lower: Vector, upper: Vector, counts: Sequence[int]
) -> list[tuple[int, float]]:
    """Return the nodes around theta, each with its weight; beyond the box those of its border."""
    corners = [(0, 1.0)]
    for value, low, high, count in zip(theta, lower, upper, counts, strict=True):
        if not count:
            continue
        relative = (value - low) / (high - low)
        position = float(relative * count)
        below = max(int(position), 0)
        begin = min(below, count - 1)
        beyond = max(position - begin, 0.0)
        fraction = min(beyond, 1.0)
        split = []
        for index, weight in corners:
            node = index * (count + 1) + begin
            split.append((node, weight * (1.0 - fraction)))
            split.append((node + 1, weight * fraction))
        corners = split
    return corners


def blended(table: NDArray[np.float64], corners: Sequence[tuple[int, float]]) -> Matrix:
    """Sum the entries of a table with their weights, in a fixed order."""
    total: Matrix = np.zeros(table.shape[1:])
    for index, weight in corners:
        total += weight * table[index]
    return total
