"""Colored noise: its model is that of the noise, and the intervals are those that it allows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from cosim.theory.assessment.assessing import assess_near
from cosim.theory.assessment.noise_color import (
    ColoredRecord,
    Criterion,
    autoregression,
    correlation_length,
    largest_power,
)
from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, counted_values
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem
from cosim.theory.quantiles import chi_square_above, ratio_above
from tests.theory.straight_lines import simulate_lines

RATE = -0.3
SIGMA = 1e-3
A = np.array([[0.0, 1.0], [-2.0, -0.8]])
B = np.array([[0.0], [1.0]])
C = np.array([[1.0, 0.0]])
PLANT = DisturbedPlant(A=A, B=B, Bd=B, C=C, D=np.zeros((1, 1)), Dd=np.zeros((1, 1)))


def signals(N):
    """Return times, input and alpha."""
    t = 0.02 * np.arange(N)
    return t, np.sin(1.1 * t) + 0.5 * np.sin(2.9 * t + 1.0), 1.3 + 0.4 * np.sin(1.7 * t)


def response(N, p, matrix=A):
    """Compute y for (theta, amplitude, x(0)), for straight lines between samples."""
    t, u, alpha = signals(N)
    forcing = u + p[1] * alpha * np.exp(p[0] * t)
    return simulate_lines((matrix, B, C, np.zeros((1, 1))), forcing, t, p[2:])


TRUE = np.array([RATE, 1.0, 1.0, -0.5])


def bound(N, a):
    """Return the Cramer-Rao bound of theta for noise of a known autoregressive model."""
    columns = []
    for j in range(len(TRUE)):
        step = np.zeros(len(TRUE))
        step[j] = 1e-4
        slope = (response(N, TRUE + step) - response(N, TRUE - step)) / 2e-4
        columns.append(lfilter(np.concatenate([[1.0], -np.asarray(a)]), [1.0], slope)[len(a) :])
    J = np.array(columns).T
    return SIGMA * float(np.sqrt(np.linalg.inv(J.T @ J)[0, 0]))


def noise(N, a, seed):
    """Return stationary noise of an autoregressive model."""
    white = np.random.default_rng(seed).standard_normal(N + 500)
    return SIGMA * lfilter([1.0], np.concatenate([[1.0], -np.asarray(a)]), white)[500:]


def record(N, disturbing, matrix=A):
    """Return the response with noise as a data set."""
    t, u, alpha = signals(N)
    y = response(N, TRUE, matrix) + disturbing
    return DataSet(t, y[:, np.newaxis], u[:, np.newaxis], alpha[:, np.newaxis])


def assessed(N, disturbing, **options):
    """Assess the response with noise."""
    data = record(N, disturbing, **options)
    return assess_near(OutputErrorProblem([data], PLANT, (Exponential(),)), np.array([RATE]))


@pytest.mark.parametrize(("a", "N"), [(0.5, 1001), (0.8, 1001), (0.95, 5001)])
def test_slow_directions_take_nothing_from_the_color(a, N):
    """Beside 31 cosines, which hold much of the power, the coefficient is that of the noise.

    In the mean over 4 records to 4 of its standard errors; the error has no smaller variance than
    (1 - a^2)/N, and less than twice that for these N.
    """
    cosines = np.cos(np.pi * np.outer(np.linspace(0.0, 1.0, N), np.arange(31)))
    found = []
    for seed in range(4):
        colored = ColoredRecord(noise(N, [a], seed), cosines, np.ones(N, bool))
        found.append(autoregression([colored], Criterion.SCHWARZ).a.sum())
    error = np.sqrt(2.0 * (1.0 - a**2) / N / len(found))
    assert np.mean(found) == pytest.approx(a, abs=4.0 * error)


def test_gaps_end_the_windows_of_a_model():
    """A sample counts where those before it are there; the coefficients are the same as without."""
    N = 20_001
    measured = np.random.default_rng(1).random(N) > 0.1
    whole = counted_values(np.where(measured, np.arange(N), -1)[:, np.newaxis], 2)[:, 0]
    expected = [k >= 2 and bool(measured[k - 2 : k + 1].all()) for k in range(N)]
    np.testing.assert_array_equal(whole, expected)
    a = np.array([1.2, -0.6])
    colored = ColoredRecord(noise(N, a, 3) * measured, np.ones((N, 1)), measured)
    model = autoregression([colored], Criterion.SCHWARZ)
    assert len(model.a) == 2
    # 4 of the asymptotic standard errors, sqrt((1 - a_2^2) / N) each, with half of the windows
    np.testing.assert_allclose(model.a, a, atol=4.0 * np.sqrt((1.0 - 0.36) / (0.5 * N)))


def test_the_memory_of_noise_is_that_of_its_autocorrelations(subtests):
    """Of a first order their squares are a geometric series, (1 + a^2)/(1 - a^2)."""
    for a in [0.0, 0.5, 0.95, -0.6]:
        with subtests.test(a=a):
            expected = (1.0 + a**2) / (1.0 - a**2)
            assert correlation_length(np.array([a])) == pytest.approx(expected, rel=1e-9)
            assert correlation_length(np.array([1.001])) == np.inf


def test_the_largest_power_of_noise_is_that_of_its_spectrum(subtests):
    """Of a first order (1 + |a|)/(1 - |a|) times the mean, at an end of the spectrum."""
    for a in [0.0, 0.5, 0.95, -0.6]:
        with subtests.test(a=a):
            expected = (1.0 + abs(a)) / (1.0 - abs(a))
            assert largest_power(np.array([a])) == pytest.approx(expected, rel=1e-9)


def test_a_ratio_with_a_known_scale_is_a_chi_square():
    """And one of one degree each is the square of Student's t: tan(pi (1 - p) / 2)^2."""
    assert ratio_above(1e-3, 7.0, 1e9) == pytest.approx(chi_square_above(1e-3, 7.0), rel=1e-5)
    expected = np.tan(0.5 * np.pi * (1.0 - 1e-3)) ** 2
    assert ratio_above(1e-3, 1.0, 1.0) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("a", "N"), [((0.8,), 1001), ((1.2, -0.6), 1001)])
def test_intervals_under_colored_noise_are_those_of_its_bound(a, N):
    """Standard errors are the bound for the known color: to 35 % each, to 15 % in the mean."""
    ratios = []
    for seed in range(4):
        assessment = assessed(N, noise(N, a, seed))
        assert assessment.parameters[0].verdict is Verdict.IDENTIFIABLE
        ratios.append(float(assessment.fit.standard_error[0]) / bound(N, a))
    np.testing.assert_allclose(ratios, 1.0, atol=0.35)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)


def test_a_running_mean_as_noise_is_whitened_by_a_longer_model():
    """Of two samples: its zero on the circle needs many coefficients; the interval then holds.

    Where the response is, at low frequencies, its power is that of white noise times 4.
    """
    white = np.random.default_rng(2).standard_normal(2002)
    assessment = assessed(2001, SIGMA * np.convolve(white, np.ones(2), "valid"))
    parameter = assessment.parameters[0]
    assert parameter.verdict is Verdict.IDENTIFIABLE
    assert parameter.lower <= RATE <= parameter.upper
    expected = 2.0 * bound(2001, ())
    assert float(assessment.fit.standard_error[0]) == pytest.approx(expected, rel=0.35)


def test_noise_that_is_correlated_over_too_much_of_the_record_is_said_to_be_so():
    """It is no statement that the model is wrong: another record could tell."""
    assessment = assessed(1001, noise(1001, [0.98], 1))
    parameter = assessment.parameters[0]
    assert parameter.verdict is Verdict.INCONSISTENT
    assert "noise that is correlated over" in parameter.reason
    assert "are too few to tell such noise from a wrong model" in parameter.reason


def test_noise_that_no_model_here_describes_is_said_to_be_so():
    """The mean of 5 samples has zeros all over the circle; a wrong model is not the only cause."""
    white = np.random.default_rng(5).standard_normal(2005)
    assessment = assessed(2001, SIGMA * np.convolve(white, np.ones(5), "valid"))
    parameter = assessment.parameters[0]
    assert parameter.verdict is Verdict.INCONSISTENT
    assert "are too few to tell such noise from a wrong model" in parameter.reason


@pytest.mark.parametrize("a", [(0.8,), (1.2, -0.6)])
def test_gaps_do_not_make_colored_noise_a_wrong_model(a):
    """One sample in ten is missing: models begin anew behind each, in the fit and in its tests."""
    data = record(2001, noise(2001, a, 4))
    y = data.y.copy()
    y[np.random.default_rng(9).random(2001) < 0.1] = np.nan
    assessment = assess_near(
        OutputErrorProblem([replace(data, y=y)], PLANT, (Exponential(),)), np.array([RATE])
    )
    parameter = assessment.parameters[0]
    assert parameter.verdict is Verdict.IDENTIFIABLE
    assert parameter.lower <= RATE <= parameter.upper
    # fewer windows, and never less than without gaps
    ratio = float(assessment.fit.standard_error[0]) / bound(2001, a)
    assert 0.8 < ratio < 1.6


@pytest.mark.parametrize("a", [0.0, 0.8])
def test_a_wrong_model_is_one_under_any_noise(a):
    """A stiffness wrong by 5 % is found beside white and colored noise alike."""
    wrong = A * np.array([[1.0, 1.0], [1.05, 1.0]])
    assessment = assessed(2001, noise(2001, [a], 2), matrix=wrong)
    assert assessment.parameters[0].verdict is Verdict.INCONSISTENT


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("a", "N"),
    [((0.5,), 1001), ((0.8,), 1001), ((1.2, -0.6), 1001), ((0.9,), 2001), ((0.95,), 5001)],
)
def test_coverage_under_colored_noise_over_200_seeds(a, N):
    """At most 4 alarms; 92 to 98 % of the intervals hold."""
    alarms = missed = 0
    for seed in range(200):
        parameter = assessed(N, noise(N, a, seed)).parameters[0]
        alarms += parameter.verdict is not Verdict.IDENTIFIABLE
        missed += not parameter.lower <= RATE <= parameter.upper
    print(f"a = {a}, {N} samples: {alarms} alarms, {missed} missed of 200")
    assert alarms <= 4
    assert 4 <= missed <= 16
