"""The noise of several outputs from what a fit leaves, and the fit that is weighed by it.

Where the covariance of the noise is unknown, maximum likelihood minimizes the determinant of the
products of the residuals (L. Ljung, System Identification, 2nd ed., 1999, section 15.2). It is
found in turn: the fit for a covariance, the covariance of its residual (W. Oberhofer and J. Kmenta,
Econometrica, 1974). The first weights are the sizes of the outputs, so that their units do not
count.

No output is taken for more exact than errors that are no noise leave it
(:mod:`cosim.theory.assessment.accuracy`): weights beyond that would only amplify them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.theory.assessment.fitted_model import FittedModel
from cosim.theory.disturbed_plant import (
    DataSet,
    NoiseModel,
    autoregressive_filter,
    counted_values,
)
from cosim.theory.estimators.output_error import OutputErrorFit, OutputErrorProblem

MOST_FITS: Final = 12
# of a covariance in units of the one that weighed the fit: its effect on theta is of second order
SMALL_CHANGE: Final = 1e-2
# degrees of freedom for each entry of a covariance, below which its correlations are left out
FEWEST_AN_ENTRY: Final = 20.0
LARGEST_CORRELATION: Final = 1.0 - 2.0**-20


def fit_with_noise(
    problem: OutputErrorProblem, theta: Vector, noise: NoiseModel, *, is_known: bool = False
) -> FittedModel:
    """Fit output error, and estimate the covariance of the noise of several outputs with it.

    Parameters
    ----------
    problem : OutputErrorProblem
    theta : Vector, shape (P,)
        Start.
    noise : NoiseModel
        The covariance to begin with. Its autoregressive models stay.
    is_known : bool
        The covariance stays too.

    Returns
    -------
    FittedModel
        The deviation of the fit is 1, in units of the estimated noise, or more; of a single output,
        which needs no weight, that of the residual.

    Raises
    ------
    AssumptionError, StartError
        As from :func:`cosim.theory.estimators.output_error.fit_output_error`.
    """
    if is_known or problem.outputs == 1:
        return FittedModel(problem, problem.fit(theta, noise), noise)
    for _ in range(MOST_FITS):
        used = noise
        fitted = FittedModel(problem, problem.fit(theta, used), used)
        fit = fitted.fit
        theta = fit.theta
        covariance = residual_covariance(fitted)
        noise = replace(used, covariance=covariance)
        relative = used.whitening @ covariance @ used.whitening.T
        if fit.converged and np.abs(relative - np.eye(len(relative))).max() <= SMALL_CHANGE:
            break
    return FittedModel(problem, _of_known_noise(fit), used)


def residual_size(fitted: FittedModel) -> float:
    """Return what maximum likelihood makes smallest: of several outputs a geometric mean."""
    outputs = fitted.problem.outputs
    is_weighed_alike = fitted.problem.stated is not None and not fitted.noise.order
    if outputs == 1 or is_weighed_alike:
        return fitted.fit.deviation
    _, logarithm = np.linalg.slogdet(residual_covariance(fitted))
    return float(np.exp(0.5 * logarithm / outputs))


def first_noise(problem: OutputErrorProblem) -> NoiseModel:
    """Return white noise to begin with: as it is stated, or as large as the outputs are."""
    covariance = problem.stated
    if covariance is None:
        covariance = np.eye(1) if problem.outputs == 1 else size_covariance(problem.data)
    return NoiseModel(covariance=covariance, a=np.zeros((problem.outputs, 0)))


def residual_covariance(fitted: FittedModel) -> Matrix:
    """Return the covariance of the residual of a fit, made white in time, shape (n_y, n_y)."""
    a = fitted.noise.a
    outputs = len(a)
    products = np.zeros((outputs, outputs))
    pairs = np.zeros((outputs, outputs))
    for data, response in zip(fitted.problem.data, fitted.responses, strict=True):
        rows = response.residual[:, :, np.newaxis]
        white = autoregressive_filter(rows, a, data.numbers)[:, :, 0]
        products += white.T @ white
        there = counted_values(data.numbers, a.shape[1]).astype(np.float64)
        pairs += there.T @ there
    freedom = max(fitted.fit.freedom / outputs, 1.0)
    # as if every output had been measured as often as they are in the mean
    evened = products * (np.diag(pairs).mean() / np.maximum(pairs, 1.0))
    covariance = evened / freedom
    if freedom < FEWEST_AN_ENTRY * outputs**2 or not _is_covariance(covariance):
        covariance = np.diag(np.diag(covariance))
    least = np.max([accuracy.deviations for accuracy in fitted.accuracies], axis=0)
    return _not_below(covariance, least)


def size_covariance(data: Sequence[DataSet]) -> Matrix:
    """Return weights to begin with, as large as the outputs are about their means."""
    variances = np.mean([np.nanvar(one.y, axis=0) for one in data], axis=0)
    return np.diag(np.where(variances > 0.0, variances, 1.0))


def _is_covariance(C: Matrix) -> bool:
    """Return whether there is noise of it; not so where outputs are measured at different times."""
    deviations = np.sqrt(np.maximum(np.diag(C), np.finfo(np.float64).tiny))
    correlation = LARGEST_CORRELATION * C / np.outer(deviations, deviations)
    np.fill_diagonal(correlation, 1.0)
    return bool(np.linalg.eigvalsh(correlation)[0] > 0.0)


def _not_below(covariance: Matrix, least: Vector) -> Matrix:
    """Return a covariance with deviations of at least ``least``, and a Cholesky factor."""
    variances = np.maximum(np.diag(covariance), least**2)
    result = LARGEST_CORRELATION * covariance
    np.fill_diagonal(result, np.where(variances > 0.0, variances, 1.0))
    return result


def _of_known_noise(fit: OutputErrorFit) -> OutputErrorFit:
    """Return the fit with errors for noise of deviation 1, where its residual is smaller.

    It is where an output is more exact than it is taken for: that says nothing of the others.
    """
    if not 0.0 < fit.deviation < 1.0:
        return fit
    variance = fit.deviation**2
    return replace(
        fit,
        covariance=fit.covariance / variance,
        presence=fit.presence * variance,
        deviation=1.0,
    )
