"""Fits by output error until one explains the data: from a start, searched, colored, smaller.

A fit for white noise that leaves what noise leaves, of components far above it, is taken as it is.
Else another one follows from a search, and the better of the two counts; of it the color of the
noise is estimated, and components that are no larger than noise are left out. Where a search leaves
more than noise does, starts are spread over the box. Of several terms other optima are looked for
in a few samples; where noise alone may have decided which of two is the better one, both are told.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import AssumptionError, StartError
from cosim.theory.assessment.consistency import WHITENESS, Consistency, examine
from cosim.theory.assessment.fitted_model import FittedModel
from cosim.theory.assessment.missing_terms import hidden_terms, silent_terms
from cosim.theory.assessment.noise_covariance import first_noise, fit_with_noise, residual_size
from cosim.theory.assessment.standing_outputs import standing_outputs
from cosim.theory.assessment.term_order import ordered_like
from cosim.theory.assessment.verdicts import (
    Assessment,
    VerdictMaker,
    are_hidden_by_errors,
    is_present,
    is_settled,
)
from cosim.theory.documents import Verdict
from cosim.theory.estimators.other_optima import search_optima, spread_optima
from cosim.theory.estimators.output_error import (
    OutputErrorFit,
    OutputErrorProblem,
    excess_squares,
    largest_chance,
)
from cosim.theory.estimators.start_grid import search_start

if TYPE_CHECKING:
    from cosim.theory.assessment.noise_color import Criterion

# Of a component that is 100 of its deviations from absent: a wrong optimum would not pass.
CLEAR_PRESENCE: Final = 1e4
SAME_OPTIMUM: Final = 1e-3  # difference of two sums of squares, in variances, that rounding makes
# times the difference that noise alone makes, white or colored: beyond it an optimum is no rival
NO_RIVAL: Final = 1e3
HIDDEN_BY_ERRORS: Final = (
    "its component is not larger than the errors of linear interpolation between samples, or of "
    "the quantization of y: shorter steps, or finer outputs, would show it"
)
APART: Final = 5.0  # standard errors between two optima that are not the same
SAME_THETA: Final = 1e-4  # relative difference of theta by the samples that are left out
COLOR_FITS: Final = 2  # the color of the noise is known from the first, and hardly moves with theta


@dataclass(frozen=True, eq=False)
class _Examined:
    """A fit, and what its residual says."""

    fitted: FittedModel
    consistency: Consistency

    @property
    def is_settled(self) -> bool:
        """Whether the fit converged, every component there, and left what noise leaves."""
        return is_settled(self.fitted.fit, self.consistency)

    @property
    def is_clear(self) -> bool:
        """Whether every component is so far above the noise that a wrong optimum would show."""
        return bool((self.fitted.fit.presence > CLEAR_PRESENCE).all())


def assess(problem: OutputErrorProblem, start: Vector | None = None) -> Assessment:
    """Fit output error, and say what the data say about every parameter.

    The outputs are weighed by the covariance of their noise, which is that of the residual where it
    is not stated. Colored noise is recognized and whitened by an autoregressive model.

    Parameters
    ----------
    problem : OutputErrorProblem
    start : Vector, shape (P,), optional
        It may be of other data: a search follows where the fit from it does not explain these, or
        where noise could hide that there is a better one. NaN: no value. The search puts
        interchangeable terms in its order. By default there is the search alone.

    Raises
    ------
    AssumptionError
        If sizes do not fit, a bound excludes every value, or there are fewer samples than unknowns.
    """
    if start is None:
        return _beside_rival(_searched(problem))
    near = _near(problem, start)
    if near is not None and near.is_settled and near.is_clear:
        return _beside_rival(near)
    searched = _searched_like(problem, start)
    if near is None:
        return _beside_rival(searched)
    best, other = _by_residual(near, searched)
    if _is_rival(_excess(best.fitted, other.fitted), problem):
        return _beside(_assessed(best), _assessed(other))
    return _beside_rival(best)


def _beside_rival(examined: _Examined) -> Assessment:
    """Assess a fit beside another optimum that explains the data as well, where there is one.

    It is looked for where several terms may exchange their parts, or the functions of one.
    """
    assessment = _assessed(examined)
    if not examined.fitted.problem.may_have_rivals or not assessment.is_settled:
        return assessment
    other = _rival(examined.fitted)
    return assessment if other is None else _beside(assessment, _assessed(other))


def _rival(own: FittedModel) -> _Examined | None:
    """Return the fit from another optimum of a few samples that is a rival; None: there is none.

    What is far worse in a few samples is so in all of them, so that few are fitted to all.
    """
    thinned = own.problem.thinned
    white = own.noise.without_color()
    try:
        optima = search_optima(thinned, own.fit.theta, white)
        near = thinned.fit(own.fit.theta, white)
        for optimum in optima:
            if not _may_be_rival(near, optimum):
                break
            theta = own.problem.in_order(optimum.theta)
            if not _is_apart(own, theta, optimum.standard_error):
                continue
            rival = _settled_rival(own, theta)
            if rival is not None:
                return rival
    except AssumptionError:  # too few samples, or a response that is not finite there
        return None
    return None


def _settled_rival(own: FittedModel, theta: Vector) -> _Examined | None:
    """Fit from a theta; None where that is no rival."""
    problem = own.problem
    is_known = problem.stated is not None
    fitted = fit_with_noise(problem, theta, first_noise(problem), is_known=is_known)
    if not _is_apart(own, problem.in_order(fitted.fit.theta), fitted.fit.standard_error):
        return None
    best, other = sorted((own, fitted), key=residual_size)
    excess = _excess(best, other)
    if excess <= SAME_OPTIMUM or (best is own and not _is_rival(excess, problem)):
        return None
    rival = _Examined(fitted, examine(fitted))
    return rival if rival.is_settled else None


def _may_be_rival(own: OutputErrorFit, other: OutputErrorFit) -> bool:
    """Return whether another optimum is no more than far worse."""
    excess = excess_squares(own.deviation, other.deviation, own.freedom)
    return excess <= NO_RIVAL * largest_chance(len(own.theta))


def _is_rival(excess: float, problem: OutputErrorProblem) -> bool:
    return SAME_OPTIMUM < excess <= NO_RIVAL * largest_chance(problem.generators.parameters)


def _is_apart(own: FittedModel, theta: Vector, standard_error: Vector) -> bool:
    """Return whether a theta is another one than that of a fit."""
    ordered = own.problem.in_order(own.fit.theta)
    reach = APART * np.hypot(standard_error, own.fit.standard_error)
    sizes = np.maximum(np.abs(theta), np.abs(ordered))
    distances = np.abs(theta - ordered)
    return bool((distances > reach + SAME_THETA * sizes).any())


def assess_near(problem: OutputErrorProblem, start: Vector) -> Assessment:
    """Assess the optimum that a start leads to, whether or not there is a better one.

    Parameters
    ----------
    problem : OutputErrorProblem
    start : Vector, shape (P,)

    Raises
    ------
    AssumptionError
        As from :func:`assess`.
    StartError
        If the response at the start is not finite.
    """
    return _assessed(_white(problem, start))


def _near(problem: OutputErrorProblem, theta: Vector) -> _Examined | None:
    """Fit from a theta; None where nothing can be fitted from it."""
    if not np.isfinite(theta).all():
        return None
    try:
        return _white(problem, theta)
    except StartError:
        return None


def _searched_like(problem: OutputErrorProblem, theta: Vector) -> _Examined:
    """Fit from a search, with interchangeable terms in the order of another theta."""
    searched = _searched(problem)
    fit = searched.fitted.fit
    ordered = ordered_like(fit.theta, theta, problem)
    if not fit.converged or np.array_equal(ordered, fit.theta):
        return searched
    return _white(problem, ordered)


def _by_residual(near: _Examined, searched: _Examined) -> tuple[_Examined, _Examined]:
    """Return the better of two fits first.

    Of two the one that has converged, unless the other explains more than chance does.
    """
    best, other = sorted((near, searched), key=_residual_size)
    is_chance = _excess(best.fitted, other.fitted) <= largest_chance(len(best.fitted.fit.theta))
    if is_chance and other.fitted.fit.converged and not best.fitted.fit.converged:
        return other, best
    return best, other


def _searched(problem: OutputErrorProblem) -> _Examined:
    """Fit from a search, or from starts spread over the box where these explain more.

    They are tried where the search leaves more than noise does. Terms may hide one another so well
    that it leads to two close together, with amplitudes that cancel, from which no fit comes back.
    """
    noise = first_noise(problem)
    white = _white(problem, problem.in_order(search_start(problem, noise)))
    is_explained = white.fitted.fit.converged and not white.consistency.is_structured
    if is_explained or not problem.has_several:
        return white
    thinned = problem.thinned
    optima = spread_optima(thinned, noise)
    if not optima:
        return white
    near = thinned.fit(white.fitted.fit.theta, noise)
    excess = excess_squares(optima[0].deviation, near.deviation, near.freedom)
    if excess <= largest_chance(len(near.theta)):
        return white
    wider = _white(problem, problem.in_order(optima[0].theta))
    return min(white, wider, key=_residual_size)


def _white(problem: OutputErrorProblem, start: Vector) -> _Examined:
    """Fit for white noise, from a start."""
    is_known = problem.stated is not None
    return _examined(fit_with_noise(problem, start, first_noise(problem), is_known=is_known))


def _examined(fitted: FittedModel) -> _Examined:
    return _Examined(fitted, examine(fitted))


def _assessed(white: _Examined) -> Assessment:
    """Return what may be said from a fit, after the color of its noise and terms to leave out."""
    examined = white
    may_be_color = white.consistency.is_structured and not white.consistency.step_too_long
    if may_be_color and white.fitted.fit.converged:  # else there is no estimate, of any noise
        examined = _colored(white)
    missing = _missing(examined)
    left_out = _absent(examined)
    with_all = examined.fitted.fit.standard_error
    if left_out:
        smaller = _without(left_out, examined)
        if smaller.fitted.fit.converged and smaller.consistency.passed:
            examined = smaller
        else:
            left_out = ()
    maker = VerdictMaker(
        examined.fitted,
        examined.consistency,
        missing=missing,
        standing=standing_outputs(white.fitted.problem.data),
        left_out=left_out,
        with_all=with_all,
    )
    return maker.assessment()


def _absent(examined: _Examined) -> tuple[int, ...]:
    """Return the terms with an effect that are no larger than noise, if others are there."""
    present = is_present(examined.fitted, examined.consistency)
    if not examined.consistency.passed or not present.any():
        return ()
    present[list(silent_terms(examined.fitted))] = True
    return tuple(np.flatnonzero(~present).tolist())


def _without(left_out: tuple[int, ...], examined: _Examined) -> _Examined:
    """Fit again without the effect of some terms, whose amplitudes would take from others."""
    fitted = examined.fitted
    problem = fitted.problem.without_effect_of(left_out)
    is_known = problem.stated is not None and not fitted.noise.order
    again = fit_with_noise(problem, fitted.fit.theta, fitted.noise, is_known=is_known)
    return _examined(again)


def _missing(examined: _Examined) -> dict[int, str]:
    """Return why components do not show, where noise is not the cause."""
    fitted = examined.fitted
    consistency = examined.consistency
    reasons = silent_terms(fitted)
    absent = ~is_present(fitted, consistency)
    absent[list(reasons)] = False
    if not absent.any() or not consistency.passed:
        return reasons
    hidden_by_errors = absent & are_hidden_by_errors(fitted, consistency)
    reasons.update(dict.fromkeys(np.flatnonzero(hidden_by_errors).tolist(), HIDDEN_BY_ERRORS))
    if len(absent) < 2:
        return reasons
    for i, others in hidden_terms(fitted, absent).items():
        names = " and ".join(f"terms[{k}]" for k in others)
        reasons[i] = (
            f"without {names} it would be there: the data are explained by either alone; "
            "leave one out"
        )
    return reasons


def _colored(white: _Examined) -> _Examined:
    """Return the fit for colored noise where that explains the residual, else the white one."""
    from cosim.theory.assessment.noise_color import UNKNOWN_COLOR, Criterion  # rarely needed

    remark = ""
    for criterion in Criterion:
        colored, unknown = _with_color(white, criterion)
        if colored.consistency.passed:
            return colored
        failed = colored.consistency.failed
        if set(failed) == {WHITENESS}:
            remark = UNKNOWN_COLOR
        remark = remark or unknown
        if unknown or WHITENESS not in failed:
            break
    return replace(white, consistency=replace(white.consistency, remark=remark))


def _with_color(examined: _Examined, criterion: Criterion) -> tuple[_Examined, str]:
    """Fit and estimate the color of the noise by turns; with a remark where it is not known."""
    from cosim.theory.assessment.noise_color import noise_color  # rarely needed

    for _ in range(COLOR_FITS):
        fitted = examined.fitted
        color = noise_color(fitted, criterion)
        if color.remark or not color.order:
            return examined, color.remark
        # what is stated is of the noise itself, not of the white one that makes it
        noise = replace(fitted.noise, a=color.a, freedom=color.freedom)
        examined = _examined(fit_with_noise(fitted.problem, fitted.fit.theta, noise))
    return examined, ""


def _residual_size(examined: _Examined) -> float:
    return residual_size(examined.fitted)


def _excess(best: FittedModel, other: FittedModel) -> float:
    """Return by how many variances the sum of squares of another fit is larger."""
    return excess_squares(residual_size(best), residual_size(other), best.fit.freedom)


def _beside(best: Assessment, other: Assessment) -> Assessment:
    """Return the better of two; its parameters are WEAK where noise may have chosen it.

    Which is better may be another one with the color of the noise than without it.

    Under noise two optima far apart may both leave what noise leaves. Which of them is the deeper
    one is then chance, unless the difference of their sums of squares is more than noise makes. Of
    two that are not one estimate every interval is to contain the other value, or is no interval.
    """
    if not best.is_settled:
        return other if other.is_settled else best
    if not other.is_settled:
        return best
    if residual_size(other.fitted) < residual_size(best.fitted):
        return _beside(other, best)
    excess = _excess(best.fitted, other.fitted)
    threshold = largest_chance(len(best.parameters))
    if not SAME_OPTIMUM < excess <= threshold:
        return best
    distances = np.abs(other.fit.theta - best.fit.theta)
    reach = np.nansum([best.half_width, other.half_width], axis=0)
    has_interval = np.array([one.verdict.has_interval for one in best.parameters])
    if not (has_interval & (distances > reach)).any():
        return best
    theta = ", ".join(f"{value:.4g}" for value in other.fit.theta)
    reason = (
        f"theta = {theta} explains the data too: the sum of squares is larger by {excess:.2g} "
        f"variances, and noise makes up to {threshold:.2g} of difference"
    )
    is_outside = has_interval & (distances > np.nan_to_num(best.half_width))
    parameters = tuple(
        replace(own, verdict=Verdict.WEAK, reason=reason) if outside else own
        for own, outside in zip(best.parameters, is_outside, strict=True)
    )
    return replace(best, parameters=parameters, other_optimum=other.fit.theta)
