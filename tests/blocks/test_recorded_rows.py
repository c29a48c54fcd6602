"""Rows of a recording of which only a part is kept."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis.strategies import integers, sampled_from

from cosim.blocks import recorded_rows
from cosim.blocks.dynamics import lag
from cosim.blocks.recorded_rows import RecordedRows
from cosim.blocks.recorded_times import GivenTimes, RegularTimes, TimesFinder
from cosim.blocks.replay import Replay
from cosim.blocks.source import sine
from cosim.core.clock import Clock
from cosim.core.contracts import Block
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError
from tests.blocks.stepping import drive

STEPS = 1000


@pytest.fixture(autouse=True)
def few_rows(monkeypatch):
    """Keep twenty rows of a double."""
    monkeypatch.setattr(recorded_rows, "_MOST_BYTES", 160)
    monkeypatch.setattr(recorded_rows, "_LEAST_BYTES", 160)


@pytest.fixture(scope="module")
def recording():
    components = {
        "u": sine(amplitude=1.0, rate=90.0, phase=0.1, offset=0.0),
        "lag": Linear(lag(time_constant=0.01)),
    }
    memory = Memory()
    run(Graph(components, {"lag.u": "u.y"}), Clock(STEPS * 1e-3, 1e-3), memory)
    return memory


def test_rows_are_the_recorded_ones_in_whatever_order_they_are_asked_for(recording):
    """One, many, forwards and backwards; twenty of them are kept."""
    rows = RecordedRows(
        recording, "lag", GivenTimes(recording.time_ns("lag"), recording.time("lag"))
    )
    expected = recording["lag.y"]
    assert len(rows) == STEPS + 1
    random = np.random.default_rng(3)
    for count in (1, 1, 2, 7, 40, 300, 1):
        for _ in range(10):
            numbers = np.sort(random.integers(0, STEPS + 1, count))
            assert (rows.at(numbers)[:, 0] == expected[numbers]).all()
            assert len(rows.rows) == rows.stop - rows.begin <= 20
    assert (rows.at(np.arange(STEPS + 1))[:, 0] == expected).all()
    assert rows.at(np.arange(0)).shape == (0, 1)


def test_a_row_before_the_last_one_is_kept(recording):
    """Going back by one reads nothing again."""
    rows = RecordedRows(
        recording, "lag", GivenTimes(recording.time_ns("lag"), recording.time("lag"))
    )
    rows.at(np.array([500]))
    kept = rows.rows
    rows.at(np.array([499]))
    assert rows.rows is kept


def test_rows_of_one_instant_are_kept_together():
    """The limits of a jump: they have the same time, and bounds of time cannot part them."""
    memory = Memory()
    channel = Channel("c", Interface((), (Signal("y"),)), 0)
    memory.begin(Plan(Layout((channel,)), 1, {}, {}, ()))
    time_ns = np.arange(200) // 3
    memory.write(Block(0, time_ns, time_ns / 1e9, 1e-9), np.arange(200.0)[:, None])
    rows = RecordedRows(memory, "c", GivenTimes(time_ns, time_ns / 1e9))
    for number in range(200):
        assert rows.at(np.array([number])) == number


def test_a_run_behind_the_last_row_has_it_again(recording):
    """One time more than there are rows is that of the last one."""
    time_ns = np.append(recording.time_ns("lag"), recording.end_ns + 5)
    rows = RecordedRows(recording, "lag", GivenTimes(time_ns, time_ns / 1e9))
    assert rows.at(np.array([STEPS + 1])) == recording["lag.y"][-1]
    assert rows.at(np.array([0])) == recording["lag.y"][0]


def test_a_recording_with_other_rows_than_before_is_refused(recording):
    """As where a file has changed."""
    time_ns = np.append(recording.time_ns("lag"), recording.end_ns + np.arange(5))
    rows = RecordedRows(recording, "lag", GivenTimes(time_ns, time_ns / 1e9))
    with pytest.raises(LogError, match=r"the run:.*rows of 'lag'"):
        rows.at(np.array([STEPS + 4]))


@pytest.mark.parametrize("inputs", [True, False])
def test_a_replay_has_the_same_bits_however_few_rows_are_kept(recording, inputs):
    """By its compiled step, and by its methods."""
    names = ("lag", "u") if inputs else ("lag",)
    components = {name: Replay(recording, name, inputs=inputs) for name in names}
    connections = {"lag.u": "u.y"} if inputs else {}
    memory = Memory()
    run(Graph(components, connections), Clock(STEPS * 1e-3, 1e-3), memory)
    assert (memory["lag.y"] == recording["lag.y"]).all()
    replay = Replay(recording, "lag", inputs=inputs)
    u = np.zeros((STEPS + 1, replay.interface.n_u))
    assert (drive(replay, u)[:, 0] == recording["lag.y"]).all()


def test_a_constant_input_needs_no_connection(recording):
    """And one that changes only in its last row does."""
    channel = Channel("c", Interface((Signal("u"), Signal("v", 2)), (Signal("y"),)), 0)
    for last, connection in ((1.0, "optional"), (2.0, "required")):
        memory = Memory()
        memory.begin(Plan(Layout((channel,)), 1, {}, {}, ()))
        time_ns = np.arange(100)
        rows = np.ones((100, 4))
        rows[:, 2] = 7.0
        rows[-1, 0] = last
        memory.write(Block(0, time_ns, time_ns / 1e9, 1e-9), rows)
        u, v = Replay(memory, "c").interface.inputs
        assert u.connection == connection
        assert (v.connection, v.start) == ("optional", (1.0, 7.0))


@given(
    first_ns=integers(0, 2**40),
    period_ns=integers(1, 2**31),
    count=integers(1, 10**6),
    data=sampled_from([0.0, 0.5, 1.0, -1.0, 2.0]),
    number=integers(-3, 10**6 + 3),
)
def test_regular_times_are_found_as_by_a_search(first_ns, period_ns, count, data, number):
    """At a hundred rows, one bit before or after them, between two and outside of all."""
    number = min(number, count + 2)
    regular = RegularTimes(first_ns, period_ns, count)
    time_ns = first_ns + period_ns * np.arange(count)
    given_times = GivenTimes(time_ns, time_ns / 1e9)
    at = (first_ns + period_ns * (np.arange(number - 100, number + 1) + data)) / 1e9
    t = np.concatenate([at, np.nextafter(at, -np.inf), np.nextafter(at, np.inf)])
    assert (regular.last_not_after(t) == given_times.last_not_after(t)).all()
    begin = max(0, count - 3)
    expected = given_times.nanoseconds(begin, count)
    assert (regular.nanoseconds(begin, count) == expected).all()


@pytest.mark.parametrize(
    ("parts", "is_regular"),
    [
        ([[]], True),
        ([[7]], True),
        ([[7], [], [9], [11, 13]], True),
        ([[7, 9, 11], [13]], True),
        ([[7, 9, 11], [14]], False),
        ([[7, 9, 12]], False),
        ([[7, 7, 7]], False),
        ([[7], [7]], False),
    ],
)
def test_times_are_regular_if_all_of_them_are(parts, is_regular):
    """However they come; several rows at one instant never are."""
    finder = TimesFinder()
    for part in parts:
        finder.add(np.array(part, np.int64))
    every = np.concatenate([np.array(part, np.int64) for part in parts])

    class Recorded:
        def time_ns(self, component):
            return every

    times = finder.times(Recorded(), "c")
    assert isinstance(times, RegularTimes) == is_regular
    assert len(times) == len(every)
    assert (times.nanoseconds(0, len(every)) == every).all()
