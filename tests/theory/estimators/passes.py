"""The methods of identification over whole records: passes of the kernels that components step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.estimation.adaptive import AdaptiveLaw, AdaptiveStep
from cosim.native.estimation.kalman import (
    AugmentedKalmanConstants,
    AugmentedKalmanStep,
    ExtendedKalmanConstants,
    ExtendedKalmanStep,
)
from cosim.native.estimation.output_error import NO_INFORMATION
from cosim.native.estimation.rayleigh import RayleighConstants, RayleighModel
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.householder import triangle
from cosim.theory.disturbances.families import Family, SearchBox, generators, search_box
from cosim.theory.disturbances.regression import Term
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, discretize, white_noise
from cosim.theory.estimators.adaptive import adaptive_constants
from cosim.theory.estimators.augmented_kalman import augmented_model, first_spread
from cosim.theory.estimators.defaults import (
    AUGMENTED_DEVIATION,
    AUGMENTED_INTENSITY,
    DREM_FORGETTING,
    DREM_GAIN,
    EXTENDED_DEVIATION,
    GRADIENT_GAIN,
    KALMAN_SIZE,
)
from cosim.theory.estimators.extended_kalman import first_theta
from cosim.theory.estimators.least_squares import Recovery
from cosim.theory.estimators.output_error import (
    OutputErrorFit,
    fit_output_error,
    presence_threshold,
)
from cosim.theory.estimators.projection import reconstruction_model
from cosim.theory.sampling import equal_step


@dataclass(frozen=True, eq=False)
class AdaptiveEstimate:
    """The path of an adaptive law: its estimates after every row but the first.

    Parameters
    ----------
    theta : Matrix, shape (N - 1, P)
        NaN: no value.
    eta : Matrix, shape (N - 1, q)
    """

    theta: Matrix
    eta: Matrix


def adapt(
    law: AdaptiveLaw,
    recovery: Recovery,
    t: Vector,
    mu: Matrix,
    *,
    gain: float,
    forgetting: float = np.inf,
) -> AdaptiveEstimate:
    """Pass over rows of the regression (25), straight lines between them.

    Parameters
    ----------
    law : AdaptiveLaw
    recovery : Recovery
        How theta follows from eta.
    t : Vector, shape (N,)
        Equally spaced instants [s].
    mu : Matrix, shape (N, q + 1)
    gain, forgetting
        As of :func:`adaptive_constants`.
    """
    constants = adaptive_constants(
        recovery, start_time=float(t[0]), gain=gain, forgetting=forgetting, held=False
    )
    kernel = AdaptiveStep(law, constants)
    kernel.initialize()
    step = equal_step(t)
    y = kernel.step.advance(np.ascontiguousarray(t), step, mu)
    n_theta = recovery.n_theta
    return AdaptiveEstimate(y[:, :n_theta], y[:, n_theta:])


def gradient(
    t: Vector, mu: Matrix, recovery: Recovery, *, gain: float = GRADIENT_GAIN
) -> AdaptiveEstimate:
    """Follow the gradient over rows of the regression, straight lines between them.

    Parameters
    ----------
    t : Vector, shape (N,)
        Equally spaced instants [s].
    mu : Matrix, shape (N, q + 1)
        Rows of (25).
    recovery : Recovery
        How theta follows from eta.
    gain : float
        [1/s]
    """
    return adapt("gradient", recovery, t, mu, gain=gain)


def drem(
    t: Vector,
    mu: Matrix,
    recovery: Recovery,
    *,
    gain: float = DREM_GAIN,
    forgetting: float = DREM_FORGETTING,
) -> AdaptiveEstimate:
    """Extend and mix rows of the regression, straight lines between them.

    Parameters
    ----------
    t : Vector, shape (N,)
        Equally spaced instants [s].
    mu : Matrix, shape (N, q + 1)
        Rows of (25).
    recovery : Recovery
        How theta follows from eta.
    gain : float
        [1/s]
    forgetting : float
        [s]
    """
    return adapt("drem", recovery, t, mu, gain=gain, forgetting=forgetting)


@dataclass(frozen=True, eq=False)
class FilteredTheta:
    """theta after every sample but the last.

    Parameters
    ----------
    theta : Matrix, shape (N - 1, P)
        NaN: no value.
    standard_error : Matrix, shape (N - 1, P)
    """

    theta: Matrix
    standard_error: Matrix


def extended_kalman(
    t: Vector,
    y: Matrix,
    u: Matrix,
    alphas: Sequence[str],
    plant: DisturbedPlant,
    families: Sequence[Family],
    *,
    deviation: float = EXTENDED_DEVIATION,
    size: float = KALMAN_SIZE,
    box: SearchBox | None = None,
) -> FilteredTheta:
    """Filter samples of y and u.

    Parameters
    ----------
    t : Vector, shape (N,)
        Equally spaced instants [s].
    y : Matrix, shape (N, n_y)
    u : Matrix, shape (N, n_u)
    alphas : sequence of str
        The known factor of every component, an expression in t.
    plant : DisturbedPlant
    families : sequence of Family
    deviation : float
        Of the noise of y.
    size : float
        Deviation of x and beta at first.
    box : SearchBox, optional
        Of theta, which begins in it with the deviation of its step; by default that of the record.
    """
    h = equal_step(t)
    span = float(t[-1] - t[0])
    searched = box or search_box(families, span=span, shortest=span / 40.0)
    noise = white_noise(len(plant.C))
    model, known = discretize(plant, generators(families), step=np.array([h]), noise=noise)
    programs = [compile_expression(alpha) for alpha in alphas]
    constants = ExtendedKalmanConstants(
        terms=0,
        model=model,
        known=known,
        alphas=programs,
        deviation=deviation,
        size=size,
        theta=first_theta(searched),
        spread=searched.step,
        threshold=presence_threshold(model.generators.size, 1),
    )
    kernel = ExtendedKalmanStep(constants)
    kernel.initialize()
    rows = kernel.step.advance(np.ascontiguousarray(t), h, np.hstack([y, u]))
    parameters = model.generators.parameters
    return FilteredTheta(rows[:, :parameters], rows[:, parameters:])


def smoothed_disturbance(
    t: Vector,
    y: Matrix,
    u: Matrix,
    plant: DisturbedPlant,
    *,
    deviation: float = AUGMENTED_DEVIATION,
    size: float = KALMAN_SIZE,
    intensity: float = AUGMENTED_INTENSITY,
) -> Vector:
    """Reconstruct delta from all samples of y and u, shape (N,).

    Where the plant has an invariant zero in the left half plane, delta has its mode as a transient.

    Parameters
    ----------
    t : Vector, shape (N,)
        Equally spaced instants [s].
    y : Matrix, shape (N, n_y)
    u : Matrix, shape (N, n_u)
    plant : DisturbedPlant
    deviation : float
        Of the noise of y.
    size : float
        Deviation of x, delta and its derivative at first.
    intensity : float
        Spectral density of the second derivative of delta.
    """
    h = equal_step(t)
    n_y, n = plant.C.shape
    free = np.zeros(u.shape[1], np.bool_)
    model = augmented_model(plant, h, noise=white_noise(n_y), intensity=intensity, held=free)
    constants = AugmentedKalmanConstants(
        **model,
        first_spread=first_spread(n, size),
        deviation=deviation,
        capacity=len(t),
        projection=None,
    )
    kernel = AugmentedKalmanStep(constants)
    kernel.initialize()
    ends = np.append(t, t[-1] + h)  # a step takes the sample at its beginning
    rows = np.hstack([y, u])
    kernel.step.advance(ends, h, np.vstack([rows, rows[-1]]))
    return kernel.smooth(len(t))


def augmented_kalman(
    t: Vector,
    y: Matrix,
    u: Matrix,
    alpha: Matrix,
    plant: DisturbedPlant,
    families: Sequence[Family],
    theta: Vector,
    *,
    A: Matrix | None = None,
    c: Vector | None = None,
    deviation: float = AUGMENTED_DEVIATION,
    size: float = KALMAN_SIZE,
    intensity: float = AUGMENTED_INTENSITY,
) -> OutputErrorFit:
    """Estimate theta by variable projection on the smoothed delta, from a start.

    Parameters
    ----------
    t, y, u, plant, deviation, size, intensity
        As of :func:`smoothed_disturbance`.
    alpha : Matrix, shape (N, components)
        The known factors.
    families : sequence of Family
    theta : Vector, shape (P,)
        Start.
    A, c : optional
        Modes that delta has as transients, as for :func:`project`.
    """
    delta = smoothed_disturbance(
        t, y, u, plant, deviation=deviation, size=size, intensity=intensity
    )
    return project(t, delta, alpha, families, theta, A=A, c=c)


def project(
    t: Vector,
    delta: Vector,
    alpha: Matrix,
    families: Sequence[Family],
    theta: Vector,
    *,
    A: Matrix | None = None,
    c: Vector | None = None,
) -> OutputErrorFit:
    """Estimate theta by variable projection on delta_hat.

    Parameters
    ----------
    t : Vector, shape (N,)
        [s]
    delta : Vector, shape (N,)
        NaN: no value.
    alpha : Matrix, shape (N, components)
        At the instants that delta belongs to: at ``t`` less its lag.
    families : sequence of Family
    theta : Vector, shape (P,)
        Start.
    A, c : optional
        The observer's modes, as for :func:`reconstruction_model`.
    """
    modes = np.zeros((0, 0)) if A is None else A
    row = np.zeros(0) if c is None else c
    model = reconstruction_model(modes, row, len(families))
    column = np.reshape(delta, (-1, 1))
    no_input = np.zeros((len(t), 0))
    data_set = DataSet(t, column, no_input, alpha)
    return fit_output_error([data_set], model, families, theta)


@dataclass(frozen=True, eq=False)
class RayleighEstimate:
    """theta at the minimum of the quotient.

    Parameters
    ----------
    theta : Vector, shape (P,)
    converged : bool
    variance : float
        The quotient: an estimate of the variance of the noise in delta.
    """

    theta: Vector
    converged: bool
    variance: float


def noise_covariance(terms: Sequence[Term], alpha_products: Matrix) -> Matrix:
    """Compute N, shape ``(q + 1, q + 1)``, for rows of alpha products, shape ``(rows, q + 1)``."""
    signs = np.array([term.sign for term in terms], np.float64)
    rows = np.array([term.row for term in terms])
    signed = alpha_products * signs
    shares_row = rows[:, np.newaxis] == rows
    covariance: Matrix = (signed.T @ signed) * shares_row
    return covariance


def means(rows: Matrix, count: int) -> Matrix:
    """Return the means of ``count`` successive rows; those at the end that make none are left out.

    The regression (25) is linear in mu, so it holds for means of mu as it does for mu, and the
    noise of a derivative nearly cancels in them. The products of the alphas are averaged with mu.
    """
    whole = len(rows) // count
    grouped = rows[: whole * count].reshape(whole, count, rows.shape[1])
    averaged: Matrix = grouped.mean(axis=1)
    return averaged


def rayleigh(
    constants: RayleighConstants, mu: Matrix, N: Matrix, *, theta: Vector | None = None
) -> RayleighEstimate:
    """Estimate theta from rows of the regression.

    Parameters
    ----------
    constants : RayleighConstants
    mu : Matrix, shape (rows, q + 1)
    N : Matrix, shape (q + 1, q + 1)
        :func:`noise_covariance` of the same rows.
    theta : Vector, shape (P,), optional
        Where to start; by default where a search on a grid finds the smallest quotients.

    Raises
    ------
    AssumptionError
        If the quotient has no value, for which alphas that vanish are a reason.
    """
    model = RayleighModel(constants)
    status, minimizer, variance = model.minimize(triangle(mu), N, theta)
    if status == NO_INFORMATION:
        raise AssumptionError(
            "the quotient of the regression has no value; the alphas vanish on this window, "
            "or delta is not finite"
        )
    return RayleighEstimate(minimizer, status == 0, variance)
