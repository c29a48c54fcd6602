"""A log to cut."""

import pytest

from tests.log.recordings import STEP_NS, record


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """Return the path of a log of 1001 rows and 11 messages, and its rows."""
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    messages = [(k * 100 * STEP_NS, "info", "run", f"message {k}") for k in range(11)]
    return path, record(path, steps=1000, messages=messages)
