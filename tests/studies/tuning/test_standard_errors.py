"""Standard errors agree with closed forms and with scipy's curve_fit, and cover what they say."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

from cosim.studies.tuning.result import statements
from cosim.studies.tuning.searching import TuningSearch, search_best
from cosim.studies.tuning.space import BoundedKey, SearchSpace
from cosim.studies.tuning.standard_errors import NoStandardErrors, standard_errors
from cosim.studies.tuning.trials import Trials
from tests.studies.tuning.curves import (
    DECAY,
    LINE,
    T,
    decay,
    errors_at_solution,
    errors_of_fit,
    fitted,
    line,
    rms_of,
)
from tests.studies.tuning.functions import OBJECTIVE, Recorded


def test_a_line_has_the_errors_of_linear_regression():
    """Of a line the sum of squares is quadratic: only rounding and the last move are left."""
    noise = np.random.default_rng(3).standard_normal(T.size)
    measured = line(T, 3.0, -2.0) + 0.1 * noise
    X = np.column_stack([T, np.ones_like(T)])
    solution, squares, *_ = np.linalg.lstsq(X, measured)
    covariance = squares[0] / (T.size - 2) * np.linalg.inv(X.T @ X)
    expected = np.sqrt(np.diag(covariance))
    result = fitted(line, LINE, measured)
    errors = result.errors
    assert list(errors.errors.values()) == pytest.approx(expected, rel=1e-3)
    assert list(result.best.point.values()) == pytest.approx(solution, abs=0.1 * expected.min())
    assert errors.deviation == pytest.approx(math.sqrt(squares[0] / (T.size - 2)), rel=1e-4)
    assert errors.correlation[0][1] == pytest.approx(
        covariance[0, 1] / expected[0] / expected[1], abs=1e-3
    )
    assert errors.skewed == ()


@pytest.mark.parametrize("deviation", [1e-6, 1e-2, 0.2])
def test_a_decay_has_the_errors_of_curve_fit(deviation):
    """curve_fit leaves the curvature of the model out: a part of about s over the amplitude."""
    measured = decay(T, 2.0, 3.0) + deviation * np.random.default_rng(1).standard_normal(T.size)
    solution, covariance = curve_fit(decay, T, measured, p0=[1.0, 1.0])
    expected = np.sqrt(np.diag(covariance))
    result = fitted(decay, DECAY, measured)
    assert len(result.trials) <= 120
    assert list(result.errors.errors.values()) == pytest.approx(expected, rel=0.01 + deviation)
    assert list(result.best.point.values()) == pytest.approx(solution, abs=0.1 * expected.min())


@pytest.mark.slow
def test_the_interval_of_a_logarithm_is_of_the_logarithm():
    """Its bounds stand symmetrically around the value on that scale."""
    measured = decay(T, 2.0, 3.0) + 0.2 * np.random.default_rng(1).standard_normal(T.size)
    low, high = fitted(decay, DECAY, measured).errors.intervals["a"]
    result = fitted(decay, DECAY, measured)
    assert math.sqrt(low * high) == pytest.approx(result.best.point["a"], rel=2e-3)


def test_noise_of_the_objective_lengthens_the_steps():
    """Noise of 1e-4 hides a rise by 1/N of 5e-3 for steps of one standard error, within 10 %."""
    measured = decay(T, 2.0, 3.0) + 0.01 * np.random.default_rng(1).standard_normal(T.size)
    _, covariance = curve_fit(decay, T, measured, p0=[1.0, 1.0])
    result = fitted(decay, DECAY, measured, noise=1e-4)
    expected = np.sqrt(np.diag(covariance))
    assert list(result.errors.errors.values()) == pytest.approx(expected, rel=0.1)


def test_noise_that_hides_the_curvature_is_said():
    measured = decay(T, 2.0, 3.0) + 0.01 * np.random.default_rng(1).standard_normal(T.size)
    result = fitted(decay, DECAY, measured, noise=0.1)
    assert result.errors is None
    assert "the objective is noisy (relative noise 0.0" in result.errors_problem
    assert "which hides its curvature" in statements(result)[-1]


def test_a_value_at_its_bound_has_no_standard_error():
    space = SearchSpace((LINE.bounded[0], BoundedKey("offset", -1.0, 10.0)))
    measured = line(T, 3.0, -2.0) + 0.1 * np.random.default_rng(3).standard_normal(T.size)
    result = fitted(line, space, measured)
    assert result.errors_problem == (
        "offset is at its bound; they hold for values between the bounds"
    )


def test_values_that_only_their_sum_matters_of_are_not_determined():
    def both(t, slope, offset):
        return (slope + offset) * t

    measured = both(T, 1.0, 2.0) + 0.1 * np.random.default_rng(3).standard_normal(T.size)
    result = fitted(both, LINE, measured)
    assert "the objective does not rise along a combination of slope, offset" in (
        result.errors_problem
    )


def almost_collinear(deviation):
    """Return the fit of two logarithms of which the data tell the sum well, and each hardly."""
    keys = [BoundedKey(name, 1e-200, 1e200, logarithmic=True) for name in "ab"]
    X = np.column_stack([T, T + 3e-3 * T**2])
    noise = deviation * np.random.default_rng(3).standard_normal(T.size)
    noise -= X @ np.linalg.lstsq(X, noise)[0]  # the best values are e, to rounding

    def logarithms(t, a, b):
        return X @ [math.log(a), math.log(b)]

    space = SearchSpace(tuple(keys))
    first = {"a": math.e, "b": math.e}
    return X, fitted(logarithms, space, logarithms(T, math.e, math.e) + noise, first=first)


def test_logarithms_that_are_hardly_determined_have_no_interval():
    """Its bounds would overflow; the standard deviation of either logarithm is about 640."""
    _, result = almost_collinear(3.0)
    assert result.errors is None
    assert result.errors_problem == (
        "the interval of a goes beyond all numbers: the data hardly determine a, b together"
    )


def test_an_interval_beyond_the_bounds_is_said_to_be_there():
    """Linear in the logarithms, so that linear regression has the same interval."""
    X, result = almost_collinear(1.0)
    squares = T.size * result.best.objective**2
    covariance = squares / (T.size - 2) * np.linalg.inv(X.T @ X)
    expected = np.sqrt(np.diag(covariance)) * math.e
    # its curvature is 1e-6 of the other one's: digits that a difference of squares has not
    assert list(result.errors.errors.values()) == pytest.approx(expected, rel=0.05)
    assert "the interval of a goes beyond its bounds" not in " ".join(statements(result))
    space = SearchSpace(tuple(replace(key, upper=1e100) for key in result.space.bounded))
    said = statements(replace(result, space=space))
    assert "the interval of b extends beyond its bounds, where nothing was tried" in said


def test_a_value_without_effect_is_not_determined():
    def first(t, slope, offset):
        return slope * t

    measured = first(T, 1.0, 2.0) + 0.1 * np.random.default_rng(3).standard_normal(T.size)
    result = fitted(first, LINE, measured)
    assert result.errors_problem == (
        "offset hardly changes the objective between its bounds: the data do not determine it there"
    )


def test_bounds_much_closer_than_the_standard_error_are_not_held_against_the_data():
    """The slope of the line has one of 0.07/sqrt(201/12) = 0.017."""
    space = SearchSpace((BoundedKey("slope", 3.0, 3.002), LINE.bounded[1]))
    measured = line(T, 3.001, -2.0)
    measured += 0.1 * np.cos(40.0 * np.pi * T)  # even about the middle: no slope
    assert fitted(line, space, measured).errors_problem == (
        "slope hardly changes the objective between its bounds: the data do not determine it there"
    )


def test_a_residual_of_zero_has_no_errors():
    result = fitted(line, LINE, line(T, 0.0, 0.0), first={"slope": 0.0, "offset": 0.0})
    assert result.best.objective == 0.0
    assert result.errors_problem == "the residual is zero"


@pytest.mark.parametrize("deviation", [1e-14, 1e-12, 1e-10])
def test_a_residual_of_rounding_has_no_errors_or_right_ones(deviation):
    """Values have 12 digits; the standard error of the slope is 0.24 deviations."""
    space = SearchSpace((BoundedKey("slope", 0.1, 10.0),))

    def slope_only(t, slope):
        return slope * t

    measured = slope_only(T, 0.7) + deviation * np.random.default_rng(3).standard_normal(T.size)
    result = fitted(slope_only, space, measured, starts=1)
    if deviation < 1e-10:
        assert "the objective is noisy" in result.errors_problem  # from rounded values
    else:
        _, covariance = curve_fit(slope_only, T, measured, p0=[0.7])
        expected = float(np.sqrt(covariance[0, 0]))
        assert result.errors.errors["slope"] == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("best", "problem"),
    [
        (0.7 + 1e-9, "the residual is zero"),
        (0.7 + 1e-9 + 1e-11, "that of slope would be below the 12 digits of its value: the resid"),
    ],
)
def test_a_recording_without_noise_has_no_errors_where_the_search_stopped_short(best, problem):
    """The optimum, to which the center moves, is met to the bit or only nearly."""
    space = SearchSpace((BoundedKey("slope", 0.1, 10.0),))
    truth = 0.7 if problem == "the residual is zero" else 0.7 + 3e-13
    trials = Trials(
        Recorded(lambda point: abs(point["slope"] - truth)), objective=OBJECTIVE, members=200
    )
    with pytest.raises(NoStandardErrors, match=problem):
        standard_errors(space, trials, {"slope": best}, 201)


def test_few_samples_are_refused():
    search = TuningSearch(LINE, OBJECTIVE, is_rms=True, with_errors=True, samples=2)
    result = search_best(Recorded(rms_of(line, line(T, 1.0, 1.0) + T**2)), search)
    assert result.errors_problem == "expected more samples than values, got 2 values from 2 samples"


def test_members_that_fail_beside_the_best_values_are_named():
    measured = line(T, 3.0, -2.0) + 0.1 * np.random.default_rng(3).standard_normal(T.size)
    rms = rms_of(line, measured)
    slope = np.polyfit(T, measured, 1)[0]

    def cliff(point):
        if point["slope"] > slope + 0.01:  # a third of a standard error
            raise ArithmeticError("too steep")
        return rms(point)

    search = TuningSearch(LINE, OBJECTIVE, is_rms=True, with_errors=True, samples=T.size)
    result = search_best(Recorded(cliff), search)
    assert result.errors_problem == "a member next to the best values fails: too steep"


def test_members_are_kept_for_the_errors_where_starts_would_use_all():
    measured = decay(T, 2.0, 3.0) + 0.01 * np.random.default_rng(1).standard_normal(T.size)
    result = fitted(decay, DECAY, measured, members=90, starts=100)
    assert result.errors is not None
    assert len(result.trials) <= 90


def test_the_assumptions_of_standard_errors_are_said():
    measured = line(T, 3.0, -2.0) + 0.1 * np.random.default_rng(3).standard_normal(T.size)
    assert statements(fitted(line, LINE, measured))[-1] == (
        "the standard errors assume that the 201 samples of the residual are white with a "
        "constant standard deviation (not checked)"
    )


def coverage(seeds, errors_of):
    """Return in how many of the seeds the interval of a and of k has the truth."""
    hits = np.zeros(2, int)
    for seed in range(seeds):
        measured = decay(T, 2.0, 3.0)
        measured += 0.02 * np.random.default_rng(seed).standard_normal(T.size)
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
