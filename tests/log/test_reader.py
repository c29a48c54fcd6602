"""Logs are read back bit for bit, or refused."""

from __future__ import annotations

import io
import os
import struct
import tracemalloc
import zlib
from dataclasses import replace

import numpy as np
import pytest
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import CompressionType, IndexType, Writer

from cosim.core.contracts import Recording
from cosim.core.recorders import Memory
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError
from cosim.log import McapRecorder, open_log
from cosim.log import buffer as row_buffer

from .recordings import STEP_NS, blocks, layout, plan, record, same_bits, table


def rewrite(source, target, *, order=lambda messages: messages, **options):
    """Copy a log message by message through mcap's own writer."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader, copy, ids = make_reader(stream), Writer(out, **options), {}
        copy.start()
        for number, channel in reader.get_summary().channels.items():
            schema = reader.get_summary().schemas[channel.schema_id]
            copied = copy.register_schema(f"other.{schema.name}", schema.encoding, schema.data)
            ids[number] = copy.register_channel(
                channel.topic, channel.message_encoding, copied, channel.metadata
            )
        for item in reader.iter_metadata():
            copy.add_metadata(item.name, item.metadata)
        for _, channel, message in order(list(reader.iter_messages())):
            copy.add_message(
                ids[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
        copy.finish()


def test_a_log_gives_back_all_it_was_given(tmp_path):
    """Channels, designs, held inputs, metadata, messages and signals."""
    said = [(3 * STEP_NS, "warning", "plant", "slow"), (0, "info", "run", "begin")]
    given = {"cosim.component.plant": {"mass": "1.5"}}
    rows = record(tmp_path / "a.mcap", messages=said, metadata=given, kinds={"plant": "descriptor"})
    log = open_log(tmp_path / "a.mcap")
    recording: Recording = log
    assert recording.channels == {channel.name: channel for channel in layout().channels}
    assert list(log.channels) == ["plant", "identifier"]
    assert log.kinds == {"plant": "descriptor", "identifier": ""}
    assert log.step_ns == STEP_NS
    expected = plan()
    assert all(
        same_bits(log.designs["plant"][name], array)
        for name, array in expected.designs["plant"].items()
    )
    assert log.designs["identifier"] == {}
    assert all(np.array_equal(log.held[name], mask) for name, mask in expected.held.items())
    assert log.metadata["cosim.component.plant"]["mass"] == "1.5"
    assert log.metadata["cosim.schedule"]["stages"] == '["cascade plant","cascade identifier"]'
    assert [(m.time_ns, m.level, m.source, m.text) for m in log.messages()] == sorted(said)
    assert log.signals() == [
        "plant.u",
        "plant.x_a",
        "plant.der(x)",
        "plant.n",
        "identifier.y",
        "identifier.theta",
    ]
    assert same_bits(log["plant.der(x)"], rows[:, 3])
    assert same_bits(log["identifier.y"], rows[::5, 5:8])
    assert np.array_equal(log.time("plant.u"), np.arange(1001) * STEP_NS / 1e9)
    assert np.array_equal(log.time("identifier"), np.arange(0, 1001, 5) * STEP_NS / 1e9)
    with pytest.raises(ValueError, match="read-only"):
        log["plant.u"][0] = 1.0


def test_a_component_of_many_elements_is_split_and_comes_back(tmp_path):
    """More than 4096 elements are several channels, and one component."""
    lay = layout(wide=9000)
    rows = record(tmp_path / "a.mcap", steps=40, lay=lay)
    log = open_log(tmp_path / "a.mcap")
    assert log.channels["wide"] == lay["wide"]
    assert same_bits(log["wide.y"], rows[:, 10:])
    with (tmp_path / "a.mcap").open("rb") as stream:
        topics = [channel.topic for channel in make_reader(stream).get_summary().channels.values()]
    assert topics == ["/plant", "/identifier", "/wide", "/wide.2", "/wide.3", "/cosim/log"]


def test_a_run_without_rows_is_a_log(tmp_path):
    """A run that ended at once has empty signals."""
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.begin(plan())
    log = open_log(tmp_path / "a.mcap")
    assert log["plant.x_a"].shape == (0, 2)
    assert log.content_hash() == log.result["content_hash"]


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
)
@pytest.mark.parametrize("turn", [1, -1])
def test_logs_rewritten_by_other_tools_read_the_same(tmp_path, options, turn):
    """Message by message in the order of time, or backwards, in any chunks or none, with or without a summary."""
    record(tmp_path / "a.mcap", steps=400, messages=[(7, "info", "run", "begin")])
    rewrite(
        tmp_path / "a.mcap", tmp_path / "b.mcap", order=lambda messages: messages[::turn], **options
    )
    a, b = open_log(tmp_path / "a.mcap"), open_log(tmp_path / "b.mcap")
    assert all(same_bits(a[name], b[name]) for name in a.signals())
    assert all(np.array_equal(a.time_ns(name), b.time_ns(name)) for name in a.channels)
    assert (a.content_hash(), a.messages(), dict(a.metadata)) == (
        b.content_hash(),
        b.messages(),
        dict(b.metadata),
    )


def read_all(path):
    """Read everything there is; give what must not change."""
    log = open_log(path)
    log.load()
    assert log.designs
    assert log.held
    attachments = [log.attachment(name) for name in log.attachments]
    return (
        log.content_hash(),
        log.messages(),
        dict(log.metadata),
        attachments,
        dict(log.channels),
        log.kinds,
    )


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_no_flipped_bit_goes_unnoticed(tmp_path, compression):
    """A flip is refused, or stands where it changes nothing that is read."""
    path = tmp_path / "a.mcap"
    record(path, steps=50, compression=compression, messages=[(0, "info", "run", "begin")])
    data = bytearray(path.read_bytes())
    before = read_all(path)
    random, found = np.random.default_rng(4), 0
    for position in random.integers(0, len(data), 400):
        bit = 1 << int(random.integers(8))
        data[position] ^= bit
        path.write_bytes(data)
        try:
            assert read_all(path) == before
        except LogError as error:
            found += 1
            assert str(path) in str(error)
        data[position] ^= bit
    assert found > 200


def test_every_bit_of_chunk_and_metadata_is_guarded(tmp_path):
    """A flip in a chunk, a metadata record or an attachment is refused, or in a length that the reading does not need."""
    path = tmp_path / "a.mcap"
    record(path, steps=50)
    before, unneeded = read_all(path), 0
    data = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    chunk = summary.chunk_indexes[0]
    stretches = [(chunk.chunk_start_offset, chunk.chunk_length)]
    stretches += [
        (index.offset, index.length)
        for index in (*summary.metadata_indexes, *summary.attachment_indexes)
    ]
    for start, length in stretches:
        for position in {*range(start, start + 30), *range(start, start + length, 41)}:
            data[position] ^= 0x20
            path.write_bytes(data)
            try:
                assert read_all(path) == before
                unneeded += 1
            except LogError:
                pass
            data[position] ^= 0x20
    assert unneeded <= len(summary.metadata_indexes)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.9999])
def test_truncated_files_are_refused_with_the_byte(tmp_path, share):
    """What a crash leaves is told from damage."""
    path = tmp_path / "a.mcap"
    record(path)
    os.truncate(path, int(path.stat().st_size * share))
    told = rf"a\.mcap is truncated at byte {path.stat().st_size}: the run was killed before it could close the log, .*: run it again"
    with pytest.raises(LogError, match=told if share else "is no MCAP file"):
        open_log(path)


@pytest.mark.parametrize(("whole", "more"), [(2, 0), (1, -1), (0, -1)])
def test_a_truncated_file_says_how_much_is_there(tmp_path, monkeypatch, whole, more):
    """The time up to which its chunks are whole."""
    monkeypatch.setattr(row_buffer, "CHUNK_BYTES", 5000)
    path = tmp_path / "a.mcap"
    record(path)
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    last = chunks[1] if whole else chunks[0]
    os.truncate(path, last.chunk_start_offset + last.chunk_length + more)
    told = (
        f"it is whole up to t = {chunks[whole - 1].message_end_time / 1e9} s: run it again, or"
        if whole
        else "no row is whole: run it"
    )
    with pytest.raises(LogError, match=f"no complete summary; {told}"):
        open_log(path)


def test_the_end_of_a_run_is_told_without_reading_rows(tmp_path):
    """Also of a run whose last step no component kept, and of one without rows; a log without a result has none to tell."""
    record(tmp_path / "a.mcap", steps=123)
    log = open_log(tmp_path / "a.mcap")
    assert (log.steps, log.end_ns, log._rows) == (123, 123 * STEP_NS, {})
    assert log.end_ns == log.time_ns("plant")[-1]
    with McapRecorder(tmp_path / "b.mcap") as recorder:
        recorder.begin(plan())
    log = open_log(tmp_path / "b.mcap")
    assert (log.steps, log.end_ns) == (0, 0)
    log._metadata.pop("cosim.result")
    with pytest.raises(
        LogError,
        match=r"b\.mcap has no 'end_ns': needed a cosim\.result record, which cosim writes",
    ):
        _ = log.end_ns


def test_a_log_and_the_memory_keep_the_same_rows(tmp_path):
    """By the number of the step, whatever its time; also signals whose names have dots, and their refusals."""
    dotted = Interface((), (Signal("a.b.c", 2), Signal("a")))
    lay = Layout((Channel("x", dotted, 0, 3), Channel("y", Interface((), (Signal("z"),)), 3, 1)))
    rows = table(lay, 20)
    memory = Memory()
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        for each in (memory, recorder):
            each.begin(plan(lay))
            for block, signals in blocks(rows, 4):
                each.write(replace(block, time_ns=block.time_ns * 7 + 5), signals)
    log = open_log(tmp_path / "a.mcap")
    for recording in (log, memory):
        assert same_bits(recording["x.a.b.c"], rows[::3, :2])
        assert same_bits(recording["x.a"], rows[::3, 2])
        assert recording.time_ns("x").tolist() == [7 * k * STEP_NS + 5 for k in range(0, 21, 3)]
        assert recording.time("x.a.b.c").tolist() == recording.time("x").tolist()
        assert (recording.steps, recording.end_ns) == (20, 7 * 20 * STEP_NS + 5)
        with pytest.raises(
            LogError,
            match=r" has no 'x\.a\.b': 'x' has no signal 'a\.b'; did you mean 'a\.b\.c'\? There is: a\.b\.c, a",
        ):
            recording["x.a.b"]
        with pytest.raises(LogError, match=r" has no component 'w'; There is: x, y"):
            recording.time("w.z")


def bomb(path, declared, size=2**28):
    """Replace the only chunk of a log by zeros that expand to ``size`` bytes, with ``declared`` bytes declared."""
    data = path.read_bytes()
    with path.open("rb") as stream:
        (index,) = make_reader(stream).get_summary().chunk_indexes
    content = bytes(size)
    packed = zstandard.compress(content)
    start, stop = (
        index.chunk_start_offset,
        index.chunk_start_offset + index.chunk_length + index.message_index_length,
    )
    head = (
        struct.pack("<QQQI", 0, 0, declared, zlib.crc32(content))
        + b"\x04\0\0\0zstd"
        + struct.pack("<Q", len(packed))
    )
    footer = struct.pack("<BQQQI", 2, 20, 0, 0, 0) + data[:8]
    end = struct.pack("<BQI", 15, 4, 0)
    path.write_bytes(
        data[:start]
        + struct.pack("<BQ", 6, len(head) + len(packed))
        + head
        + packed
        + data[stop:stop]
        + end
        + footer
    )


@pytest.mark.parametrize(
    ("declared", "found"),
    [(1000, "268435456 bytes, 1000 declared"), (2**28, "268435456 bytes, at most 67108864")],
)
def test_a_decompression_bomb_is_refused_before_it_goes_off(tmp_path, declared, found):
    """The declared size and the frame's are looked at first; the memory is not spent."""
    record(tmp_path / "a.mcap", steps=10)
    bomb(tmp_path / "a.mcap", declared)
    log = open_log(tmp_path / "a.mcap")
    tracemalloc.start()
    with pytest.raises(LogError, match=found):
        log.rows("plant")
    assert tracemalloc.get_traced_memory()[1] < 2**23
    tracemalloc.stop()


def test_reading_a_component_takes_little_more_memory_than_it_has(tmp_path, monkeypatch):
    """The file is read chunk by chunk, and the rows go to their place at once."""
    monkeypatch.setattr(row_buffer, "CHUNK_BYTES", 50_000)
    record(tmp_path / "a.mcap", steps=2000, lay=layout(wide=500))
    log = open_log(tmp_path / "a.mcap")
    tracemalloc.start()
    rows = log.rows("plant")
    assert tracemalloc.get_traced_memory()[1] < 4 * rows.nbytes + 8 * 50_000
    tracemalloc.stop()


def test_files_that_are_no_logs_are_named(tmp_path):
    """Missing, foreign and other people's files."""
    path = tmp_path / "a.mcap"
    with pytest.raises(LogError, match=r"a\.mcap cannot be read: No such file"):
        open_log(path)
    path.write_bytes(b"hello, world")
    with pytest.raises(LogError, match=r"a\.mcap is no MCAP file: it begins with b'hello, w'"):
        open_log(path)
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    writer.register_channel("/tf", "json", 0)
    writer.finish()
    path.write_bytes(stream.getvalue())
    with pytest.raises(
        LogError, match=r"no channels of cosim, which carry 'cosim\.component'; found: /tf"
    ):
        open_log(path)


def test_unknown_names_are_answered_with_the_nearest(tmp_path):
    """Signals, components and attachments."""
    record(tmp_path / "a.mcap", steps=5)
    log = open_log(tmp_path / "a.mcap")
    with pytest.raises(
        LogError,
        match=r"a\.mcap has no 'plant\.x_b': 'plant' has no signal 'x_b'; did you mean 'x_a'\? There is: u, ",
    ):
        log["plant.x_b"]
    with pytest.raises(LogError, match=r"a\.mcap has no component 'plamt'; did you mean 'plant'\?"):
        log["plamt.u"]
    with pytest.raises(LogError, match="no component 'plan'; did you mean 'plant'"):
        log.time_ns("plan")
    with pytest.raises(
        LogError, match=r"no attachment 'results\.json'; did you mean 'result\.json'"
    ):
        log.attachment("results.json")


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


def test_a_chunk_record_is_what_mcap_says(tmp_path):
    """The chunk written by hand is the chunk that mcap's own record would be."""
    record(tmp_path / "a.mcap", steps=50)
    with (tmp_path / "a.mcap").open("rb") as stream:
        (index,) = make_reader(stream).get_summary().chunk_indexes
        stream.seek(index.chunk_start_offset + 9)

        chunk, builder = Chunk.read(ReadDataStream(stream)), RecordBuilder()
        chunk.write(builder)
        stream.seek(index.chunk_start_offset)
        assert stream.read(index.chunk_length) == builder.end()
