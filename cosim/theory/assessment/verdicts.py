"""What may be said about an estimate: one verdict for every parameter, from the data alone.

======================  ==========================================================================
IDENTIFIABLE            no test contradicts the model; if it is right, the interval holds
WEAK                    the parameter has an effect, but its interval is no 95 % interval: the
                        effect is not linear over it, a bound cuts it, or another theta explains
                        the data too
NOT_IDENTIFIABLE        nothing in the data depends on it, or another parameter has the same effect:
                        there is no number
INCONSISTENT            the residual is not what noise leaves: the model is wrong, a bound, or the
                        step long, or the noise so colored that it cannot be told from that; no
                        interval holds
NO_ESTIMATE             the method found no value: that says nothing of the data
======================  ==========================================================================

The noise level comes from the residual, so noise never counts as information. A component is there
where its amplitude is larger than the largest that noise alone fits. The function is the same for
all estimators: output error is fitted (``assessing``), and what another estimator says is compared
with it (:func:`judge`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.documents import plain
from cosim.native.estimation.output_error import ParameterState
from cosim.theory.assessment.accuracy import LARGEST_STEP_ERROR, enough_shorter
from cosim.theory.assessment.consistency import (
    MARGIN,
    Consistency,
)
from cosim.theory.assessment.fitted_model import FittedModel
from cosim.theory.assessment.standing_outputs import StandingOutput
from cosim.theory.disturbed_plant import NoiseModel
from cosim.theory.documents import ParameterVerdict, Verdict
from cosim.theory.estimators.output_error import (
    OutputErrorFit,
    OutputErrorProblem,
    presence_threshold,
    squares_at,
)
from cosim.theory.quantiles import CONFIDENCE, normal_two_sided

# Growth of the sum of squares at the ends of an interval over that of a linear problem; the root of
# it is how far such an end is from where it should be: up to 20 %.
LEAST_PROFILE: Final = 0.7
LEAST_RATIO: Final = 1e-12  # of squares that do not grow, so that it has a logarithm
LARGEST_PROFILE: Final = 1.4
# Standard error with the terms that were left out over that without: beyond it the data do not say
# that these are absent, but only that they may be.
RESTS_ON_ABSENCE: Final = 2.0
NOT_LARGER: Final = (
    "its component is not larger than the largest that noise alone fits: a larger disturbance or "
    "less noise would show it"
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Assessment:
    """A fit by output error, and what may be said about it.

    Parameters
    ----------
    fitted : FittedModel
    consistency : Consistency
    half_width : Vector, shape (P,)
        Of the 95 % intervals; NaN where there is none.
    parameters : tuple of ParameterVerdict
    terms : tuple of ParameterVerdict
        What may be said of each term of the disturbance as a whole, without numbers; of those
        without parameters it is all that is said beside their amplitudes.
    other_optimum : Vector, shape (P,), or None
        Another theta that explains the data as well, as far as noise lets it be seen.
    """

    fitted: FittedModel
    consistency: Consistency
    half_width: Vector
    parameters: tuple[ParameterVerdict, ...]
    terms: tuple[ParameterVerdict, ...]
    other_optimum: Vector | None = None

    @property
    def problem(self) -> OutputErrorProblem:
        """What was fitted to which data; alpha is 0 of terms that the fit has not."""
        return self.fitted.problem

    @property
    def fit(self) -> OutputErrorFit:
        """The fit."""
        return self.fitted.fit

    @property
    def noise(self) -> NoiseModel:
        """The noise as it was in the fit."""
        return self.fitted.noise

    @property
    def is_settled(self) -> bool:
        """Whether the fit converged, every component there, and left what noise leaves."""
        return is_settled(self.fit, self.consistency)

    @property
    def correlation(self) -> Matrix:
        """The correlations of the estimates, shape (P, P); zero where not estimated."""
        errors = self.fit.standard_error
        scale = np.where(errors > 0.0, errors, 1.0)
        correlation: Matrix = self.fit.covariance / np.outer(scale, scale)
        return correlation

    @property
    def deviations(self) -> Vector:
        """The deviation of the noise of each output, made white, shape (n_y,)."""
        return self.fit.deviation * self.noise.deviations

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        parameters = [plain(parameter) for parameter in self.parameters]
        accuracy = np.max([one.deviations for one in self.consistency.accuracy], axis=0)
        tests = [test.to_dict() for test in self.consistency.tests]
        return {
            "parameters": parameters,
            "correlation": self.correlation.tolist(),
            "deviation": self.deviations.tolist(),
            "accuracy": accuracy.tolist(),
            "degrees_of_freedom": self.fit.freedom,
            "is_exact": self.consistency.is_exact,
            "noise_model": self.noise.a.tolist(),
            "tests": tests,
        }


def is_settled(fit: OutputErrorFit, consistency: Consistency) -> bool:
    """Return whether a fit converged, every component there, and left what noise leaves."""
    if ParameterState.ABSENT in fit.states:
        return False
    return fit.converged and consistency.passed


def is_present(fitted: FittedModel, consistency: Consistency) -> Mask:
    """Return which components are larger than noise and the errors of the step make them."""
    size = np.sqrt(fitted.fit.presence) - MARGIN * consistency.presence_bias
    present: Mask = size > _least_size(fitted.problem)
    return present


def are_hidden_by_errors(fitted: FittedModel, consistency: Consistency) -> Mask:
    """Return for which components step and quantization leave more than noise does."""
    hidden: Mask = MARGIN * consistency.presence_bias > _least_size(fitted.problem)
    return hidden


def _least_size(problem: OutputErrorProblem) -> Vector:
    """Return the root of the presence that noise alone rarely exceeds, shape (components,)."""
    sizes = [family.v for family in problem.families]
    return np.sqrt(presence_threshold(sizes, len(problem.data)))


def judge(
    assessment: Assessment, theta: Vector, standard_error: Vector | None
) -> tuple[ParameterVerdict, ...]:
    """Hold another estimate of the same data against that by output error.

    Parameters
    ----------
    assessment : Assessment
    theta : Vector, shape (P,)
        NaN: no value.
    standard_error : Vector, shape (P,), or None
        None: the method has none.
    """
    verdicts = []
    for j, own in enumerate(assessment.parameters):
        value = float(theta[j])
        error = None if standard_error is None else float(standard_error[j])
        is_fixed = assessment.fit.states[j] is ParameterState.FIXED
        half_width = 0.0 if is_fixed else float(assessment.half_width[j])
        verdicts.append(_judge_other(own, value, error, half_width))
    return tuple(verdicts)


def _judge_other(
    own: ParameterVerdict, value: float, error: float | None, half_width: float
) -> ParameterVerdict:
    if not np.isfinite(value):
        return ParameterVerdict(
            name=own.name,
            verdict=Verdict.NO_ESTIMATE,
            value=None,
            standard_error=None,
            lower=None,
            upper=None,
            reason="the method gives no value",
        )
    verdict = own.verdict
    reason = own.reason
    reach = 0.0 if error is None or not np.isfinite(error) else normal_two_sided(CONFIDENCE) * error
    if own.value is not None and verdict.has_interval:
        distance = abs(value - own.value)
        if distance > reach + half_width:
            verdict = Verdict.INCONSISTENT
            reason = (
                f"differs by {distance:.3g} from the output-error estimate {own.value:.6g} "
                f"+- {half_width:.2g}, more than both intervals allow: biased here"
            )
        elif error is None:
            reason = "within the interval of output error; the method has no interval of its own"
    has_interval = verdict.has_interval and error is not None
    return ParameterVerdict(
        name=own.name,
        verdict=verdict,
        value=value if verdict.has_value else None,
        standard_error=error if has_interval else None,
        lower=value - reach if has_interval else None,
        upper=value + reach if has_interval else None,
        reason=reason,
    )


def growth_of_squares(squares: Sequence[float], base: float, expected: float) -> float:
    """Return the growth of sums of squares over that expected; of several the one farthest off."""
    worst = 1.0
    for one in squares:
        ratio = max((one - base) / expected, LEAST_RATIO)
        if abs(np.log(ratio)) > abs(np.log(worst)):
            worst = ratio
    return worst


class VerdictMaker:
    """Makes the verdicts of a fit.

    Parameters
    ----------
    fitted : FittedModel
    consistency : Consistency
        Of its residual.
    missing : mapping of component to str
        Why a component does not show, where noise is not the cause.
    standing : sequence of StandingOutput
    left_out : sequence of int
        Components that the fit has not, as they are no larger than noise.
    with_all : Vector, shape (P,)
        Standard errors of the fit that has all components; NaN where there is none.
    """

    def __init__(
        self,
        fitted: FittedModel,
        consistency: Consistency,
        *,
        missing: Mapping[int, str],
        standing: Sequence[StandingOutput],
        left_out: Sequence[int],
        with_all: Vector,
    ) -> None:
        self._fitted = fitted
        self._fit = fitted.fit
        self._consistency = consistency
        problem = fitted.problem
        self._component = np.repeat(np.arange(len(problem.families)), problem.generators.count)
        self._present = is_present(fitted, consistency)
        self._bounds = problem.bounds
        self._missing = missing
        self._standing = standing
        self._left_out = left_out
        self._with_all = with_all

    def assessment(self) -> Assessment:
        """Return the fit with its intervals and verdicts."""
        half_width = self._half_widths()
        parameters = tuple(self._parameter(j, half_width) for j in range(len(half_width)))
        terms = tuple(self._term(i) for i in range(len(self._present)))
        return Assessment(
            fitted=self._fitted,
            consistency=self._consistency,
            half_width=half_width,
            parameters=parameters,
            terms=terms,
        )

    def _half_widths(self) -> Vector:
        fit = self._fit
        half_width = self._fitted.quantile * fit.standard_error + MARGIN * self._consistency.bias
        half_width[~fit.estimated] = np.nan
        return half_width

    def _parameter(self, j: int, half_width: Vector) -> ParameterVerdict:
        fit = self._fit
        verdict, reason = self._verdict(j, float(half_width[j]))
        known = verdict.has_value
        value = float(fit.theta[j])
        width = float(half_width[j])
        has_interval = verdict.has_interval and bool(np.isfinite(width))
        return ParameterVerdict(
            name=f"theta[{j}]",
            verdict=verdict,
            value=value if known else None,
            standard_error=float(fit.standard_error[j]) if has_interval else None,
            lower=value - width if has_interval else None,
            upper=value + width if has_interval else None,
            reason=reason,
        )

    def _term(self, i: int) -> ParameterVerdict:
        against = self._against_term(i)
        if against is None and not self._present[i]:
            against = Verdict.NOT_IDENTIFIABLE, NOT_LARGER
        verdict, reason = against or (Verdict.IDENTIFIABLE, self._not_contradicted())
        return ParameterVerdict(
            name=f"terms[{i}]",
            verdict=verdict,
            value=None,
            standard_error=None,
            lower=None,
            upper=None,
            reason=reason,
        )

    def _against_term(self, i: int) -> tuple[Verdict, str] | None:
        """Return what stands against all that is said of a term; None: nothing."""
        if i in self._missing:
            return Verdict.NOT_IDENTIFIABLE, self._missing[i]
        if not self._fit.converged:
            return Verdict.NO_ESTIMATE, self._not_converged()
        if not self._consistency.passed:
            return Verdict.INCONSISTENT, self._inconsistency()
        return None

    def _verdict(self, j: int, half_width: float) -> tuple[Verdict, str]:
        component = int(self._component[j])
        against = self._against_term(component)
        if against is not None:
            return against
        state = self._fit.states[j]
        if state is ParameterState.FIXED:
            return Verdict.IDENTIFIABLE, "fixed by its bounds"
        if state is ParameterState.ABSENT or not self._present[component]:
            return Verdict.NOT_IDENTIFIABLE, NOT_LARGER
        if state is ParameterState.DEPENDENT:
            return Verdict.NOT_IDENTIFIABLE, (
                "another parameter has the same effect on the output: other alphas would tell them "
                "apart"
            )
        if state is ParameterState.AT_BOUND:
            return Verdict.WEAK, f"{self._at_bound(j)}: widen it"
        ratio = self._profile(j, half_width)
        if not LEAST_PROFILE <= ratio <= LARGEST_PROFILE:
            return Verdict.WEAK, (
                f"its effect is not linear over its interval (the sum of squares grows "
                f"{ratio:.2g} times as much as it should); {self._weak_direction()}"
            )
        own_error = float(self._fit.standard_error[j])
        if self._with_all[j] > RESTS_ON_ABSENCE * own_error:
            times = self._with_all[j] / own_error
            return Verdict.WEAK, (
                f"it assumes the absence of {self._names_left_out()}, which these data do not "
                f"show: with it the standard error is {times:.2g} times as large; leave it out if "
                f"it is not there"
            )
        return Verdict.IDENTIFIABLE, self._not_contradicted()

    def _names_left_out(self) -> str:
        return " and ".join(f"terms[{i}]" for i in self._left_out)

    def _not_contradicted(self) -> str:
        model = f"the model without {self._names_left_out()}" if self._left_out else "the model"
        return f"no test contradicts {model}; if it is right, the 95 % interval holds"

    def _not_converged(self) -> str:
        last = ", ".join(f"{value:.4g}" for value in self._fit.theta)
        reason = f"the iteration has not converged; where it stopped, at theta = {last}, "
        if self._consistency.passed:
            return reason + (
                "noise explains the residual, so these data hardly determine theta: bounds, fewer "
                "terms or a longer record may help"
            )
        theta = self._fit.theta
        stopping = [j for j, own in self._bounds.items() if theta[j] in own]
        bounds = "".join(f"a bound of theta[{j}], " for j in stopping)
        return reason + (
            f"noise does not explain the residual: {bounds}a family, an alpha or the plant may "
            "be wrong"
        )

    def _at_bound(self, j: int) -> str:
        bound = float(self._fit.theta[j])
        side = "lower" if bound == self._bounds[j][0] else "upper"
        return f"theta[{j}] stands at its {side} bound {bound:g}; the optimum is beyond"

    def _profile(self, j: int, half_width: float) -> float:
        """Return the growth of the squares at the ends of an interval over that expected.

        The other parameters follow as they would in a linear problem. Of the two ends the one that
        is farther off counts.
        """
        fit = self._fit
        variance = float(fit.covariance[j, j])
        if not variance > 0.0 or not fit.deviation > 0.0:
            return 1.0
        if half_width <= 1e-9 * max(abs(float(fit.theta[j])), half_width, 1e-3):
            return 1.0  # what rounding leaves of the sums of squares would say nothing
        direction = fit.covariance[:, j] / variance
        expected = half_width**2 / variance
        ends = [fit.theta + side * half_width * direction for side in (1.0, -1.0)]
        squares = [squares_at(fit.records, end) for end in ends]
        return growth_of_squares(squares, fit.squares, fit.deviation**2 * expected)

    def _weak_direction(self) -> str:
        """Name the combination of parameters that is known least."""
        covariance = self._fit.covariance
        _, vectors = np.linalg.eigh(covariance)
        direction = vectors[:, -1]
        terms = []
        for j, part in enumerate(direction):
            if abs(part) > 0.1:
                terms.append(f"{part:+.2g} theta[{j}]")
        return f"the direction {' '.join(terms)} is missing"

    def _inconsistency(self) -> str:
        constant = [str(output) for output in self._standing if output.whole]
        if constant:
            return "; ".join(constant)
        reasons = [str(output) for output in self._standing]
        return "; ".join([*reasons, self._contradiction()])

    def _contradiction(self) -> str:
        """Return what of the fit is not as the model has it."""
        consistency = self._consistency
        if consistency.step_too_long:
            worst = int(consistency.step_error.argmax())
            relative = float(consistency.step_error[worst])
            return (
                "the samples are too far apart for the signals: linear interpolation between them "
                f"costs {100.0 * relative:.2g} % of the deviation of y[{worst}], at most "
                f"{100.0 * LARGEST_STEP_ERROR:g} % can be allowed for; samples at "
                f"{enough_shorter(relative):.1g} of their distances would do"
            )
        for j, state in enumerate(self._fit.states):
            if state is ParameterState.AT_BOUND:
                return (
                    f"{self._at_bound(j)}: widen it; where it stands, noise does not explain the "
                    "residual"
                )
        return consistency.contradiction
