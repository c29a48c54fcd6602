"""Searches find what can be found, go on where they ended, and say no more than they know."""

import math

import pytest

from cosim.errors import UsageError
from cosim.studies.contracts import COMPLETE, FAILED, MemberOutcome
from cosim.studies.search import METHODS, OBJECTIVE, BoundedKey, ChoiceKey, Search, value_name
from cosim.studies.tuning_result import search_best

# optuna is not there where the slow tests are left out
EACH_METHOD = [
    pytest.param(method, marks=pytest.mark.slow) if method == "optuna" else method
    for method in METHODS
]
PLANE = (BoundedKey("x", -2.0, 2.0), BoundedKey("y", 1e-3, 1e3, logarithmic=True))
ONE = (BoundedKey("x", -2.0, 2.0),)


def planned(keys, **options):
    """Return a search, with the defaults of a tuning."""
    given = {"expression": "f(x)", "maximize": False, "method": "cobyqa", "members": 200}
    return Search(OBJECTIVE, keys=keys, **{**given, "starts": 4, "seed": 1, **options})


class Recorded:
    """Evaluates a function of points; knows which it was given, at a time."""

    def __init__(self, function):
        self.function = function
        self.batches = []

    def __call__(self, points):
        self.batches.append([dict(point) for point in points.values()])
        for number, point in points.items():
            try:
                yield MemberOutcome(number, COMPLETE, metrics={OBJECTIVE: self.function(point)})
            except ArithmeticError as error:
                yield MemberOutcome(number, FAILED, reason=str(error))


def search(function, keys=PLANE, first=(), **options):
    return search_best(Recorded(function), planned(keys, **options), dict(first))


def points(result):
    return [trial.point for trial in result.trials]


def bowl(point):
    """Return a bowl with its lowest point 3 at x = 0.5, y = 20."""
    x = point["x"] - 0.5
    y = math.log10(point["y"] / 20.0)
    return 3.0 + x * x + y * y + 0.5 * x * y


def two_valleys(point):
    """Return two: the lower one, of -1 at x = 1.5, is narrow; the wide one has 0 at x = -1."""
    x = point["x"]
    return min((x + 1.0) ** 2, -1.0 + 25.0 * (x - 1.5) ** 2)


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
    assert len({tuple(point.values()) for point in points(many)}) == len(points(many))


@pytest.mark.parametrize("method", EACH_METHOD)
def test_what_is_recorded_is_told_again_and_not_run(method):
    """Whatever it was that a killed search had tried; progress counts each member once."""
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
    seen = []
    given = {"recorded": recorded, "progress": lambda *counts: seen.append(counts)}
    again = search_best(run, planned(PLANE, method=method, members=40), {}, **given)
    assert points(again) == points(whole)
    assert sum(map(len, run.batches)) == 35
    assert seen == [(number, 40, 0) for number in range(1, 41)]


def test_a_generation_is_one_batch():
    """So that all workers have something to do; the first member runs alone."""
    run = Recorded(bowl)
    search_best(run, planned(PLANE, method="global", members=101), {})
    assert [len(batch) for batch in run.batches] == [1, 20, 20, 20, 20, 20]


def test_the_values_of_the_scenario_are_tried_first():
    """Left out: the middle between the bounds."""
    assert points(search(bowl, first={"y": 2.0}, members=1)) == [{"x": 0.0, "y": 2.0}]


@pytest.mark.parametrize("method", ["cobyqa", "nelder-mead"])
def test_an_optimum_at_a_bound_is_said_to_be_there(method):
    result = search(lambda point: bowl(point) + 10.0 * point["x"], method=method, starts=1)
    assert result.best.point["x"] == -2.0
    assert result.at_bounds == {"x": "lower"}


def test_a_search_claims_no_optimum_that_it_has_not_seen():
    """From one start it ends in the wide valley; from four it may, and says what others found."""
    result = search(two_valleys, ONE, {"x": -0.5}, starts=1)
    assert result.best.objective == pytest.approx(0.0, abs=1e-8)
    assert "better values elsewhere are not excluded" in result.statements[-1]
    result = search(two_valleys, ONE, {"x": 1.45})
    assert result.best.objective == pytest.approx(-1.0, abs=1e-6)
    assert any("ended elsewhere" in text and "x = -1" in text for text in result.statements)
    result = search(lambda _: 1.5, ONE, members=20)
    assert "no effect" in " ".join(result.statements)


def test_members_that_fail_are_named_and_cost_themselves():
    """Where the objective has no number, too."""

    def holes(point):
        if point["x"] > 1.0:
            raise ArithmeticError("x is too large")
        return math.nan if point["x"] < -1.0 else (point["x"] - 0.25) ** 2

    result = search(holes, ONE, method="global", members=60)
    assert result.best.point["x"] == pytest.approx(0.25, abs=2e-2)
    problems = {trial.problem for trial in result.failed}
    assert problems == {"x is too large", "the objective is nan, expected a finite number"}
    assert "x is too large" in " ".join(result.statements)


@pytest.mark.slow
def test_lists_of_values_are_searched_until_all_were_tried():
    keys = (ChoiceKey("a", (1, 2, 3)), ChoiceKey("b", ("p", "q")))
    result = search(lambda point: point["a"] + 0.5 * (point["b"] == "p"), keys, method="optuna")
    assert (len(result.trials), result.best.point) == (6, {"a": 1, "b": "q"})
    assert result.stop_reason == "all combinations of the values were tried"


def test_values_are_told_apart_as_a_dataset_does():
    """Which has a column of numbers, or of JSON."""
    assert value_name(1) == value_name(1.0) != value_name(True)
    assert value_name([1]) != value_name("[1]")


@pytest.mark.parametrize(
    ("keys", "options", "words"),
    [
        ((), {}, "at least one key"),
        ((*ONE, *ONE), {}, "once, got twice"),
        ((BoundedKey("x", 1.0, 1.0),), {}, "the lower one first"),
        ((BoundedKey("x", 0.0, 1.0, True),), {}, "positive bounds"),
        ((ChoiceKey("x", (1, 2)),), {}, "'optuna' also takes lists"),
        ((ChoiceKey("x", (1, 1.0)),), {"method": "optuna"}, "distinct"),
        (ONE, {"method": "simplex"}, "cobyqa, nelder-mead, global, optuna, got 'simplex'"),
        (ONE, {"members": 0}, "members: expected 1 or more, got 0"),
    ],
)
def test_searches_that_cannot_be_are_refused(keys, options, words):
    with pytest.raises(UsageError, match=words):
        planned(keys, **options).check()


@pytest.mark.parametrize("options", [{"expression": "max(x)"}, {"maximize": True}])
def test_standard_errors_are_those_of_a_fit(options):
    with pytest.raises(UsageError, match="rms of one residual"):
        planned(ONE, **{"expression": "rms(x)", **options}).check_errors()
