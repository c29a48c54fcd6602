"""Standard errors at the edge of what data determine, and how often intervals have the truth."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

from cosim.studies.search import BoundedKey, Search, SearchSpace, Trials
from cosim.studies.standard_errors import NoStandardErrors, standard_errors
from tests.studies.test_search import (
    DECAY,
    LINE,
    Recorded,
    T,
    decay,
    fitted,
    line,
    noisy,
    rms_of,
    search,
)


def almost_collinear(deviation):
    """Return the fit of two logarithms of which the data tell the sum well, and each hardly."""
    keys = [BoundedKey(name, 1e-200, 1e200, logarithmic=True) for name in "ab"]
    X = np.column_stack([T, T + 3e-3 * T**2])
    noise = noisy(np.zeros(T.size), deviation, seed=3)
    noise -= X @ np.linalg.lstsq(X, noise)[0]  # the best values are e, to rounding

    def logarithms(t, a, b):
        return X @ [math.log(a), math.log(b)]

    measured = logarithms(T, math.e, math.e) + noise
    first = {"a": math.e, "b": math.e}
    return X, fitted(logarithms, SearchSpace(tuple(keys)), measured, first=first)


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
    space = SearchSpace(tuple(replace(key, upper=1e100) for key in result.search.space.bounded))
    said = replace(result, search=replace(result.search, space=space)).statements
    assert "the interval of b extends beyond its bounds, where nothing was tried" in said
    _, result = almost_collinear(3.0)
    assert "the interval of a goes beyond all numbers" in result.errors_problem
    assert "a, b together" in result.errors_problem


@pytest.mark.parametrize("deviation", [1e-14, 1e-10])
def test_a_residual_of_rounding_has_no_errors_or_right_ones(deviation):
    """Values have 12 digits; the standard error of the slope is 0.24 deviations."""
    space = SearchSpace((BoundedKey("slope", 0.1, 10.0),))
    measured = noisy(0.7 * T, deviation, seed=3)
    result = fitted(lambda t, slope: slope * t, space, measured)
    if deviation < 1e-10:
        assert "the objective is noisy" in result.errors_problem  # from rounded values
    else:
        _, covariance = curve_fit(lambda t, slope: slope * t, T, measured, p0=[0.7])
        expected = float(np.sqrt(covariance[0, 0]))
        assert result.errors.errors["slope"] == pytest.approx(expected, rel=0.05)


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
    space = SearchSpace((BoundedKey("slope", 0.1, 10.0),))
    trials = Trials(Recorded(lambda point: abs(point["slope"] - truth)), Search(space))
    with pytest.raises(NoStandardErrors, match=problem):
        standard_errors(space, trials, {"slope": best}, 201)


def test_members_that_fail_beside_the_best_values_are_named():
    measured = noisy(line(T, 3.0, -2.0), 0.1, seed=3)
    rms = rms_of(line, measured)
    slope = np.polyfit(T, measured, 1)[0]

    def cliff(point):
        if point["slope"] > slope + 0.01:  # a third of a standard error
            raise ArithmeticError("too steep")
        return rms(point)

    result = search(cliff, LINE, is_rms=True, with_errors=True, samples=T.size)
    assert result.errors_problem == "a member next to the best values fails: too steep"


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
    trials = Trials(Recorded(rms_of(decay, measured)), Search(DECAY))
    return standard_errors(DECAY, trials, {"a": float(a), "k": float(k)}, T.size)


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
