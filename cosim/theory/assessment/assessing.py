"""Fits by output error until one explains the data: from a start, colored, searched, smaller.

A fit that leaves what white noise leaves is taken as it is. Else the color of the noise is
estimated; components that are no larger than noise are left out; and a start that may have led to
another optimum is followed by a search.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import StartError
from cosim.theory.assessment.consistency import (
    WHITENESS,
    Consistency,
    examine,
)
from cosim.theory.assessment.missing_terms import Terms, hidden_terms, silent_terms
from cosim.theory.assessment.noise_color import UNKNOWN_COLOR, Criterion, noise_color
from cosim.theory.assessment.noise_covariance import fit_with_noise, size_covariance
from cosim.theory.assessment.standing_outputs import standing_outputs
from cosim.theory.assessment.term_order import ordered_like
from cosim.theory.assessment.verdicts import (
    Assessment,
    Verdict,
    VerdictMaker,
    are_hidden_by_errors,
    is_present,
)
from cosim.theory.disturbance import Family
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, NoiseModel
from cosim.theory.estimators.output_error import (
    NO_BOUNDS,
    OutputErrorFit,
)
from cosim.theory.estimators.start_grid import search_start
from cosim.theory.quantiles import chi_square_above

# probability of a larger difference of two optima by noise alone
FALSE_CHOICE: Final = 0.01
SAME_OPTIMUM: Final = 1e-3  # difference of two sums of squares, in variances, that rounding makes
HIDDEN_BY_ERRORS: Final = (
    "its component is not larger than what straight lines between samples, or the quantization of "
    "y, may have made it: shorter steps, or finer outputs, would show it"
)
COLOR_FITS: Final = 2  # the color of the noise is known from the first, and hardly moves with theta


def assess(
    data: Sequence[DataSet],
    plant: DisturbedPlant,
    families: Sequence[Family],
    start: Vector | None = None,
    *,
    stated: Matrix | None = None,
    offset: bool = False,
    bounds: Mapping[int, tuple[float, float]] = NO_BOUNDS,
) -> Assessment:
    """Fit output error, and say what the data say about every parameter.

    The outputs are weighed by the covariance of their noise, which is that of the residual where it
    is not stated. Colored noise is recognized and whitened by an autoregressive model.

    Parameters
    ----------
    data : sequence of DataSet
    plant : DisturbedPlant
    families : sequence of Family
    start : Vector, shape (P,), optional
        By default searched.
    stated : Matrix, shape (n_y, n_y), optional
        Covariance of the noise of the outputs, where it is known.
    offset, bounds
        As for :func:`cosim.theory.estimators.output_error.fit_output_error`.

    Raises
    ------
    AssumptionError
        As from there.
    """
    return _Assessing(data, plant, families, stated, offset, bounds).assessment(start)


_Found = tuple[OutputErrorFit, NoiseModel, Consistency]


class _Assessing:
    """Fits and examines a model of the noise after another."""

    def __init__(
        self,
        data: Sequence[DataSet],
        plant: DisturbedPlant,
        families: Sequence[Family],
        stated: Matrix | None,
        offset: bool,
        bounds: Mapping[int, tuple[float, float]],
    ) -> None:
        self._data = data
        self._plant = plant
        self._families = families
        self._stated = stated
        self._offset = offset
        self._bounds = bounds

    def assessment(self, start: Vector | None) -> Assessment:
        noise = self._first_noise()
        if start is None:
            start = search_start(
                self._data,
                self._plant,
                self._families,
                offset=self._offset,
                bounds=self._bounds,
                noise=noise,
            )
        found = self._fitted(start, noise, is_known=self._stated is not None)
        fit, noise, consistency = found
        if not consistency.passed and not consistency.step_too_long:
            fit, noise, consistency = self._colored(found)
        missing = self._missing(fit, noise, consistency)
        left_out = self._absent(fit, consistency)
        if left_out:
            smaller = self._without(left_out, fit, noise)
            if smaller[2].passed:
                fit, noise, consistency = smaller
            else:
                left_out = ()
        standing = standing_outputs(self._data)
        judge = VerdictMaker(
            fit,
            consistency,
            noise,
            self._families,
            self._bounds,
            missing=missing,
            standing=standing,
            left_out=left_out,
        )
        return judge.assessment()

    def _absent(self, fit: OutputErrorFit, consistency: Consistency) -> tuple[int, ...]:
        """Return the terms with an effect that are no larger than noise, if others are there."""
        present = is_present(fit, consistency, self._families)
        if not consistency.passed or not present.any():
            return ()
        present[list(silent_terms(fit, self._data, self._families))] = True
        return tuple(np.flatnonzero(~present).tolist())

    def _without(self, left_out: Sequence[int], fit: OutputErrorFit, noise: NoiseModel) -> _Found:
        """Fit again with alpha 0 for some terms, whose amplitudes would take from others."""
        data = []
        for one in self._data:
            alpha = one.alpha.copy()
            alpha[:, left_out] = 0.0
            data.append(replace(one, alpha=alpha))
        is_known = self._stated is not None and not noise.order
        return self._fitted(fit.theta, noise, is_known=is_known, data=data)

    def searched_like(self, theta: Vector) -> Assessment:
        """Assess from a search, with interchangeable terms in the order of another theta."""
        searched = self.assessment(None)
        found = searched.fit.theta
        ordered = ordered_like(found, theta, self._data, self._plant, self._families, self._bounds)
        if not searched.fit.converged or np.array_equal(ordered, found):
            return searched
        return self.assessment(ordered)

    def _missing(
        self, fit: OutputErrorFit, noise: NoiseModel, consistency: Consistency
    ) -> dict[int, str]:
        """Return why components do not show, where noise is not the cause."""
        reasons = silent_terms(fit, self._data, self._families)
        absent = ~is_present(fit, consistency, self._families)
        absent[list(reasons)] = False
        if not absent.any() or not consistency.passed:
            return reasons
        hidden_by_errors = absent & are_hidden_by_errors(fit, consistency, self._families)
        reasons.update(dict.fromkeys(np.flatnonzero(hidden_by_errors).tolist(), HIDDEN_BY_ERRORS))
        if len(absent) < 2:
            return reasons
        terms = Terms(
            data=self._data,
            plant=self._plant,
            families=self._families,
            noise=noise,
            offset=self._offset,
            bounds=self._bounds,
        )
        for i, others in hidden_terms(fit, terms, absent=absent).items():
            names = " and ".join(f"terms[{k}]" for k in others)
            reasons[i] = (
                f"without {names} it would be there: the data are explained by either alone; "
                "leave one out"
            )
        return reasons

    def _colored(self, white: _Found) -> _Found:
        """Return the fit for colored noise where that explains the residual, else the white one."""
        remark = ""
        for criterion in Criterion:
            found, slow = self._with_color(white, criterion)
            failed = found[2].failed
            if found[2].passed:
                return found
            if set(failed) == {WHITENESS}:
                remark = UNKNOWN_COLOR
            remark = remark or slow
            if slow or WHITENESS not in failed:
                break
        fit, noise, consistency = white
        return fit, noise, replace(consistency, remark=remark)

    def _with_color(self, found: _Found, criterion: Criterion) -> tuple[_Found, str]:
        """Fit and estimate the color of the noise by turns; with a remark where it is not known."""
        for _ in range(COLOR_FITS):
            fit, noise, _ = found
            color = noise_color(fit, self._data, self._plant, self._families, criterion)
            if color.remark or not color.order:
                return found, color.remark
            # what is stated is of the noise itself, not of the white one that makes it
            colored = replace(noise, a=color.a, freedom=color.freedom)
            found = self._fitted(fit.theta, colored, is_known=False)
        return found, ""

    def _first_noise(self) -> NoiseModel:
        outputs = len(self._plant.C)
        covariance = self._stated
        if covariance is None:
            covariance = np.eye(1) if outputs == 1 else size_covariance(self._data)
        return NoiseModel(covariance=covariance, a=np.zeros((outputs, 0)))

    def _fitted(
        self,
        theta: Vector,
        noise: NoiseModel,
        *,
        is_known: bool,
        data: Sequence[DataSet] | None = None,
    ) -> _Found:
        given = (data or self._data, self._plant, self._families)
        fit, noise = fit_with_noise(
            *given,
            theta,
            noise=noise,
            is_known=is_known,
            offset=self._offset,
            bounds=self._bounds,
        )
        return fit, noise, examine(fit, *given, noise, stated=self._stated)


def assess_from(
    data: Sequence[DataSet],
    plant: DisturbedPlant,
    families: Sequence[Family],
    theta: Vector | None,
    *,
    stated: Matrix | None = None,
    offset: bool = False,
    bounds: Mapping[int, tuple[float, float]] = NO_BOUNDS,
) -> Assessment:
    """Assess from a theta that may be none of these data, where need be from a search too.

    That is where it does not fit, or where noise could hide that it is not the best optimum.

    Parameters
    ----------
    data, plant, families, stated, offset, bounds
        As for :func:`assess`.
    theta : Vector, shape (P,), or None
        None: from a search alone; NaN: no value. Interchangeable terms are in its order.

    Returns
    -------
    Assessment
        The one with the smaller residual.

    Raises
    ------
    AssumptionError
        As from there.
    """
    assessing = _Assessing(data, plant, families, stated, offset, bounds)
    if theta is None:
        return assessing.assessment(None)
    if not np.isfinite(theta).all():
        return assessing.searched_like(theta)
    try:
        near = assessing.assessment(theta)
    except StartError:
        return assessing.searched_like(theta)
    if near.is_settled and near.is_clear:
        return near
    searched = assessing.searched_like(theta)
    if not searched.fit.converged:
        return near
    if near.fit.converged and near.residual_size <= searched.residual_size:
        return _beside(near, searched)
    return _beside(searched, near)


def _beside(best: Assessment, other: Assessment) -> Assessment:
    """Return the better of two fits; its parameters are WEAK where noise may have chosen it.

    Under noise two optima far apart may both leave what noise leaves. Which of them is the deeper
    one is then chance, unless the difference of their sums of squares is more than noise makes.
    """
    if not (best.is_settled and other.is_settled):
        return best
    excess = best.fit.freedom * ((other.residual_size / best.residual_size) ** 2 - 1.0)
    threshold = chi_square_above(FALSE_CHOICE, len(best.fit.theta))
    if not SAME_OPTIMUM < excess <= threshold:
        return best
    theta = ", ".join(f"{value:.4g}" for value in other.fit.theta)
    parameters = []
    is_apart = False
    for j, parameter in enumerate(best.parameters):
        distance = abs(float(other.fit.theta[j] - best.fit.theta[j]))
        reach = float(best.half_width[j] + other.half_width[j])
        if parameter.verdict.has_interval and distance > reach:
            is_apart = True
            parameter = replace(
                parameter,
                verdict=Verdict.WEAK,
                reason=f"theta = {theta} explains the data too: the sum of squares is larger by "
                f"{excess:.2g} variances, and noise makes up to {threshold:.2g} of difference",
            )
        parameters.append(parameter)
    if not is_apart:
        return best
    return replace(best, parameters=tuple(parameters), other_optimum=other.fit.theta)
