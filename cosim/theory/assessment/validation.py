"""Whether a fitted model holds for data that were not used in the fit.

Theta is held; amplitudes, phases, x(0) and offset are those of the other experiment, so they are
estimated there. Whether theta holds is not read off the residual alone: theta of the fit has an
error too, which the other record may show. So theta is also estimated there, and the two estimates
are compared by their covariances (A. Wald, 1943); they differ only where the residual with theta
held is larger than noise makes it, too (the likelihood ratio; S. Wilks, 1938).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.documents import plain
from cosim.native.estimation.output_error import ParameterState
from cosim.theory.assessment.assessing import assess
from cosim.theory.assessment.consistency import (
    FALSE_ALARM,
    MARGIN,
    Consistency,
    ResidualTest,
    examine,
)
from cosim.theory.assessment.fitted_model import FittedModel
from cosim.theory.assessment.verdicts import Assessment
from cosim.theory.disturbed_plant import DataSet, NoiseModel, white_noise
from cosim.theory.estimators.output_error import NO_BOUNDS, OutputErrorFit
from cosim.theory.quantiles import chi_square_above


class ValidationVerdict(StrEnum):
    """Whether a model holds for other data."""

    HOLDS = "HOLDS"
    FAILS = "FAILS"
    UNTESTED = "UNTESTED"


@dataclass(frozen=True, eq=False, kw_only=True)
class Validation:
    """What data that were not used say of a fit.

    Parameters
    ----------
    verdict : ValidationVerdict
    reason : str
    fit : OutputErrorFit
        With theta held.
    consistency : Consistency
        Of its residual: it shows the error of theta too.
    deviation, ratio : float
        Of its residual, and over that of the fit; root mean squares, of several outputs in units of
        the noise of the fit.
    own : Assessment
        With a theta of these data.
    difference : ResidualTest
        Of the two theta.
    """

    verdict: ValidationVerdict
    reason: str
    fit: OutputErrorFit
    consistency: Consistency
    deviation: float
    ratio: float
    own: Assessment
    difference: ResidualTest

    @property
    def tests(self) -> tuple[ResidualTest, ...]:
        """All tests: of the two theta, and of the residual with theta held."""
        return (self.difference, *self.consistency.tests)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        tests = [test.to_dict() for test in self.tests]
        return {
            "verdict": str(self.verdict),
            "reason": self.reason,
            "deviation": self.deviation,
            "ratio": self.ratio,
            "tests": tests,
            "own": [plain(parameter) for parameter in self.own.parameters],
        }


def validate(assessment: Assessment, data: DataSet) -> Validation:
    """Check whether a fit holds for data that were not used in it.

    Parameters
    ----------
    assessment : Assessment
        Of the fit.
    data : DataSet
        Others than were used in it.

    Raises
    ------
    AssumptionError
        If there are fewer samples than unknowns.
    """
    theta = assessment.fit.theta
    problem = replace(assessment.problem, data=[data], bounds=NO_BOUNDS)
    own = assess(problem, theta)
    bounds = {j: (float(value), float(value)) for j, value in enumerate(theta)}
    at_theta = replace(problem, bounds=bounds)
    held = FittedModel(at_theta, at_theta.fit(theta, own.noise), own.noise)
    noise = white_noise(problem.outputs)
    if problem.outputs > 1:
        noise = replace(noise, covariance=assessment.noise.covariance)
    deviation = _root_mean_square(held, noise)
    tested = _comparable(assessment, own)
    difference = _difference(assessment, own, held.fit, tested)
    verdict, reason = _verdict(assessment, own, tested, difference)
    return Validation(
        verdict=verdict,
        reason=reason,
        fit=held.fit,
        consistency=examine(held),
        deviation=deviation,
        ratio=deviation / _root_mean_square(assessment.fitted, noise),
        own=own,
        difference=difference,
    )


def _root_mean_square(fitted: FittedModel, noise: NoiseModel) -> float:
    """Return the root mean square of the white residual, corrected for what was fitted to it."""
    squares = 0.0
    count = 0
    for data, response in zip(fitted.problem.data, fitted.responses, strict=True):
        white = noise.whitened(response.residual[:, :, np.newaxis], data.numbers)
        squares += float(np.sum(white**2))
        count += int(data.measured.sum())
    freedom = max(min(float(count), fitted.fit.freedom), 1.0)
    return float(np.sqrt(squares / freedom))


def _comparable(assessment: Assessment, own: Assessment) -> Mask:
    """Return which theta both the fit and the other data determine, shape (P,)."""
    comparable = []
    for j, state in enumerate(assessment.fit.states):
        of_fit = assessment.parameters[j].verdict.has_value
        of_data = own.parameters[j].verdict.has_value
        is_known = bool(assessment.fit.estimated[j]) or state is ParameterState.FIXED
        comparable.append(of_fit and of_data and is_known and bool(own.fit.estimated[j]))
    return np.array(comparable, np.bool_)


def _difference(
    assessment: Assessment, own: Assessment, held: OutputErrorFit, tested: Mask
) -> ResidualTest:
    """Test whether the theta of the fit and that of the other data are one."""
    degrees = int(tested.sum())
    name = "theta is another one"
    if not degrees:
        return ResidualTest(name, 0.0, 0.0, 0, "")
    threshold = chi_square_above(FALSE_ALARM, degrees)
    apart = own.fit.theta - assessment.fit.theta
    allowed = MARGIN * (assessment.consistency.bias + own.consistency.bias)
    excess: Vector = np.maximum(np.abs(apart) - allowed, 0.0) * np.sign(apart)
    covariance = assessment.fit.covariance + own.fit.covariance
    of_theta = _squared_length(excess[tested], covariance[np.ix_(tested, tested)])
    squares = held.squares - own.fit.squares
    of_residual = squares / own.fit.deviation**2 if own.fit.deviation > 0.0 else 0.0
    errors = np.sqrt(np.diag(covariance))
    relative = np.abs(excess) / np.where(errors > 0.0, errors, np.finfo(np.float64).tiny)
    place = int(np.argmax(np.where(tested, relative, -1.0)))
    statistic = min(of_theta, max(of_residual, 0.0))
    return ResidualTest(name, statistic, threshold, degrees, f"theta[{place}]")


def _digits(value: float, difference: float) -> int:
    """Return how many digits of a value show a difference, of which two are."""
    if not difference or not value:
        return 6
    return min(max(6, math.ceil(math.log10(abs(value / difference))) + 2), 17)


def _squared_length(vector: Vector, covariance: Matrix) -> float:
    """Return ``v' C^-1 v``."""
    scale = np.sqrt(np.diag(covariance))
    scale[scale == 0.0] = 1.0
    unit = vector / scale
    solved = np.linalg.lstsq(covariance / np.outer(scale, scale), unit, rcond=1e-12)[0]
    return float(unit @ solved)


def _verdict(
    assessment: Assessment, own: Assessment, tested: Mask, difference: ResidualTest
) -> tuple[ValidationVerdict, str]:
    if not own.fit.converged or not own.consistency.passed:
        return ValidationVerdict.FAILS, (
            f"with no theta does the model describe these data: {own.parameters[0].reason}"
        )
    if not difference.passed:
        changes = []
        for j in np.flatnonzero(tested):
            digits = _digits(own.fit.theta[j], own.fit.theta[j] - assessment.fit.theta[j])
            there = f"{own.fit.theta[j]:.{digits}g} +- {own.half_width[j]:.2g}"
            here = f"{assessment.fit.theta[j]:.{digits}g}"
            if np.isfinite(assessment.half_width[j]):
                here += f" +- {assessment.half_width[j]:.2g}"
            changes.append(f"theta[{j}] is {there} there, {here} in the fit")
        return ValidationVerdict.FAILS, "; ".join(changes)
    if not tested.any():
        return ValidationVerdict.UNTESTED, (
            "there is no theta that the fit and these data both determine"
        )
    if tested.all():
        return ValidationVerdict.HOLDS, "theta is that of the fit, and the residual that of noise"
    left = ", ".join(f"theta[{j}]" for j in np.flatnonzero(~tested))
    return ValidationVerdict.HOLDS, (
        f"as far as it was tested: the fit and these data do not both determine {left}"
    )
