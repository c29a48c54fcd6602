"""Chosen signals and steps on their way to a recorder."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.core.contracts import Block
from cosim.core.partial_recorder import PartialRecorder, chosen_signals
from cosim.core.recorded.partial import RecordSelection, reduced_interface
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import UnknownSignalError, UsageError
from cosim.log import McapRecorder

STEP_NS = 1_000_000
PLANT = Interface(
    (Signal("u"), Signal("v", 2)),
    (Signal("x", 2, role="state"), Signal("y"), Signal("z")),
    {"y": ("u", "v"), "x": None, "z": ("v",)},
    {"y": ("u",)},
    delayed=("v",),
    lagging=("y",),
    jumping=("z",),
    left_limits=("y", "z"),
)
NAMES = [signal.name for signal in PLANT.signals]


def layout(*periods, interface=PLANT):
    """Return the layout of components with these periods, called a, b, ..."""
    channels = []
    start = 0
    for name, period in zip("abcdef", periods, strict=False):
        channels.append(Channel(name, interface, start, period))
        start = channels[-1].columns.stop
    return Layout(tuple(channels))


def plan_of(lay):
    """Return the plan of a run without designs."""
    return Plan(lay, STEP_NS, {}, {}, ())


def write(recorder, lay, steps, size, seed=1):
    """Write the rows of a run in blocks of at most ``size`` steps; return these rows."""
    rows = np.random.default_rng(seed).normal(size=(steps + 1, lay.width))
    with recorder:
        recorder.begin(plan_of(lay))
        for start in range(0, steps, size):
            stop = min(start + size, steps)
            time_ns = np.arange(start, stop + 1, dtype=np.int64) * STEP_NS
            block = Block(start, time_ns, time_ns / 1e9, STEP_NS / 1e9)
            recorder.write(block, rows[start : stop + 1])
    return rows


@given(
    st.lists(st.integers(1, 6), min_size=1, max_size=4),
    st.lists(st.sampled_from(NAMES), min_size=1, unique=True),
    st.integers(1, 9),
    st.integers(1, 40),
    st.integers(1, 12),
)
def test_the_chosen_columns_and_rows_of_the_run_are_passed_on(periods, names, every, steps, size):
    """Whatever the blocks are: those of the signals, at the multiples of both periods."""
    lay = layout(*periods)
    memory = Memory()
    selection = RecordSelection(tuple(f"*.{name}" for name in names), every)
    rows = write(PartialRecorder(memory, selection), lay, steps, size)
    assert list(memory.channels) == [channel.name for channel in lay.channels]
    for channel in lay.channels:
        kept = np.arange(0, steps + 1, math.lcm(channel.period, every))
        assert memory.time_ns(channel.name).tolist() == (kept * STEP_NS).tolist()
        assert set(memory.channels[channel.name].by_name) == set(names)
        for name in names:
            expected = rows[kept, channel.signal_columns[name]]
            found = memory[f"{channel.name}.{name}"].reshape(expected.shape)
            assert found.tobytes() == expected.tobytes()


@given(st.lists(st.sampled_from(NAMES), unique=True))
def test_a_reduced_interface_says_nothing_of_what_it_has_not(names):
    """And of the others what the whole one says."""
    reduced = reduced_interface(PLANT, names)
    kept = set(names)
    assert [signal.name for signal in reduced.signals] == [n for n in NAMES if n in kept]
    for output, inputs in reduced.feedthrough.items():
        whole = PLANT.feedthrough[output]
        expected = None if whole is None else tuple(name for name in whole if name in kept)
        assert inputs == expected
    assert set(reduced.feedthrough) == set(PLANT.feedthrough) & kept
    for key in ("delayed", "lagging", "jumping", "left_limits"):
        assert set(getattr(reduced, key)) == set(getattr(PLANT, key)) & kept


def test_a_part_of_a_wide_component_may_need_several_channels(tmp_path):
    """More than 4096 elements, chosen from the middle of a row that has more."""
    signals = (Signal("a", 3000), Signal("b", 3000), Signal("c", 3000))
    lay = layout(1, interface=Interface((), signals))
    path = tmp_path / "a.mcap"
    recorder = McapRecorder(path)
    rows = write(PartialRecorder(recorder, RecordSelection(("a.b", "a.c"))), lay, 20, 7)
    log = recorder.recorded()
    assert log.rows("a").tobytes() == np.ascontiguousarray(rows[:, 3000:]).tobytes()
    assert log.partial.missing(log.channels) == {"a": ["a"]}
    assert log.content_hash() == log.recorded_hash


def test_the_last_row_in_the_results_has_what_is_chosen():
    """What the run says of its end beside that is passed on."""
    memory = Memory()
    recorder = PartialRecorder(memory, RecordSelection(("a.x",)))
    with recorder:
        recorder.begin(plan_of(layout(1)))
        recorder.result({"last": {"a.x[0]": 1.0, "a.x[1]": 2.0, "a.y": 3.0}, "other": 4})
    assert memory.results == {"last": {"a.x[0]": 1.0, "a.x[1]": 2.0}, "other": 4}


def test_a_selection_of_everything_passes_all_on():
    """There is nothing partial, so that a log is the same file."""
    for selection in (RecordSelection(("*",)), RecordSelection(None, 2)):
        memory = Memory()
        write(PartialRecorder(memory, selection), layout(2, 4), 9, 4)
        assert memory.partial is None
        assert len(memory) == 2 * len(NAMES)


def test_only_signals_of_the_run_can_be_chosen():
    """Elements, unknown names, and what only another run has."""
    channels = {channel.name: channel for channel in layout(1).channels}
    beside = {channel.name: channel for channel in layout(1, 1).channels}
    with pytest.raises(UsageError, match=r"'a\.x'.*'a\.x\[1\]', a part of a signal"):
        chosen_signals(channels, RecordSelection(("a.x[1]",)))
    with pytest.raises(UnknownSignalError, match=r"no signal matches 'b\.\*'"):
        chosen_signals(channels, RecordSelection(("b.*",)))
    with pytest.raises(UsageError, match=r"matches no signal of this run's components: a;"):
        chosen_signals(channels, RecordSelection(("b.*",)), beside=beside)
    chosen = chosen_signals(channels, RecordSelection(("*.y",)), beside=beside)
    assert chosen == {"a": ["y"]}


@pytest.mark.parametrize(
    ("selection", "text"),
    [
        (RecordSelection(("a.*", "b.y"), 10), '[record] signals = ["a.*", "b.y"], every = 10'),
        (RecordSelection(("a.*",)), '[record] signals = ["a.*"]'),
        (RecordSelection(None, 3), "[record] every = 3"),
    ],
)
def test_a_selection_is_written_as_in_a_scenario(selection, text):
    """Messages quote it so."""
    assert str(selection) == text
