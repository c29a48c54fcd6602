"""Standard errors are those of regression, also at the edge of what data determine."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

from cosim.studies.search import BoundedKey, Trials
from cosim.studies.standard_errors import NoStandardErrors, errors_at
from cosim.studies.tuning_result import search_best
from tests.studies.test_search import Recorded, planned

T = np.linspace(0.0, 1.0, 201)
LINE = (BoundedKey("slope", -10.0, 10.0), BoundedKey("offset", -10.0, 10.0))
DECAY = (BoundedKey("a", 0.1, 10.0, True), BoundedKey("k", 0.1, 100.0))
SLOPE = (BoundedKey("slope", 0.1, 10.0),)


def line(t, slope, offset):
    return slope * t + offset


def decay(t, a, k):
    return a * np.exp(-k * t)


def noisy(values, deviation, seed=3):
    return values + deviation * np.random.default_rng(seed).standard_normal(T.size)


def rms_of(model, measured, noise=0.0):
    """Return the rms of the residual; with noise, as a solver with step control has it."""

    def rms(point):
        exact = math.sqrt(np.mean((model(T, *point.values()) - measured) ** 2))
        return exact * (1.0 + noise * (math.modf(1e5 * sum(point.values()) * math.pi)[0] - 0.5))

    return rms


def fitted(model, keys, measured, noise=0.0, first=(), **options):
    """Search the parameters of a curve."""
    search = planned(keys, **{"expression": "rms(e)", "starts": 1, **options})
    run = Recorded(rms_of(model, measured, noise))
    return search_best(run, search, dict(first), with_errors=True, samples=T.size)


def test_a_line_has_the_errors_of_linear_regression():
    """Its sum of squares is quadratic: only rounding and the last move are left."""
    measured = noisy(line(T, 3.0, -2.0), 0.1)
    X = np.column_stack([T, np.ones_like(T)])
    solution, squares, *_ = np.linalg.lstsq(X, measured)
    covariance = squares[0] / (T.size - 2) * np.linalg.inv(X.T @ X)
    expected = np.sqrt(np.diag(covariance))
    result = fitted(line, LINE, measured)
    errors = result.errors
    assert list(errors.errors.values()) == pytest.approx(expected, rel=1e-3)
    assert list(result.best.point.values()) == pytest.approx(solution, abs=0.1 * expected.min())
    assert errors.deviation == pytest.approx(math.sqrt(squares[0] / (T.size - 2)), rel=1e-4)
    correlation = covariance[0, 1] / expected[0] / expected[1]
    assert errors.correlation[0][1] == pytest.approx(correlation, abs=1e-3)


@pytest.mark.parametrize(
    ("deviation", "noise"), [(1e-6, 0.0), (1e-2, 0.0), (0.2, 0.0), (1e-2, 1e-4)]
)
def test_a_decay_has_the_errors_of_curve_fit(deviation, noise):
    """curve_fit leaves the curvature of the model out; noise of the objective is seen through."""
    measured = noisy(decay(T, 2.0, 3.0), deviation, seed=1)
    _, covariance = curve_fit(decay, T, measured, p0=[1.0, 1.0])
    result = fitted(decay, DECAY, measured, noise)
    most = 0.1 if noise else 0.01 + deviation
    errors = list(result.errors.errors.values())
    assert errors == pytest.approx(np.sqrt(np.diag(covariance)), rel=most)
    low, high = result.errors.intervals["a"]
    assert math.sqrt(low * high) == pytest.approx(result.best.point["a"], rel=2e-2)


@pytest.mark.parametrize(
    ("model", "keys", "noise", "words"),
    [
        (decay, DECAY, 0.1, "the objective is noisy"),
        (line, (LINE[0], BoundedKey("offset", -1.0, 10.0)), 0.0, "at its bound"),
        (lambda t, a, b: (a + b) * t, LINE, 0.0, "along a combination of slope, offset"),
        (lambda t, a, b: a * t, LINE, 0.0, "offset hardly changes the objective"),
    ],
)
def test_values_that_data_do_not_determine_have_no_standard_error(model, keys, noise, words):
    """And it is said why."""
    measured = noisy(line(T, 3.0, -2.0) if model is line else model(T, 1.0, 2.0), 0.1)
    result = fitted(model, keys, measured, noise)
    assert result.errors is None
    assert words in result.statements[-1]


def almost_collinear(deviation):
    """Return the fit of two logarithms of which the data tell the sum well, and each hardly."""
    keys = tuple(BoundedKey(name, 1e-200, 1e200, logarithmic=True) for name in "ab")
    X = np.column_stack([T, T + 3e-3 * T**2])
    noise = noisy(np.zeros(T.size), deviation)
    noise -= X @ np.linalg.lstsq(X, noise)[0]  # the best values are e, to rounding

    def logarithms(t, a, b):
        return X @ [math.log(a), math.log(b)]

    measured = logarithms(T, math.e, math.e) + noise
    return X, fitted(logarithms, keys, measured, first={"a": math.e, "b": math.e})


def test_an_interval_may_go_beyond_the_bounds_and_beyond_all_numbers():
    """Linear in the logarithms, so that linear regression has the same interval.

    The standard deviation of either logarithm is about 640 for three times the noise.
    """
    X, result = almost_collinear(1.0)
    squares = T.size * result.best.objective**2
    covariance = squares / (T.size - 2) * np.linalg.inv(X.T @ X)
    expected = np.sqrt(np.diag(covariance)) * math.e
    # its curvature is 1e-6 of the other one's: digits that a difference of squares has not
    assert list(result.errors.errors.values()) == pytest.approx(expected, rel=0.05)
    assert "beyond its bounds" not in " ".join(result.statements)
    keys = tuple(replace(key, upper=1e100) for key in result.search.keys)
    said = replace(result, search=replace(result.search, keys=keys)).statements
    assert "the interval of b extends beyond its bounds, where nothing was tried" in said
    _, result = almost_collinear(3.0)
    assert "the interval of a goes beyond all numbers" in result.errors_problem
    assert "a, b together" in result.errors_problem


def test_a_residual_of_rounding_has_no_errors_or_right_ones():
    """Values have 12 digits; the standard error of the slope is 0.24 deviations."""
    found = [fitted(lambda t, slope: slope * t, SLOPE, noisy(0.7 * T, d)) for d in (1e-14, 1e-10)]
    assert "the objective is noisy" in found[0].errors_problem  # from rounded values
    measured = noisy(0.7 * T, 1e-10)
    _, covariance = curve_fit(lambda t, slope: slope * t, T, measured, p0=[0.7])
    expected = math.sqrt(covariance[0, 0])
    assert found[1].errors.errors["slope"] == pytest.approx(expected, rel=0.05)


def errors_beside(function, keys, point):
    """Return the standard errors of a point that was tried."""
    trials = Trials(Recorded(function), planned(keys))
    return errors_at(trials, trials.try_points([point])[0], T.size)


@pytest.mark.parametrize(
    ("truth", "best", "problem"),
    [
        (0.7, 0.7 + 1e-9, "the residual is zero"),
        (0.7 + 3e-13, 0.7 + 1e-9 + 1e-11, "that of slope would be below the 12 digits"),
    ],
)
def test_a_recording_without_noise_has_no_errors_where_the_search_stopped_short(
    truth, best, problem
):
    """The optimum, to which the center moves, is met to the bit or only nearly."""
    with pytest.raises(NoStandardErrors, match=problem):
        errors_beside(lambda point: abs(point["slope"] - truth), SLOPE, {"slope": best})


def test_members_that_fail_beside_the_best_values_are_named():
    measured = noisy(line(T, 3.0, -2.0), 0.1)
    slope, offset = np.polyfit(T, measured, 1)

    def cliff(point):
        if point["slope"] > slope + 0.01:  # a third of a standard error
            raise ArithmeticError("too steep")
        return rms_of(line, measured)(point)

    with pytest.raises(NoStandardErrors, match="next to the best values fails: too steep"):
        errors_beside(cliff, LINE, {"slope": float(slope), "offset": float(offset)})


def test_members_are_kept_for_the_errors_where_starts_would_use_all():
    result = fitted(decay, DECAY, noisy(decay(T, 2.0, 3.0), 0.01), members=90, starts=100)
    assert result.errors is not None
    assert len(result.trials) <= 90


def errors_of_fit(measured):
    """Return the standard errors of a decay, after the search of a tuning."""
    return fitted(decay, DECAY, measured).errors


def errors_at_solution(measured):
    """Return the standard errors of a decay where curve_fit ends."""
    (a, k), _ = curve_fit(decay, T, measured, p0=[2.0, 3.0])
    return errors_beside(rms_of(decay, measured), DECAY, {"a": float(a), "k": float(k)})


def coverage(seeds, errors_of):
    """Return in how many of the seeds the interval of a and of k has the truth."""
    hits = np.zeros(2, int)
    for seed in range(seeds):
        measured = noisy(decay(T, 2.0, 3.0), 0.02, seed)
        (a_low, a_high), (k_low, k_high) = errors_of(measured).intervals.values()
        hits += [a_low < 2.0 < a_high, k_low < 3.0 < k_high]
    return hits


def test_intervals_have_the_truth_about_as_often_as_they_say():
    """Of 100 seeds 95: fewer than 88 have a probability of 0.15 %, all of 100 one of 0.6 %."""
    hits = coverage(100, errors_at_solution)
    assert ((hits >= 88) & (hits < 100)).all()


@pytest.mark.campaign
def test_intervals_have_the_truth_as_often_as_they_say():
    """Of 1000 seeds 950, with a deviation of 6.9; within four of them."""
    assert np.abs(coverage(1000, errors_of_fit) - 950).max() <= 28
