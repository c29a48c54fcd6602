"""Starts of theta from y itself, where nothing else is known.

For given theta y is linear in all other unknowns. So the responses to every component at every
point of a grid of its own theta are columns of one regression: a single pass over the samples makes
the triangle R of all of them, and the least squares of any combination of points follow from a
choice of its columns, without the samples. Where there are too many combinations to try each, the
components are added one by one at their best points, then chosen anew two by two. Rows are means of
successive samples. Unlike the regression (25) this needs neither delays nor a transient that is
over.

A minimum of the grid may lead to a local minimum of output error, whose residual cannot tell: a
wrong model would leave one of the same size. So several are fitted from, and the best fit counts,
online (``identifier.c``) as well as for recorded data (:func:`search_start`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.estimation.output_error import Generators, OutputErrorConstants, ResponseRecord
from cosim.native.estimation.start_grid import StartGridConstants, StartGridModel
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.programs import evaluate
from cosim.theory.disturbances.families import Family, SearchBox, generators, search_box
from cosim.theory.disturbed_plant import NoiseModel
from cosim.theory.estimators.output_error import (
    OutputErrorFit,
    OutputErrorProblem,
    excess_squares,
    largest_chance,
)

STARTS: Final = 8  # points of the grid that are fitted from
MOST_POINTS: Final = 4096
MOST_POINTS_ON_AN_AXIS: Final = 24  # where each combination is tried
MOST_POINTS_ONLINE: Final = 64  # along a parameter
MOST_POINTS_OF_RECORDS: Final = 256  # on an axis, where one search is all that is made
MOST_POINTS_OF_SEVERAL: Final = 64  # the same with more than one parameter
COLUMNS: Final = 240  # of the regression of a grid
COLUMNS_OF_RECORDS: Final = 640  # where one search is all that is made
# functions of t with the same bits everywhere
SINH: Final = compile_expression("sinh(t)")
ASINH: Final = compile_expression("sign(t)*log(abs(t) + sqrt(t*t + 1))")
FINE: Final = 4.0  # steps begin to grow at this part of the smaller end of a box
FEW_POINTS: Final = 6  # along a parameter whose steps grow, of a component with others
ROUNDS: Final = 3  # of a search around the best fit of the last one
# from each start at first: where none gets to an optimum, only the best one is followed further
ITERATIONS: Final = 20
STARTS_BESIDE: Final = 3  # of which so many are fitted from
ROWS: Final = 1024  # of the regression: means of successive samples
# of the grid, for each time scale that a record has room for: half periods of a sine
POINTS_A_SCALE: Final = 1.2
# searched where the grid has no point for each, as with three parameters: several starts make up
LEAST_SCALES: Final = 20.0


def grid_points(parameters: int) -> int:
    """Return how many points a grid has in every direction where each combination is tried."""
    return min(_points_on_an_axis(parameters), MOST_POINTS_ON_AN_AXIS)


def axis_points(
    generators: Generators, graded: Sequence[bool], *, most: int, columns: int
) -> tuple[int, ...]:
    """Return how many points a grid has along each parameter.

    Parameters
    ----------
    generators : Generators
    graded : sequence of bool
        For each parameter, whether its steps grow with it: of these a component of several
        parameters has few.
    most : int
        Along one axis.
    columns : int
        Of the regression, for all components: each point takes as many as it has basis functions.
    """
    searched = sum(1 for count in generators.count if count)
    points: list[int] = []
    for size, count in zip(generators.size, generators.count, strict=True):
        own = graded[len(points) : len(points) + count]
        share = max(columns // (max(searched, 1) * size), 2**count)
        few = FEW_POINTS if 0 < sum(own) < count else 0
        rest = share // few ** sum(own) if few else share
        root = int(rest ** (1.0 / max(count - sum(own) if few else count, 1)) + 1e-9)
        for is_graded in own:
            points.append(few if few and is_graded else max(min(root, most), 2))
    return tuple(points)


def start_grid(
    model: OutputErrorConstants,
    box: SearchBox,
    *,
    points: int | Sequence[int],
    average: int,
    alike: Sequence[int] = (),
    beside: Sequence[Vector] = (),
) -> StartGridConstants:
    """Return the grid over a box.

    Parameters
    ----------
    model : OutputErrorConstants
        Of y.
    box : SearchBox
    points : int or sequence of int
        Along every parameter, or along each; one where the box has no width.
    average : int
        Samples that make one row.
    alike : sequence of int
        For each component the last one before that is interchangeable with it, or -1; by default
        none.
    beside : sequence of Vector, shape (P,)
        Theta whose parts are points of their components, too.
    """
    generators = model.generators
    P = generators.parameters
    counts = [points] * P if isinstance(points, int) else list(points)
    grades = box.graded or (False,) * P
    systems = []
    rows = []
    thetas = []
    component = []
    for i, generator in enumerate(generators.each):
        own = generator.theta
        regular = points_of_box(box.lower[own], box.upper[own], counts[own], grades[own])
        others = [theta[own] for theta in beside if generators.count[i]]
        grid = np.vstack([regular, *others])
        for theta in grid:
            systems.append(generator.matrix(theta).ravel())
            rows.append(generator.c)
            component.append(i)
        thetas.append(grid.ravel())
    repeated = _at_points(model, component, systems, rows, average)
    points_of_each = [component.count(i) for i in range(len(generators.size))]
    return StartGridConstants(
        model=repeated,
        size=generators.size,
        count=generators.count,
        points=tuple(points_of_each),
        alike=tuple(alike) or (-1,) * len(generators.size),
        even=box.even or (False,) * P,
        theta=np.concatenate(thetas),
    )


def _at_points(
    model: OutputErrorConstants,
    component: Sequence[int],
    systems: Sequence[Vector],
    rows: Sequence[Vector],
    average: int,
) -> OutputErrorConstants:
    """Return the model with a component for each point, of known matrices."""
    generators = model.generators
    sources = model.source or tuple(range(len(generators.size)))
    at_points = Generators(
        size=tuple(generators.size[i] for i in component),
        count=(0,) * len(component),
        c=np.concatenate(rows),
        G0=np.concatenate(systems),
        G1=np.zeros(0),
    )
    return replace(
        model,
        generators=at_points,
        average=average,
        source=tuple(sources[i] for i in component),
    )


@dataclass(frozen=True, eq=False)
class RecordsOnGrid:
    """Records of y as regressions on all points of a grid.

    Parameters
    ----------
    constants : StartGridConstants
    grid : StartGridModel
    triangles : tuple of Matrix
        R of each record.
    """

    constants: StartGridConstants
    grid: StartGridModel
    triangles: tuple[Matrix, ...]

    def search(self, most: int) -> Matrix:
        """Return the best combinations of points, the best first, shape (at most most, P)."""
        return self.grid.search(self.triangles, most)


def records_on_grid(
    records: Sequence[ResponseRecord],
    box: SearchBox,
    points: int | Sequence[int],
    *,
    alike: Sequence[int] = (),
    beside: Sequence[Vector] = (),
) -> RecordsOnGrid:
    """Pass over records of y, at least one, with all points of a grid.

    Parameters
    ----------
    records : sequence of ResponseRecord
        Under the same theta; a point is as good as the sum of its squares over all of them.
    box, points, alike, beside
        As of :func:`start_grid`.
    """
    triangles = []
    for record in records:
        is_measured = ~np.isnan(record.residual).any(axis=1)
        samples = int(is_measured.sum())
        constants = start_grid(
            record.model.constants,
            box,
            points=points,
            average=max(1, samples // ROWS),
            alike=alike,
            beside=beside,
        )
        grid = StartGridModel(constants)
        on_grid = ResponseRecord(grid.model, record.residual, record.alpha, record.interval)
        triangles.append(on_grid.make(np.zeros(0)))
    return RecordsOnGrid(constants, grid, tuple(triangles))


def search_start(problem: OutputErrorProblem, noise: NoiseModel) -> Vector:
    """Find a start: theta of the best fit from the best points of a grid.

    With several terms the points of the best fit are added to the grid, and it is searched again:
    what the distance between points costs a term that is known well hides the others.
    A fit that has not converged counts only where it explains more than chance allows beside those
    that have: their optimum is not the best one then.

    Nothing but the data is needed; where there is a regression, its Rayleigh quotient is cheaper.

    Parameters
    ----------
    problem : OutputErrorProblem
    noise : NoiseModel
        Its autoregressive model is left out.

    Returns
    -------
    Vector
        Shape ``(P,)``, within the bounds.

    Raises
    ------
    AssumptionError
        As from :func:`fit_output_error`.
    """
    sampled = problem.sampled(noise.without_color())
    box = box_of_search(problem)
    points = _points_of_records(problem.families)

    def searched(beside: Sequence[Vector], most: int) -> Matrix:
        alike = problem.interchangeable
        on_grid = records_on_grid(sampled.records, box, points, alike=alike, beside=beside)
        return on_grid.search(most)

    starts = searched((), STARTS)
    fits = [sampled.fit(start, ITERATIONS) for start in starts]
    if any(fit.converged for fit in fits):
        pairs = zip(fits, starts, strict=True)
        fits = [fit if fit.converged else sampled.fit(start) for fit, start in pairs]
    if not fits:
        return box.lower  # no response is finite, which a fit will say
    best = _best_of(fits)
    for _ in range(ROUNDS if problem.has_several else 0):
        beside = searched([best.theta], STARTS_BESIDE)
        better = _best_of([best, *map(sampled.fit, beside)])
        excess = excess_squares(better.deviation, best.deviation, better.freedom)
        if excess <= largest_chance(len(best.theta)):
            break
        best = better
    return best.theta


def _best_of(fits: Sequence[OutputErrorFit]) -> OutputErrorFit:
    """Return the fit that explains most; of those that differ by chance one that has converged."""
    best = min(fits, key=lambda fit: fit.deviation)
    converged = [fit for fit in fits if fit.converged]
    if not converged:
        return best
    other = min(converged, key=lambda fit: fit.deviation)
    excess = excess_squares(best.deviation, other.deviation, best.freedom)
    is_chance = excess <= largest_chance(len(best.theta))
    return other if is_chance else best


def box_of_search(problem: OutputErrorProblem) -> SearchBox:
    """Return where :func:`search_start` looks: as far as the points of its grid are dense enough.

    It looks for nothing faster than the samples resolve: a sine beyond half their frequency has the
    same samples as a slower one. Bounds cut it; apart from it they are searched instead.
    """
    families = problem.families
    graded = chain.from_iterable(family.graded for family in families)
    points = zip(_points_of_records(families), graded, strict=True)
    # where all parameters have steps that grow, a grid of few points reaches as far
    of_rates = [count for count, is_graded in points if not is_graded]
    time_scales = max(min(of_rates, default=MOST_POINTS_OF_SEVERAL) / POINTS_A_SCALE, LEAST_SCALES)
    shortest = max(problem.span / time_scales, problem.spacing)
    box = search_box(families, span=problem.span, shortest=shortest)
    lower, upper = problem.limits
    first = np.maximum(box.lower, lower)
    last = np.minimum(box.upper, upper)
    # Bounds apart from the box are entered as far as the box is wide.
    width = box.upper - box.lower
    is_above = lower > box.upper
    is_below = upper < box.lower
    last = np.where(is_above, np.minimum(upper, lower + width), last)
    first = np.where(is_below, np.maximum(lower, upper - width), first)
    return replace(box, lower=first, upper=last)


def _points_of_records(families: Sequence[Family]) -> tuple[int, ...]:
    """Return how many points the grid for recorded data has along each parameter."""
    matrices = generators(families)
    graded = list(chain.from_iterable(family.graded for family in families))
    most = MOST_POINTS_OF_RECORDS if matrices.parameters == 1 else MOST_POINTS_OF_SEVERAL
    return axis_points(matrices, graded, most=most, columns=COLUMNS_OF_RECORDS)


def _points_on_an_axis(parameters: int) -> int:
    """Return the most points in every direction that make no more than are searched in all."""
    points = 1
    while (points + 1) ** max(parameters, 1) <= MOST_POINTS:
        points += 1
    return points


def points_of_box(
    lower: Vector, upper: Vector, points: Sequence[int], graded: Sequence[bool]
) -> Matrix:
    """Return the middles of equal parts of the box, shape (count, parameters).

    Of parameters whose steps grow these are parts of their inverse hyperbolic sine, in units of
    the smaller end: from there on a step is a part of the parameter.
    """
    axes = []
    for low, high, most, grows in zip(lower, upper, points, graded, strict=True):
        count = most if high > low else 1
        unit = min(abs(low), abs(high)) / FINE or abs(high - low) / FINE
        is_graded = grows and high > low
        first = evaluate(ASINH, low / unit) if is_graded else low
        width = evaluate(ASINH, high / unit) - first if is_graded else high - low
        middles = [first + (k + 0.5) / count * width for k in range(count)]
        if is_graded:
            middles = [unit * evaluate(SINH, middle) for middle in middles]
        axes.append(middles)
    points_of_all = list(product(*axes))
    grid = np.array(points_of_all, np.float64)
    return grid.reshape(len(points_of_all), len(lower))
