"""Forgetting: squares lose their weight in the stated time; errors are those of such weights."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import fit_output_error
from tests.theory.straight_lines import simulate_lines

H = 0.02
T = np.arange(1001) * H
RATE = -0.05
SIGMA = 1e-3
ALPHA = 1.3 + 0.4 * np.sin(1.7 * T)
STATES = (np.array([[0.0, 1.0], [-2.0, -0.8]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]))


def response(forcing, x0=(0.0, 0.0)):
    A, B, C = STATES
    return simulate_lines((A, B, C, [[0.0]]), forcing, T, x0)


def linear_columns():
    """Return y by the amplitude and by x(0), at the true rate, shape (N, 3)."""
    free = [response(np.zeros(len(T)), x0) for x0 in np.eye(2)]
    return np.stack([response(ALPHA * np.exp(RATE * T)), *free], axis=1)


def jacobian():
    """Return the derivatives of y by theta and the linear unknowns, amplitude 1."""
    return np.column_stack([response(ALPHA * T * np.exp(RATE * T)), linear_columns()])


def fit(seed, constant):
    A, B, C = STATES
    none = np.zeros((2, 0))
    plant = DisturbedPlant(A=A, B=none, Bd=B, C=C, D=none[:1], Dd=np.zeros((1, 1)))
    y = linear_columns() @ [1.0, 1.0, -0.5]
    y = y + SIGMA * np.random.default_rng(seed).standard_normal(y.shape)
    data = DataSet(T, y[:, np.newaxis], np.zeros((len(T), 0)), ALPHA[:, np.newaxis])
    forgetting = np.exp(-H / constant)
    return y, fit_output_error(
        [data], plant, [Exponential()], np.array([RATE]), forgetting=forgetting
    )


@pytest.mark.parametrize("constant", [5.0, 20.0])
def test_the_time_constant_is_that_of_the_weight_of_a_square(constant):
    """Theta and its error are those of weights ``exp(-age / constant)`` of the squares.

    To first order in the noise, which is small: theta by one step of Gauss and Newton, the error as
    ``H J'W^2 J H`` with ``H = (J'WJ)^-1``.
    """
    y, found = fit(1, constant)
    weight = np.exp(-(T[-1] - T) / constant)
    J = jacobian()
    unit = np.linalg.norm(J, axis=0)
    J = J / unit
    inverse = np.linalg.inv(J.T @ (weight[:, np.newaxis] * J))
    of_noise = inverse @ (J * weight[:, np.newaxis]).T
    step = of_noise @ (y - linear_columns() @ [1.0, 1.0, -0.5]) / unit
    error = SIGMA * np.sqrt(np.sum(np.square(of_noise[0]))) / unit[0]
    assert found.theta[0] - RATE == pytest.approx(step[0], abs=0.05 * error)
    # the deviation is that of so many samples as weigh, to 4 of its own standard errors
    assert found.standard_error[0] == pytest.approx(error, rel=4.0 / np.sqrt(2.0 * weight.sum()))
    assert found.freedom == pytest.approx(weight.sum() - 4, rel=1e-9)


def test_errors_are_as_large_as_the_estimates_scatter():
    """Over 60 seeds the mean square of error over standard error is 1 within 4 of its errors."""
    ratios = []
    for seed in range(60):
        _, found = fit(100 + seed, 5.0)
        ratios.append((found.theta[0] - RATE) / found.standard_error[0])
    assert np.mean(np.square(ratios)) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 60.0))
