"""Searches find what can be found, go on where they ended, and say no more than they know."""

import math

import numpy as np
import pytest
from scipy.optimize import curve_fit

from cosim.errors import UsageError
from cosim.studies.contracts import COMPLETE, FAILED, MemberOutcome
from cosim.studies.search import (
    METHODS,
    OBJECTIVE,
    BoundedKey,
    ChoiceKey,
    Search,
    SearchSpace,
    value_name,
)
from cosim.studies.tuning import search_best

# optuna is not there where the slow tests are left out
EACH_METHOD = [
    pytest.param(method, marks=pytest.mark.slow) if method == "optuna" else method
    for method in METHODS
]
PLANE = SearchSpace((BoundedKey("x", -2.0, 2.0), BoundedKey("y", 1e-3, 1e3, logarithmic=True)))
ONE = SearchSpace((BoundedKey("x", -2.0, 2.0),))


class Recorded:
    """Evaluates a function of points; knows which it was given, at a time."""

    def __init__(self, function):
        self.function = function
        self.batches = []

    def __call__(self, points):
        self.batches.append([dict(point) for point in points.values()])
        for number, point in points.items():
            try:
                metrics = {OBJECTIVE: self.function(point)}
                yield MemberOutcome(number, COMPLETE, metrics=metrics)
            except ArithmeticError as error:
                yield MemberOutcome(number, FAILED, reason=str(error))


def bowl(point):
    """Return a bowl with its lowest point 3 at x = 0.5, y = 20."""
    x = point["x"] - 0.5
    y = math.log10(point["y"] / 20.0)
    return 3.0 + x * x + y * y + 0.5 * x * y


def two_valleys(point):
    """Return two: the lower one, of -1 at x = 1.5, is narrow; the wide one has 0 at x = -1."""
    x = point["x"]
    return min((x + 1.0) ** 2, -1.0 + 25.0 * (x - 1.5) ** 2)


def search(function, space=PLANE, **options):
    return search_best(Recorded(function), Search(space, **options))


def points(result):
    return [trial.point for trial in result.trials]


@pytest.mark.parametrize("method", EACH_METHOD)
def test_every_method_comes_close_to_the_lowest_point_of_a_bowl(method):
    """A curvature of 2 turns a distance of r into a cost of r^2."""
    result = search(bowl, method=method, members=400)
    assert len(result.trials) <= 400
    most = 0.3 if method == "optuna" else 1e-3
    assert result.best.point["x"] == pytest.approx(0.5, abs=most)
    assert math.log10(result.best.point["y"] / 20.0) == pytest.approx(0.0, abs=2 * most)


@pytest.mark.parametrize("method", EACH_METHOD)
def test_searches_are_reproducible_and_do_not_depend_on_their_length(method):
    """More members go on where fewer ended; maximizing is minimizing the negative, to the bit."""
    many = search(bowl, method=method, members=90)
    assert points(search(bowl, method=method, members=37)) == points(many)[:37]
    most = search(lambda point: -bowl(point), method=method, members=90, maximize=True)
    assert points(most) == points(many)
    assert most.best.objective == -many.best.objective
    names = list(map(value_name, points(many)))
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("method", EACH_METHOD)
def test_what_is_recorded_is_told_again_and_not_run(method):
    """Whatever it was that a killed search had tried."""
    whole = search(bowl, method=method, members=40)
    by_number = {trial.number: trial for trial in whole.trials}
    recorded = [
        (
            by_number[n].point,
            MemberOutcome(n, COMPLETE, metrics={OBJECTIVE: by_number[n].objective}),
        )
        for n in (0, 1, 2, 5, 11)
    ]
    run = Recorded(bowl)
    again = search_best(run, Search(PLANE, method=method, members=40), recorded=recorded)
    assert points(again) == points(whole)
    assert sum(map(len, run.batches)) == 35


def test_a_generation_is_one_batch():
    """So that all workers have something to do; the first member runs alone."""
    run = Recorded(bowl)
    search_best(run, Search(PLANE, method="global", members=101))
    assert [len(batch) for batch in run.batches] == [1, 20, 20, 20, 20, 20]


@pytest.mark.parametrize(
    ("first", "tried"),
    [({"x": 1.0, "y": 2.0}, {"x": 1.0, "y": 2.0}), ({"x": 7.0, "y": 2.0}, {"x": 0.0, "y": 2.0})],
)
def test_the_values_of_the_scenario_are_tried_first(first, tried):
    """Those beyond the bounds are replaced by the middle."""
    assert points(search(bowl, first=first, members=1)) == [tried]


@pytest.mark.parametrize("method", ["cobyqa", "nelder-mead"])
def test_an_optimum_at_a_bound_is_said_to_be_there(method):
    result = search(lambda point: bowl(point) + 10.0 * point["x"], method=method, starts=1)
    assert result.best.point["x"] == -2.0
    assert result.at_bounds == {"x": "lower"}
    assert any("x is at its lower bound" in text for text in result.statements)


def test_a_search_claims_no_optimum_that_it_has_not_seen():
    """From one start it ends in the wide valley; from four it may, and says what others found."""
    result = search(two_valleys, ONE, first={"x": -0.5}, starts=1)
    assert result.best.objective == pytest.approx(0.0, abs=1e-8)
    assert "better values elsewhere are not excluded" in result.statements[-1]
    result = search(two_valleys, ONE, first={"x": 1.45}, starts=4)
    assert result.best.objective == pytest.approx(-1.0, abs=1e-6)
    assert any("ended elsewhere" in text and "x = -1" in text for text in result.statements)


def test_members_that_fail_are_named_and_cost_themselves():
    """Where the objective has no number, too."""

    def holes(point):
        if point["x"] > 1.0:
            raise ArithmeticError("x is too large")
        return math.nan if point["x"] < -1.0 else (point["x"] - 0.25) ** 2

    result = search(holes, ONE, method="global", members=60)
    assert result.best.point["x"] == pytest.approx(0.25, abs=2e-2)
    problems = {trial.problem for trial in result.failed}
    assert "x is too large" in problems
    assert any(text.startswith("the objective is nan") for text in problems)
    assert "x is too large" in " ".join(result.statements)


def test_an_objective_without_effect_is_said():
    result = search(lambda _: 1.5, ONE, members=20)
    assert "the varied keys have no effect" in " ".join(result.statements)


@pytest.mark.slow
def test_lists_of_values_are_searched_until_all_were_tried():
    """True and 1 are one value; a list and its name are two."""
    space = SearchSpace((ChoiceKey("a", (1, 2, 3)), ChoiceKey("b", ("p", "q"))))
    result = search(lambda point: point["a"] + (point["b"] == "p"), space, method="optuna")
    assert (len(result.trials), result.best.point) == (6, {"a": 1, "b": "q"})
    assert result.stop_reason == "all combinations of the values were tried"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"space": SearchSpace(())}, "expected at least one key"),
        ({"space": SearchSpace((*ONE.keys, *ONE.keys))}, "expected once, got twice"),
        ({"space": SearchSpace((BoundedKey("x", 1.0, 1.0),))}, "the lower one first"),
        ({"space": SearchSpace((BoundedKey("x", 0.0, 1.0, True),))}, "positive bounds"),
        ({"space": SearchSpace((ChoiceKey("x", (1, 2)),))}, "'optuna' also takes lists"),
        ({"method": "simplex"}, "cobyqa, nelder-mead, global, optuna, got 'simplex'"),
        ({"members": 0}, "members: expected 1 or more, got 0"),
        ({"with_errors": True}, "rms of one residual"),
    ],
)
def test_searches_that_cannot_be_are_refused(options, words):
    with pytest.raises(UsageError, match=words):
        Search(**{"space": ONE, **options}).check()


# --- standard errors ---

T = np.linspace(0.0, 1.0, 201)
LINE = SearchSpace((BoundedKey("slope", -10.0, 10.0), BoundedKey("offset", -10.0, 10.0)))
DECAY = SearchSpace((BoundedKey("a", 0.1, 10.0, True), BoundedKey("k", 0.1, 100.0)))


def line(t, slope, offset):
    return slope * t + offset


def decay(t, a, k):
    return a * np.exp(-k * t)


def rms_of(model, measured, noise=0.0):
    """Return the rms of the residual; with noise, as a solver with step control has it."""

    def rms(point):
        exact = math.sqrt(np.mean((model(T, *point.values()) - measured) ** 2))
        return exact * (1.0 + noise * (math.modf(1e5 * sum(point.values()) * math.pi)[0] - 0.5))

    return rms


def fitted(model, space, measured, noise=0.0, **options):
    """Search the parameters of a curve."""
    given = {"is_rms": True, "with_errors": True, "samples": T.size, "starts": 1, **options}
    return search(rms_of(model, measured, noise), space, **given)


def noisy(values, deviation, seed=1):
    return values + deviation * np.random.default_rng(seed).standard_normal(T.size)


def test_a_line_has_the_errors_of_linear_regression():
    """Its sum of squares is quadratic: only rounding and the last move are left."""
    measured = noisy(line(T, 3.0, -2.0), 0.1, seed=3)
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
    measured = noisy(decay(T, 2.0, 3.0), deviation)
    _, covariance = curve_fit(decay, T, measured, p0=[1.0, 1.0])
    expected = np.sqrt(np.diag(covariance))
    result = fitted(decay, DECAY, measured, noise)
    most = 0.1 if noise else 0.01 + deviation
    assert list(result.errors.errors.values()) == pytest.approx(expected, rel=most)
    low, high = result.errors.intervals["a"]
    assert math.sqrt(low * high) == pytest.approx(result.best.point["a"], rel=2e-2)


@pytest.mark.parametrize(
    ("model", "space", "noise", "words"),
    [
        (decay, DECAY, 0.1, "the objective is noisy"),
        (line, SearchSpace((LINE.keys[0], BoundedKey("offset", -1.0, 10.0))), 0.0, "at its bound"),
        (lambda t, a, b: (a + b) * t, LINE, 0.0, "along a combination of slope, offset"),
        (lambda t, a, b: a * t, LINE, 0.0, "offset hardly changes the objective"),
    ],
)
def test_values_that_data_do_not_determine_have_no_standard_error(model, space, noise, words):
    """And it is said why."""
    measured = noisy(line(T, 3.0, -2.0) if model is line else model(T, 1.0, 2.0), 0.1, seed=3)
    result = fitted(model, space, measured, noise)
    assert result.errors is None
    assert words in result.errors_problem
    assert words in result.statements[-1]
