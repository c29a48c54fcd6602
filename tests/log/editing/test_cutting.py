"""A span of time of a log is a log, and parts that are merged are the log again."""

from __future__ import annotations

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType

import cosim
from cosim.errors import LogError, UsageError
from cosim.log import open_log
from cosim.log.spans import cut, merge
from cosim.report.verification import verify
from tests.log.crafting import put_together, take_apart
from tests.log.recordings import STEP_NS, record, same_bits


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
    with (tmp_path / "b.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages(topics=["/plant"])) == 201
        assert reader.get_summary().statistics.message_count == 201 + 41 + 3


def test_a_cut_of_all_rows_is_the_log_of_the_run(whole, tmp_path):
    """Nothing is missing, so nothing is partial."""
    path, _ = whole
    part = cut(path, 0.0, 5.0, tmp_path / "b.mcap")
    assert part.status == "complete"
    assert part.recorded_hash == open_log(path).recorded_hash
    assert part.results == open_log(path).results


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


def test_a_part_from_the_start_is_replayed_and_any_other_is_refused(tmp_path):
    """A replay needs all rows up to the end of the log."""
    cosim.run("academic", set={"scenario.stop": 0.2}, out=tmp_path / "a.mcap")
    cut(tmp_path / "a.mcap", None, 0.1, tmp_path / "b.mcap")
    cut(tmp_path / "a.mcap", 0.101, None, tmp_path / "c.mcap")
    merged = merge([tmp_path / "b.mcap", tmp_path / "c.mcap"], tmp_path / "d.mcap")
    assert verify(merged, cosim.replay(merged)).passed
    with pytest.raises(LogError, match=r"c\.mcap.*0\.101 s to 0\.2 s"):
        cosim.replay(tmp_path / "c.mcap")
    beginning = open_log(tmp_path / "b.mcap")
    assert cosim.diff(cosim.replay(beginning), beginning).equal


def test_the_steps_of_a_replay_of_a_span_are_counted_from_its_beginning(tmp_path):
    """As in the log of the replay, of which this is a part."""
    cosim.run("academic", set={"scenario.stop": 0.4}, out=tmp_path / "a.mcap")
    span = cosim.replay(tmp_path / "a.mcap", window=(0.2, 0.4), out=tmp_path / "b.mcap")
    assert span.steps == 200
    assert cut(span.path, None, 0.3, tmp_path / "c.mcap").steps == 100
    assert cut(span.path, 0.3, None, tmp_path / "d.mcap").steps == 200


def test_logs_of_other_tools_are_cut_and_merged(whole, tmp_path):
    """With channels mixed in their chunks."""
    path, rows = whole
    content = take_apart(path)
    content.messages.sort(key=lambda message: message[1])
    put_together(content, tmp_path / "b.mcap", chunk_size=1000)
    part = cut(tmp_path / "b.mcap", 0.2, 0.4, tmp_path / "c.mcap")
    assert same_bits(part["plant.u"], rows[200:401, 0])


def test_a_cut_without_rows_is_refused(whole, tmp_path):
    """And leaves no file."""
    path, _ = whole
    with pytest.raises(LogError, match=r"a\.mcap from 5 s: no rows"):
        cut(path, 5.0, None, tmp_path / "b.mcap")
    with pytest.raises(UsageError, match=r"2\.0 s|1\.0 s"):
        cut(path, 2.0, 1.0, tmp_path / "b.mcap")
    assert list(tmp_path.iterdir()) == []


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


def test_a_log_without_a_summary_is_cut_as_well(whole, tmp_path):
    """Another tool may have left it out."""
    path, _ = whole
    put_together(
        take_apart(path),
        tmp_path / "b.mcap",
        repeat_channels=False,
        repeat_schemas=False,
        use_statistics=False,
        use_summary_offsets=False,
        index_types=IndexType.NONE,
    )
    part = cut(tmp_path / "b.mcap", 0.2, 0.4, tmp_path / "c.mcap")
    whole_log = open_log(path)
    assert same_bits(part["plant.u"], whole_log.window(0.2, 0.4)["plant.u"])
