"""Columns: what has no value is named."""

import numpy as np
import pytest

from cosim.errors import UsageError
from cosim.studies.analysis.columns import numbers_of
from tests.studies.analysis.made import columns_of


def test_every_member_is_counted_once():
    """Numbers, failures, no value, infinity: together all members."""
    values = [1.0, None, np.nan, np.inf, 2.5, -np.inf, 7.0]
    column = columns_of({"rms": values}, failed=[6]).metric("rms")
    assert column.values.tolist() == [1.0, 2.5]
    assert column.numbers.tolist() == [0, 4]
    assert column.failed.tolist() == [6]
    assert column.without_value.tolist() == [1, 2]
    assert column.infinite.tolist() == [3, 5]


def test_some_of_the_members_are_columns_too():
    """With their numbers and reasons."""
    columns = columns_of({"rms": [1.0, 2.0, 3.0]}, failed=[12], numbers=[10, 11, 12])
    found = columns.only(np.array([True, False, True]))
    assert found.numbers.tolist() == [10, 12]
    assert found.reasons == ["", "crashed"]
    assert found.metric("rms").values.tolist() == [1.0]
    assert columns.rows_of(np.array([12, 10])).tolist() == [2, 0]


def test_texts_are_counted():
    """A failed member has none."""
    verdicts = ["yes", "no", "yes", None, "no"]
    columns = columns_of({"verdict": verdicts}, failed=[4])
    column = columns.metrics["verdict"]
    assert column.is_text
    assert column.texts == {"yes": 2, "no": 1}
    assert column.without_value.tolist() == [3]
    with pytest.raises(UsageError, match=r"metric 'verdict': .*got texts"):
        columns.metric("verdict")


def test_a_metric_that_is_not_there_is_an_error():
    """It names those that are."""
    with pytest.raises(UsageError, match=r"no metric 'rsm'; did you mean 'rms'\? .*: rms"):
        columns_of({"rms": [1.0]}).metric("rsm")


def test_a_parameter_is_a_number_or_not():
    """Truth values, texts and lists are none."""
    assert numbers_of(np.array([1, 2])).tolist() == [1.0, 2.0]
    assert numbers_of(np.array([1, 2.5], object)).tolist() == [1.0, 2.5]
    assert numbers_of(np.array([True, False])) is None
    assert numbers_of(np.array([1.0, True], object)) is None
    assert numbers_of(np.array(["a.fmu", "b.fmu"])) is None
