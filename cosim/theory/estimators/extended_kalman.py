"""A joint extended Kalman filter of x, the basis beta(t), and theta: a baseline.

    x' = A x + B u + sum_i Bd_i alpha_i c_i'beta_i,   beta_i' = G_i(theta) beta_i,   theta' = 0,

linear in x and beta, bilinear in theta and beta. Over a step the transition is exact at the present
theta, with straight lines for u and the disturbance; its derivative is that of the exact
transition. There is no noise but that of y, so that where the linearization is right the filter is
the recursive least squares of theta. Where it is not, in the first seconds, the covariance shrinks
about a wrong theta, and what was learned there is never taken back: that is the price of one pass
(A. Jazwinski, Stochastic Processes and Filtering Theory, 1970, chapter 8; L. Ljung, IEEE Trans.
Automatic Control 24, 1979).

theta has no value before its standard error is half of what it was at first, nor while noise alone
explains its component.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.estimation.kalman import ExtendedKalmanConstants, ExtendedKalmanStep
from cosim.native.numerics.expression import compile_expression
from cosim.theory.disturbances.families import Family, SearchBox, generators, search_box
from cosim.theory.disturbed_plant import DisturbedPlant, discretize, white_noise
from cosim.theory.estimators.defaults import EXTENDED_DEVIATION, KALMAN_SIZE
from cosim.theory.estimators.output_error import presence_threshold
from cosim.theory.sampling import equal_step


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


def first_theta(box: SearchBox) -> Vector:
    """Return the theta to begin with: the slowest of the box but for its outer tenth."""
    step = box.step
    start: Vector = np.clip(0.0, box.lower + step, box.upper - step)
    return start


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
