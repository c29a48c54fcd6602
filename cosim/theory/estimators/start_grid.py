"""Starts of theta from y itself, where nothing else is known yet.

For given theta y is linear in all other unknowns. So the responses to every component at every
point of a grid of its own theta are columns of one regression: a single pass over the samples makes
the triangle R of all of them, and the least squares of any combination of points follow from a
choice of its columns, without the samples. Rows are means of successive samples. Unlike the
regression (25) this needs neither delays nor a transient that is over.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.estimation import Generators, OutputErrorConstants, ResponseRecord
from cosim.native.start_grid import StartGridConstants, StartGridModel


def start_grid(
    model: OutputErrorConstants, lower: Vector, upper: Vector, *, points: int, average: int
) -> StartGridConstants:
    """Return the grid over a box.

    Parameters
    ----------
    model : OutputErrorConstants
        Of y.
    lower, upper : Vector, shape (P,)
        The box.
    points : int
        In every direction; one where the box has no width.
    average : int
        Samples that make one row.
    """
    generators = model.generators
    matrices = _Matrices(generators)
    systems = []
    rows = []
    thetas = []
    component = []
    begin = 0
    for i, count in enumerate(generators.count):
        grid = _points(lower[begin : begin + count], upper[begin : begin + count], points)
        for theta in grid:
            systems.append(matrices.G(i, theta).ravel())
            rows.append(matrices.c(i))
            component.append(i)
        thetas.append(grid.ravel())
        begin += count
    at_points = Generators(
        size=tuple(generators.size[i] for i in component),
        count=(0,) * len(component),
        c=np.concatenate(rows),
        G0=np.concatenate(systems),
        G1=np.zeros(0),
    )
    repeated = replace(
        model,
        generators=at_points,
        average=average,
        source=tuple(component),
    )
    return StartGridConstants(
        model=repeated,
        size=generators.size,
        count=generators.count,
        points=tuple(component.count(i) for i in range(len(generators.size))),
        theta=np.concatenate(thetas),
    )


def search_starts(grid: StartGridConstants, record: ResponseRecord, *, most: int) -> Matrix:
    """Return the best points of the grid for a record of y, the best first, shape (starts, P)."""
    model = StartGridModel(grid)
    samples = ResponseRecord(model.model, record.residual, record.alpha, record.interval)
    return model.search(samples.make(np.zeros(0)), most)


class _Matrices:
    """The matrices of each component among those of all."""

    def __init__(self, generators: Generators) -> None:
        self._generators = generators
        self._first = np.cumsum([0, *generators.size])
        squares = [size * size for size in generators.size]
        self._G0 = np.cumsum([0, *squares])
        slopes = [n * v for n, v in zip(generators.count, squares, strict=True)]
        self._G1 = np.cumsum([0, *slopes])

    def c(self, i: int) -> Vector:
        """Return the output row."""
        return self._generators.c[self._first[i] : self._first[i + 1]]

    def G(self, i: int, theta: Vector) -> Matrix:
        """Return the system matrix at theta."""
        v = self._generators.size[i]
        constant = self._generators.G0[self._G0[i] : self._G0[i + 1]].reshape(v, v)
        slopes = self._generators.G1[self._G1[i] : self._G1[i + 1]].reshape(-1, v, v)
        G: Matrix = constant.copy()
        for value, slope in zip(theta, slopes, strict=True):
            G += value * slope
        return G


def _points(lower: Vector, upper: Vector, points: int) -> Matrix:
    """Return the middles of equal parts of the box, shape (count, parameters)."""
    axes = []
    for low, high in zip(lower, upper, strict=True):
        count = points if high > low else 1
        axes.append([low + (k + 0.5) / count * (high - low) for k in range(count)])
    points_of_all = list(product(*axes))
    grid = np.array(points_of_all, np.float64)
    return grid.reshape(len(points_of_all), len(lower))
