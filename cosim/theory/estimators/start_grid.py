"""Starts of theta from y itself, where nothing else is known.

For given theta y is linear in all other unknowns. So the responses to every component at every
point of a grid of its own theta are columns of one regression: a single pass over the samples makes
the triangle R of all of them, and the least squares of any combination of points follow from a
choice of its columns, without the samples. Rows are means of successive samples. Unlike the
regression (25) this needs neither delays nor a transient that is over.

A minimum of the grid may lead to a local minimum of output error, whose residual cannot tell: a
wrong model would leave one of the same size. So several are fitted from, and the best fit counts,
online (``identifier.c``) as well as for recorded data (:func:`search_start`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.output_error import Generators, OutputErrorConstants, ResponseRecord
from cosim.native.start_grid import StartGridConstants, StartGridModel
from cosim.theory.disturbance import Family, SearchBox, generators, search_box
from cosim.theory.disturbed_plant import (
    DataSet,
    DisturbedPlant,
    NoiseModel,
    white_noise,
)
from cosim.theory.estimators.output_error import (
    NO_BOUNDS,
    OutputErrorFit,
    bound_vectors,
    excess_squares,
    fit_output_error,
    largest_chance,
    longest_span,
    response_records,
)

STARTS: Final = 4  # points of the grid that are fitted from
MOST_POINTS: Final = 4096
MOST_POINTS_ON_AN_AXIS: Final = 24
MOST_POINTS_OF_RECORDS: Final = 256  # on an axis, where one search is all that is made
ROWS: Final = 1024  # of the regression: means of successive samples
# of the grid, for each time scale that a record has room for: half periods of a sine
POINTS_A_SCALE: Final = 1.2
# searched where the grid has no point for each, as with three parameters: several starts make up
LEAST_SCALES: Final = 20.0


def grid_points(parameters: int) -> int:
    """Return how many points a grid of starts has in every direction."""
    return min(_points_on_an_axis(parameters), MOST_POINTS_ON_AN_AXIS)


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
    systems = []
    rows = []
    thetas = []
    component = []
    for i, generator in enumerate(generators.each):
        own = generator.theta
        grid = _points(lower[own], upper[own], points)
        for theta in grid:
            systems.append(generator.matrix(theta).ravel())
            rows.append(generator.c)
            component.append(i)
        thetas.append(grid.ravel())
    sizes = [generators.size[i] for i in component]
    at_points = Generators(
        size=tuple(sizes),
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
    points_of_each = [component.count(i) for i in range(len(generators.size))]
    return StartGridConstants(
        model=repeated,
        size=generators.size,
        count=generators.count,
        points=tuple(points_of_each),
        theta=np.concatenate(thetas),
    )


def search_starts(
    records: Sequence[ResponseRecord], lower: Vector, upper: Vector, *, points: int, most: int
) -> Matrix:
    """Return the best points of the grid for records of y, the best first, shape (starts, P).

    Parameters
    ----------
    records : sequence of ResponseRecord
        Under the same theta; a point is as good as the sum of its squares over all of them.
    lower, upper : Vector, shape (P,)
        The box.
    points : int
        In every direction.
    most : int
        Starts at most.
    """
    sums = np.zeros(1)
    for record in records:
        is_measured = ~np.isnan(record.residual).any(axis=1)
        samples = int(is_measured.sum())
        average = max(1, samples // ROWS)
        constants = start_grid(record.model.constants, lower, upper, points=points, average=average)
        grid = StartGridModel(constants)
        beside = ResponseRecord(grid.model, record.residual, record.alpha, record.interval)
        sums = sums + grid.squares(beside.make(np.zeros(0)))
    return grid.best(sums, most)


def search_start(
    data: Sequence[DataSet],
    plant: DisturbedPlant,
    families: Sequence[Family],
    *,
    noise: NoiseModel | None = None,
    offset: bool = False,
    bounds: Mapping[int, tuple[float, float]] = NO_BOUNDS,
) -> Vector:
    """Find a start: theta of the best fit from the best points of a grid.

    A fit that has not converged counts only where it explains more than chance allows beside those
    that have: their optimum is not the best one then.

    Nothing but the data is needed; where there is a regression, its Rayleigh quotient is cheaper.

    Parameters
    ----------
    data, plant, families, noise, offset, bounds
        As for :func:`fit_output_error`; the noise without an autoregressive model.

    Returns
    -------
    Vector
        Shape ``(P,)``, within the bounds.

    Raises
    ------
    AssumptionError
        As from there.
    """
    matrices = generators(families)
    noise = noise or white_noise(plant.C.shape[0])
    records = response_records(data, plant, matrices, noise=noise, offset=offset)
    span = longest_span(data)
    spacing = min(data_set.sampling_interval for data_set in data)
    box = box_of_search(families, span=span, spacing=spacing, bounds=bounds)
    points = _points_of_records(matrices.parameters)
    starts = search_starts(records, box.lower, box.upper, points=points, most=STARTS)
    if not len(starts):
        return box.lower  # no response is finite, which a fit will say

    def fitted(start: Vector) -> OutputErrorFit:
        return fit_output_error(
            data, plant, families, start, noise=noise, offset=offset, bounds=bounds
        )

    fits = [fitted(start) for start in starts]
    best = min(fits, key=lambda fit: fit.deviation)
    converged = [fit for fit in fits if fit.converged]
    if not converged:
        return best.theta
    other = min(converged, key=lambda fit: fit.deviation)
    excess = excess_squares(best.deviation, other.deviation, best.freedom)
    is_chance = excess <= largest_chance(matrices.parameters)
    return other.theta if is_chance else best.theta


def box_of_search(
    families: Sequence[Family],
    *,
    span: float,
    spacing: float,
    bounds: Mapping[int, tuple[float, float]] = NO_BOUNDS,
) -> SearchBox:
    """Return where :func:`search_start` looks: as far as the points of its grid are dense enough.

    It looks for nothing faster than the samples resolve: a sine beyond half their frequency has the
    same samples as a slower one. Bounds cut it; apart from it they are searched instead.

    Parameters
    ----------
    families : sequence of Family
    span : float
        Length of the record [s].
    spacing : float
        Distance of its samples [s].
    bounds : mapping of index to (lower, upper)
        Of entries of theta.

    Raises
    ------
    AssumptionError
        If there is no such parameter, or an upper bound is below the lower bound.
    """
    parameters = sum(len(family.parameters) for family in families)
    time_scales = max(_points_of_records(parameters) / POINTS_A_SCALE, LEAST_SCALES)
    shortest = max(span / time_scales, spacing)
    box = search_box(families, span=span, shortest=shortest)
    lower, upper = bound_vectors(bounds, parameters)
    first = np.maximum(box.lower, lower)
    last = np.minimum(box.upper, upper)
    # Bounds apart from the box are entered as far as the box is wide.
    width = box.upper - box.lower
    is_above = lower > box.upper
    is_below = upper < box.lower
    last = np.where(is_above, np.minimum(upper, lower + width), last)
    first = np.where(is_below, np.maximum(lower, upper - width), first)
    return SearchBox(first, last)


def _points_of_records(parameters: int) -> int:
    """Return how many points the grid for recorded data has in every direction."""
    return min(_points_on_an_axis(parameters), MOST_POINTS_OF_RECORDS)


def _points_on_an_axis(parameters: int) -> int:
    """Return the most points in every direction that make no more than are searched in all."""
    points = 1
    while (points + 1) ** max(parameters, 1) <= MOST_POINTS:
        points += 1
    return points


def _points(lower: Vector, upper: Vector, points: int) -> Matrix:
    """Return the middles of equal parts of the box, shape (count, parameters)."""
    axes = []
    for low, high in zip(lower, upper, strict=True):
        count = points if high > low else 1
        width = high - low
        axes.append([low + (k + 0.5) / count * width for k in range(count)])
    points_of_all = list(product(*axes))
    grid = np.array(points_of_all, np.float64)
    return grid.reshape(len(points_of_all), len(lower))
