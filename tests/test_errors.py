"""Warnings reach who calls the package, at the line that calls it."""

import warnings
from pathlib import Path

import pytest

import cosim
from cosim.errors import nearest, shell_language, warn


def test_a_warning_is_shown_once_at_the_line_of_the_caller():
    """A text that comes twice is one warning; its category is a name of the package."""
    with pytest.warns(cosim.CosimWarning) as shown:
        warn(["pump: too slow", "pump: too slow", "valve: leaks"])
    assert [str(one.message) for one in shown] == ["pump: too slow", "valve: leaks"]
    assert {Path(one.filename) for one in shown} == {Path(__file__)}
    assert issubclass(cosim.CosimWarning, UserWarning)


def test_the_shell_has_its_own_lines():
    """A command prints what it warns of: nothing is shown twice."""
    with shell_language(), warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        warn(["pump: too slow"])
    assert shown == []


@pytest.mark.parametrize(
    ("name", "known", "meant"),
    [
        ("gian", ["offset", "gain"], "gain"),
        ("obs", ["plant", "observer"], "observer"),
        ("rate", ["theta", "parameters"], None),  # its letters are in there, far apart
    ],
)
def test_a_name_is_suggested_where_it_is_like_the_unknown_one(name, known, meant):
    """By its letters in their order; a long name has those of many short ones."""
    assert (f"did you mean {meant!r}" in nearest(name, known)) == (meant is not None)
