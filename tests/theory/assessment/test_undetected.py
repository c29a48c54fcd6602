"""Errors of a model that the tests let pass: how far they move estimates is what is said of it."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.theory.assessment.amplitude_verdicts import amplitude_verdicts
from cosim.theory.assessment.assessing import assess_near
from cosim.theory.assessment.undetected import undetected_errors
from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.documents import UndetectedError, Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem
from cosim.theory.forced_response import simulate as simulated
from tests.theory.experiments import FAMILIES, delta, design, record, simulate, times

START = np.array([-0.05, -0.5])
SIGMA = 1e-3
TRUTH = {"theta[0]": -0.1, "theta[1]": -0.3, "amplitude[0]": 1.0, "amplitude[1]": 1.0}
H = 2e-2


def output(h=H, *, offset=0.0, drift=0.0, term=0.0, rate=0.0, error=0.0):
    """Return y without noise, with what the model lacks: on y, in delta, in an entry of A."""
    t = times(h)
    matrix = np.array([[0, 1, 1], [0, -2, 1 + error], [1, 0, 1.0]])
    exact = simulate(t, delta(t).sum(axis=1) + term * np.exp(-rate * t), matrix=matrix)
    return exact + offset + drift * t[:, np.newaxis] / t[-1]


def noisy(y, seed, h=H):
    """Return outputs as a data set, with white noise."""
    return record(y + SIGMA * np.random.default_rng(seed).standard_normal(y.shape), h)


def problem(*data, **options):
    """Return the problem of the example."""
    return OutputErrorProblem(list(data), design(), FAMILIES, **options)


def assessed(*data, **options):
    """Return the assessment of data sets, and what it does not see."""
    assessment = assess_near(problem(*data, **options), START)
    return assessment, told(assessment)


def told(assessment) -> dict[str, UndetectedError]:
    """Return the errors that would pass, by name."""
    amplitudes = amplitude_verdicts(assessment)
    errors = undetected_errors(assessment, amplitudes, with_offset="an offset")
    return {error.error: error for error in errors}


def intervals(assessment):
    """Return value and half width of every constant that has an interval, by name."""
    found = {}
    for own in (*assessment.parameters, *amplitude_verdicts(assessment)[0]):
        if own.verdict is Verdict.IDENTIFIABLE:
            found[own.name] = own.value, 0.5 * (own.upper - own.lower)
    return found


def unstable_lag():
    """Return `x' = x + u + delta, y = x`."""
    one = [[1.0]]
    return DisturbedPlant(A=one, B=one, Bd=one, C=one, D=[[0.0]], Dd=[[0.0]])


MISSING = {
    "a constant on y": lambda size: output(offset=size),
    "a drift over the record on y": lambda size: output(drift=size),
    "a further exp(-0.05 t) in delta": lambda size: output(term=size, rate=0.05),
    "a further exp(-0.4 t) in delta": lambda size: output(term=size, rate=0.4),
}


@pytest.fixture(scope="module")
def good():
    """Return what is said of data that the model explains."""
    return assessed(noisy(output(), 1))


@pytest.mark.parametrize("name", MISSING)
def test_an_error_that_would_pass_moves_the_estimates_as_far_as_is_said(name, good):
    """Under the same noise with an error of that size: within 3 %, what first order leaves."""
    without, errors = good
    error = errors[name]
    found = assess_near(problem(noisy(MISSING[name](error.size), 1)), START)
    values = dict(zip(TRUTH, [*found.fit.theta, *found.fit.amplitudes[0]], strict=True))
    for own, (value, width) in intervals(without).items():
        moved = abs(values[own] - value) / width
        if own in error.half_widths:
            assert error.half_widths[own] == pytest.approx(moved, rel=0.03)
        else:
            assert moved < 1.0


@pytest.mark.parametrize("name", MISSING)
def test_half_of_such_an_error_passes_and_twice_of_it_does_not(name, good):
    """Noise moves what is seen of it by one in 4.5: half of it would fail once in 80 times."""
    _, errors = good
    size = errors[name].size
    half = assess_near(problem(noisy(MISSING[name](0.5 * size), 2)), START)
    twice = assess_near(problem(noisy(MISSING[name](2.0 * size), 2)), START)
    assert half.parameters[0].verdict is Verdict.IDENTIFIABLE
    assert twice.parameters[0].verdict is Verdict.INCONSISTENT


def test_the_figures_of_the_example_follow_from_the_bound():
    """A constant costs a factor 1.86 on the standard error of theta[0].

    An estimate moves by the root of the factor's square less 1 in standard errors where what is
    left of the constant is as large as the noise; a single test lets 4.53 of that pass.
    """
    errors = assessed(noisy(output(1e-2), 1, 1e-2))[1]
    constant = errors["a constant on y"]
    expected = 4.53 * np.sqrt(1.86**2 - 1.0) / 1.96
    assert constant.half_widths["theta[0]"] == pytest.approx(expected, rel=0.02)
    assert str(constant).startswith("a constant on y of 0.00024 would pass: theta[0] moves by 3.6")


def test_an_offset_removes_a_constant_and_nothing_else(good):
    """It is offered for the constant alone; with it no constant is left, on y or in delta."""
    _, errors = good
    offered = [name for name, error in errors.items() if error.remedy]
    assert offered == ["a constant on y"]
    wrong = output(offset=errors["a constant on y"].size)
    with_offset, left = assessed(noisy(wrong, 1), offset=True)
    right = assess_near(problem(noisy(output(), 1), offset=True), START)
    np.testing.assert_allclose(with_offset.fit.theta, right.fit.theta, rtol=1e-9)
    assert "a drift over the record on y" in left
    assert not [name for name in left if "constant" in name]


def test_an_offset_removes_a_constant_on_the_output_of_an_unstable_plant():
    """Its output is predicted from the samples before, and so is what an error does to it."""
    t = np.arange(2001) * 1e-2
    plant = unstable_lag()
    u = np.sin(t)[:, np.newaxis]
    disturbance = np.exp(-0.2 * t)[:, np.newaxis]
    inputs = np.hstack([plant.B, plant.Bd])
    held = np.zeros(2, np.bool_)
    y = simulated(plant.A, inputs, t, np.hstack([u, disturbance]), np.zeros(1), held)
    y = y + SIGMA * np.random.default_rng(1).standard_normal(y.shape)
    data = DataSet(t, y, u, np.ones((len(t), 1)))
    for offset in (False, True):
        own = OutputErrorProblem([data], plant, (Exponential(),), offset=offset)
        assessment = assess_near(own, np.array([-0.3]))
        assert assessment.parameters[0].verdict is Verdict.IDENTIFIABLE
        assert ("a constant on y" in told(assessment)) is not offset


def test_exact_data_leave_nothing_to_tell():
    """What the step may cost is in the interval; an error beyond it would be seen."""
    assert assessed(record(output(), H))[1] == {}


def test_an_error_in_every_data_set_adds_up():
    """Of the same experiment twice theta moves as far, its interval is narrower by the root of 2.

    Sizes are those of one of them, to the 2 % that the deviations of two noises differ.
    """
    alone = assessed(noisy(output(), 1))[1]["a constant on y"]
    both = assessed(noisy(output(), 1), noisy(output(), 2))[1]["a constant on y"]
    assert both.size == pytest.approx(alone.size, rel=0.03)
    ratio = both.half_widths["theta[0]"] / alone.half_widths["theta[0]"]
    assert ratio == pytest.approx(np.sqrt(2.0), rel=0.03)
    assert "amplitude[0], data set 2" in both.half_widths


CASES = {
    "a further term": {"term": 0.02, "rate": 0.5},
    "a slow term": {"term": 0.003, "rate": 0.05},
    "a fast term": {"term": 0.04, "rate": 1.5},
    "an offset of a quarter of sigma": {"offset": 0.25 * SIGMA},
    "a drift": {"drift": 0.25 * SIGMA},
    "an entry of A": {"error": 1e-4},
}


@pytest.mark.parametrize(
    ("h", "seeds"),
    [
        pytest.param(H, range(1), id="short"),
        pytest.param(H, range(12), marks=pytest.mark.campaign, id="20 ms"),
        pytest.param(1e-2, range(12), marks=pytest.mark.campaign, id="10 ms"),
    ],
)
@pytest.mark.parametrize("case", CASES)
def test_an_interval_that_misses_has_a_figure_that_covers_it(case, h, seeds):
    """What the model lacks is too small for the tests: no error is beyond interval and figure.

    An estimate is as far off as the error moves it, and noise, which the interval contains.
    """
    exact = output(h, **CASES[case])
    for seed in seeds:
        assessment, errors = assessed(noisy(exact, seed, h))
        for name, (value, width) in intervals(assessment).items():
            figure = max([one.half_widths.get(name, 0.0) for one in errors.values()], default=0.0)
            assert abs(value - TRUTH[name]) <= (1.0 + figure) * width
