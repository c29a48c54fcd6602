"""Starts that lead to optima of output error other than a known one, or that a grid misses.

The sum of squares has several minima: a term may take the part of another one, or of noise. A
coarse grid leads to some. Others are found **beside** a known optimum: all terms but one stay where
they are, and every minimum along the parameters of the one is a start. On a grid alone these are
hidden by what the distance of points costs the terms that are known well. Where neither explains
the data, starts are **spread** over the box, those of interchangeable terms far from one another:
two that come close together stay so, with amplitudes that cancel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import StartError
from cosim.native.estimation.output_error import Generators
from cosim.theory.disturbed_plant import NoiseModel
from cosim.theory.estimators.output_error import OutputErrorFit, OutputErrorProblem, SampledProblem
from cosim.theory.estimators.start_grid import (
    COLUMNS,
    RecordsOnGrid,
    axis_points,
    box_of_search,
    points_of_box,
    records_on_grid,
)
from cosim.theory.interchangeable import groups_of

COARSE_POINTS: Final = 32  # along a parameter
STARTS_OF_GRID: Final = 5
STARTS_OF_TERM: Final = 2  # minima along the parameters of one term
STARTS_SPREAD: Final = 12
AXIS_POINTS: Final = 256  # along a parameter, among which spread starts are
ROOT_STEPS: Final = 40  # of a fixed-point iteration whose error is divided by 3 or more in each
DEPENDENT: Final = 1e-6  # part of a column that others leave, relative to it: it is rounding


def search_optima(
    problem: OutputErrorProblem, known: Vector, noise: NoiseModel
) -> list[OutputErrorFit]:
    """Return optima beside a known one, as if the noise were white, the best first.

    Raises
    ------
    AssumptionError
        As :func:`cosim.theory.estimators.output_error.fit_output_error`.
    """
    sampled = problem.sampled(noise.without_color())
    return _optima(sampled, starts_beside(sampled, known))


def spread_optima(problem: OutputErrorProblem, noise: NoiseModel) -> list[OutputErrorFit]:
    """Return the optima that spread starts lead to, as if the noise were white, the best first.

    Raises
    ------
    AssumptionError
        As :func:`cosim.theory.estimators.output_error.fit_output_error`.
    """
    return _optima(problem.sampled(noise.without_color()), _spread_starts(problem))


def _optima(sampled: SampledProblem, starts: Sequence[Vector]) -> list[OutputErrorFit]:
    """Return the fits from starts that have converged, the best first."""
    fits = []
    for start in starts:
        with suppress(StartError):
            fits.append(sampled.fit(start))
    converged = [fit for fit in fits if fit.converged]
    return sorted(converged, key=lambda fit: fit.deviation)


def starts_beside(sampled: SampledProblem, known: Vector) -> list[Vector]:
    """Return the best points of a coarse grid, and minima beside a known optimum, each (P,)."""
    problem = sampled.problem
    box = box_of_search(problem)
    points = axis_points(problem.generators, box.graded, most=COARSE_POINTS, columns=COLUMNS)
    alike = problem.interchangeable
    on_grid = records_on_grid(sampled.records, box, points, alike=alike, beside=[known])
    return [*on_grid.search(STARTS_OF_GRID), *_minima_beside(on_grid, problem.generators, known)]


def _spread_starts(problem: OutputErrorProblem) -> list[Vector]:
    """Return starts that fill the box evenly, each part of it for one of interchangeable terms.

    The sequence is that of M. Roberts (2018): multiples of the powers of the root of
    ``x^(P+1) = x + 1``.
    """
    box = box_of_search(problem)
    matrices = problem.generators
    P = matrices.parameters
    root = 2.0
    for _ in range(ROOT_STEPS):
        root = (1.0 + root) ** (1.0 / (P + 1.0))
    ratios = root ** -np.arange(1.0, P + 1.0)
    places = np.outer(np.arange(1, STARTS_SPREAD + 1), ratios) % 1.0
    for group in groups_of(problem.interchangeable):
        for k, term in enumerate(group):
            if matrices.count[term]:
                last = matrices.each[term].theta.stop - 1
                places[:, last] = (k + places[:, last]) / len(group)
    starts = np.empty_like(places)
    for j in range(P):
        own = slice(j, j + 1)
        axis = points_of_box(box.lower[own], box.upper[own], [AXIS_POINTS], box.graded[own])[:, 0]
        starts[:, j] = axis[(places[:, j] * len(axis)).astype(np.intp)]
    return list(starts)


def _minima_beside(on_grid: RecordsOnGrid, matrices: Generators, known: Vector) -> Iterator[Vector]:
    """Yield the known theta with the part of one term at other minima of the squares along it.

    The known part is the last point of each term, so that all others explain what they can.
    """
    for i, generator in enumerate(matrices.each):
        if not matrices.count[i]:
            continue
        squares = _squares_along(on_grid, i)
        points = _points_of(on_grid, i)
        for place in _minima_apart(points, squares)[:STARTS_OF_TERM]:
            start = known.copy()
            start[generator.theta] = points[place]
            yield start


def _points_of(on_grid: RecordsOnGrid, term: int) -> Matrix:
    """Return the points of a term, shape (points, parameters of the term)."""
    constants = on_grid.constants
    entries = np.multiply(constants.points, constants.count)
    end = entries[: term + 1].sum()
    own = constants.theta[end - entries[term] : end]
    return own.reshape(constants.points[term], constants.count[term])


def _squares_along(on_grid: RecordsOnGrid, term: int) -> Vector:
    """Return the sum of squares at each point of a term, all others at their last points."""
    constants = on_grid.constants
    sizes = np.array(constants.size)
    widths = sizes * np.array(constants.points)
    ends = np.cumsum(widths)
    own = slice(ends[term] - widths[term], ends[term])
    others = []
    for k, end in enumerate(ends):
        if k != term:
            others.append(np.arange(end - sizes[k], end))
    squares = np.zeros(constants.points[term])
    for R in on_grid.triangles:
        x0_and_offset = np.arange(ends[-1], R.shape[1] - 1)
        fixed = R[:, np.concatenate([*others, x0_and_offset])]
        squares += _squares_beside(R[:, own], fixed, R[:, -1], constants.size[term])
    return squares


def _squares_beside(columns: Matrix, fixed: Matrix, residual: Vector, V: int) -> Vector:
    """Return the least squares with each V columns beside fixed ones; infinite where dependent."""
    basis = _orthonormal(fixed)
    rest = residual - basis @ (basis.T @ residual)
    free = columns - basis @ (basis.T @ columns)
    free -= basis @ (basis.T @ free)  # rounding is taken from what is left
    points = columns.shape[1] // V
    by_point = free.T.reshape(points, V, len(residual)).transpose(0, 2, 1)
    Q, R = np.linalg.qr(by_point)
    pivots = np.abs(np.diagonal(R, axis1=1, axis2=2))
    lengths = np.linalg.norm(columns, axis=0).reshape(points, V)
    is_dependent = (pivots <= DEPENDENT * lengths).any(axis=1)
    explained = np.sum((rest @ Q) ** 2, axis=1)
    squares: Vector = np.where(is_dependent, np.inf, rest @ rest - explained)
    return squares


def _orthonormal(columns: Matrix) -> Matrix:
    """Return an orthonormal basis of columns; dependent ones are left out."""
    lengths = np.linalg.norm(columns, axis=0)
    is_there = lengths > 0.0
    scaled = columns[:, is_there] / lengths[is_there]
    vectors, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    smallest = DEPENDENT * sizes.max(initial=0.0)
    basis: Matrix = vectors[:, sizes > smallest]
    return basis


def _minima_apart(points: Matrix, squares: Vector) -> list[int]:
    """Return the points that no neighbor betters, but for those around the last, the best first.

    Neighbors differ by at most one step in each parameter.
    """
    steps = _steps_along_axes(points)
    of_known = steps[-1]
    minima = []
    for k, own in enumerate(steps[:-1]):
        is_near = np.abs(steps - own).max(axis=1) <= 1
        is_least = np.isfinite(squares[k]) and squares[k] <= squares[:-1][is_near[:-1]].min()
        if is_least and np.abs(own - of_known).max() > 1:
            minima.append(k)
    return sorted(minima, key=lambda k: float(squares[k]))


def _steps_along_axes(points: Matrix) -> NDArray[np.intp]:
    """Return where each point is along each axis of the grid; of the last one the nearest place."""
    steps = np.empty(points.shape, np.intp)
    for j, values in enumerate(points.T):
        axis = np.unique(values[:-1])
        steps[:, j] = np.abs(values[:, np.newaxis] - axis).argmin(axis=1)
    return steps
