"""Searches find what can be found, go on where they ended, and say no more than they know."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cosim.errors import UsageError
from cosim.studies.contracts import COMPLETE, FAILED, MemberOutcome
from cosim.studies.search import METHODS, OBJECTIVE, BoundedKey, ChoiceKey, Search, value_name
from cosim.studies.tuning_result import search_best

# optuna is not there where the slow tests are left out
optuna = pytest.param("optuna", marks=pytest.mark.slow)
each_method = pytest.mark.parametrize("method", [*METHODS[:-1], optuna])
PLANE = (BoundedKey("x", -2.0, 2.0), BoundedKey("y", 1e-3, 1e3, logarithmic=True))
ONE = (BoundedKey("x", -2.0, 2.0),)


def planned(keys=PLANE, **options):
    """Return a search, with the defaults of a tuning."""
    given = {"expression": "f(x)", "maximize": False, "method": "cobyqa", "members": 200}
    return Search(OBJECTIVE, keys=keys, **{**given, "starts": 4, "seed": 1, **options})


def running(function, note=len):
    """Return what runs the members of a search: with a function of points, which it notes."""

    def run(points):
        note(points)
        for number, point in points.items():
            try:
                yield MemberOutcome(number, COMPLETE, metrics={OBJECTIVE: function(point)})
            except ArithmeticError as error:
                yield MemberOutcome(number, FAILED, reason=str(error))

    return run


def search(function, keys=PLANE, first=(), **options):
    return search_best(running(function), planned(keys, **options), dict(first))


def bowl(point):
    """Return a bowl with its lowest point 3 at x = 0.5, y = 20."""
    x = point["x"] - 0.5
    y = math.log10(point["y"] / 20.0)
    return 3.0 + x * x + y * y + 0.5 * x * y


@cache
def in_bowl(method):
    return search(bowl, method=method, members=400)


def two_valleys(point):
    """Return two: the lower one, of -1 at x = 1.5, is narrow; the wide one has 0 at x = -1."""
    x = point["x"]
    return min((x + 1.0) ** 2, -1.0 + 25.0 * (x - 1.5) ** 2)


@each_method
def test_every_method_comes_close_to_the_lowest_point_of_a_bowl(method):
    """A curvature of 2 turns a distance of r into a cost of r^2; no point is tried twice."""
    result = in_bowl(method)
    most = 0.3 if method == "optuna" else 1e-3
    assert result.best.point["x"] == pytest.approx(0.5, abs=most)
    assert math.log10(result.best.point["y"] / 20.0) == pytest.approx(0.0, abs=2 * most)
    points = {tuple(trial.point.values()) for trial in result.trials}
    assert len(points) == len(result.trials) <= 400


@each_method
def test_a_search_that_goes_on_asks_for_what_a_longer_one_asks(method):
    """What is recorded is told again and not run; progress counts each member once.

    Whatever it was that a killed search had tried; maximizing is minimizing the negative.
    """
    whole = in_bowl(method).trials[:40]
    recorded = [
        (trial.point, MemberOutcome(trial.number, COMPLETE, metrics={OBJECTIVE: -trial.cost}))
        for trial in whole
        if trial.number in (0, 1, 2, 5, 11)
    ]
    ran, seen = [], []
    again = search_best(
        running(lambda point: -bowl(point), ran.extend),
        planned(method=method, members=40, maximize=True),
        {},
        recorded=recorded,
        progress=lambda *counts: seen.append(counts),
    )
    assert [replace(trial, objective=-trial.objective) for trial in again.trials] == [*whole]
    assert again.best.objective == -min(trial.cost for trial in whole)
    assert sorted(ran) == [number for number in range(40) if number not in (0, 1, 2, 5, 11)]
    assert seen == [(number, 40, 0) for number in range(1, 41)]


@pytest.mark.parametrize(
    ("method", "sizes"),
    [
        ("global", [1, 20, 20]),
        pytest.param("optuna", [1, 3, *[4] * 9, 1], marks=pytest.mark.slow),
    ],
)
def test_the_first_member_runs_alone_and_others_in_batches(method, sizes):
    """Such as a generation, so that all workers have something to do."""
    batches = []
    run = running(bowl, lambda points: batches.append(len(points)))
    search_best(run, planned(method=method, members=41), {})
    assert batches == sizes


@pytest.mark.parametrize("method", ["cobyqa", "nelder-mead"])
def test_an_optimum_at_a_bound_is_said_to_be_there(method):
    result = search(lambda point: bowl(point) + 10.0 * point["x"], method=method, starts=1)
    assert result.best.point["x"] == -2.0
    assert "x is at its lower bound: values beyond it may be better" in result.statements


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


def test_a_search_that_breaks_down_has_not_converged(monkeypatch):
    def singular(cost, start, **_):
        cost(start)
        raise np.linalg.LinAlgError("singular matrix")

    monkeypatch.setattr("scipy.optimize.minimize", singular)
    result = search(bowl, starts=1)
    assert result.ends[0].reason == "COBYQA stopped: singular matrix"
    assert result.to_dict()["converged"] is False


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


def test_values_are_told_apart_as_a_dataset_does():
    """Which has a column of numbers, or of JSON."""
    assert value_name(1) == value_name(1.0) != value_name(True)
    assert value_name([1]) != value_name("[1]")


@pytest.mark.parametrize(
    ("keys", "options", "words"),
    [
        ((), {}, "vary: expected at least one key"),
        ((*ONE, *ONE), {}, r"vary\['x'\]: expected once, got twice"),
        ((BoundedKey("x", 1.0, 1.0),), {}, r"vary\['x'\]: .*the lower one first, got 1.0 to 1.0"),
        ((BoundedKey("x", 0.0, 1.0, True),), {}, r"vary\['x'\]: .*positive bounds"),
        ((ChoiceKey("x", (1, 2)),), {}, r"vary\['x'\]: .*'cobyqa'.*'optuna' also takes lists"),
        ((ChoiceKey("x", (1, 1.0)),), {"method": "optuna"}, r"distinct values, got \[1, 1.0\]"),
        (ONE, {"method": "simplex"}, "cobyqa, nelder-mead, global, optuna, got 'simplex'"),
        (ONE, {"members": 0}, "members: expected 1 or more, got 0"),
        (ONE, {"expression": "max(x)"}, "standard_errors: .*the rms of one residual"),
        (ONE, {"expression": "rms(x)", "maximize": True}, "standard_errors: .*to minimize"),
    ],
)
def test_searches_that_cannot_be_are_refused(keys, options, words):
    with pytest.raises(UsageError, match=words):
        planned(keys, **options).check(with_errors=True)
