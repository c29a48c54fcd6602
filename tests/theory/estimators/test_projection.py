"""Variable projection on delta: theta from the reconstructed disturbance."""

import numpy as np
import pytest

from cosim.native.estimation.output_error import ParameterState
from cosim.theory.disturbances.families import Exponential, Sine
from cosim.theory.estimators.projection import reconstruction_model
from tests.theory.academic import THETA, alpha, delta
from tests.theory.estimators.passes import project

FAMILIES = (Exponential(), Exponential())
T = np.arange(2001) * 0.01
START = np.array([-0.05, -0.6])


def test_exact_samples_give_theta_to_rounding():
    """And the amplitudes."""
    fit = project(T, delta(T), alpha(T), FAMILIES, START)
    assert fit.converged
    np.testing.assert_allclose(fit.theta, THETA, rtol=1e-12)
    np.testing.assert_allclose(fit.amplitudes[0], 1.0, rtol=1e-12)
    assert fit.x0[0].shape == (0,)


def test_samples_without_value_are_left_out():
    """Those before a filter has one, and lost ones."""
    samples = delta(T)
    samples[:100] = np.nan
    samples[700:750] = np.nan
    fit = project(T, samples, alpha(T), FAMILIES, START)
    assert fit.freedom == len(T) - 150 - 4
    np.testing.assert_allclose(fit.theta, THETA, rtol=1e-11)


def test_transients_of_the_observer_are_eliminated():
    """A decay exp(-2 t) beside delta costs nothing once the mode is named, and else a bias."""
    samples = delta(T) + 0.5 * np.exp(-2.0 * T)
    modes = np.array([[-2.0]])
    fit = project(T, samples, alpha(T), FAMILIES, START, A=modes, c=np.ones(1))
    np.testing.assert_allclose(fit.theta, THETA, rtol=1e-10)
    np.testing.assert_allclose(fit.x0[0], [0.5], rtol=1e-10)
    without = project(T, samples, alpha(T), FAMILIES, START)
    assert np.abs(without.theta - THETA).max() > 1e-2


def test_a_lag_is_taken_away_with_alpha_at_the_time_that_delta_belongs_to():
    """A pure delay of delta only scales the amplitudes."""
    lag = 0.3
    fit = project(T, delta(T - lag), alpha(T - lag), FAMILIES, START)
    np.testing.assert_allclose(fit.theta, THETA, rtol=1e-11)
    np.testing.assert_allclose(fit.amplitudes[0], np.exp(-lag * np.array(THETA)), rtol=1e-11)
    late = project(T, delta(T - lag), alpha(T), FAMILIES, START)
    assert np.abs(late.theta - THETA).max() > 1e-3


def test_white_noise_leaves_errors_of_the_standard_errors_size():
    """A sine of unknown phase under a known factor; 20 deviations of both are no accident."""
    factor = alpha(T)[:, :1]
    samples = factor[:, 0] * 2.0 * np.sin(1.3 * T + 0.4)
    errors = []
    for seed in range(20):
        noisy = samples + 0.1 * np.random.default_rng(seed).standard_normal(len(T))
        fit = project(T, noisy, factor, [Sine()], np.array([1.25]))
        assert fit.states == (ParameterState.ESTIMATED,)
        errors.append((fit.theta[0] - 1.3) / fit.standard_error[0])
    # 20 squares of deviation 1: their mean is within 4 deviations, sqrt(2 / 20) each
    assert np.mean(np.square(errors)) == pytest.approx(1.0, abs=4.0 * np.sqrt(0.1))


def test_the_model_without_modes_has_no_states():
    """Its outputs are the components themselves."""
    model = reconstruction_model(np.zeros((0, 0)), np.zeros(0), 3)
    assert model.A.shape == (0, 0)
    assert model.Dd.tolist() == [[1.0, 1.0, 1.0]]
