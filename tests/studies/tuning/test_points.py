"""A tuning knows the points that it has tried, whatever their values are."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.studies.dataset import parameter_column
from cosim.studies.tuning.points import value_name
from cosim.studies.tuning.searching import TuningSearch, search_best
from cosim.studies.tuning.space import BoundedKey, SearchSpace
from cosim.temporary import TemporaryFolder
from tests.studies.tuning.functions import EACH_METHOD, tried

NUMBERS = st.one_of(st.integers(-(2**70), 2**70), st.integers(-3, 3), st.floats())
VALUES = st.recursive(
    st.one_of(NUMBERS, st.booleans(), st.text()),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.lists(NUMBERS, max_size=3).map(tuple),
        st.dictionaries(st.text(max_size=3), inner, max_size=2),
    ),
    max_leaves=5,
)
CHOICES = st.lists(VALUES, min_size=1, max_size=5, unique_by=value_name)


@settings(max_examples=25)
@given(st.lists(CHOICES, min_size=1, max_size=3), st.data())
def test_a_resumed_search_equals_an_uninterrupted_one(lists, data):
    """Row for row, and no point is run twice, whatever type a column has."""
    keys = [f"plant.k{number}" for number in range(len(lists))]
    columns = [parameter_column(key, values) for key, values in zip(keys, lists, strict=True)]
    point = st.tuples(*map(st.sampled_from, lists)).map(
        lambda values: dict(zip(keys, values, strict=True))
    )
    points = data.draw(st.lists(point, min_size=1, max_size=9, unique_by=value_name))
    most = data.draw(st.integers(0, len(points)))
    batches = [points[begin : begin + 4] for begin in range(0, len(points), 4)]

    def ask(members):
        for batch in batches:
            members(batch)

    with TemporaryFolder("points") as folder:
        whole, rows = tried(folder / "whole", columns, ask)
        before, _ = tried(folder / "stopped", columns, ask, most=most)
        after, again = tried(folder / "stopped", columns, ask)
    assert len(whole) == len(points)
    assert len(before) + len(after) == len(points)
    assert again == rows


@pytest.mark.fast("global", "nelder-mead")
@pytest.mark.parametrize("method", EACH_METHOD)
def test_a_search_that_is_stopped_anywhere_or_grows_is_one_that_was_not(method, tmp_path):
    """Nor does it run anything twice; a batch that was begun is completed first."""
    space = SearchSpace((BoundedKey("p.x", -2.0, 2.0), BoundedKey("p.y", 1e-3, 1e3, True)))
    columns = [parameter_column(key.key, [1.0]) for key in space.keys]
    search = TuningSearch(space, "objective", method=method, members=60)

    def bowl(point):
        return 3.0 + (point["p.x"] - 0.5) ** 2 + math.log10(point["p.y"] / 20.0) ** 2

    def ask(members):
        search_best(members, search)

    def ask_less(members):
        search_best(members, replace(search, members=25))

    whole, rows = tried(tmp_path / "whole", columns, ask, bowl)
    assert len(whole) == 60
    for most in (0, 1, 7, 30, 59):
        place = tmp_path / str(most)
        before, _ = tried(place, columns, ask, bowl, most=most)
        after, again = tried(place, columns, ask, bowl)
        assert len(before) + len(after) == 60
        assert again == rows
    few, _ = tried(tmp_path / "grown", columns, ask_less, bowl)
    more, again = tried(tmp_path / "grown", columns, ask, bowl)
    assert (len(few), len(more)) == (25, 35)
    assert again == rows


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1, True),
        (0.0, -0.0),
        (1.0, "1.0"),
        (1.0, 1.0 + 2**-52),
        (2**53 + 1, 2.0**53),
        ([1, 2], [[1], 2]),
        (["a,b"], ["a", "b"]),
        ({"a": 1}, [["a", 1]]),
    ],
)
def test_values_that_differ_have_different_names(one, other):
    assert value_name(one) != value_name(other)


@given(st.integers(-(2**53), 2**53))
def test_whole_numbers_are_the_floats_that_a_dataset_may_make_of_them(number):
    assert value_name(number) == value_name(float(number))
    assert value_name((number,)) == value_name([float(number)])
