"""A log to convert."""

import pytest

from cosim.log import open_log
from tests.log.recordings import record


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """Return a log whose slower component has every fifth row, and its rows."""
    path = tmp_path_factory.mktemp("recorded") / "a.mcap"
    rows = record(path, steps=400)
    return open_log(path), rows
