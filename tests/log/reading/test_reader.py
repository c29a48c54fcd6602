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

import cosim
from cosim.core.recorders import Memory
from cosim.core.recording import Recording
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError, UsageError
from cosim.log import McapRecorder, open_log
from cosim.log.contents import preamble
from cosim.log.mcap_file.workers import AHEAD
from cosim.log.reading import rows as log_rows
from tests.log.crafting import put_together, take_apart
from tests.log.recordings import (
    STEP_NS,
    blocks,
    layout,
    make_chunks_small,
    plan,
    record,
    same_bits,
    table,
)


def rewrite(source, target, *, order=lambda messages: messages, **options):
    """Copy a log message by message through mcap's own writer."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        summary = reader.get_summary()
        writer = Writer(out, **options)
        writer.start()
        ids = {}
        for number, channel in summary.channels.items():
            schema = summary.schemas[channel.schema_id]
            schema_id = writer.register_schema(f"other.{schema.name}", schema.encoding, schema.data)
            ids[number] = writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )
        for item in reader.iter_metadata():
            writer.add_metadata(item.name, item.metadata)
        for _, channel, message in order(list(reader.iter_messages())):
            channel_id = ids[channel.id]
            times = {"log_time": message.log_time, "publish_time": message.publish_time}
            writer.add_message(channel_id, data=message.data, sequence=message.sequence, **times)
        writer.finish()


@pytest.fixture
def path(tmp_path):
    """Name the log."""
    return tmp_path / "a.mcap"


def test_a_log_returns_its_components(path):
    """With their kinds and the communication step."""
    record(path, kinds={"plant": "descriptor"})
    log = open_log(path)
    recording: Recording = log
    assert recording.channels == {channel.name: channel for channel in layout().channels}
    assert list(log.channels) == ["plant", "identifier"]
    assert log.kinds == {"plant": "descriptor", "identifier": ""}
    assert log.step_ns == STEP_NS


def test_a_log_returns_what_was_planned(path):
    """Designs, held inputs and the schedule."""
    record(path)
    log = open_log(path)
    for name, array in plan().designs["plant"].items():
        assert same_bits(log.designs["plant"][name], array)
    assert log.designs["identifier"] == {}
    for name, mask in plan().held.items():
        assert np.array_equal(log.held[name], mask)
    assert log.metadata["cosim.schedule"]["stages"] == '["cascade plant","cascade identifier"]'


def test_a_log_returns_metadata_and_messages(path):
    """Messages in the order of time."""
    messages = [(3 * STEP_NS, "warning", "plant", "slow"), (0, "info", "run", "begin")]
    record(path, messages=messages, metadata={"cosim.component.plant": {"mass": "1.5"}})
    log = open_log(path)
    assert log.metadata["cosim.component.plant"]["mass"] == "1.5"
    recorded = [(m.time_ns, m.level, m.source, m.text) for m in log.messages()]
    assert recorded == sorted(messages)


def test_a_log_returns_every_signal(path):
    """By its name, with its times; nothing can be written to."""
    rows = record(path)
    log = open_log(path)
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
    assert log.content_hash() == log.results["content_hash"]


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
def test_logs_rewritten_by_other_tools_read_the_same(tmp_path, path, options, turn):
    """In the order of time, or backwards, in any chunks or none, with or without a summary."""
    copy = tmp_path / "b.mcap"
    record(path, steps=400, messages=[(7, "info", "run", "begin")])
    rewrite(path, copy, order=lambda messages: messages[::turn], **options)
    a = open_log(path)
    b = open_log(copy)
    for name in a.signals:
        assert same_bits(a[name], b[name])
    for name in a.channels:
        assert np.array_equal(a.time_ns(name), b.time_ns(name))
    assert a.content_hash() == b.content_hash()
    assert a.messages() == b.messages()
    assert dict(a.metadata) == dict(b.metadata)


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


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_no_flipped_bit_goes_unnoticed(path, compression):
    """A flip is refused, or stands where it changes nothing that is read."""
    record(path, steps=50, compression=compression, messages=[(0, "info", "run", "begin")])
    data = bytearray(path.read_bytes())
    before = read_all(path)
    random = np.random.default_rng(4)
    refused = 0
    for position in random.integers(0, len(data), 400):
        bit = 1 << int(random.integers(8))
        error, content = read_flipped(path, data, position, bit)
        if error is None:
            assert content == before
        else:
            assert str(path) in str(error)
            refused += 1
    assert refused > 200


def test_every_bit_of_chunk_and_metadata_is_guarded(path):
    """A flip in a chunk, a metadata record or an attachment is refused.

    The exception is a flip in a length that the reading does not need.
    """
    record(path, steps=50)
    data = bytearray(path.read_bytes())
    before = read_all(path)
    with path.open("rb") as stream:
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


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.9999])
def test_truncated_files_are_refused_with_the_byte(path, share):
    """What a crash leaves is not called damaged."""
    record(path)
    os.truncate(path, int(path.stat().st_size * share))
    message = "is no MCAP file"
    if share:
        message = (
            rf"a\.mcap is truncated at byte {path.stat().st_size}: its end is missing"
            r", as where a copy of it broke off; .*: run it again"
        )
    with pytest.raises(LogError, match=message):
        open_log(path)


@pytest.mark.parametrize(("whole", "more"), [(2, 0), (1, -1), (0, -1)])
def test_the_error_of_a_truncated_file_names_the_end_of_its_last_whole_chunk(
    path, monkeypatch, whole, more
):
    """Up to there it need not be whole: another component may have its last rows before."""
    make_chunks_small(monkeypatch, 5000)
    record(path)
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    last = chunks[1] if whole else chunks[0]
    os.truncate(path, last.chunk_start_offset + last.chunk_length + more)
    message = "it has no whole row: run it"
    if whole:
        end = chunks[whole - 1].message_end_time / 1e9
        message = f"its last whole chunk ends at t = {end} s: run it again, or"
    with pytest.raises(LogError, match=f"broke off; {message}"):
        open_log(path)


def test_the_end_of_a_run_is_known_without_reading_rows(path):
    """Also of a run whose last step no component recorded."""
    record(path, steps=123)
    log = open_log(path)
    assert log.steps == 123
    assert log.end_ns == 123 * STEP_NS
    assert not log._rows._rows
    assert log.end_ns == log.time_ns("plant")[-1]


def test_a_run_without_rows_ends_at_its_start(path):
    """A log without a result does not know its end."""
    with McapRecorder(path) as recorder:
        recorder.begin(plan())
    log = open_log(path)
    assert (log.steps, log.end_ns) == (0, 0)
    log._metadata.pop("cosim.result")
    message = r"a\.mcap has no 'end_ns': needed a cosim\.result record, which cosim writes"
    with pytest.raises(LogError, match=message):
        _ = log.end_ns


@pytest.fixture
def dotted(path):
    """Record signals with dots in their names to a log and to the memory; return both and the rows.

    Periods go by the number of the step, so the times are made odd.
    """
    interface = Interface((), (Signal("a.b.c", 2), Signal("a")))
    other = Interface((), (Signal("z"),))
    lay = Layout((Channel("x", interface, 0, 3), Channel("y", other, 3, 1)))
    rows = table(lay, 20)
    memory = Memory()
    with McapRecorder(path) as recorder:
        for target in (memory, recorder):
            target.begin(plan(lay))
            for block, signals in blocks(rows, 4):
                target.write(replace(block, time_ns=block.time_ns * 7 + 5), signals)
    return (open_log(path), memory), rows


def test_a_log_and_the_memory_keep_the_same_rows(dotted):
    """By the number of the step, whatever its time."""
    recordings, rows = dotted
    for recording in recordings:
        assert same_bits(recording["x.a.b.c"], rows[::3, :2])
        assert same_bits(recording["x.a"], rows[::3, 2])
        times = [7 * k * STEP_NS + 5 for k in range(0, 21, 3)]
        assert recording.time_ns("x").tolist() == times
        assert recording.time("x.a.b.c").tolist() == recording.time("x").tolist()
        assert recording.steps == 20
        assert recording.end_ns == 7 * 20 * STEP_NS + 5


def test_a_log_and_the_memory_refuse_unknown_names_alike(dotted):
    """The nearest name, where there is one."""
    recordings, _ = dotted
    signal_message = (
        r" has no 'x\.a\.b': 'x' has no signal 'a\.b'; did you mean 'a\.b\.c'\?"
        r" There is: a\.b\.c, a"
    )
    for recording in recordings:
        with pytest.raises(LogError, match=signal_message):
            recording["x.a.b"]
        with pytest.raises(LogError, match=r" has no component 'w'; there is: x, y"):
            recording.time("w.z")


def bomb(path, declared, size=2**28):
    """Replace a log's only chunk by zeros that expand to ``size`` bytes, ``declared`` declared."""
    data = path.read_bytes()
    with path.open("rb") as stream:
        (index,) = make_reader(stream).get_summary().chunk_indexes
    content = bytes(size)
    packed = zstandard.compress(content)
    chunk = struct.pack("<QQQI", 0, 0, declared, zlib.crc32(content))
    chunk += b"\x04\0\0\0zstd"
    chunk += struct.pack("<Q", len(packed))
    chunk += packed
    magic = data[:8]
    path.write_bytes(
        data[: index.chunk_start_offset]
        + struct.pack("<BQ", 6, len(chunk))
        + chunk
        + struct.pack("<BQI", 15, 4, 0)  # DataEnd
        + struct.pack("<BQQQI", 2, 20, 0, 0, 0)  # Footer
        + magic
    )


@pytest.mark.parametrize(
    ("declared", "message"),
    [(1000, "268435456 bytes, 1000 declared"), (2**28, "268435456 bytes, at most 67108864")],
)
def test_a_decompression_bomb_is_refused_before_it_goes_off(tmp_path, declared, message):
    """The declared size and the frame's are looked at first; the memory is not spent."""
    record(tmp_path / "a.mcap", steps=10)
    bomb(tmp_path / "a.mcap", declared)
    log = open_log(tmp_path / "a.mcap")
    tracemalloc.start()
    with pytest.raises(LogError, match=message):
        log.rows("plant")
    assert tracemalloc.get_traced_memory()[1] < 2**23
    tracemalloc.stop()


def test_reading_a_component_takes_little_more_memory_than_it_has(tmp_path, monkeypatch):
    """The file is read chunk by chunk, and the rows go to their place at once.

    Other components are read ahead in the first pass only where all are small.
    """
    make_chunks_small(monkeypatch, 50_000)
    monkeypatch.setattr(log_rows, "_ALWAYS_AHEAD", 2**20)
    record(tmp_path / "a.mcap", steps=2000, lay=layout(wide=500))
    log = open_log(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    largest = max(index.uncompressed_size for index in summary.chunk_indexes)
    assert len(summary.chunk_indexes) > 2 * AHEAD
    tracemalloc.start()
    rows = log.rows("plant")
    # Of the chunks in hand, each compressed and not, with room for one an eighth larger.
    in_hand = AHEAD * 2 * 9 / 8 * largest
    assert tracemalloc.get_traced_memory()[1] < 4 * rows.nbytes + in_hand
    tracemalloc.stop()


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_chunks_read_one_behind_the_other_keep_their_rows(tmp_path, monkeypatch, compression):
    """However they are read: their memory is that of chunks before them."""
    make_chunks_small(monkeypatch, 10_000)
    rows = record(tmp_path / "a.mcap", steps=2000, compression=compression)
    log = open_log(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as stream:
        assert len(make_reader(stream).get_summary().chunk_indexes) > 3 * AHEAD
    log.load()
    for name, channel in log.channels.items():
        assert same_bits(log.rows(name), rows[:: channel.period, channel.columns])
    monkeypatch.setattr(log_rows, "_MOST_AHEAD", 0)
    monkeypatch.setattr(log_rows, "_MOST_KEPT", 0)
    for name, channel in open_log(tmp_path / "a.mcap").channels.items():
        streamed = [values for _, values in open_log(tmp_path / "a.mcap").blocks(name)]
        assert same_bits(np.vstack(streamed), rows[:: channel.period, channel.columns])
        times = open_log(tmp_path / "a.mcap").time_ns(name)
        assert np.array_equal(times, np.arange(len(times)) * channel.period * STEP_NS)


def test_files_that_are_no_logs_are_named(path):
    """Missing, foreign and other people's files."""
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


def test_unknown_names_name_the_nearest(tmp_path):
    """Signals, components and attachments."""
    record(tmp_path / "a.mcap", steps=5)
    log = open_log(tmp_path / "a.mcap")
    message = (
        r"a\.mcap has no 'plant\.x_b': 'plant' has no signal 'x_b'; did "
        r"you mean 'x_a'\? There is: u, "
    )
    with pytest.raises(LogError, match=message):
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


def test_an_index_without_its_chunk_is_damage(path):
    """Where the summary says that there is a chunk, there is one."""
    record(path, steps=50)
    with path.open("rb") as stream:
        (index,) = make_reader(stream).get_summary().chunk_indexes
    data = bytearray(path.read_bytes())
    found = index.chunk_start_offset.to_bytes(8, "little")
    position = data.rindex(found)
    data[position : position + 8] = (index.chunk_start_offset + 1).to_bytes(8, "little")
    summary_start = int.from_bytes(data[-28:-20], "little")
    data[-12:-8] = zlib.crc32(data[summary_start:-12]).to_bytes(4, "little")
    path.write_bytes(data)
    start = index.chunk_start_offset + 1
    with pytest.raises(LogError, match=rf"damaged at byte {start}: no chunk there, though its"):
        open_log(path).rows("plant")


def test_a_chunk_without_crc_is_read(path, tmp_path):
    """0 says that its writer gave none."""
    record(path, steps=50)
    rewrite(path, tmp_path / "b.mcap", enable_crcs=False)
    assert open_log(tmp_path / "b.mcap").content_hash() == open_log(path).recorded_hash


def test_a_chunk_record_is_what_mcap_says(tmp_path):
    """The chunk written by hand is the chunk that mcap's own record would be."""
    record(tmp_path / "a.mcap", steps=50)
    with (tmp_path / "a.mcap").open("rb") as stream:
        (index,) = make_reader(stream).get_summary().chunk_indexes
        stream.seek(index.chunk_start_offset + 9)
        chunk = Chunk.read(ReadDataStream(stream))
        builder = RecordBuilder()
        chunk.write(builder)
        stream.seek(index.chunk_start_offset)
        assert stream.read(index.chunk_length) == builder.end()


def test_a_log_of_another_format_is_refused(tmp_path, monkeypatch):
    """Where the format has changed, the reader says so before it reads what it would misread."""
    path = tmp_path / "old.mcap"
    monkeypatch.setattr(preamble, "FORMAT", "1")
    record(path, steps=10)
    text = r"old\.mcap: written in log format '1', .*; needed format '2': run its scenario"
    with pytest.raises(LogError, match=text):
        open_log(path)


def rows_of_plant(content):
    """Return where the messages of the plant stand among all."""
    (plant,) = [number for number, channel in content.channels.items() if channel[0] == "/plant"]
    return [index for index, message in enumerate(content.messages) if message[0] == plant]


@pytest.mark.parametrize("row", [0, 3, -1])
def test_a_log_whose_rows_are_not_those_of_its_steps_is_refused(tmp_path, row):
    """Also where its summary agrees with what is left: it is no whole run."""
    log = cosim.run("academic", set={"scenario.stop": 0.02}, out=tmp_path / "a.mcap")
    content = take_apart(log.path)
    del content.messages[rows_of_plant(content)[row]]
    path = put_together(content, tmp_path / "b.mcap")
    text = r"b\.mcap is damaged: 20 rows of 'plant'; needed 21, as the run recorded 20 steps"
    with pytest.raises(LogError, match=text):
        open_log(path)


@pytest.mark.parametrize("row", [0, 3, -1])
def test_a_row_off_the_grid_is_named(tmp_path, row):
    """Its values may be right, but no run has a row there."""
    log = cosim.run("academic", set={"scenario.stop": 0.02}, out=tmp_path / "a.mcap")
    content = take_apart(log.path)
    index = rows_of_plant(content)[row]
    number, time_ns, sequence, data = content.messages[index]
    content.messages[index] = (number, time_ns + 1, sequence, data)
    moved = open_log(put_together(content, tmp_path / "b.mcap"))
    text = r"b\.mcap is damaged: a row of 'plant' at t = .* s is off its grid: there are 0\.001 s"
    for read in (moved.load, moved.content_hash, lambda: moved.rows("plant")):
        with pytest.raises(LogError, match=text):
            read()


def test_a_run_in_memory_is_no_log():
    """It has no file, and says how a run gets one."""
    memory = cosim.run("academic", set={"scenario.stop": 0.01})
    for reader in (open_log, cosim.replay):
        with pytest.raises(UsageError, match=r"kept in memory; needed .* with out='x\.mcap'"):
            reader(memory)
