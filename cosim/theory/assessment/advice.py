"""What would supply the information that a WEAK parameter lacks, predicted from the fit.

The model at its estimate says what the outputs of another experiment would be: a longer one, one of
less noise, one with another parameter known. Its Jacobian gives the standard error there, and its
sum of squares says whether the effect of the parameter is linear over the interval that follows:
the condition that made the verdict WEAK. What noise adds to that is taken from these data, and goes
with the standard error. Nothing depends on u, whose response is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.estimation.output_error import ParameterState, ResponseRecord
from cosim.theory.assessment.consistency import MARGIN
from cosim.theory.assessment.record_information import information_of
from cosim.theory.assessment.verdicts import LARGEST_PROFILE, Assessment, growth_of_squares
from cosim.theory.disturbed_plant import DataSet, sample_plant
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import squares_at

LONGEST: Final = 32  # times as long as the data
MOST_SAMPLES: Final = 400_000  # of a record that is predicted, unless the data are half of that
LARGEST_FACTOR: Final = 64  # by which noise is made smaller
# of the largest curvature: from there on chance decides
SURELY_ENOUGH: Final = 0.6
SATURATED: Final = 0.99  # of the standard error: what twice the length must go below


@dataclass(frozen=True)
class Outlook:
    """What is to be expected of one parameter in another experiment.

    Parameters
    ----------
    error : float
        Its standard error.
    curvature : float
        How far from linear its effect is over its interval, over what may be.
    """

    error: float
    curvature: float

    @property
    def is_enough(self) -> bool:
        """Whether other noise of the same size would not change the verdict."""
        return self.curvature <= SURELY_ENOUGH


def advised(assessment: Assessment, alphas: Sequence[Callable[[Vector], Matrix]]) -> Assessment:
    """Return an assessment whose WEAK parameters have the reason and what would help.

    Parameters
    ----------
    assessment : Assessment
    alphas : sequence of callable
        Of each data set: the known factors at instants ``(N,)`` [s], shape ``(N, components)``,
        also after the data.
    """
    if assessment.other_optimum is not None:
        return assessment  # predictions around one of two optima say nothing of both
    advisor = None
    parameters = []
    for j, parameter in enumerate(assessment.parameters):
        if (
            parameter.verdict is Verdict.WEAK
            and assessment.fit.states[j] is ParameterState.ESTIMATED
        ):
            advisor = advisor or _Advisor(assessment, alphas)
            parameter = replace(parameter, reason=f"{parameter.reason}; {advisor.advice(j)}")
        parameters.append(parameter)
    return replace(assessment, parameters=tuple(parameters))


class _Advisor:
    """Predicts experiments beside the one that was made."""

    def __init__(
        self, assessment: Assessment, alphas: Sequence[Callable[[Vector], Matrix]]
    ) -> None:
        self._assessment = assessment
        self._problem = assessment.problem
        self._fit = assessment.fit
        self._alphas = alphas
        self._same = self._records(1, offset=self._problem.offset)

    def advice(self, j: int) -> str:
        """Return what would make parameter j identifiable, and what would not."""
        outlooks: list[tuple[str, Outlook]] = []
        length, outlook = self._length(j)
        if length:
            outlooks.append((length, outlook))
        factor, outlook = self._less_noise(j)
        outlooks.append((f"a disturbance {factor} times larger over the noise", outlook))
        for k in np.flatnonzero(self._fit.estimated).tolist():
            if k != j and self._assessment.parameters[k].verdict.has_value:
                outlooks.append((f"theta[{k}] known", self._outlook(self._same, j, known=k)))
        if self._problem.offset:
            without = self._records(1, offset=False)
            outlooks.append(("no offset on y", self._outlook(without, j)))
        fails = ["another u"] if self._problem.plant.B.shape[1] else []
        error = float(self._fit.standard_error[j])
        return f"{_sentences(outlooks, fails)} (in brackets the standard error, {error:.2g} now)"

    def _length(self, j: int) -> tuple[str, Outlook]:
        """Return the shortest record that would do, or that none would."""
        samples = sum(len(one.t) for one in self._problem.data)
        longest = max(2, min(LONGEST, MOST_SAMPLES // samples))
        outlook = Outlook(float(self._fit.standard_error[j]), np.inf)
        span = max(float(one.t[-1] - one.t[0]) for one in self._problem.data)
        times = 2
        while times <= longest:
            try:
                records = self._records(times, offset=self._problem.offset)
            except AssumptionError:  # an alpha has no value there
                return "", outlook
            longer = self._outlook(records, j)
            if not np.isfinite(longer.error):  # the response is beyond all numbers there
                break
            if longer.is_enough:
                return f"{times * span:.4g} s of data", longer
            saturated = longer.error > SATURATED * outlook.error
            outlook = longer
            if saturated:
                return "data of any length", outlook
            times *= 2
        if times == 2:
            return "", outlook
        return f"{times // 2 * span:.4g} s of data", outlook

    def _less_noise(self, j: int) -> tuple[int, Outlook]:
        """Return how many times smaller the noise must be, or that even the largest does not do."""
        factor = 2
        outlook = self._outlook(self._same, j, factor=factor)
        while not outlook.is_enough and factor < LARGEST_FACTOR:
            factor *= 2
            outlook = self._outlook(self._same, j, factor=factor)
        return factor, outlook

    def _records(self, times: int, *, offset: bool) -> list[ResponseRecord]:
        """Return the outputs of records so many times as long, without noise."""
        records = []
        for index, one in enumerate(self._problem.data):
            longer = _longer(one, times, self._alphas[index])
            sampled = sample_plant(
                self._problem.plant,
                self._problem.generators,
                longer,
                noise=self._assessment.noise,
                offset=offset,
            )
            record = sampled.record(longer)
            unknowns = [self._fit.amplitudes[index], self._fit.x0[index]]
            if offset:
                unknowns.append(self._fit.offset[index])
            beta = np.concatenate(unknowns)
            output = record.rows(self._fit.theta)[:, :, : len(beta)] @ beta
            output[np.isnan(longer.y)] = np.nan
            records.append(ResponseRecord(sampled.model, output, longer.alpha, sampled.interval))
        return records

    def _outlook(
        self,
        records: Sequence[ResponseRecord],
        j: int,
        *,
        factor: int = 1,
        known: int | None = None,
    ) -> Outlook:
        """Return what is to be expected of parameter j.

        Parameters
        ----------
        records : sequence of ResponseRecord
            Without noise.
        j : int
        factor : int
            By which noise is smaller than it is.
        known : int, optional
            Which other parameter is known.
        """
        fit = self._fit
        free = fit.estimated.copy()
        if known is not None:
            free[known] = False
        deviation = fit.deviation / factor
        covariance = self._covariance(records, free, deviation)
        variance = float(covariance[j, j])
        if not 0.0 < variance < np.inf:
            return Outlook(np.inf, np.inf)
        error = float(np.sqrt(variance))
        curvature = self._curvature(records, j, covariance, deviation)
        without_noise = self._curvature(self._same, j, fit.covariance, fit.deviation)
        own_curvature = self._curvature(fit.records, j, fit.covariance, fit.deviation)
        by_noise = max(own_curvature - without_noise, 0.0) * error / float(fit.standard_error[j])
        return Outlook(error, (curvature + by_noise) / float(np.log(LARGEST_PROFILE)))

    def _curvature(
        self, records: Sequence[ResponseRecord], j: int, covariance: Matrix, deviation: float
    ) -> float:
        """Return how far from linear the effect of parameter j is over its interval.

        It is the logarithm of the growth of the sum of squares over that expected.
        """
        fit = self._fit
        variance = float(covariance[j, j])
        bias = MARGIN * float(self._assessment.consistency.bias[j])
        reach = self._assessment.fitted.quantile * float(np.sqrt(variance)) + bias
        direction = covariance[:, j] / variance
        squares = []
        for shift in (reach, -reach, 0.0):
            theta = fit.theta + shift * direction
            squares.append(squares_at(records, theta))
        *ends, base = squares
        expected = (deviation * reach) ** 2 / variance
        return abs(float(np.log(growth_of_squares(ends, base, expected))))

    def _covariance(
        self, records: Sequence[ResponseRecord], free: Mask, deviation: float
    ) -> Matrix:
        """Return the covariance of theta, zero where a parameter is not free; infinite: none."""
        P = len(self._fit.theta)
        information = np.zeros((P, P))
        for index, record in enumerate(records):
            one = information_of(record, self._fit.theta, self._fit.amplitudes[index])
            if not (np.isfinite(one.linear).all() and np.isfinite(one.slopes).all()):
                information[:] = np.inf  # a component that grows, of data that are too long
                break
            slopes = one.free
            information += slopes.T @ slopes
        covariance = np.zeros((P, P))
        place = np.ix_(free, free)
        scale = np.sqrt(np.diag(information)[free])
        if not (np.isfinite(scale).all() and (scale > 0.0).all()):
            covariance[place] = np.inf
            return covariance
        scaled = information[place] / np.outer(scale, scale)
        inverse = np.linalg.pinv(scaled, rcond=1e-14)
        covariance[place] = deviation**2 * inverse / np.outer(scale, scale)
        return covariance


def _longer(data: DataSet, times: int, alpha: Callable[[Vector], Matrix]) -> DataSet:
    """Return the samples of a record so many times as long, in its pattern; u is zero."""
    step = float(np.median(np.diff(data.t)))
    period = float(data.t[-1] - data.t[0]) + step
    shifts = period * np.arange(times)
    t = (shifts[:, np.newaxis] + data.t).ravel()
    y = np.where(np.isnan(data.y), np.nan, 0.0)
    u = np.zeros((len(t), data.u.shape[1]))
    taken = np.tile(data.is_taken, times)
    factors = data.alpha
    if times > 1:
        later = alpha(t[len(data.t) :])
        later[:, ~data.alpha.any(axis=0)] = 0.0  # terms that the fit has not
        factors = np.vstack([data.alpha, later])
    return DataSet(t, np.tile(y, (times, 1)), u, factors, data.held, taken)


def _sentences(outlooks: Sequence[tuple[str, Outlook]], others: Sequence[str]) -> str:
    """Return what would be enough, what may be by chance, and what would not with the others."""
    helps = []
    perhaps = []
    fails = []
    for what, outlook in outlooks:
        text = f"{what} [{outlook.error:.2g}]"
        if outlook.is_enough:
            helps.append(text)
        elif outlook.curvature <= 1.0:
            perhaps.append(text)
        else:
            fails.append(text)
    sentences = []
    if helps:
        sentences.append(f"{_listed(helps)} would supply it")
    if perhaps:
        sentences.append(f"{_listed(perhaps)} may by chance")
    if fails or others:
        sentences.append(f"{_listed([*fails, *others])} would not")
    return ", ".join(sentences)


def _listed(parts: Sequence[str]) -> str:
    """Return parts as an enumeration."""
    if len(parts) < 2:
        return "".join(parts)
    return f"{', '.join(parts[:-1])} or {parts[-1]}"
