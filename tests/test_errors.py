"""Warnings reach who calls the package, at the line that calls it."""

import warnings
from pathlib import Path

import pytest

import cosim
from cosim.errors import shell_language, warn


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
