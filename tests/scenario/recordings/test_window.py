"""Replays of which a window of time is recorded."""

import json

import numpy as np
import pytest

import cosim
from cosim.errors import ClockError, LogError, UsageError
from cosim.report.summary import summarize
from cosim.report.verification import verify
from cosim.scenario.document.document import shipped
from tests.log.crafting import change_rows, put_together, take_apart

pytestmark = pytest.mark.usefixtures("without_verdicts")

END = 0.2
RATES = {"identifier.period": 0.01, "scenario.stop": END}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Record a run whose identifier has a row in ten communication steps."""
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    return cosim.run("academic", out=path, set=RATES)


def rows_within(run, name, begin, end):
    """Return times and rows of a component within a window of time [s]."""
    time_ns = run.time_ns(name)
    inside = (time_ns >= round(begin * 1e9)) & (time_ns <= round(end * 1e9))
    return time_ns[inside], run.rows(name)[inside]


def check_same_rows(part, whole, begin, end):
    """Check that a recording has exactly the rows that another has within a window."""
    assert list(part.channels) == list(whole.channels)
    for name in whole.channels:
        time_ns, rows = rows_within(whole, name, begin, end)
        assert part.time_ns(name).tolist() == time_ns.tolist()
        assert part.rows(name).tobytes() == rows.tobytes()


@pytest.mark.fast("pair")
@pytest.mark.parametrize("name", sorted(set(shipped()) - {"compensation"}))
def test_a_window_has_the_rows_of_the_whole_replay(name, tmp_path):
    """Bit for bit, of every signal, in memory and in a log; whatever the states are there."""
    source = cosim.run(name, out=tmp_path / "a.mcap", set={"scenario.stop": 0.5})
    changes = {"observer.filter_rate": 500.0} if name.startswith("academic") else {}
    whole = cosim.replay(source, set=changes)
    open_ends = ((None, 0.35), (0.1, None)) if name == "academic" else ()
    for begin, end in ((0.4, 0.41), *open_ends):
        part = cosim.replay(source, set=changes, window=(begin, end))
        check_same_rows(part, whole, begin or 0.0, end or 0.5)
    out = tmp_path / "b.mcap"
    written = cosim.replay(source, set=changes, window=(0.1, 0.35), out=out)
    check_same_rows(written, whole, 0.1, 0.35)
    assert written.recorded_hash == written.content_hash()


@pytest.mark.slow
def test_blocks_do_not_change_a_window(log):
    """Where a block ends, and how long it is, makes no difference."""
    hashes = set()
    for block in (1, 7, 50, 1000):
        part = cosim.replay(log, window=(0.05, 0.1), block=block)
        check_same_rows(part, log, 0.05, 0.1)
        hashes.add(part.rows("observer").tobytes())
    assert len(hashes) == 1


def test_a_window_begins_where_every_component_has_a_row(log):
    """A component with a period of its own would have none at the begin."""
    message = r"the window begins at 0\.053 s, where 'identifier' has no row: .* 10 .*: 0\.05 s"
    with pytest.raises(UsageError, match=message):
        cosim.replay(log, window=(0.053, None))
    part = cosim.replay(log, window=(0.05, 0.103))
    assert part.time("identifier").tolist() == [0.05, 0.06, 0.07, 0.08, 0.09, 0.1]


def test_an_invalid_window_is_refused(log, subtests):
    """Beyond it, off the grid, empty, or no times."""
    for window, error, message in [
        ((0.0105, None), ClockError, r"where the window begins: 0\.0105 s is not a whole number"),
        ((None, 0.0105), ClockError, r"where the window ends: 0\.0105 s is not a whole number"),
        ((-0.01, None), UsageError, r"begins at -0\.01 s; .* the recording, 0\.0 s to 0\.2 s"),
        ((None, 0.21), UsageError, r"ends at 0\.21 s; .* the recording, 0\.0 s to 0\.2 s"),
        ((float("nan"), None), UsageError, "begins at nan s; .* the recording"),
        ((0.1, 0.1), UsageError, r"the window from 0\.1 s to 0\.1 s: expected at least one"),
        ((0.2, 0.1), UsageError, r"the window from 0\.2 s to 0\.1 s: expected at least one"),
        (("0.1", None), UsageError, r"the window begins at '0\.1'; expected a time"),
        (0.1, UsageError, r"window: expected its begin and end .*, got 0\.1"),
    ]:
        with subtests.test(window=window), pytest.raises(error, match=message):
            cosim.replay(log, window=window)


def test_a_stop_beside_a_window_is_refused(log):
    """The window says where the replay ends."""
    with pytest.raises(UsageError, match=r"expected set\['scenario.stop'\] or a window, got both"):
        cosim.replay(log, window=(0.1, None), set={"scenario.stop": 0.15})


@pytest.mark.slow
def test_a_window_cannot_be_replayed(log, tmp_path):
    """What was before it is missing; the message names the log that has it."""
    part = cosim.replay(log, window=(0.1, 0.15), out=tmp_path / "b.mcap")
    with pytest.raises(LogError, match=r"starts at 0\.1 s and ends at 0\.15 s only.*a\.mcap"):
        cosim.replay(part)
    beginning = cosim.replay(log, window=(None, 0.15), out=tmp_path / "c.mcap")
    assert verify(beginning, cosim.replay(beginning)).passed


def test_events_in_a_window_are_those_of_the_whole_replay(tmp_path):
    """An override from before it still acts in it."""
    scenario = cosim.load("academic").set(RATES)
    with scenario.start(out=tmp_path / "a.mcap") as session:
        session.step(50)
        session["observer.u"] = 1.0
        session.step(50)
        session.release("observer.u")
        session.step(100)
    source = cosim.open_log(tmp_path / "a.mcap")
    part = cosim.replay(source, window=(0.07, 0.15), out=tmp_path / "b.mcap")
    check_same_rows(part, source, 0.07, 0.15)
    inside = [event for event in source.events() if 70_000_000 <= event.time_ns <= 150_000_000]
    assert part.events() == inside
    assert inside[0].cause == "release"
    assert len(source.events()) > len(inside)
    assert verify(source, part).passed


def test_a_window_is_verified_alone(log, tmp_path, call):
    """A changed row in it is found; of one outside it only the content hash knows."""
    content = take_apart(log.path)

    def change(number, values):
        if number == 60:
            values[-1] += 1.0

    change_rows(content, "observer", change)
    changed = put_together(content, tmp_path / "b.mcap")
    found = verify(cosim.open_log(changed), cosim.replay(changed, window=(0.05, 0.1)))
    assert found.difference.first.time_ns == 60_000_000
    assert not found.passed
    outside = verify(cosim.open_log(changed), cosim.replay(changed, window=(0.07, 0.1)))
    assert outside.difference.equal
    assert not outside.passed
    assert "were changed after recording" in outside.problems[0]
    code, out, _ = call("replay", log.path, "--from", 0.05, "--to", 0.1, "--verify")
    assert code == 0
    assert "signals recomputed, and all events, from 0.05 s to 0.1 s" in out
    assert "not compared: rows outside that window" in out
    code, out, _ = call("replay", changed, "--from", 0.05, "--to", 0.1, "--verify", "--json")
    assert code == 1
    assert json.loads(out)["window"] == [0.05, 0.1]


def test_the_table_says_that_a_window_was_computed_from_the_start(log, call):
    """And the summary has the times of the rows."""
    part = cosim.replay(log, window=(0.05, 0.1))
    summary = summarize(part)
    assert (summary.start, summary.end, summary.steps) == (0.05, 0.1, 50)
    _, out, _ = call("replay", log.path, "--from", 0.05, "--to", 0.1, "--out", "w.mcap")
    assert "academic: 0.05 s to 0.1 s in 50 steps" in out
    assert "rows from 0.05 s on; computed from 0 s" in out
    code, out, _ = call("info", "w.mcap")
    assert code == 0
    assert "0.05 s to 0.1 s in 50 steps" in out


@pytest.mark.slow
def test_messages_before_a_window_are_left_out(tmp_path):
    """Those in it are there."""
    changes = {"scenario.input_interpolation": "zero-order", **RATES}
    source = cosim.run("academic", out=tmp_path / "a.mcap", set=changes)
    assert [message.time_ns for message in source.messages()] == [0, 0]
    assert cosim.replay(source, window=(0.1, None)).messages() == []
    assert np.size(cosim.replay(source, window=(0.1, None))["plant.y"]) == 101
