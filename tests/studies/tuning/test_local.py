"""Local searches ask the optimizers of scipy what they should, and take what these find."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.studies.tuning.local import (
    FIRST_RADIUS,
    MOST_FAILING_STARTS,
    TOLERANCE,
    LocalSearch,
    _ShapedCost,
)
from cosim.studies.tuning.space import BoundedKey, SearchSpace
from cosim.studies.tuning.trials import Trials
from tests.studies.tuning.functions import OBJECTIVE, Recorded

SQUARE = SearchSpace((BoundedKey("x", 0.0, 1.0), BoundedKey("y", 0.0, 1.0)))
METHODS = ("cobyqa", "nelder-mead")


def search_of(function, method="cobyqa", *, squared=False, members=10_000):
    """Return a search of a function between 0 and 1, and what it asks for."""
    recorded = Recorded(function)
    trials = Trials(recorded, objective=OBJECTIVE, members=members)
    return LocalSearch(SQUARE, trials, method, squared, []), recorded


def bowl(point):
    return 2.0 + (point["x"] - 0.3) ** 2 + (point["y"] - 0.6) ** 2


def shaped(costs, *, squared=False):
    """Return a cost that has given values, one after the other, and where it was asked."""
    values = iter(costs)
    places = []

    def ask(point):
        places.append(point)
        return next(values)

    return _ShapedCost(ask, squared=squared), places


def test_a_cost_is_divided_by_the_size_of_the_first():
    """Also a negative one; squared after that; a first one of zero divides nothing."""
    place = np.array([0.5])
    for costs, squared, expected in [
        ([4.0, 2.0, -1.0], False, [1.0, 0.5, -0.25]),
        ([-4.0, 2.0], False, [-1.0, 0.5]),
        ([4.0, 2.0, 8.0], True, [1.0, 0.25, 4.0]),
        ([0.0, 3.0, 6.0], False, [0.0, 1.0, 2.0]),
        ([math.inf, 4.0, 2.0], False, [math.inf, 1.0, 0.5]),
    ]:
        cost, _ = shaped(costs, squared=squared)
        assert [cost(place) for _ in costs] == expected, costs


def test_the_best_cost_is_kept_as_it_is_with_its_place():
    """The first of equal ones; one that failed only where there is no other."""
    cost, places = shaped([math.inf, 3.0, 5.0, 3.0])
    for number in range(4):
        cost(np.array([0.1 * number]))
        assert cost.best_at == pytest.approx([0.0 if number == 0 else 0.1])
    assert cost.best == 3.0
    assert len(places) == 4
    failing, _ = shaped([math.inf, math.inf])
    failing(np.array([0.25]))
    failing(np.array([0.75]))
    assert failing.best == math.inf
    assert failing.best_at == [0.25]


def test_coordinates_beyond_a_bound_are_asked_at_the_bound():
    """Rounding puts them there."""
    cost, places = shaped([1.0])
    cost(np.array([-1e-17, 1.0 + 1e-15]))
    assert places[0].tolist() == cost.best_at.tolist() == [0.0, 1.0]


def test_a_failed_member_has_the_worst_cost_so_far():
    """As shaped; 0 where nothing is known yet."""
    cost, _ = shaped([math.inf, 4.0, 8.0, 2.0, math.inf, 12.0, math.inf])
    found = [cost.finite(np.array([0.5])) for _ in range(7)]
    assert found == [0.0, 1.0, 2.0, 0.5, 2.0, 3.0, 3.0]


@pytest.fixture
def asked(monkeypatch):
    """Return what scipy is asked for; it evaluates the start, and says what ``answer`` says."""
    calls = []

    def minimize(cost, start, **options):
        cost(start)
        calls.append(SimpleNamespace(start=start, **options))
        return SimpleNamespace(success=True, message="")

    monkeypatch.setattr("scipy.optimize.minimize", minimize)
    return calls


@pytest.mark.parametrize("radius", [0.25, TOLERANCE / 10.0])
def test_cobyqa_is_asked_to_search_to_the_tolerance_without_an_end_of_its_own(asked, radius):
    """In the unit square; the first radius is not below the last."""
    search, _ = search_of(bowl)
    search.from_point(np.array([0.2, 0.9]), radius)
    (call,) = asked
    assert call.method == "COBYQA"
    assert call.bounds == [(0.0, 1.0)] * 2
    assert call.start.tolist() == [0.2, 0.9]
    assert call.options["initial_tr_radius"] == max(radius, TOLERANCE)
    assert call.options["final_tr_radius"] == TOLERANCE == 1e-5
    assert min(call.options["maxfev"], call.options["maxiter"]) >= 10**6


def test_the_simplex_of_nelder_mead_lies_away_from_the_nearer_bound(asked):
    """A corner that is clipped would make it flat; in the middle it goes down."""
    search, _ = search_of(bowl, "nelder-mead")
    search.from_point(np.array([0.49, 0.5]), 0.1)
    (call,) = asked
    assert call.method == "Nelder-Mead"
    assert call.bounds == [(0.0, 1.0)] * 2
    corners = [[0.49, 0.5], [0.59, 0.5], [0.49, 0.4]]
    assert call.options["initial_simplex"] == pytest.approx(np.array(corners))
    assert call.options["xatol"] == TOLERANCE
    assert call.options["fatol"] == math.inf
    assert min(call.options["maxfev"], call.options["maxiter"]) >= 10**6


@pytest.mark.parametrize("method", METHODS)
def test_the_end_of_a_search_has_start_best_point_and_cost(method):
    """The cost is that of the member, neither squared nor divided."""
    search, recorded = search_of(bowl, method, squared=True)
    search.from_point(np.array([0.8, 0.2]), 0.1)
    (end,) = search.ends
    assert end.start == {"x": 0.8, "y": 0.2}
    assert end.point["x"] == pytest.approx(0.3, abs=1e-3)
    assert end.point["y"] == pytest.approx(0.6, abs=1e-3)
    assert end.cost == min(map(bowl, recorded.points)) == pytest.approx(2.0, abs=1e-6)
    assert end.converged
    assert "converged" in end.reason
    assert f"{TOLERANCE:g}" in end.reason


@pytest.mark.parametrize("problem", ["message", "error"])
def test_an_optimizer_that_stops_has_not_converged(monkeypatch, problem):
    """With its reason, and the best that it had found."""

    def minimize(cost, start, **options):
        cost(start)
        if problem == "error":
            raise np.linalg.LinAlgError("no such matrix")
        return SimpleNamespace(success=False, message="no such matrix")

    monkeypatch.setattr("scipy.optimize.minimize", minimize)
    search, _ = search_of(bowl)
    search.from_point(np.array([0.25, 0.5]), 0.1)
    (end,) = search.ends
    assert not end.converged
    assert end.reason == "COBYQA stopped: no such matrix"
    assert end.point == {"x": 0.25, "y": 0.5}
    assert end.cost == bowl(end.point)


def test_each_start_is_searched_from_with_the_first_radius(asked):
    """The given one, and one less than their number of a balanced sequence of the seed."""
    search, recorded = search_of(bowl)
    search.from_starts(np.array([0.5, 0.5]), 4, seed=3)
    starts = [call.start.tolist() for call in asked]
    assert starts[0] == [0.5, 0.5]
    assert len(starts) == len(search.ends) == 4
    assert {call.options["initial_tr_radius"] for call in asked} == {FIRST_RADIUS}
    assert FIRST_RADIUS == 0.1
    quadrants = [tuple(np.array(start) >= 0.5) for start in starts[1:]]
    assert len(set(quadrants)) == 3  # of four
    assert [len(batch) for batch in recorded.batches] == [1, 3]
    again, _ = search_of(bowl)
    again.from_starts(np.array([0.5, 0.5]), 4, seed=3)
    assert [call.start.tolist() for call in asked[4:]] == starts
    other, _ = search_of(bowl)
    other.from_starts(np.array([0.5, 0.5]), 4, seed=4)
    assert [call.start.tolist() for call in asked[9:]] != starts[1:]


def test_starts_that_fail_in_half_of_the_box_are_replaced_from_the_other(asked):
    """Whichever half that is: all points of the sequence are tried in their order."""

    def fails(point):
        if (point["x"] >= 0.5) == right:
            raise ArithmeticError("a half")
        return bowl(point)

    for right in (False, True):
        search, _ = search_of(fails)
        search.from_starts(np.array([0.5, 0.5]), 6, seed=3)
        starts = [call.start for call in asked if call.start.tolist() != [0.5, 0.5]]
        assert len(starts) == 5
        assert all((start[0] >= 0.5) != right for start in starts)
        asked.clear()


def test_one_start_asks_for_no_other(asked):
    search, recorded = search_of(bowl)
    search.from_starts(np.array([0.5, 0.5]), 1, seed=0)
    assert recorded.points == [{"x": 0.5, "y": 0.5}]
    assert len(asked) == 1


def test_a_start_that_fails_is_replaced_by_one_that_does_not(asked):
    """The given one is not; of the others there are as many as were asked for."""

    def right_fails(point):
        if point["x"] >= 0.5:
            raise ArithmeticError("right")
        return bowl(point)

    search, recorded = search_of(right_fails)
    search.from_starts(np.array([0.5, 0.5]), 6, seed=1)
    starts = np.array([call.start for call in asked])
    assert len(starts) == 5
    assert (starts[:, 0] < 0.5).all()
    assert 6 < len(recorded.points) < 1 + 5 * MOST_FAILING_STARTS


def test_starts_that_all_fail_are_given_up(asked):
    """After ten batches of two, of which each start is one."""

    def fails(point):
        raise ArithmeticError("never")

    search, recorded = search_of(fails)
    search.from_starts(np.array([0.5, 0.5]), 3, seed=0)
    assert asked == search.ends == []
    assert MOST_FAILING_STARTS == 10
    assert [len(batch) for batch in recorded.batches] == [1, *[2] * 10]
