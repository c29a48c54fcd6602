"""Terms that are absent or alike: what is said of the others does not depend on the start."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from cosim.theory.assessment.assessing import assess, assess_near
from cosim.theory.disturbances.families import Exponential, Polynomial, TExponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem
from tests.theory.straight_lines import simulate_lines

T = 0.02 * np.arange(1001)
U = np.sin(1.1 * T) + 0.5 * np.sin(2.9 * T + 1.0)
A = np.array([[0.0, 1.0], [-2.0, -0.8]])
B = np.array([[0.0], [1.0]])
C = np.array([[1.0, 0.0]])
D = np.zeros((1, 1))
SIGMA = 1e-3


def plant(terms):
    """Return a plant that every term disturbs in the same way."""
    Bd = np.repeat(B, terms, axis=1)
    return DisturbedPlant(A=A, B=B, Bd=Bd, C=C, D=D, Dd=np.zeros((1, terms)))


def response(forcing, x0=(1.0, -0.5)):
    """Simulate straight lines between samples."""
    return simulate_lines((A, B, C, D), forcing, T, x0)


def record(rates, terms, seed=1):
    """Return samples under exponentials of one alpha, 1, with noise."""
    y = response(U + sum(np.exp(rate * T) for rate in rates))
    y = y + SIGMA * np.random.default_rng(seed).standard_normal(len(T))
    return DataSet(T, y[:, np.newaxis], U[:, np.newaxis], np.ones((len(T), terms)))


def single_rate(data):
    """Fit one exponential by a least squares of its own; return its rate and standard error."""
    known = response(U, (0.0, 0.0))
    free = [response(np.zeros_like(T), x0) for x0 in ((1.0, 0.0), (0.0, 1.0))]

    def rest(p):
        forced = response(np.exp(p[0] * T), (0.0, 0.0))
        return data.y[:, 0] - known - p[1] * forced - p[2] * free[0] - p[3] * free[1]

    found = least_squares(rest, [-0.3, 2.0, 1.0, -0.5], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    variance = found.fun @ found.fun / (len(T) - 4)
    return found.x[0], np.sqrt(variance * np.linalg.inv(found.jac.T @ found.jac)[0, 0])


@pytest.mark.parametrize("start", [-0.35, -0.6, -1.0, -0.2])
def test_an_absent_term_takes_nothing_from_another_wherever_it_started(start):
    """Of rates -0.3 and -0.33 one explains the data: its value is that of a fit of it alone.

    It is WEAK: it is neither of the two.
    """
    data = record((-0.3, -0.33), 2)
    found = assess_near(
        OutputErrorProblem([data], plant(2), (Exponential(),) * 2), np.array([-0.25, start])
    ).parameters
    rate, error = single_rate(data)
    told = [one for one in found if one.verdict is Verdict.WEAK]
    assert len(told) == 1
    assert told[0].value == pytest.approx(rate, abs=0.05 * error)
    assert told[0].standard_error == pytest.approx(error, rel=0.01)
    assert "assumes the absence of terms[" in told[0].reason


def test_an_estimate_that_rests_on_the_absence_of_another_term_is_weak():
    """Constant and t-exponential are alike in 6 s: without the constant theta is far off.

    Neither is too small to be seen; it is their difference that noise hides.
    """
    few = slice(0, 301)
    y = response(U + 1.0 + (1.0 + 0.5 * T) * np.exp(-0.07 * T))
    y = y + 3e-4 * np.random.default_rng(1).standard_normal(len(T))
    ones = np.ones((301, 2))
    data = DataSet(T[few], y[few, np.newaxis], U[few, np.newaxis], ones)
    problem = OutputErrorProblem([data], plant(2), (Polynomial(0), TExponential()))
    assessment = assess_near(problem, np.array([-0.07]))
    (theta,) = assessment.parameters
    assert assessment.terms[0].verdict is Verdict.NOT_IDENTIFIABLE
    assert abs(theta.value + 0.07) > 5.0 * theta.standard_error
    assert theta.verdict is Verdict.WEAK
    assert "assumes the absence of terms[0]" in theta.reason


def test_one_order_of_terms_that_are_interchangeable():
    """An estimate with a value missing gives the others their places, however the search ended."""
    data = record((-0.1, -0.6), 2, seed=5)
    for estimate in ([-0.1, np.nan], [np.nan, -0.1]):
        given = np.array(estimate)
        found = assess(OutputErrorProblem([data], plant(2), (Exponential(),) * 2), given).parameters
        place = int(np.flatnonzero(np.isfinite(given))[0])
        assert found[place].value == pytest.approx(-0.1, abs=0.01)
        assert found[1 - place].value == pytest.approx(-0.6, abs=0.1)


def coarse(h):
    """Return samples of smooth signals every h seconds, simulated every millisecond."""
    fine = 1e-3 * np.arange(10_000)
    every = round(h / 1e-3)
    alpha = 1.2 + 0.5 * np.sin(2.0 * fine)
    delta = alpha * (np.exp(-3.8 * fine) - 0.78 * np.exp(-2.0 * fine))
    u = np.sin(2.5 * fine)
    y = simulate_lines((A, B, C, D), u + delta, fine, (1.0, -0.5))[::every]
    y = y + 1e-6 * np.random.default_rng(0).standard_normal(len(y))
    both = np.stack([alpha, alpha], axis=1)[::every]
    return DataSet(fine[::every], y[:, np.newaxis], u[::every, np.newaxis], both)


def test_a_term_that_errors_of_the_step_hide_is_said_to_be_so():
    """Noise is none of the reasons: a third of the step shows both terms, as the reason says."""
    start = np.array([-2.0, -3.8])
    found = assess_near(
        OutputErrorProblem([coarse(0.06)], plant(2), (Exponential(),) * 2), start
    ).parameters
    assert {one.verdict for one in found} == {Verdict.NOT_IDENTIFIABLE}
    for one in found:
        assert "linear interpolation between samples" in one.reason
        assert "less noise" not in one.reason
    shorter = assess_near(
        OutputErrorProblem([coarse(0.02)], plant(2), (Exponential(),) * 2), start
    ).parameters
    assert {one.verdict for one in shorter} == {Verdict.IDENTIFIABLE}
