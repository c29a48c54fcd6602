"""Lists of values on the command line."""

import pytest

from cosim.errors import UsageError
from cosim.scenario.document.document import parse_values

VALUES = {
    "1e3,1e6": [1e3, 1e6],
    "1": [1],
    "[0,2,4],[0,2]": [[0, 2, 4], [0, 2]],
    "{a=1,b=[2,3]},4": [{"a": 1, "b": [2, 3]}, 4],
    "'a,b',\"c,]\",d": ["a,b", "c,]", "d"],
    "abs(min(u.y,2)),3": ["abs(min(u.y,2))", 3],
    "a], b": ["a]", "b"],
}


def test_values_are_split_at_their_own_commas():
    """Not at those inside lists, tables, calls and strings."""
    assert {text: parse_values(text) for text in VALUES} == VALUES


def test_an_empty_value_is_refused():
    with pytest.raises(UsageError, match="'1,,2'"):
        parse_values("1,,2")
