"""What an irregular part of the disturbance within a bound leaves open of theta."""

from __future__ import annotations

from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import AssumptionError
from cosim.scenario.record import IrregularEffect, IrregularPart
from cosim.theory.assessment.verdicts import Assessment
from cosim.theory.bounded.feasible_program import Watch
from cosim.theory.bounded.irregular_part import GuaranteedInterval, Programs, guaranteed_interval
from cosim.theory.disturbed_plant import NoiseModel

FREQUENCIES: Final = 1025  # of a spectrum, from 0 to half the sampling frequency


def irregular_part(bound: float, interval: GuaranteedInterval) -> IrregularPart:
    """Return what an interval that is guaranteed for a bound says of every theta."""
    effects = []
    for j, half_width in enumerate(interval.half_width.tolist()):
        lower = float(interval.lower[j])
        upper = float(interval.upper[j])
        effects.append(
            IrregularEffect(
                name=f"theta[{j}]",
                first_order=half_width,
                holds=bool(interval.first_order_holds[j]),
                is_explained=not (np.isnan(lower) or np.isnan(upper)),
                lower=lower if np.isfinite(lower) else None,
                upper=upper if np.isfinite(upper) else None,
            )
        )
    return IrregularPart(
        bound=bound,
        effects=tuple(effects),
        confidence=interval.confidence,
        unsolved=0 if interval.feasible is None else interval.feasible.unsolved,
    )


def interval_of(
    assessment: Assessment, bound: float, programs: Programs, watch: Watch | None = None
) -> GuaranteedInterval:
    """Return which theta data allow if an irregular part of delta is within a bound.

    Where the noise of y is not stated it is as large as the residual, which holds the irregular
    part too; errors of step and quantization are allowed for.

    Parameters
    ----------
    assessment : Assessment
        Of one data set.
    bound : float
        Of the irregular part, ``|delta_0| <= bound``.
    programs : Programs
        When linear programs are solved.
    watch : callable, optional
        Is told after every linear program how many have been solved.

    Raises
    ------
    AssumptionError
        If not every theta was estimated, samples are missing or at unequal distances, or the plant
        is unstable.
    """
    problem = assessment.problem
    estimated = assessment.fit.estimated
    if not estimated.all():
        missing = ", ".join(f"theta[{j}]" for j in np.flatnonzero(~estimated))
        raise AssumptionError(
            f"{missing} was not estimated; bounding theta for an irregular part of the "
            "disturbance takes an estimate of every theta"
        )
    accuracy = assessment.consistency.accuracy[0]
    sampling_error = float(np.abs(accuracy.step).max()) + 0.5 * float(accuracy.spacing.max())
    outputs = accuracy.step.shape[1]
    sigma = _largest_deviations(assessment)
    if problem.stated is not None:
        sigma = np.sqrt(np.diag(problem.stated))
    return guaranteed_interval(
        problem.data[0],
        problem.plant,
        problem.families,
        assessment.fit,
        bound=bound,
        sigma=sigma,
        sampling_error=sampling_error,
        noise=NoiseModel(covariance=assessment.noise.covariance, a=np.zeros((outputs, 0))),
        programs=programs,
        watch=watch,
    )


def _largest_deviations(assessment: Assessment) -> Vector:
    """Return deviations of white noise whose means are as large as those of each residual.

    Of colored noise that is the one at the frequency where its spectrum is largest.
    """
    noise = assessment.noise
    if assessment.consistency.is_exact:
        return np.zeros(len(noise.a))
    frequencies = np.linspace(0.0, np.pi, FREQUENCIES)
    lags = np.arange(1, noise.order + 1)
    waves = np.exp(-1j * np.outer(frequencies, lags))
    gains = 1.0 / np.abs(1.0 - waves @ noise.a.T)
    return np.asarray(assessment.deviations * gains.max(axis=0), np.float64)
