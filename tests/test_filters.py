"""Filters of warnings leave those of others as they are."""

import warnings
from contextlib import suppress

import pytest

from cosim.filters import collected_warnings, ignored_warnings


def test_ignored_warnings_are_those_whose_text_matches():
    """Others are shown, here as errors."""
    with ignored_warnings("no room"):
        warnings.warn("no room for it", stacklevel=1)
        with pytest.raises(UserWarning, match="something else"):
            warnings.warn("something else", stacklevel=1)


def test_collected_warnings_are_those_whose_text_matches():
    """They are no errors, whatever the filters say; others are as ever."""
    with collected_warnings("no room") as texts:
        warnings.warn("no room for it", stacklevel=1)
        with pytest.raises(UserWarning, match="something else"):
            warnings.warn("something else", stacklevel=1)
    assert texts == ["no room for it"]


def test_others_are_shown_after_those_that_are_collected():
    """Also where the block ends with an error."""
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        with suppress(KeyError), collected_warnings("no room"):
            warnings.warn("something else", stacklevel=1)
            warnings.warn("no room for it", stacklevel=1)
            raise KeyError
    assert [str(one.message) for one in shown] == ["something else"]
