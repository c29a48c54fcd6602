"""Values that are missing: each output counts where it is measured, alone or with others."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.signal import lfilter

from cosim.errors import AssumptionError
from cosim.theory.assessment.assessing import assess, assess_near
from cosim.theory.assessment.smoothing import smoothed_signals
from cosim.theory.disturbances.families import generators
from cosim.theory.disturbed_plant import DisturbedPlant, NoiseModel
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem, fit_output_error
from cosim.theory.fitted_response import fitted_response
from cosim.theory.forced_response import simulate
from tests.theory.lag import FAMILY, RATE, alpha, lag, record, states

START = np.array([-0.12])
GRID = np.arange(2001) * 1e-2
SENSORS = (1.0, 2.0)


def missing(pattern, seed, *, correlation=0.0):
    """Return a record of two sensors of which some values are missing, and its covariance."""
    u = np.sin(GRID)
    x = states(GRID, u)
    covariance = 1e-6 * np.array([[1.0, 2.0 * correlation], [2.0 * correlation, 4.0]])
    noise = np.random.default_rng(seed).standard_normal((len(GRID), 2))
    y = np.outer(x, SENSORS) + noise @ np.linalg.cholesky(covariance).T
    y[~pattern] = np.nan
    return record(GRID, u, y), covariance


def alternating():
    """Return which values are measured if two sensors take turns."""
    even = np.arange(len(GRID)) % 2 == 0
    return np.column_stack([even, ~even])


def scattered():
    """Return which values are measured if each is lost with a probability of 0.3."""
    return np.random.default_rng(17).random((len(GRID), 2)) > 0.3


def two_sensors():
    return lag(sensors=SENSORS)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
@pytest.mark.parametrize("pattern", [alternating, scattered])
def test_an_output_counts_where_it_is_measured(pattern, correlation):
    """The fit is that of generalized least squares on the values that are there."""
    data, covariance = missing(pattern(), 1, correlation=correlation)
    noise = NoiseModel(covariance=covariance, a=np.zeros((2, 0)))
    fit = fit_output_error([data], two_sensors(), FAMILY, START, noise=noise)
    response = fitted_response(fit, 0, data, two_sensors(), generators(FAMILY))
    columns = np.concatenate([response.slopes, response.linear], axis=2)
    information = np.zeros((columns.shape[2], columns.shape[2]))
    gradient = np.zeros(columns.shape[2])
    for rows, residual, there in zip(columns, response.residual, data.measured, strict=True):
        inverse = (
            np.linalg.inv(covariance[np.ix_(there, there)]) if there.any() else np.zeros((0, 0))
        )
        information += rows[there].T @ inverse @ rows[there]
        gradient += rows[there].T @ inverse @ residual[there]
    expected = np.linalg.inv(information)
    np.testing.assert_allclose(fit.covariance[0, 0] / fit.deviation**2, expected[0, 0], rtol=1e-4)
    # the last step of the iteration is a small part of a standard error, and its effect the square
    assert np.abs(expected @ gradient)[0] < 1e-2 * np.sqrt(expected[0, 0])
    assert fit.deviation == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * data.measured.sum()))
    assert fit.freedom == data.measured.sum() - columns.shape[2]


@pytest.mark.parametrize("pattern", [alternating, scattered])
def test_sensors_that_are_not_measured_together_identify(pattern):
    """With the noise estimated too; a wrong gain of one of them is found."""
    data, covariance = missing(pattern(), 2)
    found = assess(OutputErrorProblem([data], two_sensors(), FAMILY))
    parameter = found.parameters[0]
    assert parameter.verdict is Verdict.IDENTIFIABLE
    assert parameter.lower <= RATE <= parameter.upper
    deviations = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.deviations, deviations, rtol=0.1)
    wrong = assess_near(OutputErrorProblem([data], lag(sensors=(1.0, 2.02)), FAMILY), START)
    assert wrong.parameters[0].verdict is Verdict.INCONSISTENT
    smoothed = smoothed_signals(found.fitted)
    errors = np.abs(smoothed.states[:, 0] - states(GRID, np.sin(GRID)))
    assert (errors < 2.5 * smoothed.states_half_width[:, 0]).all()


def test_colored_noise_of_sensors_that_take_turns_is_whitened():
    """Each by a model along its own samples."""
    u = np.sin(GRID)
    white = np.random.default_rng(6).standard_normal((len(GRID), 2))
    noise = 1e-3 * lfilter([1.0], [1.0, -0.8], white, axis=0)
    y = np.outer(states(GRID, u), SENSORS) + noise
    y[~alternating()] = np.nan
    found = assess_near(OutputErrorProblem([record(GRID, u, y)], two_sensors(), FAMILY), START)
    assert found.parameters[0].verdict is Verdict.IDENTIFIABLE
    np.testing.assert_allclose(found.noise.a[:, 0], 0.64, atol=0.08)


@pytest.mark.parametrize("every", [0.0199, 0.02, 0.0271])
def test_the_color_of_noise_is_over_samples_whatever_rows_are_between_them(every):
    """Samples at times of their own stand among the points of a grid, where y is not measured.

    Each follows the one before, and an AR(1) of 0.5 is found to four of its standard errors,
    sqrt((1 - a^2)/N).
    """
    points = np.arange(2001) / 100
    times = np.arange(round(20.0 / every)) * every
    t = np.union1d(times, points)
    here = np.searchsorted(t, times)
    u = np.sin(t)
    y = np.full((len(t), 1), np.nan)
    white = np.random.default_rng(3).standard_normal(len(times))
    y[here, 0] = states(t, u)[here] + 1e-3 * lfilter([1.0], [1.0, -0.5], white)
    data = record(t, u, y)
    np.testing.assert_array_equal(data.numbers[here, 0], np.arange(len(times)))
    assert data.distances[0] == pytest.approx(every, rel=1e-9)
    found = assess_near(OutputErrorProblem([data], lag(), FAMILY), START)
    parameter = found.parameters[0]
    assert parameter.verdict is Verdict.IDENTIFIABLE
    assert parameter.lower <= RATE <= parameter.upper
    error = np.sqrt(0.75 / len(times))
    assert found.noise.a.sum() == pytest.approx(0.5, abs=4.0 * error)


def test_lost_samples_and_pauses_leave_their_numbers_out():
    """A sample that is later than the usual distance is one of those behind; jitter does not count.

    One that is much too early follows none.
    """
    t = np.array([0.0, 1.0, 2.1, 2.9, 5.0, 6.0, 6.3, 7.3, 8.3, 9.3])
    data = record(t, np.zeros(10), np.zeros((10, 1)))
    np.testing.assert_array_equal(data.numbers[:, 0], [0, 1, 2, 3, 5, 6, 8, 9, 10, 11])


def test_an_unstable_plant_is_predicted_by_the_sensors_that_are_there():
    """Two that take turns: the fit finds theta as well as with both at half as many times."""
    plant = DisturbedPlant(
        A=[[0.5]], B=[[1.0]], Bd=[[1.0]], C=[[1.0], [2.0]], D=np.zeros((2, 1)), Dd=np.zeros((2, 1))
    )
    delta = alpha(GRID) * np.exp(RATE * GRID)
    u = -delta + np.sin(GRID)
    forcing = np.sin(GRID)[:, np.newaxis]
    x = simulate(plant.A, plant.B, GRID, forcing, np.zeros(1), np.zeros(1, np.bool_))
    noise = np.random.default_rng(4).standard_normal((len(GRID), 2)) * [1e-3, 2e-3]
    y = x * SENSORS + noise
    y[~alternating()] = np.nan
    found = assess_near(OutputErrorProblem([record(GRID, u, y)], plant, FAMILY), START)
    parameter = found.parameters[0]
    assert parameter.verdict is Verdict.IDENTIFIABLE
    assert parameter.value == pytest.approx(RATE, abs=1e-3)


def test_an_output_that_is_never_measured_is_refused():
    """It is named."""
    pattern = np.ones((len(GRID), 2), np.bool_)
    pattern[:, 1] = False
    with pytest.raises(AssumptionError, match=r"y\[1\]: expected at least one"):
        missing(pattern, 1)


def test_values_of_a_sample_are_whitened_by_the_covariance_of_those_that_are_there(subtests):
    """Sample by sample, by the inverse factor of their part of it; of any number of outputs."""
    for outputs, lost in product([1, 2, 8, 9, 17], [0.0, 0.3]):
        with subtests.test(outputs=outputs, lost=lost):
            rng = np.random.default_rng(outputs)
            measured = rng.random((200, outputs)) >= lost
            rows = rng.standard_normal((200, outputs, 3))
            mixed = rng.standard_normal((outputs, outputs))
            covariance = mixed @ mixed.T + np.eye(outputs)
            noise = NoiseModel(covariance=covariance, a=np.zeros((outputs, 0)))
            numbers = np.where(measured, np.arange(200)[:, np.newaxis], -1)
            expected = np.zeros_like(rows)
            for k, there in enumerate(measured):
                if there.any():
                    factor = np.linalg.cholesky(covariance[np.ix_(there, there)])
                    expected[k, there] = np.linalg.solve(factor, rows[k, there])
            # the covariance has a condition below 1e4
            np.testing.assert_allclose(noise.whitened(rows, numbers), expected, rtol=0, atol=1e-10)


def test_a_thinned_record_keeps_every_so_many_values_of_each_output():
    """Rows 0, 3, ..., and every third one of those that have a value of an output."""
    data, _ = missing(scattered(), 0)
    rows = set(range(0, len(GRID), 3))
    for own in data.measured.T:
        rows |= set(np.flatnonzero(own)[::3].tolist())
    assert data.kept(3).tolist() == sorted(rows)
