r"""Standard errors of fitted values, from the curvature of the sum of squares.

Of an objective f that is the rms of one residual with N samples, S = N f^2 is the sum of squares.
Where the residual at the best values is white, with one deviation s, the covariance of the values
is about :math:`2 s^2 H^{-1}` with the Hessian H of S and s^2 = S / (N - p) [1]_.

Differences find H. A step along a key is such that S rises by s^2: that is one standard error of
this key, the others held. So H is measured where the interval will be, its relative error by noise
of the objective is about its relative noise times N, and a step is neither too short nor too long.
Noise of the objective, as of a solver with step control, is estimated first, from differences of
high order [2]_; where it would be seen, the steps are longer.

Mixed second differences need two more members for a pair of keys. The same members give the
gradient: a Newton step moves the center to the optimum where the search stopped short of it.

References
----------
.. [1] G. A. F. Seber, C. J. Wild, "Nonlinear Regression", Wiley, 1989, sections 2.1 and 5.1.
.. [2] J. J. Moré, S. M. Wild, "Estimating computational noise", SIAM J. Sci. Comput. 33 (2011).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, TypeAlias

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import option
from cosim.studies.residual import ResidualCheck
from cosim.studies.search import DIGITS, Point, Search, SearchTrial, Trials
from cosim.studies.statistics import student_quantile

_FIRST_STEP: Final = 1e-3  # of the range between the bounds
_SHORTEST_STEP: Final = 1e-9
_NOISE_POINTS: Final = 6

Squares: TypeAlias = Callable[[Iterable[Vector]], Vector]  # S at coordinates
Curvature: TypeAlias = tuple[float, Vector, Matrix]  # S = level + gradient z + z hessian z / 2


class NoStandardErrors(Exception):
    """Standard errors would mean nothing; its text says why."""


@dataclass(frozen=True, slots=True)
class StandardErrors:
    """Standard errors of the best values.

    Parameters
    ----------
    errors : mapping of key to float
    intervals : mapping of key to (float, float)
        With 95 %.
    correlation : list of lists
        Of the values, in the order of the keys.
    deviation : float
        Standard deviation of the residual.
    samples : int
        Independent ones of the residual.
    skewed : tuple of str
        Keys along which S rises unevenly.
    values : mapping of key to float
        Where S is least, by the parabola.
    """

    errors: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]]
    correlation: list[list[float]]
    deviation: float
    samples: int
    skewed: tuple[str, ...]
    values: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {name: item for name, item in asdict(self).items() if name != "values"}


def members_of_errors(keys: int) -> int:
    """Return about how many members standard errors take."""
    return _NOISE_POINTS + 8 * keys + 3 * (1 + keys * (keys + 1))


def errors_at(
    trials: Trials, best: SearchTrial | None, samples: int | None = None
) -> StandardErrors:
    """Return the standard errors of the best values; more points are tried for it.

    Raises
    ------
    NoStandardErrors
    SearchEnded
        If the members do not suffice.
    """
    if best is None:
        raise NoStandardErrors("no member has an objective")
    search = trials.search
    count = best.samples if samples is None else samples
    free = _free(search, count)

    def squares(coordinates: Iterable[Vector]) -> Vector:
        tried = trials.try_points([search.point(each) for each in coordinates])
        for trial in tried:
            if trial.objective is None:
                raise NoStandardErrors(f"a member next to the best values fails: {trial.problem}")
        return count * np.array([trial.cost for trial in tried]) ** 2

    names = [key.key for key in search.bounded]
    center = search.coordinates(best.point)
    level = squares([center])[0]
    if level <= 0.0:
        raise NoStandardErrors("the residual is zero")
    noise = _noise(squares, center)
    wanted = max(1.0, 100.0 * noise * free)
    if wanted > 25.0:  # a rise of S in s^2: five standard errors
        noisy = f"the objective is noisy (relative noise {noise / 2:.1g})"
        raise NoStandardErrors(f"{noisy}, which hides its curvature")
    steps = _steps(squares, center, wanted * level / free, names)
    center, steps, (level, gradient, hessian) = _centered(
        squares, center, steps, noise, count, names
    )
    variance = level / free
    scaled = 2.0 * variance * np.linalg.inv(hessian)
    deviations = np.sqrt(np.diag(scaled))
    correlation = scaled / np.outer(deviations, deviations)
    values = search.point(center)
    errors = {}
    for key, step, deviation in zip(search.bounded, steps, deviations, strict=True):
        error = float(key.slope(values[key.key]) * step * deviation)
        if error < abs(values[key.key]) * 10.0 ** (1 - DIGITS):
            below = f"that of {key.key} would be below the {DIGITS} digits of its value"
            raise NoStandardErrors(f"{below}: the residual is rounding noise")
        errors[key.key] = error
    return StandardErrors(
        errors,
        _intervals(search, values, errors, correlation, free),
        correlation.tolist(),
        math.sqrt(variance),
        count,
        tuple(
            n for n, g, h in zip(names, gradient, np.diag(hessian), strict=True) if abs(g) / h > 0.3
        ),
        values,
    )


def _free(search: Search, samples: int) -> int:
    """Return the degrees of freedom that the values leave."""
    values = len(search.keys)
    if samples <= values:
        found = f"got {values} values from {samples} samples"
        raise NoStandardErrors(f"expected more samples than values, {found}")
    return samples - values


def _noise(squares: Squares, center: Vector) -> float:
    """Return the relative noise, by differences of high order [More and Wild 2011, ECnoise]."""
    inwards = np.where(center < 0.5, 1e-8, -1e-8)
    values = squares(center + k * inwards for k in range(_NOISE_POINTS + 1))
    factors = {
        n: math.factorial(n) ** 2 / math.factorial(2 * n) for n in range(4, _NOISE_POINTS + 1)
    }
    means = [f * float(np.mean(np.diff(values, n) ** 2)) for n, f in factors.items()]
    estimates = [math.sqrt(mean) for mean in means]
    return float(np.median(estimates)) / float(values[0])


def _steps(squares: Squares, center: Vector, wanted: float, names: list[str]) -> Vector:
    """Return the steps over which S rises by about what is wanted."""
    room = np.minimum(center, 1.0 - center)
    steps = np.minimum(_FIRST_STEP, room)
    for name, step in zip(names, steps, strict=True):
        if step < 0.1 * _FIRST_STEP:
            raise NoStandardErrors(f"{name} is at its bound; they hold between the bounds")
    level = squares([center])[0]
    ratios = np.zeros(center.size)
    open_ = list(range(center.size))
    for _ in range(10):
        ends = np.diag(steps)
        values = squares([*(center + ends), *(center - ends)]).reshape(2, -1)
        ratios[open_] = ((values.mean(axis=0) - level) / wanted)[open_]
        open_ = []
        for number, ratio in enumerate(ratios):
            longer = min(max(1.0 / math.sqrt(ratio), 1e-3), 100.0) if ratio > 1e-4 else 100.0
            step = min(max(steps[number] * longer, _SHORTEST_STEP), room[number])
            if not 0.25 <= ratio <= 4.0 and step != steps[number]:
                steps[number] = step
                open_.append(number)
        if not open_:
            break
    for number in np.flatnonzero(ratios < 0.05).tolist():
        if steps[number] < 0.2 * max(center[number], 1.0 - center[number]):
            raise NoStandardErrors(f"{names[number]} is within a standard error of its bound")
        hardly = f"{names[number]} hardly changes the objective between its bounds"
        raise NoStandardErrors(f"{hardly}: the data do not determine it there")
    return steps


def _centered(
    squares: Squares, center: Vector, steps: Vector, noise: float, samples: int, names: list[str]
) -> tuple[Vector, Vector, Curvature]:
    """Return center and steps of the parabola about the optimum, to which Newton steps go."""
    for _ in range(5):
        found = center, steps, _curvature(squares, center, steps, names)
        reached, gradient, hessian = found[-1]
        move = -np.linalg.solve(hessian, gradient)
        if np.abs(move).max() <= 0.1:  # standard errors
            break
        most = math.sqrt(samples)
        moved = center + np.clip(move, -most, most) * steps
        if (np.minimum(moved, 1.0 - moved) < steps).any():
            break
        level = squares([moved])[0]
        if level <= 0.0:
            raise NoStandardErrors("the residual is zero")
        if level >= reached * (1.0 - 2.0 * noise):
            break
        center = moved
        shorter = steps * math.sqrt(level / reached)  # s is smaller there
        steps = np.maximum(shorter, np.minimum(steps, _SHORTEST_STEP))
    return found


def _curvature(squares: Squares, center: Vector, steps: Vector, names: list[str]) -> Curvature:
    """Return S about a center, by points on both sides along each key, and each pair of keys."""
    count = center.size
    ends = np.diag(steps)
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    corners = [center + sign * (ends[i] + ends[j]) for i, j in pairs for sign in (1.0, -1.0)]
    values = squares([center, *(center + ends), *(center - ends), *corners])
    level = float(values[0])
    up, down = values[1 : 2 * count + 1].reshape(2, -1)
    hessian = np.diag(up + down - 2.0 * level)
    sums = values[2 * count + 1 :].reshape(-1, 2).sum(axis=1)
    for (i, j), corner in zip(pairs, sums, strict=True):
        mixed = corner - up[i] - down[i] - up[j] - down[j] + 2.0 * level
        hessian[i, j] = hessian[j, i] = mixed / 2.0
    scale = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    eigenvalues, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    if eigenvalues[0] <= 1e-7:
        weights = np.abs(vectors[:, 0])
        involved = [names[k] for k in np.flatnonzero(weights > 0.1 * weights.max())]
        along, them = ", ".join(involved), "it"
        if len(involved) > 1:
            along, them = f"a combination of {along}", "them together"
        rise = f"the objective does not rise along {along}"
        raise NoStandardErrors(f"{rise}: the data do not determine {them}")
    return level, (up - down) / 2.0, hessian


def _intervals(
    search: Search,
    values: Mapping[str, float],
    errors: Mapping[str, float],
    correlation: Matrix,
    freedom: float,
) -> dict[str, tuple[float, float]]:
    wide = student_quantile(float(freedom) + 1.0)
    intervals = {}
    for key, row in zip(search.bounded, correlation, strict=True):
        value = values[key.key]
        half = wide * errors[key.key]
        low, high = value - half, value + half
        if key.logarithmic:
            factor = math.exp(half / value) if half < 709.0 * value else math.inf
            low, high = value / factor, value * factor
        if not math.isfinite(high - low) or (key.logarithmic and low <= 0.0):
            involved = [
                k.key for k, each in zip(search.bounded, row, strict=True) if abs(each) > 0.5
            ]
            them = f"{', '.join(involved)}{' together' if len(involved) > 1 else ''}"
            beyond = f"the interval of {key.key} goes beyond all numbers"
            raise NoStandardErrors(f"{beyond}: the data hardly determine {them}")
        intervals[key.key] = low, high
    return intervals


# --- with what is known of the residual ---


def moved_points(
    errors: StandardErrors, search: Search, best: Point
) -> tuple[list[dict[str, float]], Vector]:
    """Return points with one value each about a standard error away, and how many errors that is.

    The error is that of the value while the others are held.
    """
    held = 1.0 / np.sqrt(np.diag(np.linalg.inv(np.array(errors.correlation))))
    points = []
    units = np.empty(len(held))
    for number, key in enumerate(search.bounded):
        value = best[key.key]
        above, below = key.upper - value, value - key.lower
        step = min(errors.errors[key.key] * float(held[number]), max(above, below))
        moved = value + (step if above >= below else -step)
        points.append({**best, key.key: moved})
        units[number] = (moved - value) / errors.errors[key.key]
    return points, units


def of_samples(
    errors: StandardErrors,
    search: Search,
    residual: ResidualCheck,
    samples: int | None,
    moves: Matrix | None,
) -> StandardErrors:
    """Return standard errors by the samples on which the rows rest.

    Parameters
    ----------
    errors : StandardErrors
        As if all rows were independent.
    search : Search
    residual : ResidualCheck
    samples : int or None
        Of these, how many are independent; None: as the residual says.
    moves : Matrix or None, shape (n, p)
        ``W'J``: how the weighed samples move with each value, by its standard error; None: the
        samples are the rows.

    Raises
    ------
    NoStandardErrors
        If noise does not explain the residual, or there are not more samples than values.
    """
    if residual.problem and samples is None:
        way_out = f"or {option('samples')} says how many of them are independent"
        if residual.samples:
            way_out = (
                f"where a wrong model is not the cause, {option('samples')} says how many of the "
                f"{residual.samples} samples are independent"
            )
        raise NoStandardErrors(f"{residual.problem}; {way_out}")
    independent = residual.independent if samples is None else samples
    if not residual.samples or (moves is None and independent == errors.samples):
        return errors
    free = _free(search, independent)
    factor = residual.ratio * math.sqrt(_free(search, errors.samples) / free)
    correlation = np.array(errors.correlation)
    deviations = np.full(len(correlation), factor)
    if moves is not None:
        weighed = moves @ correlation
        rows = residual.rows**2 / (errors.samples * residual.samples)
        covariance = weighed.T @ weighed / (rows * errors.deviation**2)
        own = np.sqrt(np.diag(covariance))
        deviations *= own
        correlation = covariance / np.outer(own, own)
    pairs = zip(errors.errors.items(), deviations, strict=True)
    found = {key: float(error * deviation) for (key, error), deviation in pairs}
    freedom = residual.freedom if independent == residual.independent else math.inf
    return replace(
        errors,
        errors=found,
        intervals=_intervals(search, errors.values, found, correlation, min(free, freedom)),
        correlation=correlation.tolist(),
        deviation=residual.ratio * errors.deviation,
        samples=independent,
    )
