"""The combinations of a sweep."""

import numpy as np
import pytest

from cosim.errors import UsageError
from cosim.scenario.running.combinations import combination_text, combinations
from tests.scenario.refusals import check_refused


def test_combinations_are_the_full_product_in_order():
    """The last key changes first; values are those that TOML has."""
    found = combinations({"a.x": np.array([1.0, 2.0]), "b.y": [[0, 2], "z"]})
    assert found == [
        {"a.x": 1.0, "b.y": [0, 2]},
        {"a.x": 1.0, "b.y": "z"},
        {"a.x": 2.0, "b.y": [0, 2]},
        {"a.x": 2.0, "b.y": "z"},
    ]
    assert combination_text(found[1]) == "a.x = 1.0, b.y = 'z'"


def test_a_thousand_combinations_are_the_most():
    """One more is refused before anything is built."""
    assert len(combinations({"a.x": range(10), "a.y": range(100)})) == 1000
    with pytest.raises(UsageError, match=r"vary: .*7 x 143 = 1001"):
        combinations({"a.x": range(7), "a.y": range(143)})


INVALID = [
    ({}, "vary: expected a key and its values"),
    ({"a.x": []}, r"vary\['a.x'\]: expected at least one value"),
    ({"a.x": "12"}, r"vary\['a.x'\]: expected a list, got '12'"),
    ({"a.x": 3.0}, r"vary\['a.x'\]: expected a list, got 3.0"),
    ({"a.x": [object]}, r"vary\['a.x'\]: expected a number, .* got <class 'object'>"),
    ([1.0], r"vary: .*\[1\.0\]"),
    ({1: [1.0]}, "vary: .* 1$"),
]


def test_an_invalid_list_of_values_is_refused():
    """The message names the key."""
    check_refused(INVALID, combinations)
