"""Recordings that tests only read."""

import threading

import pytest

from cosim.log import open_log, store
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


@pytest.fixture
def flushing(monkeypatch):
    """Return a lock that a run holds while it writes to its log.

    A kill leaves what a copy has that is made under it; one of a file that changes has neither.
    """
    lock = threading.Lock()
    add = store.LogStore.add

    def add_alone(own, content):
        with lock:
            add(own, content)

    monkeypatch.setattr(store.LogStore, "add", add_alone)
    return lock
