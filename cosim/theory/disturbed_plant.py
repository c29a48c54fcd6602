"""A linear plant under a disturbance of the class (4)-(5), as a regression on samples.

::

    x' = A x + B u + sum_i Bd_i alpha_i f_i        f_i = c_i' expm(G_i(theta) t) beta_i
    y  = C x + D u + sum_i Dd_i alpha_i f_i + offset

Between samples u and ``alpha_i f_i`` are straight lines, which is exact for what a run of this
package makes, and else has an error of second order in the step:
:mod:`cosim.theory.assessment.accuracy`.

**Predictor.** The response of an unstable plant overflows its digits, so what is fitted is not the
simulated but the predicted output,

    x' = (Ad - K C) x + (B0 - K D) u0 + B1 u1 + K y0,

with the gain K of the Kalman filter without process noise for the unstable modes
(:mod:`cosim.theory.predictor`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector, frozen
from cosim.errors import AssumptionError
from cosim.native.estimation.output_error import (
    Generators,
    KnownInput,
    OutputErrorConstants,
    OutputErrorModel,
    ResponseRecord,
    residual_of,
)
from cosim.native.numerics.linear import first_order_holds
from cosim.theory.plants.descriptor import ReducedSystem
from cosim.theory.predictor import Predictor, stationary_predictor, time_varying_predictor
from cosim.theory.sampling import distinct_steps

# growth of a mode over the record from which on the output is predicted, not simulated
LARGEST_GROWTH: Final = 1e3
ALIKE: Final = 0.05  # of two distances of samples, relative: they count as the same
HALF: Final = 0.55  # of the usual distance: a sample that is as near to another is none of its line
MOST_MISSING: Final = 10_000  # in a gap, beyond what any model of the noise looks back


@dataclass(frozen=True, eq=False, kw_only=True)
class DisturbedPlant:
    """The plant of the module docstring.

    Shapes: ``A (n, n)``, ``B (n, n_u)``, ``Bd (n, components)``, ``C (n_y, n)``, ``D (n_y, n_u)``,
    ``Dd (n_y, components)``.

    Raises
    ------
    AssumptionError
        If one is no matrix of numbers.
    """

    A: Matrix
    B: Matrix
    Bd: Matrix
    C: Matrix
    D: Matrix
    Dd: Matrix

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        for field in fields(self):
            object.__setattr__(self, field.name, _frozen(self, field.name, 2))


def disturbed_plant(reduced: ReducedSystem, elements: Sequence[int]) -> DisturbedPlant:
    """Return the reduced system (9)-(10) with the components of its disturbances.

    Parameters
    ----------
    reduced : ReducedSystem
    elements : sequence of int
        Which entry of delta each component belongs to.

    Raises
    ------
    AssumptionError
        If there is no such entry.
    """
    n_d = reduced.B_2a.shape[1]
    for element in elements:
        if not 0 <= element < n_d:
            raise AssumptionError(
                f"expected one of the disturbances 0 to {n_d - 1} of the plant, got {element}"
            )
    Bd = reduced.B_2a[:, list(elements)]
    Dd = reduced.C5[:, list(elements)]
    return DisturbedPlant(A=reduced.A_a, B=reduced.B_1a, Bd=Bd, C=reduced.C3, D=reduced.C4, Dd=Dd)


def _frozen(owner: object, name: str, ndim: int) -> NDArray[np.float64]:
    try:
        return frozen(getattr(owner, name), ndim)
    except (TypeError, ValueError) as error:
        raise AssumptionError(f"{name}: {error}") from error


@dataclass(frozen=True, eq=False)
class DataSet:
    """Samples of one experiment.

    Parameters
    ----------
    t : Vector, shape (N,)
        Ascending instants [s], at any distances.
    y : Matrix, shape (N, n_y)
        Outputs; NaN: not measured. Each counts where it is measured, alone or with others.
    u : Matrix, shape (N, n_u)
        Inputs.
    alpha : Matrix, shape (N, components)
        The known factor of each component of the disturbance.
    held : shape (n_u,), optional
        Inputs that keep their value from one sample to the next; by default none: straight lines.
    taken : shape (N,), optional
        Samples at which u was taken; at others it is on the straight lines between. By default all.
    in_feedback : shape (n_u,), optional
        Inputs that depend on y, and so carry its noise: a closed loop. By default none.

    Raises
    ------
    AssumptionError
        If the sizes do not fit, time does not ascend, a number is not finite, or an output is never
        measured.
    """

    t: Vector
    y: Matrix
    u: Matrix
    alpha: Matrix
    held: NDArray[np.bool_] | None = None
    taken: NDArray[np.bool_] | None = None
    in_feedback: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        """Freeze and check the samples."""
        object.__setattr__(self, "t", _frozen(self, "t", 1))
        for name in ("y", "u", "alpha"):
            object.__setattr__(self, name, _frozen(self, name, 2))
        N = len(self.t)
        for name in ("y", "u", "alpha"):
            rows = len(getattr(self, name))
            if rows != N:
                raise AssumptionError(
                    f"{name}: expected {N} samples, one for every time, got {rows}"
                )
        steps = np.diff(self.t)
        if not np.isfinite(self.t).all() or not (steps > 0.0).all():
            place = int(np.argmin(np.append(steps > 0.0, False)))
            raise AssumptionError(
                f"t: expected ascending finite times, got {self.t[place]} s at sample {place}, "
                f"followed by {self.t[min(place + 1, N - 1)]} s"
            )
        for name in ("u", "alpha"):
            finite = np.isfinite(getattr(self, name)).all(axis=1)
            if not finite.all():
                place = int(np.argmin(finite))
                raise AssumptionError(
                    f"{name}: expected a finite number at every time, not so at t = "
                    f"{self.t[place]} s"
                )
        if np.isinf(self.y).any():
            raise AssumptionError("y: expected finite numbers, and NaN only where not measured")
        never = np.flatnonzero(~self.measured.any(axis=0))
        if len(never):
            raise AssumptionError(f"y[{never[0]}]: expected at least one measured value, got none")

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which outputs were measured when, shape (N, n_y)."""
        return ~np.isnan(self.y)

    @property
    def samples(self) -> int:
        """The number of times at which something was measured."""
        return int(self.measured.any(axis=1).sum())

    @property
    def sampling_interval(self) -> float:
        """The usual distance of the times at which something was measured [s].

        Of a single one there is no distance: that from the first instant to the last.
        """
        times = self.t[self.measured.any(axis=1)]
        if len(times) < 2:
            return float(self.t[-1] - self.t[0])
        return float(np.median(np.diff(times)))

    @cached_property
    def distances(self) -> Vector:
        """The usual time from one value of each output to its next [s], shape (n_y,)."""
        return np.array([_usual_distance(self.t[own]) for own in self.measured.T])

    @cached_property
    def numbers(self) -> NDArray[np.integer]:
        """Which value of its output each one is, shape (N, n_y); -1: not measured.

        Where values are missing, so are their numbers: one is the next of another at their usual
        distance alone, whatever rows are between them.
        """
        numbers = np.full(self.y.shape, -1)
        for o, (own, usual) in enumerate(zip(self.measured.T, self.distances, strict=True)):
            ratios = np.diff(self.t[own]) / usual
            passed = np.minimum(np.floor(ratios + (1.0 - HALF)), MOST_MISSING)
            passed[ratios <= HALF] = 2  # closer than the next one is
            numbers[own, o] = np.cumsum(np.append(0, passed))
        return numbers

    @property
    def is_held(self) -> NDArray[np.bool_]:
        """Which inputs keep their value from one sample to the next, shape (n_u,)."""
        if self.held is None:
            return np.zeros(self.u.shape[1], np.bool_)
        return np.array(self.held, np.bool_)

    @property
    def is_in_feedback(self) -> NDArray[np.bool_]:
        """Which inputs depend on y, shape (n_u,)."""
        if self.in_feedback is None:
            return np.zeros(self.u.shape[1], np.bool_)
        return np.array(self.in_feedback, np.bool_)

    @property
    def is_taken(self) -> NDArray[np.bool_]:
        """At which samples u was taken, shape (N,)."""
        if self.taken is None:
            return np.ones(len(self.t), np.bool_)
        return np.array(self.taken, np.bool_)

    def kept(self, every: int) -> NDArray[np.intp]:
        """Return the rows that are left of every so many, also of those of each output."""
        is_kept = np.zeros(len(self.t), np.bool_)
        is_kept[::every] = True
        for values in self.measured.T:
            is_kept[np.flatnonzero(values)[::every]] = True
        return np.flatnonzero(is_kept)

    def thinned(self, every: int) -> DataSet:
        """Return every so many samples of it, and the inputs as often."""
        return self._rows(self.kept(every))

    def last(self, span: float) -> DataSet:
        """Return the samples less than ``span`` seconds before the last one, and that one."""
        before = self.t[-1] - span
        rounding = 1e-9 * span if np.isfinite(span) else 0.0
        return self._rows(np.flatnonzero(self.t > before + rounding))

    def _rows(self, rows: NDArray[np.intp]) -> DataSet:
        return replace(
            self,
            t=self.t[rows],
            y=self.y[rows],
            u=self.u[rows],
            alpha=self.alpha[rows],
            taken=self.is_taken[rows],
        )


def _usual_distance(t: Vector) -> float:
    """Return the distance that most successive instants have, but for a little jitter [s]."""
    gaps = np.sort(np.diff(t))
    if not len(gaps):
        return 1.0
    first = np.searchsorted(gaps, (1.0 - ALIKE) * gaps, side="left")
    end = np.searchsorted(gaps, (1.0 + ALIKE) * gaps, side="right")
    most = int((end - first).argmax())
    return float(np.median(gaps[first[most] : end[most]]))


@dataclass(frozen=True, eq=False, kw_only=True)
class NoiseModel:
    """What is assumed of the noise of the outputs.

    Parameters
    ----------
    covariance : Matrix, shape (n_y, n_y)
        Of the white e below, up to a factor, which the residual decides.
    a : Matrix, shape (n_y, order)
        Autoregressive model of each output, `e(k) = v(k) - a_1 v(k-1) - ...` is white; no columns:
        v is white.
    freedom : float
        Degrees of freedom of the variance of v at low frequencies, as far as ``a`` is known.
    """

    covariance: Matrix
    a: Matrix
    freedom: float = np.inf

    @property
    def order(self) -> int:
        """The order of the autoregressive models."""
        return int(self.a.shape[1])

    @property
    def whitening(self) -> Matrix:
        """W with ``W covariance W' = I``, shape (n_y, n_y)."""
        factor = np.linalg.cholesky(self.covariance)
        return np.linalg.inv(factor)

    @property
    def deviations(self) -> Vector:
        """The deviation of each output's e, shape (n_y,)."""
        return np.sqrt(np.diag(self.covariance))

    def without_color(self) -> NoiseModel:
        """Return the same without its autoregressive models, as if v were white."""
        return replace(self, a=self.a[:, :0])

    def whitened(
        self, rows: NDArray[np.float64], numbers: NDArray[np.integer]
    ) -> NDArray[np.float64]:
        """Return rows of successive samples made white, shape (N, n_y, k).

        Those of a sample are white by the covariance of the outputs that it has. Rows that are not
        counted are 0.

        Parameters
        ----------
        rows : shape (N, n_y, k)
        numbers : shape (N, n_y)
            As of :attr:`DataSet.numbers`.
        """
        filtered = autoregressive_filter(rows, self.a, numbers)
        result = np.zeros_like(filtered)
        for there, samples in _by_outputs(counted_values(numbers, self.order)):
            W = np.linalg.inv(self._factor(there))
            part = np.ix_(samples, there)
            result[part] = np.einsum("ab,nbk->nak", W, filtered[part])
        return result

    def _factor(self, outputs: NDArray[np.bool_]) -> Matrix:
        part = self.covariance[np.ix_(outputs, outputs)]
        return np.asarray(np.linalg.cholesky(part), np.float64)


def counted_values(numbers: NDArray[np.integer], order: int) -> NDArray[np.bool_]:
    """Return which values count, shape (N, n_y).

    Those that have ``order`` others of their output before them, each at its usual distance.

    Parameters
    ----------
    numbers : shape (N, n_y)
        As of :attr:`DataSet.numbers`.
    order : int
    """
    counted = numbers >= 0
    for own, values in zip(counted.T, numbers.T, strict=True):
        there = np.flatnonzero(own)
        places = np.arange(len(there))
        is_first = np.diff(values[there], prepend=-2) != 1
        first = np.maximum.accumulate(np.where(is_first, places, 0))
        own[there] = places - first >= order
    return counted


def white_noise(outputs: int) -> NoiseModel:
    """Return white noise of equal deviation on every output."""
    return NoiseModel(covariance=np.eye(outputs), a=np.zeros((outputs, 0)))


def autoregressive_filter(
    rows: NDArray[np.float64], a: Matrix, numbers: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Compute ``v(k) - a_1 v(k-1) - ...`` of each output, anew behind what was not measured.

    Parameters
    ----------
    rows : shape (N, n_y, k)
    a : Matrix, shape (n_y, order)
    numbers : shape (N, n_y)
        As of :attr:`DataSet.numbers`.

    Returns
    -------
    array, shape (N, n_y, k)
        0 for values that do not count.
    """
    result = np.zeros_like(rows)
    counted = counted_values(numbers, a.shape[1])
    for o, coefficients in enumerate(a):
        there = numbers[:, o] >= 0
        values = rows[there, o]
        filtered = values.copy()
        for k, coefficient in enumerate(coefficients, start=1):
            filtered[k:] -= coefficient * values[:-k]
        filtered[~counted[there, o]] = 0.0
        result[there, o] = filtered
    return result


def _by_outputs(
    measured: NDArray[np.bool_],
) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.integer]]]:
    """Yield every set of outputs that are measured together, (n_y,), and the samples it has."""
    packed = np.packbits(measured, axis=1)
    keys: NDArray[np.integer] = packed[:, 0]
    for byte in packed.T[1:]:
        longer = 256 * keys.astype(np.int64) + byte
        keys = np.unique(longer, return_inverse=True)[1]
    order = np.argsort(keys, kind="stable")
    borders = 1 + np.flatnonzero(np.diff(keys[order]))
    for samples in np.split(order, borders):
        outputs = measured[samples[0]]
        if outputs.any():
            yield outputs, samples


@dataclass(frozen=True, eq=False)
class SampledPlant:
    """A plant discretized for the times of a data set.

    Parameters
    ----------
    model : OutputErrorModel
    known : KnownInput
    interval : array of int, shape (N,), or None
        Which of the intervals ends at each sample; None: all are the first.
    """

    model: OutputErrorModel
    known: KnownInput
    interval: NDArray[np.integer] | None

    def record(self, data: DataSet) -> ResponseRecord:
        """Return the record of a data set: its outputs less their known part."""
        residual = residual_of(self.model, self.known, u=data.u, y=data.y, interval=self.interval)
        return ResponseRecord(self.model, residual, data.alpha, self.interval)


def sample_plant(
    plant: DisturbedPlant,
    generators: Generators,
    data: DataSet,
    *,
    noise: NoiseModel,
    offset: bool = False,
    forgetting: float = 1.0,
) -> SampledPlant:
    """Discretize a plant exactly for straight lines between the samples of a data set.

    Parameters
    ----------
    plant : DisturbedPlant
    generators : Generators
        Of the components of its disturbance.
    data : DataSet
        Its times, and where outputs are missing.
    noise : NoiseModel
    offset : bool
        An unknown constant is on every output.
    forgetting : float
        Weight of the square of a sample over that of the next one; 1: all weigh the same.

    Raises
    ------
    AssumptionError
        If shapes do not fit, there are more unknowns than the kernels hold, or a single sample.
    """
    check_sizes(plant, generators, data)
    if len(data.t) < 2:
        raise AssumptionError(f"expected a record, got a single sample at {data.t[0]:g} s")
    step, interval, predictor = sample_intervals(plant, data, noise.covariance)
    constants, known = discretize(
        plant,
        generators,
        step=step,
        predictor=predictor,
        noise=noise,
        held=data.held,
    )
    constants = replace(
        constants, every=tuple(data.distances.tolist()), offset=offset, forgetting=forgetting
    )
    return SampledPlant(OutputErrorModel(constants), known, interval)


def discretize(
    plant: DisturbedPlant,
    generators: Generators,
    *,
    step: Vector,
    noise: NoiseModel,
    predictor: Predictor | None = None,
    held: NDArray[np.bool_] | None = None,
) -> tuple[OutputErrorConstants, KnownInput]:
    """Discretize a plant for intervals of given lengths.

    Parameters
    ----------
    plant : DisturbedPlant
    generators : Generators
        Of the components of its disturbance.
    step : Vector, shape (m,)
        Lengths of the intervals [s].
    noise : NoiseModel
    predictor : Predictor, optional
        Of the outputs; by default they are simulated.
    held : shape (n_u,), optional
        Inputs that keep their value over an interval; by default none.
    """
    n, n_u = plant.B.shape
    n_y, components = plant.Dd.shape
    m = len(step)
    inputs = np.hstack([plant.B, plant.Bd])
    mask = np.zeros(n_u + components, np.bool_)
    if held is not None:
        mask[:n_u] = held
    lengths, which = np.unique(step, return_inverse=True)
    of_lengths = first_order_holds(plant.A, inputs, lengths, mask)
    Ad, start, end = (matrices[which] for matrices in of_lengths)
    K = np.zeros((m, n, n_y))
    L = np.tile(np.eye(n_y), (m, 1, 1))
    if predictor is not None:
        K = predictor.K
        L = predictor.L
    Ad = Ad - K @ plant.C
    B0 = start[:, :, n_u:] - K @ plant.Dd
    Bu0 = start[:, :, :n_u] - K @ plant.D
    constants = OutputErrorConstants(
        generators=generators,
        step=step,
        Ad=Ad,
        B0=B0.transpose(0, 2, 1),
        B1=end[:, :, n_u:].transpose(0, 2, 1),
        K=K,
        L=L,
        C=plant.C,
        D=plant.Dd.T,
        W=noise.whitening,
        a=noise.a,
    )
    predicts = np.asarray(K.any(axis=(1, 2)), np.bool_)
    return constants, KnownInput(Bu0, end[:, :, :n_u], plant.D, predicts)


def needs_predictor(A: Matrix, span: float) -> bool:
    """Return whether a mode of ``x' = A x`` grows too much over ``span`` seconds."""
    if not A.size:
        return False
    fastest = float(np.linalg.eigvals(A).real.max())
    return bool(fastest * span > np.log(LARGEST_GROWTH))


def check_sizes(plant: DisturbedPlant, generators: Generators, data: DataSet) -> None:
    """Check that a data set and the terms of the disturbance are of a plant.

    Raises
    ------
    AssumptionError
        If they are not; names what has another number of columns.
    """
    n_y, components = plant.Dd.shape
    n_u = plant.B.shape[1]
    for name, columns, expected in (
        ("y", data.y.shape[1], n_y),
        ("u", data.u.shape[1], n_u),
        ("alpha", data.alpha.shape[1], components),
        ("families", len(generators.size), components),
    ):
        if columns != expected:
            raise AssumptionError(
                f"{name}: expected {expected} columns, as of the plant, got {columns}"
            )


def sample_intervals(
    plant: DisturbedPlant, data: DataSet, covariance: Matrix
) -> tuple[Vector, NDArray[np.integer] | None, Predictor | None]:
    """Return the lengths of intervals, which of them ends at each sample, and the predictor.

    Intervals that differ by rounding of the times are one, unless their gains differ.

    Parameters
    ----------
    plant : DisturbedPlant
    data : DataSet
    covariance : Matrix, shape (n_y, n_y)
        Of the noise of the outputs.

    Returns
    -------
    Vector, shape (m,)
        Lengths [s].
    array of int, shape (N,), or None
        None: all are the first.
    Predictor or None
        None: the outputs are simulated.

    Raises
    ------
    AssumptionError
        If an unstable mode is not seen by the outputs.
    """
    A, C = plant.A, plant.C
    steps, index = distinct_steps(data.t)
    is_regular = len(steps) == 1
    if not needs_predictor(A, float(data.t[-1] - data.t[0])):
        return steps, None if is_regular else index, None
    if is_regular and data.measured.all():
        return steps, None, stationary_predictor(A, C, float(steps[0]), covariance)
    each = np.arange(len(data.t), dtype=np.int32)
    predictor = time_varying_predictor(A, C, steps, index, data.measured, covariance)
    return steps[index], each, predictor
