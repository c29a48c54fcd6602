"""Logs played to viewers: what they receive, and when."""

from __future__ import annotations

from itertools import chain

import numpy as np
import pytest
from mcap.reader import make_reader

import cosim
from cosim.core.recording import SignalEvent
from cosim.errors import LogError, UnknownSignalError, UsageError
from cosim.live import play
from cosim.live import playback as playing
from cosim.live.playback import Playback, _Cursor, _messages
from cosim.log import McapRecorder
from cosim.log.messages import encode_event, encode_log
from tests.live.collecting import sent
from tests.live.viewer import Viewer, fields
from tests.log.recordings import STEP_NS, blocks, layout, make_chunks_small, plan, table


class WallClock:
    """A wall clock that goes on by what somebody sleeps; every look at it takes a while."""

    def __init__(self, look=0.0):
        self.time = 100.0
        self.look = look
        self.sleeps = 0

    def now(self):
        self.time += self.look
        return self.time

    def sleep(self, seconds):
        assert 0.0 < seconds <= 0.05
        self.sleeps += 1
        self.time += seconds


class EnoughError(Exception):
    """Ends playback."""


WIDE = ("/wide", "/wide.2")


def test_rows_are_sent_bit_for_bit(log, collector):
    """Of every component at its own instants, decoded with the schemas that are advertised.

    Of the widest every hundredth row is decoded.
    """
    wall = WallClock()
    Playback(log, collector, speed=2.0, now=wall.now, sleep=wall.sleep).run()
    topics = sent(collector).topics
    for names, name, stride in (
        (["/plant"], "plant", 1),
        (["/identifier"], "identifier", 1),
        (WIDE, "wide", 100),
    ):
        for topic in names:
            assert topics[topic].times == log.time_ns(name).tolist()
        values = np.hstack([topics[topic].rows(stride) for topic in names])
        assert values.tobytes() == log.rows(name)[::stride].tobytes()
    ((time_ns, text),) = topics["/cosim/log"].messages
    assert (time_ns, text.message, text.name) == (5 * STEP_NS, "hot", "plant")
    assert sent(collector).sent == sorted(sent(collector).sent)


@pytest.mark.slow
def test_a_viewer_receives_the_channels_the_rows_and_the_time_of_the_log(log, server):
    """Topics, schemas and metadata byte for byte, rows bit for bit; time never goes back."""
    wall = WallClock()
    playback = Playback(log, server, now=wall.now, sleep=wall.sleep)
    with log.path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    with Viewer(server.url) as viewer:
        viewer.wait_for_channels(*(channel.topic for channel in summary.channels.values()))
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            advertised = viewer.channels[channel.topic]
            assert advertised["schemaName"] == schema.name
            assert viewer.schema(channel.topic) == schema.data
            assert advertised.get("metadata", {}) == channel.metadata
        assert len(viewer.channels) == len(summary.channels)
        assert "time" in viewer.info["capabilities"]
        viewer.subscribe("/plant", "/identifier", "/cosim/log")
        server.wait_for_viewer()
        playback.run()
        found = viewer.messages({"/plant": 401, "/identifier": 81, "/cosim/log": 1})
        viewer.wait_for_time(400 * STEP_NS)
    for name in ("plant", "identifier"):
        times = [time_ns for time_ns, _ in found[f"/{name}"]]
        values = np.array([fields(message) for _, message in found[f"/{name}"]])
        assert times == log.time_ns(name).tolist()
        assert values.tobytes() == log.rows(name).tobytes()
    assert viewer.times == [k * STEP_NS for k in range(401)]


def test_viewers_are_told_of_some_instants_of_many(log, collector):
    """Of a window of 200 steps the first, every twentieth, and the last."""
    wall = WallClock()
    Playback(log, collector, speed=20.0, now=wall.now, sleep=wall.sleep).run()
    connection = sent(collector)
    assert connection.topics["/plant"].times == [k * STEP_NS for k in range(401)]
    windows = [range(1, 201, 20), [200], range(201, 401, 20), [400]]
    told = list(dict.fromkeys(connection.times))
    assert told == [0, *(k * STEP_NS for k in chain(*windows))]


def test_playback_takes_the_time_of_the_log_by_the_speed(log, collecting):
    """It is never behind by more than it takes to look at the clock, and no error adds up."""
    for speed in (0.5, 1.0, 3.0):
        wall = WallClock()
        with collecting("plant") as server:
            playback = Playback(log, server, speed=speed, now=wall.now, sleep=wall.sleep)
            playback.run()
        # The last window ends at most one window, 10 ms, behind the last row.
        assert 0.4 / speed - 1e-9 <= wall.time - 100.0 <= 0.4 / speed + 0.01 + 1e-9
        assert playback.lateness.late == 0
        assert playback.lateness.factor == speed
        assert playback.lateness.blocks == pytest.approx(0.4 / (0.01 * speed), abs=1)


def test_playback_that_is_too_slow_says_how_late_it_was(log, collector):
    """Each look at the clock takes 20 ms here, and the windows are 10 ms."""
    wall = WallClock(look=0.02)
    playback = Playback(log, collector, now=wall.now, sleep=wall.sleep)
    playback.run()
    lateness = playback.lateness
    assert wall.sleeps == 0
    assert lateness.late == lateness.blocks == 40  # behind the first row
    # 41 looks of 20 ms from the first on; the last one is due after 0.4 s
    assert lateness.largest == pytest.approx(41 * 0.02 - 0.4)
    assert lateness.time == pytest.approx(0.4)


def test_a_loop_begins_again_one_step_behind_the_end(log, collecting):
    """Counted from the first start, so that no error adds up either."""
    wall = WallClock()

    def check():
        if wall.time >= 100.0 + 10 * 0.401:
            raise EnoughError

    with collecting("identifier") as server:
        playback = Playback(log, server, check=check, now=wall.now, sleep=wall.sleep)
        with pytest.raises(EnoughError):
            playback.run(loop=True)
    assert sent(server).topics["/identifier"].times == 10 * log.time_ns("identifier").tolist()
    assert 0 in sent(server).times[1:]
    assert playback.lateness.late == 0


def test_a_long_wait_is_interrupted(tmp_path, collector):
    """No sleep is longer than the patience of who presses Ctrl-C."""
    scenario = cosim.load("academic").set({"scenario.stop": 0.001})
    log = cosim.run(scenario, out=tmp_path / "a.mcap")
    wall = WallClock()
    looks = []

    def check():
        looks.append(wall.time)
        if wall.time > 101.0:
            raise EnoughError

    playback = Playback(log, collector, speed=1e-6, check=check, now=wall.now, sleep=wall.sleep)
    with pytest.raises(EnoughError):
        playback.run()
    assert max(np.diff(looks)) <= 0.05 + 1e-9


def test_selected_channels_alone_are_published(log, collecting):
    """Components, signals, elements: every channel that holds one of them."""
    expected = {
        (): ["/cosim/log", "/identifier", "/plant", "/wide", "/wide.2"],
        ("plant",): ["/cosim/log", "/plant"],
        ("identifier.theta",): ["/cosim/log", "/identifier"],
        ("plant.u", "wide.y[4099]"): ["/cosim/log", "/plant", "/wide.2"],
        ("wide.y[0:2]",): ["/cosim/log", "/wide"],
        ("wide",): ["/cosim/log", "/wide", "/wide.2"],
        ("*.y",): ["/cosim/log", "/identifier", "/wide", "/wide.2"],
        ("*.theta[0]", "pl*.u"): ["/cosim/log", "/identifier", "/plant"],
    }
    for signals, topics in expected.items():
        with collecting(*signals) as server:
            Playback(log, server)
            assert sorted(sent(server).topics) == topics


def test_signals_that_the_log_has_not_cannot_be_selected(log, collecting, subtests):
    """The nearest name is told."""
    for name, text in [
        ("plan", "'plan'; did you mean 'plant'"),
        ("plant.x", "'plant'.*'x'"),
        ("plant.x_a[2]", "2 elements"),
        ("*.delta", r"'\*\.delta'"),
    ]:
        with (
            collecting(name) as server,
            subtests.test(case=name),
            pytest.raises(UnknownSignalError, match=text),
        ):
            Playback(log, server)


def test_a_speed_that_is_none_is_refused(log, collector, subtests):
    """Before anything is played."""
    for speed in (0.0, -1.0, float("nan"), float("inf"), "fast"):
        with subtests.test(case=speed), pytest.raises(UsageError, match=rf"^speed: .*{speed}"):
            play(log, collector, speed=speed)
    assert sent(collector).topics == {}


def test_a_log_without_rows_cannot_be_played(tmp_path, collector):
    """There is nothing to show."""
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.begin(plan())
    with pytest.raises(LogError, match=r"a\.mcap has no rows to play"):
        play(cosim.open_log(tmp_path / "a.mcap"), collector)


@pytest.fixture
def spoken(tmp_path):
    """Record 100 steps with many messages and events, some at one time, in small chunks."""
    rows = table(layout(), 100)
    random = np.random.default_rng(5)
    with pytest.MonkeyPatch.context() as patch:
        make_chunks_small(patch, 1000)
        with McapRecorder(tmp_path / "a.mcap", events=True) as recorder:
            recorder.begin(plan(layout()))
            for number, time_ns in enumerate(random.integers(0, 101, 120) * STEP_NS):
                recorder.message(int(time_ns), "info", "plant", str(number))
                if number % 3 == 0:
                    recorder.event(SignalEvent(int(time_ns), "set", "plant.u", (1.0,), ()))
            for block, signals in blocks(rows, 70):
                recorder.write(block, signals)
    return cosim.open_log(tmp_path / "a.mcap")


def test_messages_are_played_in_their_order_however_few_are_read_at_once(spoken, monkeypatch):
    """Each once: those of the log in the order of time, messages before events."""
    expected = [
        (message.time_ns, 0, encode_log(message.time_ns, "info", "plant", message.text))
        for message in spoken.messages()
    ]
    expected += [(event.time_ns, 1, encode_event(event)) for event in spoken.events()]
    expected.sort(key=lambda entry: entry[:2])
    assert spoken.message_counts() == {"/cosim/log": 120, "/cosim/event": 40}
    for together in (1, 7, 40, 10_000):
        monkeypatch.setattr(playing, "_TOGETHER", together)
        messages = _Cursor(_messages(spoken, 160, start_ns=0))
        found = []
        for until_ns in (0, *range(3 * STEP_NS, 130 * STEP_NS, 7 * STEP_NS)):
            for _, piece in messages.take(until_ns):
                assert (
                    len(piece) <= 4 * together + 20
                )  # 160 at 101 instants are 1.6 each, at random
                for topic, time_ns, data in piece:
                    assert time_ns <= until_ns
                    found.append((time_ns, int(topic == "/cosim/event"), data))
            assert messages.next_ns is None or messages.next_ns > until_ns
        assert found == expected, together
    assert list(_messages(spoken, 0, start_ns=0)) == []  # nothing is read of a log without any
