"""Replays of which a window of time is recorded."""

import json

import pytest

import cosim
from cosim.errors import CosimError, LogError, UsageError
from cosim.report.verification import verify
from tests.log.crafting import change_rows, put_together, take_apart
from tests.scenario.refusals import check_refused

pytestmark = pytest.mark.usefixtures("without_verdicts")

RATES = {"identifier.period": 0.01, "scenario.stop": 0.2}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Record a run whose identifier has a row in ten communication steps."""
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    return cosim.run("academic", out=path, set=RATES)


def check_same_rows(part, whole, begin, end):
    """Check that a recording has exactly the rows that another has within a window [s]."""
    assert list(part.channels) == list(whole.channels)
    for name in whole.channels:
        time_ns = whole.time_ns(name)
        inside = (time_ns >= round(begin * 1e9)) & (time_ns <= round(end * 1e9))
        assert part.time_ns(name).tolist() == time_ns[inside].tolist()
        assert part.rows(name).tobytes() == whole.rows(name)[inside].tobytes()


def test_a_window_has_the_rows_of_the_whole_replay(log, tmp_path):
    """Bit for bit, in a log, too; of random scenarios see the tests of replayed parts."""
    changes = {"observer.filter_rate": 500.0}
    whole = cosim.replay(log, set=changes)
    for begin, end, block in ((None, 0.15, 7), (0.1, None, 1000)):
        part = cosim.replay(log, set=changes, window=(begin, end), block=block)
        check_same_rows(part, whole, begin or 0.0, end or 0.2)
    written = cosim.replay(log, set=changes, window=(0.1, 0.15), out=tmp_path / "b.mcap")
    check_same_rows(written, whole, 0.1, 0.15)
    assert written.recorded_hash == written.content_hash()


WINDOWS = [
    ((0.053, None), r"begins at 0\.053 s, where 'identifier' has no row: .* 10 .*: 0\.05 s"),
    ((0.0105, None), r"where the window begins: 0\.0105 s is not a whole number"),
    ((None, 0.0105), r"where the window ends: 0\.0105 s is not a whole number"),
    ((-0.01, None), r"begins at -0\.01 s; .* the recording, 0\.0 s to 0\.2 s"),
    ((None, 0.21), r"ends at 0\.21 s; .* the recording, 0\.0 s to 0\.2 s"),
    ((float("nan"), None), "begins at nan s; .* the recording"),
    ((0.1, 0.1), r"the window from 0\.1 s to 0\.1 s: expected at least one"),
    (("0.1", None), r"the window begins at '0\.1'; expected a time"),
    (0.1, r"window: expected its begin and end .*, got 0\.1"),
]


def test_an_invalid_window_is_refused(log):
    """Where a component has no row, beyond the log, off the grid, empty, or no times."""
    check_refused(WINDOWS, lambda window: cosim.replay(log, window=window), CosimError)
    with pytest.raises(UsageError, match=r"expected set\['scenario.stop'\] or a window, got both"):
        cosim.replay(log, window=(0.1, None), set={"scenario.stop": 0.15})


def test_a_window_begins_where_all_that_the_replay_records_has_rows(log, tmp_path):
    """Not where the log has some: a replay may record other components, and other rows."""
    partial = {"scenario.stop": 0.2, "record.signals": ["observer.*", "plant.*"]}
    part = cosim.run("academic", out=tmp_path / "a.mcap", set=partial)
    everything = {"record.signals": ["*"], "record.every": 1}
    message = r"the window begins at 0\.053 s, where 'identifier' has no row: .* 100 .*: 0\.0 s"
    with pytest.raises(UsageError, match=message):
        cosim.replay(part, set=everything, window=(0.053, None))
    check_same_rows(cosim.replay(part, window=(0.053, 0.06)), cosim.replay(part), 0.053, 0.06)
    few = cosim.run("academic", out=tmp_path / "b.mcap", set=partial | {"record.every": 7})
    everything["record.signals"] = ["u.*"]
    again = cosim.replay(few, set=everything, window=(0.053, 0.06))
    whole = cosim.replay(log, set=everything, window=(0.053, 0.06))
    check_same_rows(again, whole, 0.053, 0.06)


def test_a_window_cannot_be_replayed(log, tmp_path):
    """What was before it is missing; the message names the log that has it."""
    part = cosim.replay(log, window=(0.1, 0.15), out=tmp_path / "b.mcap")
    with pytest.raises(LogError, match=r"starts at 0\.1 s and ends at 0\.15 s only.*a\.mcap"):
        cosim.replay(part)
    beginning = cosim.replay(log, window=(None, 0.15), out=tmp_path / "c.mcap")
    assert verify(beginning, cosim.replay(beginning)).passed


def test_events_and_messages_in_a_window_are_those_of_the_whole_replay(tmp_path):
    """An override from before it still acts in it; messages before it are left out."""
    changes = {"scenario.input_interpolation": "zero-order", **RATES}
    with cosim.load("academic").set(changes).start(out=tmp_path / "a.mcap") as session:
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
    assert [message.time_ns for message in source.messages()] == [0, 0]
    assert part.messages() == []


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
    outside = verify(cosim.open_log(changed), cosim.replay(changed, window=(0.07, 0.1)))
    assert outside.difference.equal
    assert not outside.passed
    assert "were changed after recording" in outside.problems[0]
    code, out, _ = call("replay", changed, "--from", 0.05, "--to", 0.1, "--verify", "--json")
    assert code == 1
    assert json.loads(out)["window"] == [0.05, 0.1]
