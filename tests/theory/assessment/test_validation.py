"""Validation: a fit held against data that were not used in it."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cosim.theory.assessment.assessing import _assessed, _white, assess
from cosim.theory.assessment.validation import ValidationVerdict, validate
from cosim.theory.disturbances.families import Exponential, Sine
from cosim.theory.disturbed_plant import DataSet
from cosim.theory.estimators.output_error import OutputErrorProblem, fit_output_error
from tests.theory.academic import THETA, alpha
from tests.theory.closed_forms import static_plant
from tests.theory.experiments import (
    COARSE,
    FAMILIES,
    delta,
    design,
    noisy,
    record,
    simulate,
    times,
)

START = np.array([-0.05, -0.5])


@cache
def fitted(sigma, seed=1):
    """Assess good data."""
    data = noisy("good", sigma, seed, COARSE)
    return assess_near(OutputErrorProblem([data], design(), FAMILIES), START)


def assess_near(problem, start):
    """Assess the optimum that a start leads to, whether or not there is a better one."""
    return _assessed(_white(problem, start))


def other(sigma, seed, scale=(1.0, 1.0), x0=(0.0, 2.0)):
    """Return data of other amplitudes and another x(0)."""
    t = times(COARSE)
    y = simulate(t, delta(t) @ np.array(scale), x0=x0)
    return record(y + sigma * np.random.default_rng(seed).standard_normal(y.shape), COARSE)


@pytest.mark.parametrize("sigma", [0.0, 1e-5, 1e-3])
def test_other_amplitudes_and_another_start_are_the_same_model(sigma):
    """They are estimated anew; theta holds, and the residual is as large as that of the fit."""
    assessment = fitted(sigma)
    found = validate(assessment, other(sigma, 11, scale=(0.5, 2.0)))
    assert found.verdict is ValidationVerdict.HOLDS
    assert found.difference.passed
    if sigma:
        assert found.ratio == pytest.approx(1.0, abs=4.0 / np.sqrt(4001))
        np.testing.assert_allclose(found.fit.amplitudes[0], [0.5, 2.0], rtol=10.0 * sigma)
        assert found.consistency.passed
    np.testing.assert_array_equal(found.fit.theta, assessment.fit.theta)


@pytest.mark.parametrize(("j", "errors"), [(0, 10.0), (1, 10.0), (1, -10.0)])
def test_a_wrong_theta_shows_in_other_data(j, errors):
    """Ten standard errors are found, and said with the theta of these data."""
    assessment = fitted(1e-3)
    theta = assessment.fit.theta.copy()
    theta[j] += errors * assessment.fit.standard_error[j]
    moved = replace(assessment.fitted, fit=replace(assessment.fit, theta=theta))
    wrong = replace(assessment, fitted=moved)
    found = validate(wrong, other(1e-3, 12))
    assert found.verdict is ValidationVerdict.FAILS
    assert not found.difference.passed
    assert f"theta[{j}] is {found.own.fit.theta[j]:.6g}" in found.reason


def test_a_theta_that_has_changed_shows_in_the_residual():
    """Where theta was another one when the data of the fit were taken: size and tests say so."""
    t = times(COARSE)
    changed = alpha(t) * np.exp(np.outer(t, [-0.1, -0.4]))
    y = simulate(t, changed.sum(axis=1))
    data = record(y + 1e-3 * np.random.default_rng(1).standard_normal(y.shape), COARSE)
    assessment = assess_near(OutputErrorProblem([data], design(), FAMILIES), START)
    found = validate(assessment, other(1e-3, 13))
    assert found.verdict is ValidationVerdict.FAILS
    assert found.ratio > 1.5
    assert not found.consistency.passed
    assert found.own.fit.theta == pytest.approx(THETA, abs=5e-3)
    assert assessment.fit.theta == pytest.approx((-0.1, -0.4), abs=5e-3)


def test_a_change_of_a_strong_term_shows_beside_a_weak_one():
    """However much better its theta is known: of a sine, and of a ten millionth of it that decays.

    The statistic is the square of the change over the variances of both estimates.
    """
    t = 0.02 * np.arange(401)
    static = static_plant(2)

    def data(rate, seed):
        noise = 1e-6 * np.random.default_rng(seed).standard_normal(len(t))
        y = 1e3 * np.sin(rate * t) + 1e-4 * np.exp(-0.3 * t) + noise
        return DataSet(t, y[:, np.newaxis], np.zeros((len(t), 0)), np.ones((len(t), 2)))

    problem = OutputErrorProblem([data(2.0, 1)], static, (Sine(), Exponential()))
    assessment = assess_near(problem, np.array([2.0, -0.2]))
    strong, weak = assessment.fit.standard_error
    assert strong < 1e-7 * weak
    assert validate(assessment, data(2.0, 2)).verdict is ValidationVerdict.HOLDS
    change = 1e-8
    found = validate(assessment, data(2.0 + change, 2))
    assert found.verdict is ValidationVerdict.FAILS
    variance = strong**2 + found.own.fit.standard_error[0] ** 2
    assert found.difference.statistic == pytest.approx(change**2 / variance, rel=0.1)


def test_the_theta_that_differs_most_is_that_by_its_own_errors():
    """Not the one that is farthest off; and both values have the digits that tell them apart."""
    assessment = fitted(1e-5)
    theta = assessment.fit.theta.copy()
    # theta[1] is known a few times worse
    theta += np.array([30.0, 10.0]) * assessment.fit.standard_error
    assert abs(theta - assessment.fit.theta).argmax() == 1
    moved = replace(assessment.fitted, fit=replace(assessment.fit, theta=theta))
    found = validate(replace(assessment, fitted=moved), other(1e-5, 12))
    assert found.difference.largest == "theta[0]"
    there, here = re.search(r"theta\[0\] is (\S+) .*? there, (\S+)", found.reason).groups()
    difference = 30.0 * assessment.fit.standard_error[0]
    assert float(here) - float(there) == pytest.approx(difference, rel=0.2)


def test_a_fixed_theta_is_held_against_other_data():
    """Nothing is known of its error: it is taken as exact."""
    for value, verdict in ((-0.3, ValidationVerdict.HOLDS), (-0.32, ValidationVerdict.FAILS)):
        data = noisy("good", 1e-3, 1, COARSE)
        bounds = {1: (value, value)}
        assessment = assess_near(
            OutputErrorProblem([data], design(), FAMILIES, bounds=bounds), START
        )
        assert validate(assessment, other(1e-3, 14)).verdict is verdict


@pytest.mark.parametrize(
    "case",
    [
        "constant delta",
        pytest.param("sensor gain", marks=pytest.mark.campaign),
        pytest.param("A11", marks=pytest.mark.campaign),
    ],
)
def test_another_plant_fails(case):
    """With no theta is its residual what noise leaves."""
    assessment = fitted(1e-3)
    found = validate(assessment, noisy(case, 1e-3, 15, COARSE))
    assert found.verdict is ValidationVerdict.FAILS
    assert "with no theta does the model describe these data" in found.reason


def test_data_without_disturbance_test_nothing():
    """Theta has no effect there; of one absent component, its theta is named."""
    assessment = fitted(1e-3)
    nothing = validate(assessment, noisy("zero disturbance", 1e-3, 16, COARSE))
    assert nothing.verdict is ValidationVerdict.UNTESTED
    first = validate(assessment, noisy("first alone", 1e-3, 17, COARSE))
    assert first.verdict is ValidationVerdict.HOLDS
    assert "do not both determine theta[1]" in first.reason


@pytest.mark.parametrize("sigma", [0.0, 1e-3])
def test_a_fit_without_theta_tests_nothing(sigma):
    """Of data without disturbance: what stands for theta is no start for the other data."""
    data = noisy("zero disturbance", sigma, 1, COARSE)
    assessment = assess(OutputErrorProblem([data], design(), FAMILIES))
    found = validate(assessment, noisy("good", sigma, 2, COARSE))
    assert found.verdict is ValidationVerdict.UNTESTED
    assert found.own.fit.theta == pytest.approx(THETA, abs=5e-3)


def test_more_noise_is_no_other_model():
    """The ratio says how much more; the verdict is on the model."""
    assessment = fitted(1e-3)
    found = validate(assessment, other(5e-3, 18))
    assert found.verdict is ValidationVerdict.HOLDS
    assert found.ratio == pytest.approx(5.0, rel=0.1)


@pytest.mark.campaign
def test_good_data_rarely_fail():
    """The test has the probability of a false alarm that it states: 3e-4, and its own verdict's."""
    failures = 0
    for seed in range(200):
        assessment = fitted(1e-3, seed=1000 + seed)
        found = validate(assessment, other(1e-3, 5000 + seed))
        failures += found.verdict is not ValidationVerdict.HOLDS
    assert failures <= 2


def test_the_held_fit_has_no_error_of_theta():
    """All covariance is that of the linear unknowns."""
    assessment = fitted(1e-3)
    found = validate(assessment, other(1e-3, 19))
    assert not found.fit.covariance.any()
    free = fit_output_error([noisy("good", 1e-3, 1, COARSE)], design(), FAMILIES, START)
    assert found.fit.freedom == free.freedom + 2
