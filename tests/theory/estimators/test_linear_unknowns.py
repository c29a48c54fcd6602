"""Amplitudes, x(0) and offset are those that belong to theta, of least squares at it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import fit_output_error
from tests.theory.straight_lines import simulate_lines

MASS = (np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]))
RATES = np.array([-0.1, -0.5])
START = np.array([-0.12, -0.6])
SIGMA = 3.5e-3
T = np.arange(2001) * 0.01


def mass() -> DisturbedPlant:
    A, Bd, C = MASS
    none = np.zeros((2, 0))
    return DisturbedPlant(
        A=A, B=none, Bd=np.repeat(Bd, 2, axis=1), C=C, D=none[:1], Dd=np.zeros((1, 2))
    )


def position(force, x0=(0.0, 0.0)):
    """Return the position under a force that is a straight line between samples."""
    A, Bd, C = MASS
    return simulate_lines((A, Bd, C, [[0.0]]), force, T, x0)


def columns(theta):
    """Return the position by each amplitude and each initial state, shape (N, 4)."""
    forced = [position(np.exp(rate * T)) for rate in theta]
    return np.stack([*forced, np.ones_like(T), T], axis=1)


def record(seed: int) -> DataSet:
    y = position(np.exp(np.outer(T, RATES)).sum(axis=1), (1.0, 1.0))
    y = y + SIGMA * np.random.default_rng(seed).standard_normal(y.shape)
    return DataSet(T, y[:, np.newaxis], np.zeros((len(T), 0)), np.ones((len(T), 2)))


@pytest.mark.parametrize("records", [1, 2])
def test_they_leave_the_least_residual_at_theta(records):
    """The sum of squares is that of the least squares at theta, to its rounding.

    Seed 500 ends a step beside the last regression, where the old unknowns leave 37 % more.
    """
    data = [record(500 + i) for i in range(records)]
    fit = fit_output_error(data, mass(), (Exponential(), Exponential()), START)
    assert fit.converged
    by_unknown = columns(fit.theta)
    least = 0.0
    for one, amplitudes, x0 in zip(data, fit.amplitudes, fit.x0, strict=True):
        y = one.y[:, 0]
        left = np.sum(np.square(y - by_unknown @ np.concatenate([amplitudes, x0])))
        best = np.linalg.lstsq(by_unknown / np.linalg.norm(by_unknown, axis=0), y)[1][0]
        assert left == pytest.approx(best, rel=1e-9)
        least += best
    assert fit.deviation == pytest.approx(np.sqrt(least / fit.freedom), rel=1e-9)


@pytest.mark.parametrize("outputs", [1, 2])
def test_an_offset_is_found_where_the_output_is_predicted(outputs):
    """Without noise theta, amplitude, x(0) and offset of an unstable plant are exact.

    The response is computed by a solver of its own, for straight lines between samples; rounding
    grows by 2e4 over the record.
    """
    t = np.arange(1001) * 0.02
    A, B = np.array([[0.5]]), np.array([[1.0]])
    C = np.array([[1.0], [-0.7]])[:outputs]
    offset = np.array([0.3, -0.2])[:outputs]
    alpha = 1.3 + 0.4 * np.sin(1.7 * t)
    direct = np.zeros((outputs, 1))
    exact = lsim((A, B, C, direct), alpha * np.exp(-0.3 * t), t, X0=[-0.9])[1]
    y = exact.reshape(len(t), outputs) + offset
    plant = DisturbedPlant(A=A, B=np.zeros((1, 0)), Bd=B, C=C, D=np.zeros((outputs, 0)), Dd=direct)
    data = DataSet(t, y, np.zeros((len(t), 0)), alpha[:, np.newaxis])
    fit = fit_output_error([data], plant, [Exponential()], np.array([-0.29]), offset=True)
    assert fit.theta[0] == pytest.approx(-0.3, abs=1e-6)
    np.testing.assert_allclose(fit.offset[0], offset, atol=1e-6)
    np.testing.assert_allclose(fit.x0[0], -0.9, atol=1e-6)
    np.testing.assert_allclose(fit.amplitudes[0], 1.0, atol=1e-6)
