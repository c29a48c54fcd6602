"""Recordings that tests only read."""

import pytest

from cosim.log import open_log
from tests.log.recordings import record


@pytest.fixture(scope="session")
def short_log(tmp_path_factory):
    """Return the path of a log of 20 steps."""
    path = tmp_path_factory.mktemp("short") / "a.mcap"
    record(path, steps=20)
    return path


@pytest.fixture(scope="session")
def long_log(tmp_path_factory):
    """Return a log of 1000 steps, whose slower component has every fifth row, and its rows."""
    path = tmp_path_factory.mktemp("long") / "a.mcap"
    rows = record(path, steps=1000)
    return open_log(path), rows
