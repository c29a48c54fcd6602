"""Smoothing: states and disturbance from all samples, and bands that hold."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import lfilter
from scipy.stats import binom

from cosim.errors import AssumptionError
from cosim.theory.assessment.fitted_model import FittedModel
from cosim.theory.assessment.smoothing import smoothed_signals
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, NoiseModel, white_noise
from cosim.theory.estimators.output_error import OutputErrorProblem, fit_output_error
from cosim.theory.plants.descriptor import reduce
from tests.theory.academic import THETA, academic, alpha
from tests.theory.academic import delta as true_delta
from tests.theory.experiments import COARSE, FAMILIES, delta, design, noisy, record, simulate, times

START = np.array([-0.05, -0.5])
PLACES = np.array([0, 50, 400, 1500, 4000])
FEW = 30  # seeds


def smoothed(data, fit=None):
    fit = fit or fit_output_error([data], design(), FAMILIES, START)
    return smoothed_signals(fitted([data], fit))


@cache
def smoothed_good(seed):
    """Return the example's bands under noise of a seed."""
    return smoothed(noisy("good", 1e-3, seed, COARSE))


def fitted(data, fit, noise=None):
    noise = noise or white_noise(1)
    return FittedModel(OutputErrorProblem(data, design(), FAMILIES), fit, noise)


def true_states(t):
    """Return the states of the example: as outputs of the same plant, two at a time."""
    one = design()
    x = np.array([1.0, -1.0])
    states = [x]
    inputs = np.stack([np.sin(t), delta(t).sum(axis=1)], axis=1)
    h = t[1] - t[0]
    drive = np.hstack([one.B, one.Bd[:, :1]])
    block = np.zeros((6, 6))
    block[:2, :2] = h * one.A
    block[:2, 2:4] = h * drive
    block[2:4, 4:] = np.eye(2)
    power = expm(block)
    end = power[:2, 4:]
    begin = power[:2, 2:4] - end
    for u0, u1 in itertools.pairwise(inputs):
        x = power[:2, :2] @ x + begin @ u0 + end @ u1
        states.append(x)
    return np.array(states)


def test_exact_data_give_the_exact_signals():
    """States from their first sample on: there is no transient.

    The bands are as wide as the error of straight lines would be: nobody says these are exact.
    """
    data = noisy("good", 0.0, 1, COARSE)
    found = smoothed(data)
    t = times(COARSE)
    np.testing.assert_allclose(found.states, true_states(t), atol=1e-8)
    np.testing.assert_allclose(found.disturbance, delta(t).sum(axis=1), atol=1e-8)
    assert found.disturbance_half_width.max() < 1e-3


def test_the_bands_have_the_error_of_the_step():
    """Data of another solver, without noise: straight lines are all that is wrong.

    The bands contain what they do, of the states too: they are half as wide again, and a little
    more as the residual that is left counts as noise.
    """
    t = times(COARSE)
    reduced = reduce(academic())

    def rate(t, x):
        forced = reduced.B_1a[:, 0] * np.sin(t) + reduced.B_2a[:, 0] * true_delta(np.array([t]))[0]
        return reduced.A_a @ x + forced

    solution = solve_ivp(
        rate, (0.0, t[-1]), [1.0, -1.0], method="DOP853", rtol=1e-12, atol=1e-13, t_eval=t
    )
    y = (reduced.C3 @ solution.y).T + np.outer(np.sin(t), reduced.C4[0])
    found = smoothed(record(y, COARSE))
    errors = np.column_stack([found.disturbance - true_delta(t), found.states - solution.y.T])
    widths = np.column_stack([found.disturbance_half_width, found.states_half_width])
    assert np.abs(errors).max() > 1e-7
    assert (np.abs(errors) <= widths + 1e-9).all()
    size = np.sqrt(np.mean(errors**2, axis=0))
    ratio = np.sqrt(np.mean(widths**2, axis=0)) / size
    assert (ratio > 1.49).all()
    assert (ratio < 2.0).all()


def coverage(seeds):
    """Return how often the truth is within the bands, at some instants: delta, then both states."""
    t = times(COARSE)
    true_delta = delta(t).sum(axis=1)
    true = np.column_stack([true_delta, true_states(t)])[PLACES]
    inside = np.zeros(true.shape)
    for seed in range(seeds):
        found = smoothed_good(seed)
        values = np.column_stack([found.disturbance, found.states])[PLACES]
        widths = np.column_stack([found.disturbance_half_width, found.states_half_width])[PLACES]
        inside += np.abs(values - true) <= widths
    return inside


def test_the_bands_contain_the_truth():
    """In 95 % of the runs at any one instant, within what chance makes of so few of them."""
    counts = coverage(FEW)
    least = binom.ppf(1e-4 / counts.size, FEW, 0.95)
    assert (counts >= least).all()
    assert counts.mean() < FEW  # and they are no wider than that


@pytest.mark.campaign
def test_the_bands_contain_the_truth_in_95_percent():
    """Over 1000 seeds, at every one of the instants."""
    counts = coverage(1000)
    low, high = binom.ppf([1e-4 / counts.size, 1.0 - 1e-4 / counts.size], 1000, 0.95)
    assert (counts >= low).all()
    assert (counts <= high).all()


def test_a_band_is_as_wide_as_the_scatter():
    """Of the estimates over seeds: with so few of them, to a fifth or so (chi-square)."""
    values = []
    widths = []
    for seed in range(FEW):
        found = smoothed_good(seed)
        values.append(found.disturbance[PLACES])
        widths.append(found.disturbance_half_width[PLACES])
    scatter = np.std(values, axis=0, ddof=1)
    ratio = np.mean(widths, axis=0) / (1.96 * scatter)
    assert (np.abs(ratio - 1.0) < 4.0 / np.sqrt(2.0 * FEW)).all()


def test_a_second_record_narrows_the_bands_of_the_first():
    """Theta is shared: what another record says of it is known here, too."""
    data = noisy("good", 1e-3, 1, COARSE)
    t = times(COARSE)
    y = simulate(t, delta(t) @ np.array([2.0, 5.0]), x0=(0.0, 0.0))
    strong = record(y + 1e-3 * np.random.default_rng(2).standard_normal(y.shape), COARSE)
    alone = smoothed(data)
    fit = fit_output_error([data, strong], design(), FAMILIES, START)
    both = smoothed_signals(fitted([data, strong], fit))
    end = slice(2000, None)
    assert (both.disturbance_half_width[end] < 0.7 * alone.disturbance_half_width[end]).all()
    other = smoothed_signals(fitted([data, strong], fit), 1)
    true = delta(t) @ np.array([2.0, 5.0])
    assert (np.abs(other.disturbance - true) < 2.0 * other.disturbance_half_width).all()


def test_samples_at_any_distance_are_smoothed_exactly():
    """The intervals are those of the samples, not their mean."""
    data = noisy("good", 0.0, 1, COARSE)
    fit = fit_output_error([data], design(), FAMILIES, START)
    whole = smoothed(data, fit)
    kept = np.sort(np.random.default_rng(3).permutation(4001)[:3000])
    kept[0] = 0
    thin = DataSet(data.t[kept], data.y[kept], data.u[kept], data.alpha[kept])
    found = smoothed(thin, fit_output_error([thin], design(), FAMILIES, THETA))
    # what is left is the error of straight lines over two or more steps
    np.testing.assert_allclose(found.states, whole.states[kept], atol=1e-4)
    np.testing.assert_array_equal(found.t, data.t[kept])


def test_colored_noise_makes_wider_bands():
    """Of a deviation of the same size: slow noise looks more like a disturbance."""
    t = times(COARSE)
    rng = np.random.default_rng(4)
    white = rng.standard_normal(len(t))
    white[0] = 0.0
    colored = lfilter([0.6], [1.0, -0.8], white)
    y = simulate(t, delta(t).sum(axis=1)) + 1e-3 * colored[:, np.newaxis]
    data = DataSet(t, y, np.sin(t)[:, np.newaxis], alpha(t))
    noise = NoiseModel(covariance=np.eye(1), a=np.array([[0.8]]))
    fit = fit_output_error([data], design(), FAMILIES, START, noise=noise)
    found = smoothed_signals(fitted([data], fit, noise))
    plain = smoothed_good(4)
    wider = found.disturbance_half_width[2000] / plain.disturbance_half_width[2000]
    # the spectrum of the noise at low frequencies: (0.6 / (1 - 0.8)) = 3 times the deviation
    assert wider == pytest.approx(3.0, rel=0.2)


def test_an_unstable_plant_is_refused():
    """Its simulated states say nothing."""
    data = noisy("good", 0.0, 1, COARSE)
    fit = fit_output_error([data], design(), FAMILIES, START)
    one = design()
    unstable = DisturbedPlant(A=-one.A, B=one.B, Bd=one.Bd, C=one.C, D=one.D, Dd=one.Dd)
    problem = OutputErrorProblem([data], unstable, FAMILIES)
    with pytest.raises(AssumptionError, match="smoothing needs a stable plant"):
        smoothed_signals(FittedModel(problem, fit, white_noise(1)))
