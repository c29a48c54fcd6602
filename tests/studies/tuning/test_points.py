"""A tuning knows the points that it has tried, whatever their values are."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.studies.contracts import COMPLETE, MemberOutcome, StudyMember
from cosim.studies.dataset.columns import metric_column, parameter_column
from cosim.studies.dataset.identity import StudyIdentity
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.tuning.members import TrialMembers, in_pool
from cosim.studies.tuning.points import value_name
from cosim.studies.tuning.recorded import TuningDataset
from cosim.temporary import TemporaryFolder

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


class CountingPool:
    """Runs members here; their outcomes follow from their values. It may be lost with one."""

    def __init__(self, most):
        self.most = most
        self.ran = []

    def run(self, members):
        """Yield outcomes, the last of a batch first."""
        for member in reversed(list(members)):
            if len(self.ran) == self.most:
                raise KeyboardInterrupt
            self.ran.append(member)
            metrics = {"objective": float(len(repr(member.set)))}
            yield MemberOutcome(member.number, COMPLETE, metrics=metrics)


def member_of(number, point):
    """Return the member that tries a point of no swaps."""
    return StudyMember(number, dict(point))


def tried(place, columns, batches, most=math.inf):
    """Try batches of points with a dataset; return what was run, and its rows at the end."""
    pool = CountingPool(most)
    identity = StudyIdentity("x", "", {}, (*columns, metric_column("objective")), 100)
    with TuningDataset(place, identity) as dataset:
        run = in_pool(pool)
        members = TrialMembers(run, run, member_of, dataset, members=100)
        try:
            for batch in batches:
                members(batch)
        except KeyboardInterrupt:
            pass
    rows = StudyDataset.open(place).read().to_pylist() if place.exists() else []
    return pool.ran, repr(rows)


@settings(max_examples=25)
@given(st.lists(CHOICES, min_size=1, max_size=3), st.data())
def test_what_is_stopped_and_goes_on_is_what_was_not_stopped(lists, data):
    """Row for row, and no point is run twice, whatever type a column has."""
    keys = [f"plant.k{number}" for number in range(len(lists))]
    columns = [parameter_column(key, values) for key, values in zip(keys, lists, strict=True)]
    point = st.tuples(*map(st.sampled_from, lists)).map(
        lambda values: dict(zip(keys, values, strict=True))
    )
    points = data.draw(st.lists(point, min_size=1, max_size=9, unique_by=value_name))
    most = data.draw(st.integers(0, len(points)))
    batches = [points[begin : begin + 4] for begin in range(0, len(points), 4)]
    with TemporaryFolder("points") as folder:
        whole, rows = tried(folder / "whole", columns, batches)
        before, _ = tried(folder / "stopped", columns, batches, most)
        after, again = tried(folder / "stopped", columns, batches)
    assert len(whole) == len(points)
    assert len(before) + len(after) == len(points)
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
