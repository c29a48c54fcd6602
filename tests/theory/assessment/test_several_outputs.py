"""Several outputs: each counts by its noise, which is estimated where it is not stated."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.signal import lfilter

from cosim.theory.assessment.assessing import assess, assess_near
from cosim.theory.assessment.noise_covariance import fit_with_noise
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, NoiseModel
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem
from tests.theory.academic import THETA, alpha
from tests.theory.experiments import FAMILIES, design, times
from tests.theory.straight_lines import simulate_lines

H = 2e-2  # s
START = np.array([-0.05, -0.5])
SIGMA = np.array([1e-1, 1e-3])  # what the first says is as good as nothing
GOOD = [Verdict.IDENTIFIABLE, Verdict.IDENTIFIABLE]


def two_outputs(scale: float = 1.0) -> DisturbedPlant:
    """Return the example with a second sensor, whose unit is ``scale`` times smaller."""
    one = design()
    return DisturbedPlant(
        A=one.A,
        B=one.B,
        Bd=one.Bd,
        C=np.vstack([one.C, scale * np.array([[1.0, 0.5]])]),
        D=np.vstack([one.D, np.zeros((1, 1))]),
        Dd=np.zeros((2, 2)),
    )


def response(plant: DisturbedPlant, theta=THETA, amplitudes=(1.0, 1.0), x0=(1.0, -1.0)):
    """Compute y exactly for straight lines between samples."""
    t = times(H)
    u = np.sin(t)
    parts = alpha(t) * np.exp(np.outer(t, theta)) * np.asarray(amplitudes)
    forcing = np.column_stack([u, parts])
    B = np.hstack([plant.B, plant.Bd])
    D = np.hstack([plant.D, plant.Dd])
    return simulate_lines((plant.A, B, plant.C, D), forcing, t, x0)


def record(y) -> DataSet:
    """Return samples as a data set."""
    t = times(H)
    return DataSet(t, y, np.sin(t)[:, np.newaxis], alpha(t))


def bound(plant: DisturbedPlant, covariance) -> np.ndarray:
    """Compute the Cramer-Rao bound of theta, amplitudes and x(0) unknown, by differences."""
    p = np.concatenate([THETA, [1.0, 1.0], [1.0, -1.0]])
    W = np.linalg.inv(np.linalg.cholesky(covariance))
    columns = []
    for j in range(len(p)):
        step = np.zeros(len(p))
        step[j] = 1e-4
        ends = [response(plant, q[:2], q[2:4], q[4:]) for q in (p + step, p - step)]
        columns.append(((ends[0] - ends[1]) @ W.T).ravel() / 2e-4)
    J = np.stack(columns, axis=1)
    return np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[:2]


def campaign(covariance, seeds: range):
    """Return errors, whether the intervals miss, and verdicts, one row a seed."""
    plant = two_outputs()
    y = response(plant)
    factor = np.linalg.cholesky(covariance)
    errors = []
    misses = []
    verdicts = []
    for seed in seeds:
        noise = np.random.default_rng(seed).standard_normal(y.shape) @ factor.T
        found = assess_near(OutputErrorProblem([record(y + noise)], plant, FAMILIES), START)
        error = found.fit.theta - THETA
        errors.append(error)
        misses.append(np.abs(error) > found.half_width)
        verdicts.append([one.verdict for one in found.parameters])
    return np.array(errors), np.array(misses), verdicts


def test_a_bad_output_costs_nothing_where_nothing_is_stated():
    """The error is that of the Cramer-Rao bound for the true covariance.

    The ratio is that within 4 of its own standard errors, 1/sqrt(2 * 8 * 2); the standard errors
    are the bound to 5 %.
    """
    plant = two_outputs()
    expected = bound(plant, np.diag(SIGMA**2))
    white = NoiseModel(covariance=np.eye(2), a=np.zeros((2, 0)))
    errors = []
    for seed in range(8):
        data = [record(noisy(seed=seed))]
        fitted = fit_with_noise(OutputErrorProblem(data, plant, FAMILIES), START, white)
        errors.append(fitted.fit.theta - THETA)
        np.testing.assert_allclose(fitted.noise.deviations, SIGMA, rtol=0.05)
        np.testing.assert_allclose(fitted.fit.standard_error, expected, rtol=0.05)
    ratio = np.sqrt(np.mean((np.array(errors) / expected) ** 2))
    assert 1.0 - 4.0 / np.sqrt(32.0) < ratio < 1.0 + 4.0 / np.sqrt(32.0)


@pytest.mark.campaign
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_errors_and_intervals_of_two_outputs(correlation):
    """RMS error over the bound within 0.9 to 1.15, coverage of the intervals 93 to 97 %."""
    covariance = np.diag(SIGMA**2)
    covariance[0, 1] = covariance[1, 0] = correlation * SIGMA.prod()
    expected = bound(two_outputs(), covariance)
    errors, misses, verdicts = campaign(covariance, range(1000))
    assert sum(found == GOOD for found in verdicts) >= 995
    ratio = np.sqrt(np.mean((errors / expected) ** 2, axis=0))
    assert (ratio > 0.9).all()
    assert (ratio < 1.15).all()
    coverage = 1.0 - misses.mean(axis=0)
    assert (coverage >= 0.93).all()
    assert (coverage <= 0.97).all()


def noisy(sigma=SIGMA, seed: int = 1, scale: float = 1.0):
    """Return the response with white noise on each output, in units of its own."""
    y = response(two_outputs(scale))
    return y + np.array([1.0, scale]) * sigma * np.random.default_rng(seed).standard_normal(y.shape)


def test_units_of_the_outputs_do_not_count():
    """A sensor in another unit has another noise: theta is the same, also where it is searched.

    What the weights leave of the unit is their own tolerance, 1 %, in a small part of an error.
    """
    found = []
    for scale in (1.0, 1e6):
        assessment = assess(
            OutputErrorProblem([record(noisy(scale=scale))], two_outputs(scale), FAMILIES)
        )
        found.append(assessment)
    one, other = found
    error = one.fit.standard_error
    assert (np.abs(other.fit.theta - one.fit.theta) < 0.02 * error).all()
    np.testing.assert_allclose(other.fit.standard_error, error, rtol=0.01)
    assert [parameter.verdict for parameter in other.parameters] == GOOD


def test_correlated_noise_is_estimated_with_its_correlation():
    """Standard errors are the bound for the true covariance, which they are not without it."""
    covariance = np.diag(SIGMA**2)
    covariance[0, 1] = covariance[1, 0] = 0.9 * SIGMA.prod()
    factor = np.linalg.cholesky(covariance)
    y = response(two_outputs())
    noise = np.random.default_rng(4).standard_normal(y.shape) @ factor.T
    assessment = assess_near(
        OutputErrorProblem([record(y + noise)], two_outputs(), FAMILIES), START
    )
    found = assessment.noise.covariance
    assert found[0, 1] / np.sqrt(found[0, 0] * found[1, 1]) == pytest.approx(0.9, abs=0.02)
    np.testing.assert_allclose(
        assessment.fit.standard_error, bound(two_outputs(), covariance), rtol=0.05
    )


@pytest.mark.parametrize("level", [0.0, 2.0**-10])
def test_an_output_without_noise_gets_no_infinite_weight(level):
    """It is taken for as exact as step, quantization and rounding leave it; the interval holds."""
    y = noisy(np.array([1e-1, 0.0]))
    if level:
        y[:, 1] = level * np.round(y[:, 1] / level)
    assessment = assess_near(OutputErrorProblem([record(y)], two_outputs(), FAMILIES), START)
    assert [one.verdict for one in assessment.parameters] == GOOD
    for one, true in zip(assessment.parameters, THETA, strict=True):
        assert one.lower <= true <= one.upper
    accuracy = assessment.consistency.accuracy[0].deviations
    assert assessment.deviations[0] == pytest.approx(0.1, rel=0.05)
    assert accuracy[1] <= 1.01 * assessment.deviations[1]
    assert assessment.deviations[1] < 1.5 * accuracy[1]


def test_noise_of_one_output_alone_may_be_colored():
    """Each output has a model of its own: that of the white one is none."""
    y = response(two_outputs())
    white = SIGMA * np.random.default_rng(5).standard_normal(y.shape)
    white[:, 1] = lfilter([1.0], [1.0, -0.8], white[:, 1])
    assessment = assess_near(
        OutputErrorProblem([record(y + white)], two_outputs(), FAMILIES), START
    )
    assert [one.verdict for one in assessment.parameters] == GOOD
    a = assessment.noise.a
    assert a[1, 0] == pytest.approx(0.8, abs=0.05)
    np.testing.assert_array_equal(a[0], 0.0)
    np.testing.assert_allclose(assessment.deviations, SIGMA, rtol=0.05)


def test_a_stated_covariance_weighs_the_outputs():
    """Stated right it holds; theta is that of the estimated one but for a part of its error."""
    data = [record(noisy())]
    stated = assess_near(
        OutputErrorProblem(data, two_outputs(), FAMILIES, stated=np.diag(SIGMA**2)), START
    )
    estimated = assess_near(OutputErrorProblem(data, two_outputs(), FAMILIES), START)
    assert [one.verdict for one in stated.parameters] == GOOD
    apart = np.abs(stated.fit.theta - estimated.fit.theta)
    assert (apart < 0.1 * stated.fit.standard_error).all()
    np.testing.assert_allclose(stated.deviations, SIGMA, rtol=0.05)


@pytest.mark.parametrize(
    ("stated", "text"),
    [
        ([1e-1, 1e-4], r"deviation of y\[1\] over the stated one: (9|10).*stated 0.0001"),
        ([1e-1, 1e-2], r"stated deviation over that of y\[1\]: (9|10).*stated 0.01"),
        ([1.0, 1e-3], r"stated deviation over that of y\[0\]: .*stated 1"),
    ],
)
def test_a_residual_of_another_size_than_stated_is_said(stated, text):
    """Much larger or much smaller: the statement and the data exclude each other."""
    covariance = np.diag(np.square(stated))
    assessment = assess_near(
        OutputErrorProblem([record(noisy())], two_outputs(), FAMILIES, stated=covariance), START
    )
    for one in assessment.parameters:
        assert one.verdict is Verdict.INCONSISTENT
        assert re.search(text, one.reason)


def test_a_wrong_model_of_one_output_is_seen_beside_a_good_one():
    """5 % in the gain of the exact sensor, while the other one is as good as nothing."""
    y = noisy()
    y[:, 1] *= 1.05
    assessment = assess_near(OutputErrorProblem([record(y)], two_outputs(), FAMILIES), START)
    assert [one.verdict for one in assessment.parameters] == 2 * [Verdict.INCONSISTENT]
