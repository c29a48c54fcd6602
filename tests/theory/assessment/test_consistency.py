"""What a residual may be: inputs that are held, errors that are allowed, several records."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.native.estimation.output_error import ParameterState
from cosim.theory.assessment.accuracy import step_error
from cosim.theory.assessment.assessing import assess_near
from cosim.theory.assessment.model_errors import model_errors
from cosim.theory.assessment.verdicts import is_settled
from cosim.theory.disturbances.families import generators
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem, fit_output_error
from cosim.theory.fitted_response import fitted_response
from cosim.theory.forced_response import forced_outputs
from tests.theory.experiments import COARSE, FAMILIES, design, exact, solved
from tests.theory.experiments import record as example_record
from tests.theory.lag import FAMILY, RATE, alpha, lag, record, staircase, states

START = np.array([-0.12])
GRID = np.arange(2001) * 1e-2


def held_record(sigma, seed):
    """Return a record of the lag under an input that is held from sample to sample."""
    u = staircase(len(GRID), seed)
    return record(GRID, u, states(GRID, u, held=True)[:, np.newaxis], held=True, sigma=sigma)


def test_a_held_input_has_no_error_of_the_step():
    """It is constant from sample to sample: what is left is that of the disturbance alone."""
    data = held_record(0.0, 1)
    delta = (alpha(GRID) * np.exp(RATE * GRID))[:, np.newaxis]
    without = replace(data, u=np.zeros_like(data.u))
    found = step_error(lag(), data, delta)
    np.testing.assert_array_equal(found, step_error(lag(), without, delta))
    parameter = assess_near(OutputErrorProblem([data], lag(), FAMILY), START).parameters[0]
    assert parameter.verdict is Verdict.IDENTIFIABLE
    assert parameter.lower <= RATE <= parameter.upper
    assert parameter.upper - parameter.lower < 1e-5


@pytest.mark.parametrize("sigma", [0.0, 1e-5, 1e-4])
def test_a_wrong_gain_of_a_held_input_is_inconsistent(sigma):
    """By 0.2 %: what the data say is not hidden by an error that they do not have."""
    found = assess_near(OutputErrorProblem([held_record(sigma, 1)], lag(gain=1.002), FAMILY), START)
    assert found.parameters[0].verdict is Verdict.INCONSISTENT


@pytest.mark.parametrize("sigma", [0.0, 1e-7, 1e-5])
@pytest.mark.parametrize("bits", [None, 12])
def test_allowed_errors_pass_each_test(bits, sigma):
    """Data below the errors of step and quantization: no test fails beside a good verdict."""
    y = exact("good", COARSE) if bits else solved(COARSE)
    y = y + sigma * np.random.default_rng(3).standard_normal(y.shape)
    if bits:
        level = 8.0 / 2**bits
        y = level * np.round(y / level)
    start = np.array([-0.05, -0.5])
    found = assess_near(OutputErrorProblem([example_record(y, COARSE)], design(), FAMILIES), start)
    assert found.parameters[0].verdict is Verdict.IDENTIFIABLE
    assert [test.name for test in found.consistency.tests if not test.passed] == []


def test_a_failed_test_is_never_beside_a_good_verdict():
    """Half of what is allowed, where it does not belong, is not what noise leaves."""
    u = np.sin(GRID)
    data = record(GRID, u, states(GRID, u)[:, np.newaxis])
    allowed = (
        assess_near(OutputErrorProblem([data], lag(), FAMILY), START)
        .consistency.accuracy[0]
        .deviations[0]
    )
    wave = allowed * np.sqrt(2.0) * np.cos(np.pi * GRID)
    wrong = record(GRID, u, data.y + wave[:, np.newaxis])
    found = assess_near(OutputErrorProblem([wrong], lag(), FAMILY), START)
    assert found.consistency.is_exact
    assert not all(test.passed for test in found.consistency.tests)
    assert found.parameters[0].verdict is Verdict.INCONSISTENT


@pytest.mark.parametrize("sigma", [0.0, 1e-3])
def test_the_order_of_records_changes_nothing(sigma):
    """Of a record with the disturbance, one without it and one of a third of it."""
    u = np.sin(GRID)
    records = []
    for seed, amplitude in enumerate((1.0, 0.0, 0.3)):
        y = states(GRID, u, amplitude=amplitude)[:, np.newaxis]
        records.append(record(GRID, u, y, sigma=sigma, seed=seed))
    found = []
    for order in (records, records[::-1]):
        found.append(assess_near(OutputErrorProblem(order, lag(), FAMILY), START).parameters[0])
    assert {parameter.verdict for parameter in found} == {Verdict.IDENTIFIABLE}
    values = [parameter.value for parameter in found]
    np.testing.assert_allclose(values, values[0], rtol=1e-9)
    np.testing.assert_allclose(values[0], RATE, atol=1e-2 * sigma + 1e-6)


def sampled(h):
    """Return a record of the lag under a fast input, every h seconds."""
    t = np.arange(0.0, 20.0, h)
    u = np.sin(3.0 * t)
    return record(t, u, states(t, u)[:, np.newaxis], sigma=1e-3)


def test_a_long_step_is_said_with_its_error_and_the_step_that_would_do():
    """Which output, how large the error is, and by how much shorter the step must be."""
    found = assess_near(OutputErrorProblem([sampled(0.5)], lag(), FAMILY), START)
    relative = float(found.consistency.step_error[0])
    assert relative > 0.01
    reason = found.parameters[0].reason
    assert "y[0]" in reason
    assert f"{100.0 * relative:.2g} %" in reason
    shorter = re.search(r"samples at (\S+) of their distances would do", reason)
    assert shorter is not None
    enough = assess_near(
        OutputErrorProblem([sampled(0.5 * float(shorter[1]))], lag(), FAMILY), START
    )
    assert not enough.consistency.step_too_long


def test_a_fit_that_has_not_converged_is_no_statement_about_the_data(monkeypatch):
    """It has no estimate; that nothing depends on theta is not said."""
    monkeypatch.setattr("cosim.native.estimation.output_error.MOST_ITERATIONS", 1)
    u = np.sin(GRID)
    data = record(GRID, u, states(GRID, u)[:, np.newaxis], sigma=1e-3)
    parameter = assess_near(OutputErrorProblem([data], lag(), FAMILY), np.array([-0.5])).parameters[
        0
    ]
    assert parameter.verdict is Verdict.NO_ESTIMATE
    assert parameter.value is None


def test_a_fit_is_settled_where_it_converged_and_leaves_noise():
    """Neither alone is enough, and every component has to be there."""
    estimated = ParameterState.ESTIMATED
    for converged, passed in product([False, True], repeat=2):
        for last in (estimated, ParameterState.ABSENT):
            fit = SimpleNamespace(converged=converged, states=[estimated, last])
            settled = is_settled(fit, SimpleNamespace(passed=passed))
            assert settled == (converged and passed and last is estimated)


UNEQUAL = np.concatenate([np.arange(0.0, 5.0, 0.005), np.arange(5.0, 20.0, 0.02)])
JITTERED = GRID + 1e-3 * np.random.default_rng(8).random(len(GRID))


def test_the_states_of_a_fit_are_those_at_the_samples(subtests):
    """Whatever their distances, and whether the input is held between them."""
    for held, (number, t) in product([False, True], enumerate([UNEQUAL, JITTERED])):
        with subtests.test(held=held, number=number):
            u = staircase(len(t), 3)
            x = states(t, u, held=held)
            data = record(t, u, x[:, np.newaxis], held=held)
            fit = fit_output_error([data], lag(), FAMILY, START)
            response = fitted_response(fit, 0, data, lag(), generators(FAMILY))
            np.testing.assert_allclose(response.states[:, 0], x, atol=1e-9)


def test_a_wrong_gain_leaves_its_own_trace_at_any_samples(subtests):
    """The direction of a wrong B is the response of the plant to u."""
    for held, (number, t) in product([False, True], enumerate([UNEQUAL, JITTERED])):
        with subtests.test(held=held, number=number):
            u = staircase(len(t), 3)
            data = record(t, u, states(t, u, held=held)[:, np.newaxis], held=held)
            fit = fit_output_error([data], lag(), FAMILY, START)
            response = fitted_response(fit, 0, data, lag(), generators(FAMILY))
            directions = model_errors(lag(), data, response)
            names = [error.name for error in directions.errors]
            place = names.index("u[0] in the dynamics of x_a[0]")
            np.testing.assert_allclose(
                directions.columns[:, 0, place], states(t, u, amplitude=0.0, held=held), atol=1e-9
            )


def test_errors_of_an_unstable_plant_show_in_its_predicted_outputs():
    """A direction is bounded there, as the residual is: it is no simulation that grows."""
    plant = DisturbedPlant(A=[[1.0]], B=[[1.0]], Bd=[[1.0]], C=[[1.0]], D=[[0.0]], Dd=[[0.0]])
    u = np.sin(GRID)
    data = record(GRID, u, np.ones((len(GRID), 1)))
    outputs = forced_outputs(plant, data)
    lines = np.ones((len(GRID), 1))
    found = outputs.respond(lines, np.zeros_like(lines))
    # exp(h) - 1 over a step, and the pole of the prediction is exp(-h): a geometric series; what is
    # predicted wrong is exp(h) times the noise, and is divided by that
    series = np.exp(-1e-2) * np.expm1(1e-2) * np.expm1(-GRID) / np.expm1(-1e-2)
    np.testing.assert_allclose(found[:, 0], series, rtol=1e-9, atol=1e-12)


def test_the_error_of_long_steps_among_short_ones_is_computed():
    """In the mean over each interval: of a ramp's square it is known, h^2 / 12 times 2, exactly."""
    t = np.cumsum(np.tile([0.001, 0.05], 200))
    u = t**2
    data = record(t, u, np.ones((len(t), 1)))
    found = step_error(lag(), data, np.zeros((len(t), 1)))
    fine = np.linspace(0.0, 1.0, 101)[1:]
    dense = np.concatenate([t[:1], (t[:-1, None] + np.diff(t)[:, None] * fine).ravel()])
    true = states(dense, dense**2, amplitude=0.0)[:: len(fine)]
    chord = states(t, u, amplitude=0.0)
    np.testing.assert_allclose(found[:, 0], true - chord, rtol=2e-2, atol=1e-3 * np.ptp(found))


def test_samples_between_the_points_of_an_input_have_the_error_of_its_lines(subtests):
    """Where u is known at other instants than y: it is wrong at the samples themselves too."""
    for feedthrough, place in product([0.0, 0.5], [0, 10, 25]):
        with subtests.test(feedthrough=feedthrough, place=place):
            fine = np.arange(20001) * 1e-3
            u = np.sin(2.0 * fine)
            y = states(fine, u) + feedthrough * u
            points = fine[::50]
            samples = fine[place::50]
            t = np.union1d(samples, points)
            at_samples = np.full((len(t), 1), np.nan)
            at_samples[np.searchsorted(t, samples), 0] = y[place::50]
            between = np.interp(t, points, u[::50])[:, np.newaxis]
            taken = np.isin(t, points)
            data = DataSet(t, at_samples, between, alpha(t)[:, np.newaxis], taken=taken)
            plant = replace(lag(), D=np.array([[feedthrough]]))
            found = assess_near(OutputErrorProblem([data], plant, FAMILY), START)
            parameter = found.parameters[0]
            assert parameter.verdict is Verdict.IDENTIFIABLE
            assert parameter.lower <= RATE <= parameter.upper
            delta = (alpha(t) * np.exp(RATE * t))[:, np.newaxis]
            error = step_error(plant, data, delta)[~np.isnan(at_samples)]
            lines = states(t, between[:, 0]) + feedthrough * between[:, 0]
            true = y[place::50] - lines[np.searchsorted(t, samples)]
            np.testing.assert_allclose(error, true, atol=0.1 * np.abs(true).max())
