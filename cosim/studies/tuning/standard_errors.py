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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.studies.tuning.space import DIGITS, BoundedKey, SearchSpace
from cosim.studies.tuning.trials import Trials
from cosim.studies.tuning.whiteness import ResidualCheck

_FIRST_STEP: Final = 1e-3  # of the range between the bounds
_SHORTEST_STEP: Final = 1e-9
_ROUNDS: Final = 10  # to find the steps
_MOVES: Final = 5  # of the center
_NEAR: Final = 0.1  # standard errors from the optimum
_NOISE_POINTS: Final = 6
_NOISE_STEP: Final = 1e-8
_LONGEST: Final = 25.0  # rise of S in s^2: five standard errors
_LEAST_RISE: Final = 0.05  # of the wanted one
_LEAST_EIGENVALUE: Final = 1e-7  # of the Hessian scaled to a diagonal of ones
_SKEWED: Final = 0.3
_INVOLVED: Final = 0.5  # correlation of what is not determined together


class NoStandardErrors(Exception):
    """There are no standard errors; the text says why."""


@dataclass(frozen=True, slots=True)
class StandardErrors:
    """Standard errors of fitted values.

    Parameters
    ----------
    errors : mapping of key to float
        In the unit of the value.
    intervals : mapping of key to (float, float)
        95 % of each, by Student's t; of a key that is searched in the logarithm that of the
        logarithm.
    correlation : tuple of tuples of float
        Of the values, in the order of the keys, shape (p, p).
    deviation : float
        s, of one sample of the residual.
    samples : int
        N.
    skewed : tuple of str
        Keys along which S rises on one side much more than on the other within about one standard
        error.
    values : mapping of key to float
        Around which they are.
    """

    errors: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]]
    correlation: tuple[tuple[float, ...], ...]
    deviation: float
    samples: int
    skewed: tuple[str, ...]
    values: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "errors": dict(self.errors),
            "intervals": {key: list(interval) for key, interval in self.intervals.items()},
            "correlation": [list(row) for row in self.correlation],
            "deviation": self.deviation,
            "samples": self.samples,
            "skewed": list(self.skewed),
        }


def members_of_errors(keys: int) -> int:
    """Return how many members the standard errors of so many keys usually need, or fewer.

    For the noise, four rounds of steps, and all differences three times.
    """
    return _NOISE_POINTS + 8 * keys + 3 * (1 + keys * (keys + 1))


def standard_errors(
    space: SearchSpace, trials: Trials, best: Mapping[str, Any], samples: int
) -> StandardErrors:
    """Return the standard errors at the best values, which it improves where it can.

    Parameters
    ----------
    space : SearchSpace
        All keys have bounds.
    trials : Trials
        The cost is the rms of the residual.
    best : mapping of key to value
    samples : int
        Of the residual, N.

    Raises
    ------
    NoStandardErrors
        If there are too few samples, a value is at a bound, a member beside it fails, or the
        objective does not determine all values.
    SearchEnded
        If the members are used up.
    """
    free = _free(space, samples)
    squares = _SumOfSquares(space, trials, samples)
    center = space.coordinates(best)
    level = squares.at([center])[0]
    if level <= 0.0:
        raise NoStandardErrors("the residual is zero")
    noise = _noise(squares, center)
    wanted = max(1.0, 100.0 * noise * free)
    if wanted > _LONGEST:
        raise NoStandardErrors(
            f"the objective is noisy (relative noise {noise / 2:.1g}), which hides its curvature"
        )
    steps = _steps(squares, center, wanted * level / free)
    curvature = _centered(squares, center, steps, noise)
    return _result(space, curvature, samples)


def moved_points(
    errors: StandardErrors, space: SearchSpace, best: Mapping[str, float]
) -> tuple[list[dict[str, float]], Vector]:
    """Return a point beside the best values for each key, and how many errors away each is.

    Where there is room between the bounds that is one standard error, the other values held.
    """
    held = 1.0 / np.sqrt(np.diag(np.linalg.inv(np.array(errors.correlation))))
    points = []
    units = np.empty(len(held))
    for number, key in enumerate(space.bounded):
        value = best[key.key]
        above, below = key.upper - value, value - key.lower
        step = min(errors.errors[key.key] * float(held[number]), max(above, below))
        moved = value + (step if above >= below else -step)
        points.append({**best, key.key: moved})
        units[number] = (moved - value) / errors.errors[key.key]
    return points, units


def of_samples(
    errors: StandardErrors,
    space: SearchSpace,
    residual: ResidualCheck,
    samples: int,
    moves: Matrix | None,
) -> StandardErrors:
    """Return the standard errors that follow from the samples on which the rows rest.

    Parameters
    ----------
    errors : StandardErrors
        As if every row were a sample.
    space : SearchSpace
    residual : ResidualCheck
    samples : int
        As many are independent.
    moves : Matrix, shape (n, p), or None
        How much W' times the rows moves with each value, for one standard error
        (:mod:`cosim.studies.tuning.sampled_residual`); None: the rows are samples.

    Raises
    ------
    NoStandardErrors
        If they are too few.
    """
    free = _free(space, samples)
    factor = residual.ratio * math.sqrt(_free(space, errors.samples) / free)
    correlation = np.array(errors.correlation)
    deviations = np.full(len(correlation), factor)
    if moves is not None:
        # by the errors as units C is the correlation, over N deviations squared of as many rows
        weighed = moves @ correlation
        rows = residual.rows**2 / (errors.samples * residual.samples)
        covariance = weighed.T @ weighed / (rows * errors.deviation**2)
        own = np.sqrt(np.diag(covariance))
        deviations *= own
        correlation = covariance / np.outer(own, own)
    found = {
        key: float(error * deviation)
        for (key, error), deviation in zip(errors.errors.items(), deviations, strict=True)
    }
    freedom = residual.freedom if samples == residual.independent else math.inf
    return replace(
        errors,
        errors=found,
        intervals=_intervals(space, errors.values, found, correlation, min(free, freedom)),
        correlation=_as_tuples(correlation),
        deviation=residual.ratio * errors.deviation,
        samples=samples,
    )


def _free(space: SearchSpace, samples: int) -> int:
    """Return how many more samples there are than values.

    Raises
    ------
    NoStandardErrors
        If there are not.
    """
    free = samples - len(space.keys)
    if free < 1:
        raise NoStandardErrors(
            f"expected more samples than values, got {len(space.keys)} values from {samples} "
            "samples"
        )
    return free


def _intervals(
    space: SearchSpace,
    values: Mapping[str, float],
    errors: Mapping[str, float],
    correlation: Matrix,
    freedom: float,
) -> dict[str, tuple[float, float]]:
    """Return the 95 % intervals by Student's t.

    Raises
    ------
    NoStandardErrors
        If one has no end.
    """
    from cosim.studies.statistics import student_quantile

    wide = student_quantile(float(freedom) + 1.0)
    intervals = {}
    for number, key in enumerate(space.bounded):
        interval = _interval(key, values[key.key], wide * errors[key.key])
        if interval is None:
            raise NoStandardErrors(_hardly_determined(space, number, correlation[number]))
        intervals[key.key] = interval
    return intervals


def _as_tuples(matrix: Matrix) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in matrix)


@dataclass(frozen=True, slots=True)
class _SumOfSquares:
    """S at coordinates."""

    space: SearchSpace
    trials: Trials
    samples: int

    def at(self, coordinates: Sequence[Vector]) -> Vector:
        """Return S at several coordinates that are tried together, shape (m,)."""
        points = [self.space.point(each) for each in coordinates]
        costs = self.trials.costs(points)
        for point, cost in zip(points, costs, strict=True):
            if not math.isfinite(cost):
                trial = self.trials.known(point)
                problem = trial.problem if trial is not None else ""
                raise NoStandardErrors(f"a member next to the best values fails: {problem}")
        return self.samples * np.array(costs) ** 2

    def name(self, number: int) -> str:
        """Return the name of a key."""
        return self.space.bounded[number].key


def _noise(squares: _SumOfSquares, center: Vector) -> float:
    """Return the noise of S relative to S, by differences of order 4 and higher."""
    inwards = np.where(center < 0.5, _NOISE_STEP, -_NOISE_STEP)
    values = squares.at([center + k * inwards for k in range(_NOISE_POINTS + 1)])
    estimates = []
    for order in range(1, _NOISE_POINTS + 1):
        differences = np.diff(values, order)
        factor = math.factorial(order) ** 2 / math.factorial(2 * order)
        if order >= 4:
            estimates.append(math.sqrt(factor * float(np.mean(differences**2))))
    return float(np.median(estimates)) / float(values[0])


def _steps(squares: _SumOfSquares, center: Vector, wanted: float) -> Vector:
    """Return steps along every key, shape (p,), that let S rise by about ``wanted``."""
    room = np.minimum(center, 1.0 - center)
    steps = np.minimum(_FIRST_STEP, room)
    _check_room(squares, steps)
    level = squares.at([center])[0]
    rises = np.zeros(center.size)
    open_ = list(range(center.size))
    for _ in range(_ROUNDS):
        rises[open_] = _rises(squares, center, steps, level)[open_]
        ratios = rises / wanted
        open_ = []
        for number, ratio in enumerate(ratios):
            longer = _factor(ratio)
            step = min(max(steps[number] * longer, _SHORTEST_STEP), room[number])
            if not 0.25 <= ratio <= 4.0 and step != steps[number]:
                steps[number] = step
                open_.append(number)
        if not open_:
            break
    for number, ratio in enumerate(rises / wanted):
        if ratio >= _LEAST_RISE:
            continue
        if steps[number] < 0.2 * max(center[number], 1.0 - center[number]):
            raise NoStandardErrors(
                f"{squares.name(number)} is within a standard error of its bound"
            )
        raise NoStandardErrors(
            f"{squares.name(number)} hardly changes the objective between its bounds: the data do "
            "not determine it there"
        )
    return steps


def _check_room(squares: _SumOfSquares, steps: Vector) -> None:
    for number, step in enumerate(steps):
        if step < 0.1 * _FIRST_STEP:
            raise NoStandardErrors(
                f"{squares.name(number)} is at its bound; they hold for values between the bounds"
            )


def _factor(ratio: float) -> float:
    """Return how much longer a step must be whose rise is ``ratio`` of the wanted one."""
    if ratio <= 1e-4:
        return 100.0
    return min(max(1.0 / math.sqrt(ratio), 1e-3), 100.0)


def _rises(squares: _SumOfSquares, center: Vector, steps: Vector, level: float) -> Vector:
    """Return the mean rise of S at both ends of every step, shape (p,)."""
    ends = np.diag(steps)
    values = squares.at([*(center + ends), *(center - ends)]).reshape(2, -1)
    rises: Vector = values.mean(axis=0) - level
    return rises


@dataclass(frozen=True, slots=True)
class _Curvature:
    """S around a center, by its steps: S is ``level + gradient z + z hessian z / 2``."""

    center: Vector
    steps: Vector
    level: float
    gradient: Vector
    hessian: Matrix


def _centered(squares: _SumOfSquares, center: Vector, steps: Vector, noise: float) -> _Curvature:
    """Return the curvature around the optimum, to which Newton steps go from ``center``."""
    for _ in range(_MOVES):
        curvature = _curvature(squares, center, steps)
        move = -np.linalg.solve(curvature.hessian, curvature.gradient)
        if np.abs(move).max() <= _NEAR:
            return curvature
        # an optimum of no residual at all is this far away
        most = math.sqrt(squares.samples)
        moved = center + np.clip(move, -most, most) * steps
        room = np.minimum(moved, 1.0 - moved)
        if (room < steps).any():
            return curvature
        level = squares.at([moved])[0]
        if level <= 0.0:
            raise NoStandardErrors("the residual is zero")
        if level >= curvature.level * (1.0 - 2.0 * noise):
            return curvature
        center = moved
        shorter = steps * math.sqrt(level / curvature.level)  # s is smaller there
        steps = np.maximum(shorter, np.minimum(steps, _SHORTEST_STEP))
    return curvature


def _curvature(squares: _SumOfSquares, center: Vector, steps: Vector) -> _Curvature:
    count = center.size
    ends = np.diag(steps)
    pairs = [(i, j) for i, j in np.ndindex(count, count) if i < j]
    both = [ends[i] + ends[j] for i, j in pairs]
    coordinates = [center, *(center + ends), *(center - ends)]
    for each in both:
        coordinates += [center + each, center - each]
    values = squares.at(coordinates)
    level = float(values[0])
    up = values[1 : count + 1]
    down = values[count + 1 : 2 * count + 1]
    hessian = np.diag(up + down - 2.0 * level)
    corners = values[2 * count + 1 :].reshape(-1, 2).sum(axis=1)
    for (i, j), corner in zip(pairs, corners, strict=True):
        mixed = corner - up[i] - down[i] - up[j] - down[j] + 2.0 * level
        hessian[i, j] = hessian[j, i] = mixed / 2.0
    _check_definite(squares, hessian)
    return _Curvature(center, steps, level, (up - down) / 2.0, hessian)


def _check_definite(squares: _SumOfSquares, hessian: Matrix) -> None:
    """Check that S rises in every direction.

    Raises
    ------
    NoStandardErrors
        If it does not.
    """
    scale = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    if values[0] > _LEAST_EIGENVALUE:
        return
    weights = np.abs(vectors[:, 0])
    involved = np.flatnonzero(weights > 0.1 * weights.max())
    names = [squares.name(int(number)) for number in involved]
    if len(names) == 1:
        raise NoStandardErrors(
            f"the objective does not rise along {names[0]}: the data do not determine it"
        )
    raise NoStandardErrors(
        f"the objective does not rise along a combination of {', '.join(names)}: the data do not "
        "determine them together"
    )


def _interval(key: BoundedKey, value: float, half: float) -> tuple[float, float] | None:
    """Return the interval of a value, given half of its width; None: no number is its end."""
    try:
        factor = math.exp(half / value) if key.logarithmic else 1.0
    except OverflowError:
        factor = math.inf
    low, high = (value / factor, value * factor)
    if not key.logarithmic:
        low, high = (value - half, value + half)
    is_finite = math.isfinite(low) and math.isfinite(high)
    return (low, high) if is_finite and (low > 0.0 or not key.logarithmic) else None


def _hardly_determined(space: SearchSpace, number: int, correlations: Vector) -> str:
    """Return what to say of a key without an end of its interval."""
    keys = space.bounded
    involved = [keys[k].key for k in np.flatnonzero(np.abs(correlations) > _INVOLVED)]
    together = " together" if len(involved) > 1 else ""
    return (
        f"the interval of {keys[number].key} goes beyond all numbers: the data hardly determine "
        f"{', '.join(involved)}{together}"
    )


def _result(space: SearchSpace, curvature: _Curvature, samples: int) -> StandardErrors:
    free = _free(space, samples)
    variance = curvature.level / free
    scaled = 2.0 * variance * np.linalg.inv(curvature.hessian)
    deviations = np.sqrt(np.diag(scaled))
    correlation = scaled / np.outer(deviations, deviations)
    errors = {}
    values = space.point(curvature.center)
    for number, key in enumerate(space.bounded):
        value = values[key.key]
        error = float(key.slope(value) * curvature.steps[number] * deviations[number])
        if error < abs(value) * 10.0 ** (1 - DIGITS):
            raise NoStandardErrors(
                f"that of {key.key} would be below the {DIGITS} digits of its value: the residual "
                "is rounding noise"
            )
        errors[key.key] = error
    skew = np.abs(curvature.gradient) / np.diag(curvature.hessian)
    skewed = [key.key for key, each in zip(space.bounded, skew, strict=True) if each > _SKEWED]
    return StandardErrors(
        errors=errors,
        intervals=_intervals(space, values, errors, correlation, free),
        correlation=_as_tuples(correlation),
        deviation=math.sqrt(variance),
        samples=samples,
        skewed=tuple(skewed),
        values=values,
    )
