"""Logs are read back bit for bit, or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType

import cosim
from cosim.core.port import Port
from cosim.core.recorders import Memory
from cosim.core.recording import Recording
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError, UsageError
from cosim.log import McapRecorder, open_log, preamble
from cosim.log.diff import diff
from tests.log.crafting import put_together, rewrite, rows_of_plant, take_apart
from tests.log.recordings import (
    STEP_NS,
    blocks,
    layout,
    plan,
    record,
    same_bits,
    table,
)


def test_a_log_returns_what_was_planned_and_recorded(tmp_path):
    """Components, their kinds and designs, held inputs, the schedule; messages by their time."""
    path = tmp_path / "a.mcap"
    messages = [(3 * STEP_NS, "warning", "plant", "slow"), (0, "info", "run", "begin")]
    metadata = {"cosim.component.plant": {"mass": "1.5"}}
    record(path, steps=123, kinds={"plant": "lag"}, messages=messages, metadata=metadata)
    log = open_log(path)
    recording: Recording = log
    assert recording.channels == {channel.name: channel for channel in layout().channels}
    assert list(log.channels) == ["plant", "identifier"]
    assert log.kinds == {"plant": "lag", "identifier": ""}
    assert (log.step_ns, log.steps, log.end_ns) == (STEP_NS, 123, 123 * STEP_NS)
    assert not log._rows._kept
    assert log.end_ns == log.time_ns("plant")[-1]
    for name, array in plan().designs["plant"].items():
        assert same_bits(log.designs["plant"][name], array)
    assert log.designs["identifier"] == {}
    assert log.designs is log.designs  # decoded once
    for name, mask in plan().held.items():
        assert np.array_equal(log.held[name], mask)
    assert log.metadata["cosim.schedule"]["stages"] == '["cascade plant","cascade identifier"]'
    assert log.metadata["cosim.component.plant"]["mass"] == "1.5"
    recorded = [(m.time_ns, m.level, m.source, m.text) for m in log.messages()]
    assert recorded == sorted(messages)


def test_a_log_returns_every_signal(long_log):
    """By its name, with its times; nothing can be written to."""
    log, rows = long_log
    assert list(log.signals) == [
        "plant.u",
        "plant.x_a",
        "plant.der(x)",
        "plant.n",
        "identifier.y",
        "identifier.theta",
    ]
    assert same_bits(log["plant.der(x)"], rows[:, 3])
    assert same_bits(log["identifier.y"], rows[::5, 5:8])
    times = np.arange(1001) * STEP_NS / 1e9
    assert np.array_equal(log.time("plant.u"), times)
    assert np.array_equal(log.time("identifier"), times[::5])
    port = Port("plant", "x_a")
    assert same_bits(log[port], rows[:, 1:3])
    assert same_bits(log[[port, "plant.u"]], rows[:, [1, 2, 0]])
    with pytest.raises(ValueError, match="read-only"):
        log["plant.u"][0] = 1.0


def test_a_run_without_rows_is_a_log(tmp_path):
    """A run that ended at once has empty signals; without a result its end is not known."""
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.begin(plan())
    log = open_log(tmp_path / "a.mcap")
    assert log["plant.x_a"].shape == (0, 2)
    assert log.content_hash() == log.results["content_hash"]
    assert (log.steps, log.end_ns) == (0, 0)
    log._metadata.pop("cosim.result")
    with pytest.raises(LogError, match=r"a\.mcap has no 'end_ns': .*cosim\.result"):
        _ = log.end_ns


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunk_size": 2000, "compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"use_chunking": False, "repeat_channels": False, "enable_data_crcs": True},
        {
            "repeat_channels": False,
            "use_statistics": False,
            "index_types": IndexType.NONE,
            "use_summary_offsets": False,
        },
    ],
    ids=["as it was", "lz4", "uncompressed", "no chunks", "no channels repeated", "no summary"],
)
def test_logs_rewritten_by_other_tools_read_the_same(tmp_path, options):
    """In the order of time, or backwards, in any chunks or none, with or without a summary."""
    path = tmp_path / "a.mcap"
    record(path, steps=200, messages=[(7, "info", "run", "begin")])
    a = open_log(path)
    for turn in (1, -1):
        copy = tmp_path / f"{turn}.mcap"
        rewrite(path, copy, order=lambda messages, turn=turn: messages[::turn], **options)
        b = open_log(copy)
        for name in a.signals:
            assert same_bits(a[name], b[name])
        for name in a.channels:
            assert np.array_equal(a.time_ns(name), b.time_ns(name))
        assert a.content_hash() == b.content_hash()
        assert a.messages() == b.messages()
        assert dict(a.metadata) == dict(b.metadata)


def test_messages_encoded_anew_are_refused(tmp_path):
    """A tool that leaves out zeros changes the size of messages."""
    record(tmp_path / "a.mcap", steps=5)

    def shorten(messages):
        for schema, channel, message in messages:
            message.data = message.data[:-9]
            yield schema, channel, message

    rewrite(tmp_path / "a.mcap", tmp_path / "b.mcap", order=shorten)
    with pytest.raises(LogError, match="re-encoded by another tool"):
        open_log(tmp_path / "b.mcap").rows("plant")


def read_all(path):
    """Read everything; return what must not change."""
    log = open_log(path)
    log.load()
    assert log.designs
    assert log.held
    return {
        "hash": log.content_hash(),
        "messages": log.messages(),
        "metadata": dict(log.metadata),
        "attachments": [log.attachment(name) for name in log.attachments],
        "channels": dict(log.channels),
        "kinds": log.kinds,
    }


def read_flipped(path, data, position, mask):
    """Read a log with some bits flipped; return (error or None, content or None)."""
    data[position] ^= mask
    path.write_bytes(data)
    data[position] ^= mask
    try:
        return None, read_all(path)
    except LogError as error:
        return error, None


def test_every_bit_of_chunk_and_metadata_is_guarded(short_log, tmp_path):
    """A flip in a chunk, a metadata record or an attachment is refused.

    The exception is a flip in a length that the reading does not need.
    """
    data = bytearray(short_log.read_bytes())
    path = tmp_path / "a.mcap"
    before = read_all(short_log)
    with short_log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    chunk = summary.chunk_indexes[0]
    spans = [(chunk.chunk_start_offset, chunk.chunk_length)]
    for index in (*summary.metadata_indexes, *summary.attachment_indexes):
        spans.append((index.offset, index.length))
    unneeded = 0
    for start, length in spans:
        header = range(start, start + 30)
        sample = range(start, start + length, 41)
        for position in {*header, *sample}:
            error, content = read_flipped(path, data, position, 0x20)
            if error is None:
                assert content == before
                unneeded += 1
    assert unneeded <= len(summary.metadata_indexes)


def test_a_log_and_the_memory_keep_the_same_rows(tmp_path):
    """By the number of the step, whatever its time; names of signals may have dots."""
    interface = Interface((), (Signal("a.b.c", 2), Signal("a")))
    lay = Layout((Channel("x", interface, 0, 3), Channel("y", Interface((), (Signal("z"),)), 3)))
    rows = table(lay, 20)
    memory = Memory()
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        for target in (memory, recorder):
            target.begin(plan(lay))
            for block, signals in blocks(rows, 4):
                target.write(replace(block, time_ns=block.time_ns * 7 + 5), signals)
    for recording in (open_log(tmp_path / "a.mcap"), memory):
        assert same_bits(recording["x.a.b.c"], rows[::3, :2])
        assert same_bits(recording["x.a"], rows[::3, 2])
        times = [7 * k * STEP_NS + 5 for k in range(0, 21, 3)]
        assert recording.time_ns("x").tolist() == times
        assert recording.time("x.a.b.c").tolist() == recording.time("x").tolist()
        assert (recording.steps, recording.end_ns) == (20, 7 * 20 * STEP_NS + 5)
        with pytest.raises(LogError, match=r"'x\.a\.b'.*did you mean 'a\.b\.c'\?.*: a\.b\.c, a"):
            recording["x.a.b"]


def test_unknown_names_name_the_nearest(short_log):
    """Components and attachments."""
    log = open_log(short_log)
    with pytest.raises(LogError, match=r"a\.mcap.*'plamt'; did you mean 'plant'\?"):
        log["plamt.u"]
    for read in (log.time_ns, log.rows, log.load, log.shares_chunks, lambda n: list(log.blocks(n))):
        with pytest.raises(LogError, match="'plan'; did you mean 'plant'"):
            read("plan")
    with pytest.raises(LogError, match=r"'results\.json'; did you mean 'result\.json'"):
        log.attachment("results.json")


def test_a_log_of_another_format_is_refused(tmp_path, monkeypatch):
    """Where the format has changed, the reader says so before it reads what it would misread."""
    path = tmp_path / "old.mcap"
    monkeypatch.setattr(preamble, "FORMAT", "1")
    record(path, steps=10)
    with pytest.raises(LogError, match=r"old\.mcap: expected log format '2', got '1'"):
        open_log(path)


def test_a_log_whose_rows_are_not_those_of_its_steps_is_refused(short_log, tmp_path):
    """Also where its summary agrees with what is left: it is no whole run."""
    for row in (0, 3, -1):
        content = take_apart(short_log)
        del content.messages[rows_of_plant(content)[row]]
        path = put_together(content, tmp_path / "b.mcap")
        text = r"b\.mcap is damaged: expected 21 rows of 'plant' for 20 steps, got 20"
        with pytest.raises(LogError, match=text):
            open_log(path)


def test_a_run_in_memory_is_no_log():
    """It has no file, and says how a run gets one."""
    memory = cosim.run("academic", set={"scenario.stop": 0.01})
    for reader in (open_log, cosim.replay):
        with pytest.raises(UsageError, match=r"^log: .*memory.*out='x\.mcap'"):
            reader(memory)


def test_wrong_arguments_are_named(short_log, subtests):
    """A LogError or UsageError that says what was found, and no error of Python's own."""
    log = open_log(short_log)
    misuses = [
        lambda: log[3],
        lambda: log[None],
        lambda: log[["plant.u", 3]],
        lambda: log[[]],
        lambda: log[{"plant.u"}],
        lambda: log.rows(3),
        lambda: log.rows(["plant"]),
        lambda: log.time(3),
        lambda: log.time_ns(None),
        lambda: log.load("plant", 3),
        lambda: log.attachment(3),
        lambda: list(log.blocks(3)),
        lambda: diff(log, str(log.path)),
        lambda: diff(None, log),
        lambda: diff(log, log, signals=[3]),
        lambda: diff(log, log, signals="plant"),
        lambda: diff(log, log, atol="x"),
        lambda: diff(log, log, atol=-1.0),
        lambda: diff(log, log, rtol=float("nan")),
    ]
    for number, misuse in enumerate(misuses):
        with (
            subtests.test(case=number),
            pytest.raises(UsageError, match=r"3|None|\[\]|\{|plant|x|-1|nan"),
        ):
            misuse()
