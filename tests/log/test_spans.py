"""A span of time of a log is a log; parts that are merged or joined are the log again."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType

import cosim
from cosim.errors import LogError, UsageError
from cosim.log import open_log
from cosim.log.recovering import recover
from cosim.log.spans import cut, merge, open_joined
from cosim.report.verification import verify
from tests.log.crafting import change_rows, put_together, take_apart
from tests.log.recordings import STEP_NS, layout, record, same_bits, table


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the path of a log of 1001 rows and 11 messages, and its rows."""
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    messages = [(k * 100 * STEP_NS, "info", "run", f"message {k}") for k in range(11)]
    return path, record(path, steps=1000, messages=messages)


def test_a_cut_has_the_rows_and_messages_of_its_time(whole, tmp_path):
    """Bit for bit, for any MCAP reader; it says that it is partial."""
    path, rows = whole
    part = cut(path, 0.2, 0.4, tmp_path / "b.mcap")
    log = open_log(tmp_path / "b.mcap")
    assert (log.status, log.reason) == ("partial", "the part from 0.2 s to 0.4 s")
    assert (part.steps, part.end_ns) == (400, 400 * STEP_NS)
    assert same_bits(log["plant.x_a"], rows[200:401, 1:3])
    assert same_bits(log["identifier.y"], rows[200:401:5, 5:8])
    assert np.array_equal(log.time_ns("plant"), np.arange(200, 401) * STEP_NS)
    assert [message.text for message in log.messages()] == ["message 2", "message 3", "message 4"]
    assert log.recorded_hash == log.content_hash()
    source = open_log(path)
    assert log.results["whole"] == source.results
    assert log.results["content_hash"] == log.recorded_hash
    again = cut(tmp_path / "b.mcap", 0.25, 0.3, tmp_path / "c.mcap")
    assert again.results["whole"] == source.results
    assert dict(log.channels) == dict(source.channels)
    for name in ("cosim.schedule", "cosim.component.plant"):
        assert log.metadata[name] == source.metadata[name]
    everything = cut(path, 0.0, 5.0, tmp_path / "d.mcap")
    assert (everything.status, everything.results) == ("complete", source.results)
    assert everything.recorded_hash == source.recorded_hash
    with (tmp_path / "b.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages(topics=["/plant"])) == 201
        assert reader.get_summary().statistics.message_count == 201 + 41 + 3


def test_messages_between_two_rows_go_with_the_row_behind_them(tmp_path, subtests):
    """As substeps do, so that parts whose rows are all rows have all messages, once."""
    messages = [(k * STEP_NS // 4, "info", "run", f"message {k}") for k in range(1100, 1300)]
    record(tmp_path / "a.mcap", steps=1000, messages=messages)
    for last, first in [(0.3, 0.301), (0.3004, 0.301), (0.3008, 0.3009), (0.3, 0.3005)]:
        before = cut(tmp_path / "a.mcap", None, last, tmp_path / "b.mcap", force=True)
        behind = cut(tmp_path / "a.mcap", first, None, tmp_path / "c.mcap", force=True)
        merged = merge([before.path, behind.path], tmp_path / "d.mcap", force=True)
        with subtests.test(case=(last, first)):
            assert [message.text for message in before.messages()][-1] == "message 1200"
            assert next(message.text for message in behind.messages()) == "message 1201"
            assert merged.messages() == open_log(tmp_path / "a.mcap").messages()


def test_a_cut_without_rows_is_refused(whole, tmp_path):
    """And leaves no file."""
    path, _ = whole
    with pytest.raises(LogError, match=r"a\.mcap from 5 s: no rows"):
        cut(path, 5.0, None, tmp_path / "b.mcap")
    with pytest.raises(UsageError, match=r"2\.0 s|1\.0 s"):
        cut(path, 2.0, 1.0, tmp_path / "b.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_log_with_a_damaged_attachment_is_recovered_first(whole, tmp_path):
    """The refusal names the command for that; what it keeps is cut."""
    path, rows = whole
    with path.open("rb") as stream:
        damaged = make_reader(stream).get_summary().attachment_indexes[0]
    data = bytearray(path.read_bytes())
    data[damaged.offset + damaged.length - 10] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    rest = tmp_path / "rest.mcap"
    cut(path, 0.5, None, rest)
    for refused in (
        lambda: cut(tmp_path / "a.mcap", None, 0.499, tmp_path / "b.mcap"),
        lambda: merge([tmp_path / "a.mcap", rest], tmp_path / "b.mcap"),
    ):
        with pytest.raises(LogError, match=rf"at byte {damaged.offset}: .*'cosim recover'"):
            refused()
    recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    kept = cut(tmp_path / "b.mcap", None, 0.499, tmp_path / "c.mcap")
    assert same_bits(kept["plant.u"], rows[:500, 0])


def test_a_log_that_exists_is_not_replaced_unless_asked(whole, tmp_path):
    """And never by a part of itself."""
    path, rows = whole
    part = tmp_path / "part.mcap"
    cut(path, 0.2, 0.4, part)
    with pytest.raises(LogError, match="exists; choose another path"):
        cut(path, 0.3, 0.4, part)
    cut(path, 0.3, 0.4, part, force=True)
    assert same_bits(open_log(part)["plant.u"], rows[300:401, 0])
    rest = tmp_path / "rest.mcap"
    cut(path, 0.401, None, rest)
    content = path.read_bytes(), part.read_bytes()
    text = "cannot be replaced by it; choose another path"
    with pytest.raises(LogError, match=text):
        cut(path, 0.2, 0.4, path.parent / "." / path.name, force=True)
    with pytest.raises(LogError, match=text):
        merge([rest, part], part, force=True)
    assert (path.read_bytes(), part.read_bytes()) == content


def test_a_part_from_the_start_is_replayed_and_any_other_is_refused(tmp_path):
    """A replay needs all rows up to the end of the log; one of a span counts steps from there."""
    cosim.run("academic", set={"scenario.stop": 0.2}, out=tmp_path / "a.mcap")
    beginning = cut(tmp_path / "a.mcap", None, 0.1, tmp_path / "b.mcap")
    assert cosim.diff(cosim.replay(beginning), beginning).equal
    rest = cut(tmp_path / "a.mcap", 0.101, None, tmp_path / "c.mcap")
    with pytest.raises(LogError, match=r"c\.mcap.*0\.101 s to 0\.2 s"):
        cosim.replay(rest)
    merged = merge([beginning.path, rest.path], tmp_path / "d.mcap")
    assert verify(merged, cosim.replay(merged)).passed
    span = cosim.replay(tmp_path / "a.mcap", window=(0.1, 0.2), out=tmp_path / "e.mcap")
    assert span.steps == 100
    assert cut(span.path, None, 0.15, tmp_path / "f.mcap").steps == 50
    assert cut(span.path, 0.15, None, tmp_path / "g.mcap").steps == 100


NO_SUMMARY = {
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
    "index_types": IndexType.NONE,
}


@pytest.mark.parametrize("options", [{"chunk_size": 1000}, NO_SUMMARY])
def test_logs_of_other_tools_are_cut(whole, tmp_path, options):
    """With channels mixed in their chunks, or without a summary."""
    path, rows = whole
    content = take_apart(path)
    content.messages.sort(key=lambda message: message[1])
    put_together(content, tmp_path / "b.mcap", **options)
    part = cut(tmp_path / "b.mcap", 0.2, 0.4, tmp_path / "c.mcap")
    assert same_bits(part["plant.u"], rows[200:401, 0])


# --- merged ---


def test_parts_that_are_merged_are_the_log_again(whole, tmp_path):
    """In any order; with the result of the run, whose content hash theirs is."""
    path, _ = whole
    cut(path, None, 0.1234, tmp_path / "b.mcap")
    cut(path, 0.124, 0.7, tmp_path / "c.mcap")
    cut(path, 0.701, None, tmp_path / "d.mcap")
    names = ["c", "d", "b"]
    merged = merge([tmp_path / f"{name}.mcap" for name in names], tmp_path / "e.mcap")
    source = open_log(path)
    assert merged.status == "complete"
    assert merged.content_hash() == merged.recorded_hash == source.recorded_hash
    assert merged.messages() == source.messages()
    assert cosim.diff(merged, source).equal
    assert merged.results == source.results
    two = merge([tmp_path / "d.mcap", tmp_path / "c.mcap"], tmp_path / "f.mcap")
    assert (two.status, two.reason) == ("partial", "the part from 0.124 s to 1.0 s")
    again = merge([tmp_path / "f.mcap", tmp_path / "b.mcap"], tmp_path / "g.mcap")
    assert again.results == source.results


def test_slow_components_may_have_no_row_in_a_part(tmp_path):
    """They go on where they were."""
    rows = table(layout(period=500), 1000)
    record(tmp_path / "a.mcap", lay=layout(period=500), rows=rows)
    bounds = [(None, 0.3), (0.301, 0.4), (0.401, None)]
    parts = []
    for number, (first, last) in enumerate(bounds):
        parts.append(tmp_path / f"{number}.mcap")
        cut(tmp_path / "a.mcap", first, last, parts[-1])
    assert len(open_log(parts[1]).time_ns("identifier")) == 0
    assert merge(parts, tmp_path / "b.mcap").status == "complete"


def test_a_log_whose_run_has_not_ended_is_cut_and_merged(whole, tmp_path):
    """It has no result; its rows say where it ends."""
    path, rows = whole
    content = take_apart(path)
    content.metadata = [item for item in content.metadata if item[0] != "cosim.result"]
    put_together(content, tmp_path / "b.mcap")
    first = cut(tmp_path / "b.mcap", None, 0.4, tmp_path / "c.mcap")
    second = cut(tmp_path / "b.mcap", 0.401, None, tmp_path / "d.mcap")
    assert (first.steps, second.steps) == (400, 1000)
    merged = merge([first.path, second.path], tmp_path / "e.mcap")
    assert (merged.status, merged.steps) == ("partial", 1000)
    assert same_bits(merged["plant.u"], rows[:, 0])


def test_parts_that_do_not_follow_each_other_are_refused(whole, tmp_path):
    """Overlapping ones, and those that leave rows out."""
    path, _ = whole
    cut(path, None, 0.5, tmp_path / "b.mcap")
    cut(path, 0.5, None, tmp_path / "c.mcap")
    cut(path, 0.502, None, tmp_path / "d.mcap")
    with pytest.raises(LogError, match=r"'plant' up to 0\.5 s, .* begins at 0\.5 s: they overlap"):
        merge([tmp_path / "b.mcap", tmp_path / "c.mcap"], tmp_path / "e.mcap")
    with pytest.raises(LogError, match=r"0\.501 s on are missing"):
        merge([tmp_path / "b.mcap", tmp_path / "d.mcap"], tmp_path / "e.mcap")
    with pytest.raises(UsageError, match="at least two logs to merge, got 1"):
        merge([path], tmp_path / "e.mcap")


def test_parts_of_other_runs_are_refused(whole, tmp_path, subtests):
    """What they declare, what was recorded of the run, and how it ended must be the same."""
    path, _ = whole
    cut(path, None, 0.5, tmp_path / "b.mcap")
    for number, (options, text) in enumerate(
        [
            ({"lay": layout(period=10)}, "channels"),
            ({"kinds": {"plant": "lag"}}, "channels"),
            ({"metadata": {"cosim.connections": {"a": "b"}}}, "the metadata 'cosim.connections'"),
            ({"rows": table(layout(), 1000, seed=2)}, "the result of the run"),
        ]
    ):
        other = tmp_path / f"{number}.mcap"
        record(other, steps=1000, **{"lay": options.get("lay", layout()), **options})
        cut(other, 0.501, None, tmp_path / "c.mcap", force=True)
        with (
            subtests.test(case=options),
            pytest.raises(LogError, match=f"same run: .*{text} differs"),
        ):
            merge([tmp_path / "b.mcap", tmp_path / "c.mcap"], tmp_path / "e.mcap")
        assert not (tmp_path / "e.mcap").exists()


# --- joined: a file of a log that was rotated is replayed with those before it ---


SHORT = {"scenario.stop": 2.0, "identifier.start": 0.5, "regressor.delays": [0.1, 0.2, 0.3]}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Run 2 s into three files, and into one; return the folder of the files and the other log."""
    folder = tmp_path_factory.mktemp("parts")
    last = cosim.run("academic", set=SHORT, out=folder / "run.mcap", rotate="0.8s")
    assert last.path == folder / "run.part3.mcap"
    one = tmp_path_factory.mktemp("one") / "one.mcap"
    return folder, cosim.run("academic", set=SHORT, out=one)


@pytest.fixture
def run(recorded, tmp_path):
    """Return the first path of a copy of the three files."""
    shutil.copytree(recorded[0], tmp_path, dirs_exist_ok=True)
    return tmp_path / "run.mcap"


@pytest.mark.slow
def test_the_last_part_replays_the_run(run, recorded):
    """Bit for bit, and the log says nothing false; it is called by its own path."""
    last = run.with_name("run.part3.mcap")
    again = cosim.replay(last)
    assert cosim.diff(again, recorded[1]).equal
    joined = open_joined(last)
    assert (joined.path, joined.status) == (last, "complete")
    assert verify(joined, again).passed
    assert cosim.diff(cosim.replay(open_log(last)), recorded[1]).equal
    assert open_log(run).status == "partial"


def test_a_part_between_replays_what_is_before_its_end(run):
    """And the first one alone."""
    joined = open_joined(run.with_name("run.part2.mcap"))
    assert (joined.status, joined.reason) == ("partial", "the part from 0.0 s to 1.599 s")
    assert verify(joined, cosim.replay(joined)).passed
    first = open_joined(run)
    assert first.reason == "part 1 of its log, from 0.0 s to 0.799 s"
    assert verify(first, cosim.replay(run)).passed


def test_a_limit_of_the_files_is_refused_before_the_run(tmp_path, monkeypatch):
    """Where there is no file, or it is none."""
    monkeypatch.chdir(tmp_path)
    for options, text in [
        ({"rotate": "1GB"}, "rotate"),
        ({"rotate": 1e9, "out": "run.mcap"}, r"^rotate: expected a size in .*1000000000\.0"),
    ]:
        with pytest.raises(UsageError, match=text):
            cosim.run("academic", **options)
    assert list(tmp_path.iterdir()) == []


def test_a_replay_does_not_replace_a_file_of_its_log(run):
    """It reads those before its own, and would remove those behind."""
    files = {path: path.read_bytes() for path in run.parent.iterdir()}
    second = run.with_name("run.part2.mcap")
    third = run.with_name("run.part3.mcap")
    for source, out in [(third, run), (second, second), (second, third)]:
        with pytest.raises(UsageError, match=out.name):
            cosim.replay(source, out=out, force=True)
        assert {path: path.read_bytes() for path in run.parent.iterdir()} == files


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "stop", "block"), [("0.8s", 2.0, 1000), ("1MB", 6.0, 1)])
def test_parts_have_the_hash_of_their_run(tmp_path, limit, stop, block):
    """For sizes and times, whatever the blocks are; the result is that of the run, too."""
    options = {**SHORT, "scenario.stop": stop}
    whole = cosim.run("academic", set=options, out=tmp_path / "one.mcap")
    path = tmp_path / "run.mcap"
    last = cosim.run("academic", set=options, out=path, rotate=limit, block=block)
    parts = [path, *sorted(tmp_path.glob("run.part*.mcap"))]
    assert last.path == parts[-1] != path
    merged = merge(parts, tmp_path / "merged.mcap")
    assert merged.status == "complete"
    assert merged.content_hash() == merged.recorded_hash == whole.recorded_hash
    assert merged.results == whole.results
    assert open_log(parts[-1]).results["last"] == whole.results["last"]
    assert verify(merged, cosim.replay(merged)).passed


def test_a_part_that_is_missing_is_named(run, recorded, tmp_path):
    """So is one of another run; what only is named like a part has its run from the start."""
    second = run.with_name("run.part2.mcap")
    second.rename(run.with_name("x.mcap"))
    text = r"run\.part3\.mcap is part 3 .*; part 2 is missing: .*run\.part2\.mcap$"
    with pytest.raises(LogError, match=text):
        cosim.replay(run.with_name("run.part3.mcap"))
    cosim.run("closed-loop", set={"scenario.stop": 0.1}, out=second)
    with pytest.raises(LogError, match="not parts of the same run"):
        cosim.replay(run.with_name("run.part3.mcap"))
    shutil.copy(recorded[1].path, second)
    assert open_joined(second).recorded_hash == recorded[1].recorded_hash


def test_a_changed_row_of_an_earlier_part_is_found(run):
    """A replay copies the row, and would equal it; a merged log would have a hash that fits.

    All checksums are right. Where the hash of a part was computed anew, that of all parts is not
    the one of their run.
    """
    parts = [run, run.with_name("run.part2.mcap"), run.with_name("run.part3.mcap")]
    content = take_apart(run)

    def change(number, values):  # of a value that nothing is computed from
        if number == 50:
            values[-1] *= 2.0

    change_rows(content, "plant", change)
    put_together(content, run)
    text = r"run\.mcap: .* changed after they were recorded: expected the content hash"
    with pytest.raises(LogError, match=text):
        cosim.replay(parts[1])
    with pytest.raises(LogError, match=text):
        merge(parts, run.with_name("merged.mcap"))
    (result,) = [items for name, items in content.metadata if name == "cosim.result"]
    result["content_hash"] = open_log(run).content_hash()
    put_together(content, run)
    text = r"run\.mcap .* have all rows of the run, but not its values"
    with pytest.raises(LogError, match=text):
        merge(parts, run.with_name("merged.mcap"))
    assert not run.with_name("merged.mcap").exists()
    assert merge(parts[:2], run.with_name("two.mcap")).status == "partial"


@pytest.mark.slow
def test_a_last_part_without_a_hash_is_not_reported_to_have_one(tmp_path, flushing):
    """As of a run that was killed; the hash of what is joined was recorded by no run."""
    killed = tmp_path / "killed"

    def copy(time, end):
        with flushing:
            if not killed.exists() and (tmp_path / "run.part2.mcap").exists():
                shutil.copytree(tmp_path, killed)

    options = {"rotate": "0.8s", "flush": 1e-3, "block": 50, "progress": copy}
    cosim.run("academic", set={"scenario.stop": 2.0}, out=tmp_path / "run.mcap", **options)
    last = killed / "run.part2.mcap"
    assert open_log(last).status == "unfinished"
    verification = verify(open_joined(last), cosim.replay(last))
    assert verification.passed
    assert "unfinished" in verification.lines[0]
