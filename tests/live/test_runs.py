"""Runs that viewers watch while they go on, beside their logs."""

from __future__ import annotations

import socket
from contextlib import ExitStack

import pytest

import cosim
from cosim.core.recorders import Memory, Watched
from cosim.errors import UnknownSignalError
from cosim.live import play
from tests.live.collecting import sent
from tests.live.viewer import Viewer, fields
from tests.log.recordings import layout, plan


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


def test_the_rows_of_the_log_of_a_run_are_sent(collector, tmp_path):
    """Every row of every component bit for bit, also of slower ones, and the messages."""
    scenario = cosim.load("closed-loop").set({"scenario.stop": 0.2})
    log = cosim.run(scenario, out=tmp_path / "a.mcap", live=collector)
    topics = sent(collector).topics
    for name in log.channels:
        assert topics[f"/{name}"].times == log.time_ns(name).tolist()
        assert topics[f"/{name}"].rows().tobytes() == log.rows(name).tobytes()
    texts = [message.message for _, message in topics["/cosim/log"].messages]
    assert texts == [message.text for message in log.messages()]
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


def academic(folder, addition):
    """Return the scenario of 0.2 s with something more in it."""
    path = folder / "x.toml"
    path.write_text(cosim.load("academic").document.text + addition)
    return cosim.load(path).set({"scenario.stop": 0.2})


def test_events_are_shown(collector, tmp_path):
    """With the schema and in the order that they have in the log."""
    run = cosim.run(academic(tmp_path, ACTION), live=collector)
    messages = sent(collector).topics["/cosim/event"].messages
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


def test_a_run_of_which_a_part_is_recorded_is_shown_as_a_whole(collecting, tmp_path):
    """Its log is played as far as it goes."""
    record = '\n[record]\nsignals = ["plant.y", "observer.*"]\nevery = 2\n'
    with collecting() as server:
        out = tmp_path / "a.mcap"
        log = cosim.run(academic(tmp_path, record), out=out, live=server)
    shown = sent(server).topics["/plant"]
    assert len(shown.times) == 201
    assert [message.y for _, message in shown.messages][::2] == log["plant.y"].tolist()
    with collecting() as again:
        assert play(log, again, speed=1000.0).factor == 1000.0
    topics = sent(again).topics
    assert topics.keys() == {"/cosim/log", "/plant", "/observer"}
    assert topics["/plant"].rows().tolist() == log.rows("plant").tolist()


def test_what_comes_behind_the_last_block_is_shown(collector):
    """What comes before the run begins is not: it has no topics yet."""
    with collector.beside(Memory(), {}) as recorder:
        recorder.message(0, "error", "plant", "not built")
        recorder.begin(plan(layout()))
        recorder.message(5, "info", "plant", "the end")
    ((time_ns, text),) = sent(collector).topics["/cosim/log"].messages
    assert (time_ns, text.message) == (5, "the end")


def test_signals_that_the_run_has_not_are_refused_before_it_begins(collecting, tmp_path):
    """There is no log then."""
    with collecting("plant.z") as server, pytest.raises(UnknownSignalError, match=r"'plant\.z'"):
        cosim.run("academic", out=tmp_path / "a.mcap", live=server)
    assert list(tmp_path.iterdir()) == []
