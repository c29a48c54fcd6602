"""Servers, and the log that they show."""

import pytest

from cosim.live import LiveServer
from cosim.log import McapRecorder, open_log
from tests.live.collecting import CollectingSdk
from tests.log.recordings import STEP_NS, blocks, layout, plan, table


@pytest.fixture(scope="session")
def log(tmp_path_factory):
    """Record 400 steps of a plant and an identifier of every fifth, with odd bits and messages."""
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    rows = table(layout(wide=4100), 400)
    with McapRecorder(path, kinds={"plant": "descriptor"}) as recorder:
        recorder.begin(plan(layout(wide=4100)))
        recorder.message(5 * STEP_NS, "warning", "plant", "hot")
        for block, signals in blocks(rows, 70):
            recorder.write(block, signals)
    return open_log(path)


@pytest.fixture
def server():
    """Listen on any free port."""
    with LiveServer(port=0) as server:
        yield server


@pytest.fixture
def collecting(monkeypatch):
    """Collect what servers would send; return what makes one."""
    monkeypatch.setattr("cosim.live.server.load_sdk", CollectingSdk)
    monkeypatch.setattr("cosim.live.server._QUIET", 0.0)
    return lambda *signals: LiveServer(port=0, signals=signals)


@pytest.fixture
def collector(collecting):
    """Return a server that collects what it would send."""
    with collecting() as server:
        yield server
