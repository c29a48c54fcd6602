"""What takes a run: memory, several recorders, a slice of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.blocks import sine
from cosim.core import Clock, Graph, Memory, Nothing, Watched, recorders, run
from cosim.core.contracts import Block
from cosim.core.recorded.partial import RecordSelection, reduced_interface
from cosim.core.recorded.selection import chosen_signals
from cosim.core.recorders import GrowingRows, Slice, Tee
from cosim.core.recording import Plan, SignalEvent, Substep
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError, UnknownSignalError, UsageError
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


def block(first, steps, offset=0):
    """Return some steps, ``offset`` [ns] behind their grid points."""
    time_ns = np.arange(first, first + steps + 1, dtype=np.int64) * STEP_NS + offset
    return Block(first, time_ns, time_ns / 1e9, STEP_NS / 1e9)


def write(recorder, lay, steps, size):
    """Write the rows of a run in blocks of at most ``size`` steps; return these rows."""
    rows = np.random.default_rng(1).normal(size=(steps + 1, lay.width))
    with recorder:
        recorder.begin(plan_of(lay))
        for start in range(0, steps, size):
            stop = min(start + size, steps)
            recorder.write(block(start, stop - start), rows[start : stop + 1])
    return rows


# --- memory ---


def memory(first=0, offset=0, period=3, sizes=(4, 4)):
    """Keep rows that hold the numbers of their steps, in blocks of some sizes."""
    kept = Memory()
    kept.begin(plan_of(layout(period, interface=Interface((), (Signal("n"), Signal("p.q", 2))))))
    for size in sizes:
        steps = np.arange(first, first + size + 1.0)
        kept.write(block(first, size, offset), np.repeat(steps[:, None], 3, axis=1))
        first += size
    return kept


@pytest.mark.parametrize("offset", [0, 3])
def test_rows_are_kept_by_the_number_of_their_step(offset):
    """A time off the grid loses no row; what is read cannot be written to."""
    kept = memory(offset=offset)
    assert kept["a.n"].tolist() == [0.0, 3.0, 6.0]
    assert kept.time_ns("a").tolist() == [offset + k * STEP_NS for k in (0, 3, 6)]
    assert memory(first=5)["a.n"].tolist() == [6.0, 9.0, 12.0]
    for array in (kept.rows("a"), kept.time_ns("a")):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize(("sizes", "last"), [((4, 4), 8), ((4, 4, 0), 8), ((), 0)])
def test_the_end_of_a_run_is_its_last_step_kept_or_not(sizes, last):
    """A block that stopped at once adds nothing; without rows it is 0."""
    kept = memory(sizes=sizes)
    assert (kept.steps, kept.end_ns) == (last, last * STEP_NS)
    assert kept["a.p.q"].shape == (last and 3, 2)


def test_signal_names_may_have_dots_and_unknown_ones_name_the_nearest():
    """The first dot ends the component's name."""
    kept = memory(period=1)
    assert kept["a.p.q"].shape == (9, 2)
    assert kept.time("a.p.q").tolist() == kept.time("a").tolist()
    with pytest.raises(
        LogError,
        match=r"the run has no 'a\.p': 'a' has no signal 'p'; did you mean 'p\.q'\?.*n, p\.q",
    ):
        kept["a.p"]
    with pytest.raises(LogError, match="the run has no component 'd'; available: a"):
        kept.time("d.n")


def test_rows_that_grow_stay_as_they_were_written(monkeypatch):
    """Each place begins with the last row that there is, also where its memory is new."""
    monkeypatch.setattr(recorders, "MEMORY_BYTES", 100)
    written = np.random.default_rng(1).random((60, 2))
    rows = GrowingRows(2)
    done = 0
    for steps in (3, 1, 8, 20, 2, 25):
        first = min(done, 1)
        place = rows.place(steps, expected=60 - done)
        assert np.array_equal(place[:first], written[done - first : done])
        place[first:] = written[done : done + steps + 1 - first]
        rows.append(place, first)
        done += steps + 1 - first
    assert done == rows.count == 60
    assert np.array_equal(rows.all(), written)


# --- several ---


class FullError(Exception):
    """A recorder cannot take more."""


def full(block, _):
    """Refuse what is behind 0.5 s."""
    if block.time[-1] > 0.5:
        raise FullError


def advance(recorder, block=3):
    """Run a source over 10 steps."""
    run(Graph({"u": sine(rate=1.0)}, {}), Clock(stop=1.0, step=0.1, block=block), recorder)


def test_all_take_the_whole_run():
    """Rows, and what a scenario adds to them; the rows stay in the memory of the first."""
    first, second = Memory(), Memory()
    said = []
    both = Tee(first, second, said=said.append)
    advance(both)
    both.message(0, "info", "run", "text")
    both.result({"a": 1})
    assert first["u.y"].tolist() == second["u.y"].tolist()
    assert len(first["u.y"]) == 11
    assert first.messages() == second.messages() == said != []
    assert first.results == second.results == {"a": 1}
    assert np.shares_memory(both.memory_for(block(10, 1), 1), first.memory_for(block(10, 1), 1))


class Followed(Nothing):
    """Follows the rows of a block under way, as a log does."""

    rows = None

    def follow(self, rows):
        """Keep what returns them."""
        self.rows = rows


@pytest.mark.parametrize(
    "wrap",
    [
        lambda log: Tee(log, Nothing()),
        lambda log: Tee(Nothing(), log),  # as with --assert, which is first to refuse
        lambda log: Slice(log, RecordSelection(("u.*",))),
    ],
)
def test_a_log_follows_blocks_under_way_behind_any_other_recorder(wrap):
    """Else what a run has computed is lost where an FMU hangs in it."""
    log = Followed()
    advance(wrap(log), block=10)
    under_way, rows = log.rows()
    assert (under_way.index, under_way.steps, len(rows)) == (0, 10, 11)


@pytest.mark.parametrize("is_first", [True, False])
def test_an_error_of_one_ends_the_run_for_all(is_first):
    """They are closed with it; what the first has taken it keeps."""
    kept = Memory()
    refusing = Watched(Nothing(), full)
    pair = (refusing, kept) if is_first else (kept, refusing)
    with pytest.raises(FullError):
        advance(Tee(*pair), block=1)
    assert kept.status == "failed"
    assert len(kept["u.y"]) == (6 if is_first else 7)


def test_all_are_closed_where_closing_fails():
    """The error of the first is raised."""
    closed = []

    def ended(recorder, error):
        closed.append(recorder)
        raise FullError

    second = Memory()
    with (
        pytest.raises(FullError),
        Tee(Watched(Nothing(), lambda *_: None, ended=ended), second),
    ):
        raise KeyboardInterrupt
    assert closed
    assert second.status == "interrupted"


# --- a slice ---


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
    kept = Memory()
    selection = RecordSelection(tuple(f"*.{name}" for name in names), every)
    rows = write(Slice(kept, selection), lay, steps, size)
    assert list(kept.channels) == [channel.name for channel in lay.channels]
    for channel in lay.channels:
        own = np.arange(0, steps + 1, math.lcm(channel.period, every))
        assert kept.time_ns(channel.name).tolist() == (own * STEP_NS).tolist()
        assert set(kept.channels[channel.name].by_name) == set(names)
        for name in names:
            expected = rows[own, channel.signal_columns[name]]
            found = kept[f"{channel.name}.{name}"].reshape(expected.shape)
            assert found.tobytes() == expected.tobytes()


@given(st.integers(1, 20), st.integers(1, 7))
def test_a_window_begins_with_its_first_row_which_is_number_0(index, size):
    """Whatever the blocks are; messages, events and substeps before it are left out."""
    kept = Memory()
    window = Slice(kept, index=index, begin_ns=index * STEP_NS)
    rows = write(window, layout(1), 20, size)
    assert kept.rows("a").tobytes() == rows[index:].tobytes()
    assert kept.time_ns("a").tolist() == [k * STEP_NS for k in range(index, 21)]
    assert kept.steps == 20 - index
    for k in range(21):
        time_ns = k * STEP_NS
        window.message(time_ns, "info", "run", "text")
        window.event(SignalEvent(time_ns, "set", "a.y", ()))
        window.substep(Substep(time_ns / 1e9, time_ns / 1e9 + 1e-3, "a", None, accepted=True))
    assert len(kept.messages()) == len(kept.events()) == len(kept.substeps()) == 21 - index


def test_a_window_shifts_the_rows_that_are_followed():
    """As those that it passes on; before the window there are none."""
    log = Followed()
    Slice(log, index=2, begin_ns=2 * STEP_NS).follow(lambda: found)
    found = None
    assert log.rows() is None
    found = (block(0, 1), np.zeros((2, 1)))
    assert log.rows() is None
    found = (block(3, 4), np.arange(5.0).reshape(5, 1))
    under_way, rows = log.rows()
    assert (under_way.index, under_way.steps, len(rows)) == (1, 4, 5)


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
    recorder = McapRecorder(tmp_path / "a.mcap")
    rows = write(Slice(recorder, RecordSelection(("a.b", "a.c"))), lay, 20, 7)
    log = recorder.recorded()
    assert log.rows("a").tobytes() == np.ascontiguousarray(rows[:, 3000:]).tobytes()
    assert log.partial.missing(log.channels) == {"a": ["a"]}
    assert log.content_hash() == log.recorded_hash


def test_the_last_row_in_the_results_has_what_is_chosen():
    """What the run says of its end beside that is passed on."""
    kept = Memory()
    recorder = Slice(kept, RecordSelection(("a.x",)))
    recorder.begin(plan_of(layout(1)))
    recorder.result({"last": {"a.x[0]": 1.0, "a.x[1]": 2.0, "a.y": 3.0}, "other": 4})
    assert kept.results == {"last": {"a.x[0]": 1.0, "a.x[1]": 2.0}, "other": 4}


@pytest.mark.parametrize("selection", [RecordSelection(("*",)), RecordSelection(None, 2)])
def test_a_selection_of_everything_passes_all_on(selection):
    """There is nothing partial, so that a log is the same file."""
    kept = Memory()
    write(Slice(kept, selection), layout(2, 4), 9, 4)
    assert kept.partial is None
    assert len(kept) == 2 * len(NAMES)


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
    assert chosen_signals(channels, RecordSelection(("*.y",)), beside=beside) == {"a": ["y"]}


def test_a_selection_is_written_as_in_a_scenario():
    """Messages quote it so."""
    every = '[record] signals = ["a.*", "b.y"], every = 10'
    assert str(RecordSelection(("a.*", "b.y"), 10)) == every
    assert str(RecordSelection(("a.*",))) == '[record] signals = ["a.*"]'
    assert str(RecordSelection(None, 3)) == "[record] every = 3"
