"""Searches find what can be found, and say no more than they know."""

import math
import re

import numpy as np
import pytest

from cosim.errors import UsageError
from cosim.studies.tuning.points import value_name
from cosim.studies.tuning.result import statements
from cosim.studies.tuning.searching import TuningSearch, check_search, search_best
from cosim.studies.tuning.space import BoundedKey, ChoiceKey, SearchSpace
from cosim.studies.tuning.trials import SearchEnded, Trials
from tests.studies.tuning.functions import EACH_METHOD, OBJECTIVE, Recorded

PLANE = SearchSpace((BoundedKey("x", -2.0, 2.0), BoundedKey("y", 1e-3, 1e3, logarithmic=True)))
LOCAL = ("cobyqa", "nelder-mead")


def bowl(point):
    """Return a bowl with its lowest point 3 at x = 0.5, y = 20."""
    x = point["x"] - 0.5
    y = math.log10(point["y"] / 20.0)
    return 3.0 + x * x + y * y + 0.5 * x * y


def two_valleys(point):
    """Return two: the lower one, of -1 at x = 1.5, is narrow; the wide one has 0 at x = -1."""
    x = point["x"]
    return min((x + 1.0) ** 2, -1.0 + 25.0 * (x - 1.5) ** 2)


LINE = SearchSpace((BoundedKey("x", -2.0, 2.0),))


def search(function, space=PLANE, **options):
    return search_best(Recorded(function), TuningSearch(space, OBJECTIVE, **options))


@pytest.mark.parametrize("method", EACH_METHOD)
def test_every_method_comes_close_to_the_lowest_point_of_a_bowl(method):
    """A curvature of 2 turns a distance of r into a cost of r^2."""
    result = search(bowl, method=method, members=400)
    assert len(result.trials) <= 400
    most = 0.3 if method == "optuna" else 1e-3
    assert result.best.point["x"] == pytest.approx(0.5, abs=most)
    assert math.log10(result.best.point["y"] / 20.0) == pytest.approx(0.0, abs=2 * most)


@pytest.mark.parametrize("method", EACH_METHOD)
def test_maximizing_is_minimizing_the_negative(method):
    """To the bit: the same points are asked for."""
    most = search(lambda point: -bowl(point), method=method, members=60, maximize=True)
    least = search(bowl, method=method, members=60)
    assert [trial.point for trial in most.trials] == [trial.point for trial in least.trials]
    assert most.best.objective == -least.best.objective


@pytest.mark.parametrize("method", EACH_METHOD)
def test_more_members_go_on_where_fewer_ended(method):
    """A search does not depend on how many members it has."""
    few = search(bowl, method=method, members=37).trials
    many = search(bowl, method=method, members=90).trials
    assert len(few) == 37
    assert few == many[:37]


@pytest.mark.parametrize("method", EACH_METHOD)
def test_no_point_is_run_twice(method):
    recorded = Recorded(bowl)
    search_best(recorded, TuningSearch(PLANE, OBJECTIVE, method=method, members=90))
    names = [repr(point) for point in recorded.points]
    assert len(set(names)) == len(names)


def test_a_generation_is_one_batch():
    """So that all workers have something to do."""
    recorded = Recorded(bowl)
    search_best(recorded, TuningSearch(PLANE, OBJECTIVE, method="global", members=101))
    assert [len(batch) for batch in recorded.batches] == [1, 20, 20, 20, 20, 20]


def test_the_values_of_the_scenario_are_tried_first():
    first = {"x": 1.0, "y": 2.0}
    assert search(bowl, first=first, members=1).trials[0].point == first


def test_first_values_beyond_the_bounds_are_replaced_by_the_middle():
    trial = search(bowl, first={"x": 7.0, "y": 2.0}, members=1).trials[0]
    assert trial.point == {"x": 0.0, "y": 2.0}


@pytest.mark.parametrize("method", LOCAL)
def test_an_optimum_at_a_bound_is_said_to_be_there(method):
    result = search(lambda point: bowl(point) + 10.0 * point["x"], method=method, starts=1)
    assert result.best.point["x"] == -2.0
    assert result.at_bounds == {"x": "lower"}
    assert "x is at its lower bound: values beyond it may be better" in statements(result)


def test_a_local_search_in_the_wrong_valley_does_not_claim_the_optimum():
    """From one start it ends at 0; the lowest value is -1."""
    result = search(two_valleys, LINE, first={"x": -0.5}, starts=1)
    assert result.best.objective == pytest.approx(0.0, abs=1e-8)
    assert statements(result) == [
        "COBYQA converged: trust region 1e-05 of the bounds",
        "searched from one start; better values elsewhere are not excluded",
    ]


def test_starts_that_agree_do_not_prove_the_optimum():
    """All of them miss a narrow valley, and the sentence stays true."""

    def needle(point):
        return min((point["x"] + 1.0) ** 2, -1.0 + 1e8 * (point["x"] - 1.2345) ** 2)

    result = search(needle, LINE, first={"x": -0.5})
    assert result.best.objective > -0.5
    assert "all 4 starts ended here; better values elsewhere are not excluded" in statements(result)


def test_starts_that_end_elsewhere_are_told():
    result = search(two_valleys, LINE, first={"x": 1.45}, starts=4)
    assert result.best.objective == pytest.approx(-1.0, abs=1e-6)
    (text,) = (each for each in statements(result) if "ended elsewhere" in each)
    assert "the best of them at x = -1 with" in text
    assert "more starts, or the method 'global', may find better values" in text


def test_equal_optima_at_two_places_are_said_not_to_be_unique():
    result = search(lambda point: 1.0 + (point["x"] ** 2 - 1.0) ** 2, LINE, first={"x": 0.7})
    (text,) = (each for each in statements(result) if "not unique" in each)
    assert re.search(r"another start ended at x = -(1|0\.9999\d+) with this objective", text)


def test_a_global_search_finds_the_narrow_valley():
    result = search(two_valleys, LINE, method="global", first={"x": -0.5}, members=400)
    assert result.best.objective == pytest.approx(-1.0, abs=1e-4)
    assert "whether there are better values elsewhere is not known" in statements(result)


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_a_constant_in_the_objective_does_not_end_a_global_search(offset):
    """The tolerance of scipy is relative to the mean: it would end with the first generation."""
    result = search(lambda point: bowl(point) + offset - 3.0, method="global", members=600)
    assert result.finished
    assert result.best.point["x"] == pytest.approx(0.5, abs=2e-3)


@pytest.mark.parametrize("method", EACH_METHOD)
def test_a_key_without_effect_is_reported(method):
    result = search(lambda point: 3.0, method=method, members=50)
    assert (
        "all members have the same objective: the varied keys have no effect on it here"
        in statements(result)
    )


@pytest.mark.parametrize("method", EACH_METHOD)
def test_failing_members_are_counted_and_named(method):
    """Half of the plane fails, next to the lowest point, too."""

    def cliff(point):
        if point["x"] > 0.6:
            raise ArithmeticError("x is too much")
        return bowl(point)

    result = search(cliff, method=method, members=150)
    failed = [trial for trial in result.trials if trial.point["x"] > 0.6]
    assert failed
    assert list(result.failed) == failed
    assert result.best.objective < 3.1
    (text,) = (each for each in statements(result) if "no objective" in each)
    assert text.startswith(f"{len(failed)} members have no objective ({failed[0].number}, ")
    assert text.endswith(": x is too much")


@pytest.mark.parametrize("method", EACH_METHOD)
def test_where_all_members_fail_there_is_no_result(method):

    def fails(point):
        raise ArithmeticError("never")

    result = search(fails, method=method, members=60)
    assert result.best is None
    assert len(result.failed) == len(result.trials)
    assert "members have no objective" in statements(result)[1]


@pytest.mark.parametrize("value", [math.nan, math.inf, None, "PASS"])
def test_an_objective_that_is_no_number_is_none(value):
    result = search(lambda point: value if point["x"] > 0.0 else bowl(point), members=40)
    assert result.failed
    assert result.best.objective is not None


def test_members_that_are_used_up_are_no_convergence():
    result = search(bowl, members=12)
    assert not result.finished
    assert result.best_end is None
    assert statements(result)[0] == (
        "all members were used before a search converged at these values"
    )


def test_a_search_that_converged_before_the_members_ended_says_both():
    result = search(bowl, members=60)
    assert statements(result)[0] == (
        "COBYQA converged: trust region 1e-05 of the bounds; then all members were used"
    )


@pytest.mark.slow
def test_optuna_searches_lists_of_values_and_ends_when_all_are_tried():
    """Of two lists there are six points; no search asks on for ever."""
    space = SearchSpace((ChoiceKey("plant", ("a.fmu", "b.fmu")), ChoiceKey("n", (1, 2, 3))))
    result = search(
        lambda point: point["n"] + (point["plant"] == "a.fmu"), space, method="optuna", members=50
    )
    assert result.best.point == {"plant": "b.fmu", "n": 1}
    assert len(result.trials) == 6
    assert result.finished
    assert statements(result)[0] == "all combinations of the values were tried"


def test_a_search_that_asks_for_no_new_point_ends():
    """It would go round in circles for ever."""
    trials = Trials(Recorded(lambda point: 1.0), objective=OBJECTIVE, members=9)
    for _ in range(1001):
        assert trials.costs([{"x": 1.0}]) == [1.0]
    with pytest.raises(SearchEnded, match="the search asked for no new point any more"):
        trials.costs([{"x": 1.0}])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "newton"}, "method: .*got 'newton'"),
        ({"members": 0}, "members: .*got 0"),
        ({"starts": 0}, "starts: .*got 0"),
        (
            {"with_errors": True, "is_rms": True, "samples": 0},
            "samples: .*got 0",
        ),
        ({"seed": -1}, "seed: .*got -1"),
        (
            {"space": SearchSpace((ChoiceKey("plant", (1, 2)),))},
            r"vary\['plant'\]: .*bounds.*'cobyqa'.*a list of values",
        ),
        (
            {"with_errors": True},
            "standard_errors: .*rms of one residual and is minimized",
        ),
        (
            {"with_errors": True, "is_rms": True, "maximize": True},
            "of one residual and is minimized",
        ),
    ],
)
def test_wrong_searches_are_refused(options, message):
    with pytest.raises(UsageError, match=message):
        check_search(TuningSearch(**{"space": PLANE, "objective": OBJECTIVE, **options}))


def test_optuna_is_needed_by_its_method_only(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "optuna", None)
    check_search(TuningSearch(PLANE, OBJECTIVE))
    with pytest.raises(
        UsageError, match="the method 'optuna' needs optuna, which is not installed"
    ):
        check_search(TuningSearch(PLANE, OBJECTIVE, method="optuna"))


def test_a_result_is_plain_data():
    import json

    result = search(bowl, members=60)
    content = json.loads(json.dumps(result.to_dict()))
    assert content["best"]["values"] == result.best.point
    assert content["converged"]
    assert content["members"] == 60


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_the_unit_of_the_objective_does_not_matter(scale):
    """An rms of nanometres is searched like one of metres."""

    def rms(point):
        return scale * math.sqrt(0.01 + (point["x"] - 0.5) ** 2)

    result = search(rms, LINE, is_rms=True, starts=1)
    assert result.best.point["x"] == pytest.approx(0.5, abs=1e-4)
    assert np.isfinite(result.best.cost)


@pytest.mark.slow
def test_the_value_of_the_scenario_is_found_in_a_list_by_what_it_is():
    """``True`` is not the 1 that equals it."""
    space = SearchSpace((ChoiceKey("n", (1, [1.0], True)),))
    for first in (True, [1]):
        result = search(lambda point: 1.0, space, method="optuna", members=1, first={"n": first})
        assert value_name(result.trials[0].point["n"]) == value_name(first)
