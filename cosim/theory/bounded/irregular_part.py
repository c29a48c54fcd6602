"""Guaranteed intervals of theta from a recording, for a bounded irregular part of the disturbance.

Here the recording and the plant of output error become the problem of ``worst_case`` and
``set_membership``. The irregular part enters where the components do: one channel, with
its bound, for every different column of (Bd, Dd).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import NAN, Mask, Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.estimation.output_error import ResponseRecord
from cosim.theory.bounded.feasible_program import (
    RecordedOutputs,
    Watch,
    cells_of,
    gaussian_noise_bound,
)
from cosim.theory.bounded.set_membership import FeasibleInterval, feasible_interval, starts_around
from cosim.theory.bounded.worst_case import (
    BoundedDisturbance,
    Prediction,
    first_order,
    interval_around,
    irregular_response,
)
from cosim.theory.disturbances.families import Family, even_parameters, generators
from cosim.theory.disturbed_plant import (
    DataSet,
    DisturbedPlant,
    NoiseModel,
    needs_predictor,
    sample_plant,
    white_noise,
)
from cosim.theory.estimators.output_error import OutputErrorFit
from cosim.theory.fitted_response import slopes_of
from cosim.theory.quantiles import GUARANTEED_CONFIDENCE, normal_two_sided
from cosim.theory.sampling import equal_step

# relative difference of both sides of an interval around an estimate up to which the first order,
# which has two equal ones, is said to hold
FIRST_ORDER: Final = 0.05


class Programs(StrEnum):
    """When linear programs are solved."""

    ALWAYS = "always"
    BEYOND_FIRST_ORDER = "beyond the first order"


@dataclass(frozen=True, eq=False)
class GuaranteedInterval:
    """What |delta_0| <= bound leaves open of theta.

    Attributes
    ----------
    lower, upper : Vector
        What both intervals below have in common, shape ``(n_theta,)``; infinite where neither has
        an end, NaN where they contradict each other or no theta explains the data. Of a sine the
        rate keeps its sign, as the other one says the same.
    half_width : Vector
        Largest error of the estimate by the irregular part, to first order, shape ``(n_theta,)``.
    around_estimate : Matrix
        The least and the largest theta that some delta_0 and noise turn into this estimate, shape
        ``(n_theta, 2)``. Where its half width differs much from ``half_width``, the first order
        does not hold. Narrower than the other one where the noise is larger than delta_0.
    first_order_holds : Mask
        Where the interval around the estimate reaches as far to both sides, shape ``(n_theta,)``.
    feasible : FeasibleInterval or None
        All theta that explain the data. It may exclude the estimate. None: not computed.
    confidence : float
        Probability of the bounds of the noise; 1 without noise.
    """

    lower: Vector
    upper: Vector
    half_width: Vector
    around_estimate: Matrix
    first_order_holds: Mask
    feasible: FeasibleInterval | None
    confidence: float


@dataclass(frozen=True, eq=False)
class ResponseModel:
    """The outputs of a disturbed plant, less their known part, at p = (theta, linear unknowns)."""

    record: ResponseRecord

    def __call__(self, p: Vector) -> Prediction:
        """Compute output and Jacobian at p, shape ``(n_p,)``."""
        kernel = self.record.model
        matrices = kernel.constants.generators
        theta = p[: matrices.parameters]
        linear = p[matrices.parameters :]
        rows = self.record.rows(theta)
        columns = rows[:, :, : kernel.linear]
        slopes = slopes_of(rows[:, :, kernel.linear : -1], linear, matrices)
        jacobian = np.concatenate([slopes, columns], axis=2)
        return Prediction(columns @ linear, jacobian)


def bounded_problem(
    data: DataSet,
    plant: DisturbedPlant,
    families: Sequence[Family],
    *,
    bound: float,
    noise: NoiseModel | None = None,
    offset: bool = False,
) -> tuple[BoundedDisturbance, Matrix]:
    """Build the problem of a bounded irregular part, and its outputs, less their known part.

    Parameters
    ----------
    data : DataSet
        Equally spaced, every output measured.
    plant : DisturbedPlant
    families : sequence of Family
        Of the components.
    bound : float
        Largest magnitude of the irregular part of every disturbance.
    noise : NoiseModel, optional
        Its covariance weighs the outputs of the estimate; by default equally.
    offset : bool
        An unknown constant is on every output.

    Raises
    ------
    AssumptionError
        If the samples are not equally spaced, an output is missing, or the plant is unstable.
    """
    if not data.measured.all():
        missing = int(np.isnan(data.y).sum())
        raise AssumptionError(
            f"{missing} values are not measured; the interval for a bounded irregular part needs "
            "all, equally spaced"
        )
    h = equal_step(data.t)
    span = float(data.t[-1] - data.t[0])
    if needs_predictor(plant.A, span):
        raise AssumptionError(
            f"the interval for a bounded irregular part needs a stable plant: over {span:g} s a "
            "mode of this one grows too much for its outputs to be simulated"
        )
    plain = white_noise(len(plant.C))
    sampled = sample_plant(plant, generators(families), data, noise=plain, offset=offset)
    record = sampled.record(data)
    effect = np.vstack([plant.Bd, plant.Dd])
    channels = np.unique(effect, axis=1)
    n = len(plant.A)
    response = irregular_response(plant.A, channels[:n], plant.C, channels[n:], h)
    covariance = (noise or plain).covariance
    weight: Matrix = np.linalg.inv(covariance).astype(np.float64)
    problem = BoundedDisturbance(
        ResponseModel(record),
        response,
        bound=np.full(channels.shape[1], bound),
        weight=weight,
        n_theta=record.model.constants.generators.parameters,
    )
    return problem, record.residual


def guaranteed_interval(
    data: DataSet,
    plant: DisturbedPlant,
    families: Sequence[Family],
    fit: OutputErrorFit,
    *,
    bound: float,
    sigma: Vector,
    sampling_error: float = 0.0,
    confidence: float = GUARANTEED_CONFIDENCE,
    noise: NoiseModel | None = None,
    programs: Programs = Programs.ALWAYS,
    watch: Watch | None = None,
) -> GuaranteedInterval:
    """Compute which theta the data allow if the irregular part is within its bound.

    Parameters
    ----------
    data, plant, families, noise
        As in `bounded_problem`.
    fit : OutputErrorFit
        Of these data alone, with every theta estimated.
    bound : float
        Largest magnitude of the irregular part.
    sigma : Vector
        Deviation of the white noise of each output, shape ``(n_y,)``; zero for exact data. What is
        known of the sensor: the residual of the fit holds the irregular part too.
    sampling_error : float
        Largest further error of an output, from quantization or from straight lines between the
        samples.
    confidence : float
        Probability with which the noise is within its bounds, where there is noise.
    programs : Programs
        When linear programs are solved, which take seconds to minutes: without them the interval is
        that around the estimate, which is the narrower one where the first order holds and there
        is noise.
    watch : callable, optional
        Is told after every linear program how many have been solved.
    """
    offset = bool(len(fit.offset[0]))
    problem, y = bounded_problem(data, plant, families, bound=bound, noise=noise, offset=offset)
    p = np.concatenate([fit.theta, fit.amplitudes[0], fit.x0[0], fit.offset[0]])
    noisy = bool(np.any(sigma > 0.0))
    of_each = 1.0 - (1.0 - confidence) / 2.0  # of the two intervals, so that both hold
    linear = first_order(problem, p)
    margin = _error_by_noise(linear.functional, sigma, of_each)
    margin += sampling_error * np.abs(linear.functional).sum(axis=(1, 2))
    around = interval_around(problem, p) + np.outer(margin, [-1.0, 1.0])
    holds = _reach_equal(around, fit.theta)
    feasible = None
    lower = around[:, 0]
    upper = around[:, 1]
    if programs is Programs.ALWAYS or not holds.all():
        cells = cells_of(len(y), noisy)
        random_error = gaussian_noise_bound(sigma, cells, len(y), of_each)
        recorded = RecordedOutputs(y, cells, random_error + sampling_error)
        starts = starts_around(problem, recorded, p)
        feasible = feasible_interval(problem, recorded, starts, watch=watch)
        lower = np.maximum(feasible.lower, lower)
        upper = np.minimum(feasible.upper, upper)
    contradictory = lower > upper
    lower, upper = _magnitudes(lower, upper, fit.theta, families)
    return GuaranteedInterval(
        lower=np.where(contradictory, NAN, lower),
        upper=np.where(contradictory, NAN, upper),
        half_width=linear.half_width(problem.bound),
        around_estimate=around,
        first_order_holds=holds,
        feasible=feasible,
        confidence=confidence if noisy else 1.0,
    )


def _magnitudes(
    lower: Vector, upper: Vector, theta: Vector, families: Sequence[Family]
) -> tuple[Vector, Vector]:
    """Return intervals with the sign of theta where it has no meaning: of a rate [-2, 3] is [0, 3].

    What they have on the other side of 0 is the same signals.
    """
    crosses = np.array(even_parameters(families), np.bool_) & (lower < 0.0) & (upper > 0.0)
    largest = np.maximum(-lower, upper)
    positive = crosses & (theta >= 0.0)
    negative = crosses & (theta < 0.0)
    low = np.where(positive, 0.0, np.where(negative, -largest, lower))
    high = np.where(negative, 0.0, np.where(positive, largest, upper))
    return low, high


def _reach_equal(interval: Matrix, theta: Vector) -> Mask:
    """Return where intervals around theta reach as far to both sides."""
    below = theta - interval[:, 0]
    above = interval[:, 1] - theta
    finite = np.isfinite(below + above)
    equal: Mask = finite.copy()
    difference = np.abs(above[finite] - below[finite])
    equal[finite] = difference <= FIRST_ORDER * (above + below)[finite]
    return equal


def _error_by_noise(functional: NDArray[np.float64], sigma: Vector, confidence: float) -> Vector:
    """Bound the effect of white noise on all theta at once, shape ``(n_theta,)``."""
    variance = np.square(functional).sum(axis=1) @ np.square(sigma)
    bound: Vector = normal_two_sided(confidence, len(functional)) * np.sqrt(variance)
    return bound
