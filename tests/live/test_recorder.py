"""Runs that viewers watch while they go on, beside their logs."""

from __future__ import annotations

import socket
from contextlib import ExitStack

import numpy as np
import pytest

import cosim
from cosim.core.recorders import Watched
from cosim.errors import UnknownSignalError
from cosim.live import LiveServer
from cosim.live.playback import Playback
from tests.live.viewer import Viewer, fields


class Subscribing:
    """A view of a run to which a viewer connects, and subscribes, before the first row."""

    def __init__(self, server, *topics):
        self._server = server
        self._topics = topics
        self._opened = ExitStack()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._opened.close()

    def beside(self, recorder, kinds):
        """Return what the server does, which waits once all is advertised."""

        def subscribe():
            self.viewer = self._opened.enter_context(Viewer(self._server.url))
            self.viewer.subscribe(*self._topics)
            self._server.wait_for_viewer()

        beside = self._server.beside(recorder, kinds)
        return Watched(beside, lambda *_: None, began=subscribe)


@pytest.mark.slow
def test_the_rows_of_the_log_of_a_run_are_sent(collector, tmp_path):
    """Every row of every component bit for bit, also of slower ones, and the messages."""
    scenario = cosim.load("closed-loop").set({"scenario.stop": 0.2})
    log = cosim.run(scenario, out=tmp_path / "a.mcap", live=collector)
    topics = collector.connection.topics
    for name in log.channels:
        assert topics[f"/{name}"].times == log.time_ns(name).tolist()
        assert topics[f"/{name}"].rows().tobytes() == log.rows(name).tobytes()
    texts = [message.message for _, message in topics["/cosim/log"].messages]
    assert texts == [message.text for message in log.messages()]
    assert cosim.diff(log, cosim.run(scenario)).equal


@pytest.mark.slow
def test_a_viewer_receives_the_rows_of_the_log(server, tmp_path):
    """Every row of every component bit for bit, also of slower ones, and the messages."""
    scenario = cosim.load("closed-loop").set({"scenario.stop": 0.5})
    with Subscribing(server, *(f"/{name}" for name in scenario.specs)) as live:
        log = cosim.run(scenario, out=tmp_path / "a.mcap", live=live)
        counts = {f"/{name}": len(log.time_ns(name)) for name in log.channels}
        found = live.viewer.messages(counts)
    for name in log.channels:
        messages = found[f"/{name}"]
        times = [time_ns for time_ns, _ in messages]
        assert times == log.time_ns(name).tolist()
        values = np.array([fields(message) for _, message in messages])
        assert values.tobytes() == log.rows(name).tobytes()
    assert cosim.diff(log, cosim.run(scenario)).equal


@pytest.mark.slow
def test_a_run_is_watched_at_the_pace_of_the_wall_clock(server):
    """Without a log, too: the rows are those of any other run."""
    scenario = cosim.load("academic").set({"scenario.stop": 0.05})
    with Subscribing(server, "/plant") as live:
        run = cosim.run(scenario, live=live, realtime=1.0)
        messages = live.viewer.messages({"/plant": 51})["/plant"]
    assert [fields(message) for _, message in messages] == run.rows("plant").tolist()
    assert run.results["real_time"]["blocks"] == 5


ACTION = """
[[actions]]
at = 0.105
signal = "plant.u"
offset = 0.5
"""


def test_events_are_shown(collector, tmp_path):
    """With the schema and in the order that they have in the log."""
    path = tmp_path / "x.toml"
    text = cosim.load("academic").document.text
    path.write_text(text + ACTION)
    run = cosim.run(cosim.load(path).set({"scenario.stop": 0.2}), live=collector)
    messages = collector.connection.topics["/cosim/event"].messages
    events = [(time_ns, message.cause, message.signal) for time_ns, message in messages]
    assert events == [(event.time_ns, event.cause, event.signal) for event in run.events()]
    assert events


@pytest.mark.slow
def test_a_viewer_that_takes_nothing_does_not_stop_the_run(server):
    """The client reads a few messages ahead, and no more unless somebody asks for them."""
    scenario = cosim.load("academic").set({"scenario.stop": 40.0})
    with Subscribing(server, "/plant", "/observer", "/regressor") as live:
        run = cosim.run(scenario, live=live)
    assert (run.status, run.steps) == ("complete", 40_000)


@pytest.mark.slow
def test_a_viewer_that_vanishes_does_not_stop_the_run(server):
    """Its connection is reset between two blocks."""
    scenario = cosim.load("academic").set({"scenario.stop": 2.0})
    vanished = []

    def vanish(time, end):
        if time > 0.5 and not vanished:
            vanished.append(time)
            live.viewer._socket.socket.shutdown(socket.SHUT_RDWR)

    with Subscribing(server, "/plant") as live:
        run = cosim.run(scenario, live=live, progress=vanish, block=10)
    assert vanished
    assert (run.status, run.steps) == ("complete", 2000)


@pytest.mark.slow
def test_a_run_of_which_a_part_is_recorded_is_shown_as_a_whole(server, tmp_path):
    """Its log is played as far as it goes."""
    path = tmp_path / "x.toml"
    text = cosim.load("academic").document.text
    path.write_text(f'{text}\n[record]\nsignals = ["plant.y", "observer.*"]\nevery = 2\n')
    scenario = cosim.load(path).set({"scenario.stop": 0.2})
    with Subscribing(server, "/plant") as live:
        log = cosim.run(scenario, out=tmp_path / "a.mcap", live=live)
        messages = live.viewer.messages({"/plant": 201})["/plant"]
    assert [message.y for _, message in messages][::2] == log["plant.y"].tolist()
    with LiveServer(port=0) as again:
        playback = Playback(log, again, speed=10.0)
        with Viewer(again.url) as viewer:
            viewer.subscribe("/plant", "/observer")
            again.wait_for_viewer()
            playback.run()
            found = viewer.messages({"/plant": 101, "/observer": 101})
        assert "/u" not in viewer.channels
    assert [fields(message) for _, message in found["/plant"]] == log.rows("plant").tolist()


@pytest.mark.usefixtures("collecting")
def test_signals_that_the_run_has_not_are_refused_before_it_begins(tmp_path):
    """There is no log then."""
    with (
        LiveServer(signals=["plant.z"]) as server,
        pytest.raises(UnknownSignalError, match=r"'plant\.z'"),
    ):
        cosim.run("academic", out=tmp_path / "a.mcap", live=server)
    assert list(tmp_path.iterdir()) == []
