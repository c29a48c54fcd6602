"""Lists of values on the command line."""

from cosim.scenario.document.value_lists import split_values

PARTS = {
    "1e3,1e6": ["1e3", "1e6"],
    "1": ["1"],
    "[0,2,4],[0,2]": ["[0,2,4]", "[0,2]"],
    "{a=1,b=[2,3]},4": ["{a=1,b=[2,3]}", "4"],
    "'a,b',\"c,]\",d": ["'a,b'", '"c,]"', "d"],
    "abs(min(u.y,2)),3": ["abs(min(u.y,2))", "3"],
    "1,,2": ["1", "", "2"],
    "a], b": ["a]", "b"],
}


def test_values_are_split_at_their_own_commas():
    """Not at those inside lists, tables, calls and strings."""
    assert {text: split_values(text) for text in PARTS} == PARTS
