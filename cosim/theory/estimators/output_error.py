"""Output error: theta, amplitudes, x(0) and offset from y by variable projection.

What is minimized is the sum of squares of ``y - y(theta, beta, x(0), offset)``, whitened, over the
whole record. y is linear in all but theta: the linear unknowns are eliminated by orthogonal
rotations, theta is estimated by Gauss-Newton on what remains
(:mod:`cosim.native.estimation.output_error`). The initial state is an unknown, so there is no
transient to wait for. With white Gaussian noise this is maximum likelihood, and its covariance is
the Cramer-Rao bound for the same unknowns
(L. Ljung, System Identification, 2nd ed., 1999, section 7.4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError, StartError
from cosim.native.estimation.output_error import (
    NO_INFORMATION,
    GaussNewtonResult,
    Generators,
    ParameterState,
    ResponseRecord,
    minimize,
)
from cosim.theory.disturbances.families import Family, generators, search_box
from cosim.theory.disturbed_plant import (
    DataSet,
    DisturbedPlant,
    NoiseModel,
    sample_plant,
    white_noise,
)
from cosim.theory.quantiles import chi_square_above

# probability of a larger difference of two optima by noise alone
FALSE_CHOICE: Final = 0.01
# Probability that noise alone makes an absent component look present, for a given theta; that of
# the largest over all theta, which the fit finds, is about a hundred times as large.
FALSE_PRESENCE: Final = 1e-8
LARGEST_ENTRY: Final = 1e150  # of a column: the squares of larger ones are no numbers
ROUNDING: Final = 2.0**-44  # error of a simulated output relative to the largest output
NO_BOUNDS: Mapping[int, tuple[float, float]] = MappingProxyType({})


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputErrorFit:
    """An estimate of theta, with all that belongs to it.

    Parameters
    ----------
    theta : Vector, shape (P,)
    covariance : Matrix, shape (P, P)
        From the variance of the residual; zero in rows of parameters that are not estimated.
    states : tuple of ParameterState
    converged : bool
    iterations : int
    deviation : float
        Of the whitened residual.
    freedom : float
        Measured values less unknowns.
    presence : Vector, shape (components,)
        ``beta' C^-1 beta`` with the covariance C of beta: how far a component is from absent; for
        noise alone a chi-square of V degrees of freedom.
    amplitudes : tuple of Vector, shape (V,)
        beta at the first time of each data set.
    x0 : tuple of Vector, shape (n,)
        The state there.
    offset : tuple of Vector, shape (n_y,) or (0,)
    records : tuple of ResponseRecord
        The residual problem of each data set.
    """

    theta: Vector
    covariance: Matrix
    states: tuple[ParameterState, ...]
    converged: bool
    iterations: int
    deviation: float
    freedom: float
    presence: Vector
    amplitudes: tuple[Vector, ...]
    x0: tuple[Vector, ...]
    offset: tuple[Vector, ...]
    records: tuple[ResponseRecord, ...]

    @property
    def standard_error(self) -> Vector:
        """The standard errors of theta, shape (P,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def estimated(self) -> NDArray[np.bool_]:
        """Which parameters the data determine, shape (P,)."""
        states = [state is ParameterState.ESTIMATED for state in self.states]
        return np.array(states, np.bool_)

    @cached_property
    def triangles(self) -> tuple[Matrix, ...]:
        """The triangle R of each record at theta."""
        return tuple(record.make(self.theta) for record in self.records)

    @cached_property
    def squares(self) -> float:
        """The sum of squares at theta, the linear unknowns of each record at their best."""
        pairs = zip(self.records, self.triangles, strict=True)
        return sum(_least_squares(record, R) for record, R in pairs)


def fit_output_error(
    data: Sequence[DataSet],
    plant: DisturbedPlant,
    families: Sequence[Family],
    theta: Vector,
    *,
    noise: NoiseModel | None = None,
    offset: bool = False,
    forgetting: float = 1.0,
    bounds: Mapping[int, tuple[float, float]] = NO_BOUNDS,
) -> OutputErrorFit:
    """Estimate theta by output error, from a start.

    Parameters
    ----------
    data : sequence of DataSet
        One or more records of the same plant under the same theta; amplitudes, initial states and
        offsets are their own.
    plant : DisturbedPlant
    families : sequence of Family
        The components of the disturbance.
    theta : Vector, shape (P,)
        Start.
    noise : NoiseModel, optional
        By default white, of equal deviation on every output.
    offset : bool
        An unknown constant is on every output.
    forgetting : float
        Weight of the square of a sample over that of the next sample.
    bounds : mapping of index to (lower, upper)
        Of entries of theta; equal bounds fix an entry.

    Raises
    ------
    AssumptionError
        If sizes do not fit, a bound excludes every value, or there are fewer samples than unknowns.
    StartError
        If the response at the start is not finite.
    """
    if not data:
        raise AssumptionError("data: expected at least one record, got none")
    matrices = generators(families)
    noise = noise or white_noise(plant.C.shape[0])
    records = response_records(
        data, plant, matrices, noise=noise, offset=offset, forgetting=forgetting
    )
    return fit_records(records, data, plant, families, theta, noise=noise, bounds=bounds)


def fit_records(
    records: Sequence[ResponseRecord],
    data: Sequence[DataSet],
    plant: DisturbedPlant,
    families: Sequence[Family],
    theta: Vector,
    *,
    noise: NoiseModel,
    bounds: Mapping[int, tuple[float, float]],
    iterations: int | None = None,
) -> OutputErrorFit:
    """Estimate theta as :func:`fit_output_error` does, from the residual problems of the data.

    Parameters
    ----------
    records : sequence of ResponseRecord
        As from :func:`response_records`.
    data, plant, families, theta, noise, bounds
        As of :func:`fit_output_error`.
    iterations : int, optional
        At most; by default as many as lead to an optimum nearly always.
    """
    matrices = generators(families)
    start = np.asarray(theta, np.float64)
    if start.shape != (matrices.parameters,):
        raise AssumptionError(
            f"theta: expected a start of shape {(matrices.parameters,)}, one for each parameter "
            f"of the families, got {start.shape}"
        )
    lower, upper = bound_vectors(bounds, matrices.parameters)
    result = minimize(
        records,
        np.clip(start, lower, upper),
        lower=lower,
        upper=upper,
        scale=_longest_steps(data, families),
        threshold=presence_threshold(matrices.size, len(data)),
        accuracy=_rounding_of(data, noise),
        iterations=iterations,
    )
    if result.status == NO_INFORMATION:
        unknowns = len(records) * records[0].model.linear + matrices.parameters
        raise _no_information(data, unknowns, start)
    return _fit(result, records, matrices.order, plant.A.shape[0])


def response_records(
    data: Sequence[DataSet],
    plant: DisturbedPlant,
    matrices: Generators,
    *,
    noise: NoiseModel,
    offset: bool = False,
    forgetting: float = 1.0,
) -> list[ResponseRecord]:
    """Return the residual problem of each data set; parameters as of :func:`fit_output_error`."""
    records = []
    for data_set in data:
        sampled = sample_plant(
            plant, matrices, data_set, noise=noise, offset=offset, forgetting=forgetting
        )
        records.append(sampled.record(data_set))
    return records


def longest_span(data: Sequence[DataSet]) -> float:
    """Return the length of the longest record [s]."""
    spans = [float(data_set.t[-1] - data_set.t[0]) for data_set in data]
    return max(spans)


def squares_at(records: Sequence[ResponseRecord], theta: Vector) -> float:
    """Return the sum of squares at ``theta``, the linear unknowns of each record at their best."""
    return sum(_least_squares(record, record.make(theta)) for record in records)


def _least_squares(record: ResponseRecord, R: Matrix) -> float:
    linear = record.model.linear
    columns = R[:, :linear]
    if not (np.abs(columns) < LARGEST_ENTRY).all():
        return np.inf
    lengths = np.linalg.norm(columns, axis=0)
    lengths[lengths == 0.0] = 1.0
    columns = columns / lengths
    solution = np.linalg.lstsq(columns, R[:, -1], rcond=1e-12)[0]
    rest = R[:, -1] - columns @ solution
    return float(rest @ rest)


def excess_squares(best: float, other: float, freedom: float) -> float:
    """Return by how many variances a fit leaves a larger sum of squares than another one.

    Parameters
    ----------
    best, other : float
        Sizes of their residuals.
    freedom : float
        Of the best one.
    """
    if best == 0.0:
        return np.inf if other > 0.0 else 0.0
    return float(freedom * ((other / best) ** 2 - 1.0))


def largest_chance(parameters: int) -> float:
    """Return the largest difference that noise alone makes between two optima, in variances."""
    return chi_square_above(FALSE_CHOICE, max(parameters, 1))


def bound_vectors(
    bounds: Mapping[int, tuple[float, float]], parameters: int
) -> tuple[Vector, Vector]:
    """Return the bounds of all parameters, infinite where none are given, shapes ``(P,)``.

    Raises
    ------
    AssumptionError
        If there is no such parameter, or an upper bound is below the lower bound.
    """
    lower = np.full(parameters, -np.inf)
    upper = np.full(parameters, np.inf)
    for j, (low, high) in bounds.items():
        if not 0 <= j < parameters:
            raise AssumptionError(f"bounds: no theta[{j}]; there are {parameters} parameters")
        if not low <= high:
            raise AssumptionError(f"bounds of theta[{j}]: expected lower first, got {low} > {high}")
        lower[j] = low
        upper[j] = high
    return lower, upper


def presence_threshold(sizes: Sequence[int], records: int) -> Vector:
    """Return above which ``beta' C^-1 beta`` a component is there, shape (components,)."""
    thresholds = [chi_square_above(FALSE_PRESENCE, size * records) for size in sizes]
    return np.array(thresholds)


def _no_information(data: Sequence[DataSet], unknowns: int, theta: Vector) -> AssumptionError:
    """Return why there is no fit: too few samples, or a start without a response."""
    measured = sum(int(data_set.measured.sum()) for data_set in data)
    if measured > unknowns:
        return StartError(
            f"the response at theta = {theta.tolist()} is not finite; choose another start"
        )
    return AssumptionError(
        f"expected at least {unknowns} measured values for {unknowns} unknowns, got {measured}"
    )


def _longest_steps(data: Sequence[DataSet], families: Sequence[Family]) -> Vector:
    """Return the longest steps of an iteration, shape (P,).

    Longer steps make the response overflow, or pass between two samples.
    """
    span = longest_span(data)
    count = max(len(data_set.t) for data_set in data)
    shortest = 4.0 * span / max(count - 1, 4)
    return search_box(families, span=span, shortest=shortest).step


def _rounding_of(data: Sequence[DataSet], noise: NoiseModel) -> float:
    """Return the largest error by rounding of the simulated outputs, made white."""
    largest_of_each = [np.nanmax(np.abs(data_set.y), axis=0) for data_set in data]
    largest = np.max(largest_of_each, axis=0)
    positive = np.maximum(largest, np.finfo(np.float64).tiny)
    white = np.abs(noise.whitening) @ positive
    return ROUNDING * float(white.max())


def _fit(
    result: GaussNewtonResult, records: Sequence[ResponseRecord], order: int, states: int
) -> OutputErrorFit:
    amplitudes = []
    x0 = []
    offset = []
    for record in records:
        linear = record.amplitudes[: record.model.linear]
        amplitudes.append(linear[:order].copy())
        x0.append(linear[order : order + states].copy())
        offset.append(linear[order + states :].copy())
    return OutputErrorFit(
        theta=result.theta,
        covariance=result.covariance,
        states=result.states,
        converged=result.status == 0,
        iterations=result.iterations,
        deviation=float(np.sqrt(result.variance)),
        freedom=result.freedom,
        presence=result.statistics / result.variance,
        amplitudes=tuple(amplitudes),
        x0=tuple(x0),
        offset=tuple(offset),
        records=tuple(records),
    )
