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
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError, StartError, quoted
from cosim.native.estimation.output_error import (
    NO_INFORMATION,
    GaussNewtonResult,
    Generators,
    ParameterState,
    ResponseRecord,
    SearchLimits,
    minimize,
)
from cosim.theory.covariance import is_covariance
from cosim.theory.disturbances.families import Family, even_parameters, generators, search_box
from cosim.theory.disturbed_plant import (
    DataSet,
    DisturbedPlant,
    NoiseModel,
    check_sizes,
    needs_predictor,
    sample_plant,
    white_noise,
)
from cosim.theory.interchangeable import in_order, interchangeable
from cosim.theory.quantiles import chi_square_above

# probability of a larger difference of two optima by noise alone
FALSE_CHOICE: Final = 0.01
# Probability that noise alone makes an absent component look present, for a given theta; that of
# the largest over all theta, which the fit finds, is about a hundred times as large.
FALSE_PRESENCE: Final = 1e-8
LARGEST_ENTRY: Final = 1e150  # of a column: the squares of larger ones are no numbers
ROUNDING: Final = 2.0**-44  # error of a simulated output relative to the largest output
MOST_SAMPLES: Final = 1000  # of a record, in which other optima are searched
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


@dataclass(frozen=True, eq=False)
class OutputErrorProblem:
    """Data sets of one plant under one theta, and the model that is fitted to them.

    Parameters
    ----------
    data : sequence of DataSet
        Amplitudes, initial states and offsets of each are its own.
    plant : DisturbedPlant
    families : sequence of Family
        Of the terms of the disturbance.
    stated : Matrix, shape (n_y, n_y), optional
        Covariance of the noise of the outputs, where it is known.
    offset : bool
        An unknown constant is on every output.
    bounds : mapping of index to (lower, upper)
        Of entries of theta; equal bounds fix one.

    Raises
    ------
    AssumptionError
        If there are no data, they do not fit the plant, ``stated`` is no covariance of its outputs,
        or there is no such theta to bound, or a lower bound is above its upper one.
    """

    data: Sequence[DataSet]
    plant: DisturbedPlant
    families: Sequence[Family]
    stated: Matrix | None = None
    offset: bool = False
    bounds: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that all of it fits together."""
        if not self.data:
            raise AssumptionError("data: expected at least one record, got none")
        for data_set in self.data:
            check_sizes(self.plant, self.generators, data_set)
        _ = self.limits
        if self.stated is None:
            return
        stated = np.asarray(self.stated)
        shape = (self.outputs, self.outputs)
        if stated.shape != shape or not is_covariance(stated):
            raise AssumptionError(
                "stated: expected the covariance of the noise of y, a symmetric positive definite "
                f"matrix of shape {shape}, got {quoted(stated.tolist())}"
            )

    @cached_property
    def generators(self) -> Generators:
        """Those of all terms."""
        return generators(self.families)

    @cached_property
    def interchangeable(self) -> tuple[int, ...]:
        """For every term the last one before it that is interchangeable with it, or -1."""

        def same_alpha(i: int, k: int) -> bool:
            return all(np.array_equal(one.alpha[:, i], one.alpha[:, k]) for one in self.data)

        return interchangeable(self.generators, self.plant, same_alpha, self.bounds)

    @property
    def has_several(self) -> bool:
        """Whether there are several terms with parameters, which may exchange their parts."""
        return sum(1 for count in self.generators.count if count) > 1

    @property
    def may_have_rivals(self) -> bool:
        """Whether parts may be exchanged, of several terms or of the functions of one."""
        pairs = zip(self.generators.size, self.generators.count, strict=True)
        return self.has_several or any(V > 1 and count for V, count in pairs)

    def in_order(self, theta: Vector) -> Vector:
        """Return the one of all theta of the same model that is reported, shape (P,)."""
        even = even_parameters(self.families)
        return in_order(theta, self.generators, self.interchangeable, even)

    @property
    def outputs(self) -> int:
        """The number of outputs."""
        return len(self.plant.C)

    @cached_property
    def limits(self) -> tuple[Vector, Vector]:
        """The bounds of all parameters, infinite where none are given, each ``(P,)``."""
        return limits_of(self.bounds, self.generators.parameters)

    @property
    def span(self) -> float:
        """The length of the longest record [s]."""
        return max(float(one.t[-1] - one.t[0]) for one in self.data)

    @property
    def spacing(self) -> float:
        """The shortest usual distance of the samples of a record [s]."""
        return min(one.sampling_interval for one in self.data)

    def sampled(self, noise: NoiseModel, forgetting: float = 1.0) -> SampledProblem:
        """Discretize it.

        Parameters
        ----------
        noise : NoiseModel
        forgetting : float
            Weight of the square of a sample over that of the next sample.

        Raises
        ------
        AssumptionError
            If there are more unknowns than the kernels hold, or a single sample.
        """
        records = []
        for one in self.data:
            sampled = sample_plant(
                self.plant,
                self.generators,
                one,
                noise=noise,
                offset=self.offset,
                forgetting=forgetting,
            )
            records.append(sampled.record(one))
        return SampledProblem(self, noise, tuple(records))

    def fit(self, theta: Vector, noise: NoiseModel) -> OutputErrorFit:
        """Fit output error from a start.

        Raises
        ------
        AssumptionError, StartError
            As :func:`fit_output_error`.
        """
        return self.sampled(noise).fit(theta)

    @cached_property
    def thinned(self) -> OutputErrorProblem:
        """The problem of every so many samples, in which other optima are searched.

        The response to u is taken off before, as u may change between these samples.
        """
        data = []
        for one in self._without_inputs():
            every = max(1, len(one.t) // MOST_SAMPLES)
            data.append(one.thinned(every))
        return self.of_data(data)

    def _without_inputs(self) -> list[DataSet]:
        """Return the data less the response to u; as they are where that grows too much."""
        records = self.sampled(white_noise(self.outputs)).records
        data = []
        for one, record in zip(self.data, records, strict=True):
            span = float(one.t[-1] - one.t[0])
            if needs_predictor(self.plant.A, span):
                data.append(one)
            else:
                data.append(replace(one, y=record.residual, u=np.zeros_like(one.u)))
        return data

    def of_data(self, data: Sequence[DataSet]) -> OutputErrorProblem:
        """Return the same for other data."""
        return replace(self, data=data)

    def of_terms(self, kept: Sequence[int]) -> OutputErrorProblem:
        """Return the problem of some of the terms."""
        data = [replace(one, alpha=one.alpha[:, kept]) for one in self.data]
        plant = replace(self.plant, Bd=self.plant.Bd[:, kept], Dd=self.plant.Dd[:, kept])
        bounds = {}
        for place, j in enumerate(self.parameters_of(kept)):
            if j in self.bounds:
                bounds[place] = self.bounds[j]
        families = [self.families[i] for i in kept]
        return replace(self, data=data, plant=plant, families=families, bounds=bounds)

    def without_effect_of(self, terms: Sequence[int]) -> OutputErrorProblem:
        """Return the problem with alpha 0 for some terms, whose theta keeps its place."""
        data = []
        for one in self.data:
            alpha = one.alpha.copy()
            alpha[:, terms] = 0.0
            data.append(replace(one, alpha=alpha))
        return self.of_data(data)

    def parameters_of(self, terms: Sequence[int]) -> list[int]:
        """Return the places in theta of the parameters of some terms."""
        places: list[int] = []
        first = 0
        for i, family in enumerate(self.families):
            count = len(family.parameters)
            if i in terms:
                places += range(first, first + count)
            first += count
        return places


@dataclass(frozen=True, eq=False)
class SampledProblem:
    """A problem under a model of its noise.

    Parameters
    ----------
    problem : OutputErrorProblem
    noise : NoiseModel
    records : tuple of ResponseRecord
        The residual problem of each data set.
    """

    problem: OutputErrorProblem
    noise: NoiseModel
    records: tuple[ResponseRecord, ...]

    def fit(self, theta: Vector, iterations: int | None = None) -> OutputErrorFit:
        """Estimate theta as :func:`fit_output_error` does.

        Parameters
        ----------
        theta : Vector, shape (P,)
            Start.
        iterations : int, optional
            At most; by default as many as lead to an optimum nearly always.
        """
        data = self.problem.data
        matrices = self.problem.generators
        start = np.asarray(theta, np.float64)
        if start.shape != (matrices.parameters,):
            raise AssumptionError(
                f"theta: expected a start of shape {(matrices.parameters,)}, one for each "
                f"parameter of the families, got {start.shape}"
            )
        lower, upper = self.problem.limits
        limits = SearchLimits(
            lower=lower,
            upper=upper,
            scale=self._longest_steps(),
            threshold=presence_threshold(matrices.size, len(data)),
            accuracy=self._rounding(),
        )
        result = minimize(self.records, np.clip(start, lower, upper), limits, iterations)
        if result.status == NO_INFORMATION:
            unknowns = len(data) * self.records[0].model.linear + matrices.parameters
            raise _no_information(data, unknowns, start)
        return _fit(result, self.records, matrices.order, self.problem.plant.A.shape[0])

    def _longest_steps(self) -> Vector:
        """Return the longest steps of an iteration, shape (P,).

        Longer steps make the response overflow, or pass between two samples.
        """
        span = self.problem.span
        count = max(len(one.t) for one in self.problem.data)
        shortest = 4.0 * span / max(count - 1, 4)
        return search_box(self.problem.families, span=span, shortest=shortest).step

    def _rounding(self) -> float:
        """Return the largest error by rounding of the simulated outputs, made white."""
        largest_of_each = [np.nanmax(np.abs(one.y), axis=0) for one in self.problem.data]
        largest = np.max(largest_of_each, axis=0)
        positive = np.maximum(largest, np.finfo(np.float64).tiny)
        white = np.abs(self.noise.whitening) @ positive
        return ROUNDING * float(white.max())


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
    problem = OutputErrorProblem(data, plant, families, offset=offset, bounds=bounds)
    noise = noise or white_noise(problem.outputs)
    return problem.sampled(noise, forgetting).fit(theta)


def limits_of(bounds: Mapping[int, tuple[float, float]], parameters: int) -> tuple[Vector, Vector]:
    """Return bounds of theta as vectors, infinite where there is none, each ``(P,)``.

    Raises
    ------
    AssumptionError
        If there is no such theta, or a lower bound is above its upper one.
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
