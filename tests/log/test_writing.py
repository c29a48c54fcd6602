"""What the recorder writes is an ordinary MCAP file, however the run ends."""

from __future__ import annotations

import io
import json
import re
import shutil
import threading
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from google.protobuf import json_format
from mcap.reader import NonSeekingReader, make_reader

import cosim
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.errors import Interrupted, LogWriteError
from cosim.log import Attachment, McapRecorder, files, open_log
from cosim.log.background import BackgroundWriter
from tests.log.decoding import message_class
from tests.log.disks import FullDisk
from tests.log.recordings import (
    STEP_NS,
    blocks,
    layout,
    make_chunks_small,
    many,
    plan,
    record,
    same_bits,
    table,
    wait_for_rows,
)


@pytest.mark.parametrize("make", [make_reader, NonSeekingReader])
@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_stock_readers_see_every_bit(tmp_path, compression, make):
    """Mcap's two readers, with CRCs checked, and protobuf decode every message as it was."""
    path = tmp_path / "a.mcap"
    rows = record(path, steps=300, compression=compression, kinds={"plant": "descriptor"})
    reader = make(io.BytesIO(path.read_bytes()), validate_crcs=True)
    decoded_rows = {"/plant": [], "/identifier": []}
    for schema, channel, message in reader.iter_messages():
        assert message.log_time == message.publish_time == message.sequence * STEP_NS
        kind = message_class(schema.name, schema.data)
        decoded = kind.FromString(message.data)
        row = [getattr(decoded, field.name) for field in kind.DESCRIPTOR.fields]
        decoded_rows[channel.topic].append(row)
    assert same_bits(np.array(decoded_rows["/plant"]), rows[:, :5])
    assert same_bits(np.array(decoded_rows["/identifier"]), rows[::5, 5:])


def test_the_stock_reader_finds_everything_through_the_summary(tmp_path):
    """Header, schemas, topics, counts, every metadata record once, attachments and messages."""
    record(
        tmp_path / "a.mcap",
        attachments=[Attachment("scenario.toml", "application/toml", b"[scenario]")],
        metadata={"cosim.connections": {"plant.u": "u.y"}, "cosim.component.plant": {"m": "1.5"}},
        messages=[(0, "info", "plant", "ready")],
    )
    reader = make_reader(io.BytesIO((tmp_path / "a.mcap").read_bytes()), validate_crcs=True)
    header = reader.get_header()
    assert header.profile == ""
    assert header.library.startswith(f"cosim/{cosim.__version__} mcap-python/")
    summary = reader.get_summary()
    schemas = {schema.name for schema in summary.schemas.values()}
    assert schemas == {"cosim.plant", "cosim.identifier", "foxglove.Log"}
    topics = [channel.topic for channel in summary.channels.values()]
    assert topics == ["/plant", "/identifier", "/cosim/log"]
    assert summary.statistics.channel_message_counts == {1: 1001, 2: 201, 3: 1}
    records = list(reader.iter_metadata())
    names = "run env written schedule connections result component.plant component.identifier"
    assert sorted(item.name for item in records) == sorted(
        f"cosim.{name}" for name in names.split()
    )
    by_name = {item.name: item.metadata for item in records}
    assert by_name["cosim.env"]["cosim"] == cosim.__version__
    attachments = {item.name: item.data for item in reader.iter_attachments()}
    assert attachments["scenario.toml"] == b"[scenario]"
    ((schema, _, message),) = reader.iter_messages(topics="/cosim/log")
    decoded = message_class("foxglove.Log", schema.data).FromString(message.data)
    assert json_format.MessageToDict(decoded) == {
        "timestamp": "1970-01-01T00:00:00Z",
        "level": "INFO",
        "message": "ready",
        "name": "plant",
    }


def test_the_summary_knows_when_a_late_run_began(tmp_path, monkeypatch):
    """Its first and its last instant, of all chunks; times before 0 are none of MCAP."""
    make_chunks_small(monkeypatch, 700)
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.begin(plan())
        for block, signals in blocks(table(layout(), 40), 7):
            recorder.write(replace(block, time_ns=block.time_ns + 5 * STEP_NS), signals)
        with pytest.raises(LogWriteError, match=r"a\.mcap: expected a time >= 0, got -1 ns"):
            recorder.write(replace(block, time_ns=np.array([-1, 0])), signals)
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert len(summary.chunk_indexes) > 3
    assert summary.statistics.message_start_time == 5 * STEP_NS
    assert summary.statistics.message_end_time == 45 * STEP_NS


@pytest.mark.slow
def test_content_does_not_depend_on_blocks_chunks_or_compression(tmp_path, monkeypatch):
    """Equal runs have equal hashes and equal data."""
    path = tmp_path / "a.mcap"
    hashes = {}
    ways = [
        (1, "zstd", 2**20),
        (7, "zstd", 3000),
        (1000, "zstd", 2**20),
        (7, "lz4", 100),
        (1000, "none", 30_000),
    ]
    for period, (block, compression, chunk) in product((1, 5, 7), ways):
        make_chunks_small(monkeypatch, chunk)
        options = {"steps": 300, "size": block, "compression": compression, "force": True}
        rows = record(path, lay=layout(period=period), **options)
        log = open_log(path)
        assert same_bits(log.rows("plant"), rows[:, :5])
        assert same_bits(log.rows("identifier"), rows[::period, 5:])
        steps = np.arange(0, 301, period)
        assert np.array_equal(log.time_ns("identifier"), steps * STEP_NS)
        recorded = log.metadata["cosim.result"]["content_hash"], log.results["content_hash"]
        hashes.setdefault(period, set()).update({log.content_hash(), *recorded})
    assert [len(found) for found in hashes.values()] == [1, 1, 1]


def test_rows_are_in_the_file_after_the_flush_interval(tmp_path):
    """While the run pauses, too; the file is an MCAP to every reader then."""
    path = tmp_path / "a.mcap"
    rows = table(layout(), 12)
    with McapRecorder(path, flush=0.0) as recorder:
        recorder.begin(plan())
        for number, (block, signals) in enumerate(blocks(rows, 1)):
            recorder.write(block, signals)
            wait_for_rows(path, number + 2)
    assert same_bits(open_log(path).rows("plant"), rows[:, :5])
    with path.open("rb") as stream:
        assert len(make_reader(stream).get_summary().chunk_indexes) == 1


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (ValueError("boom"), "failed", "ValueError: boom"),
        (KeyboardInterrupt(), "interrupted", "interrupted by the user"),
        (Interrupted("Ctrl-C"), "interrupted", "Ctrl-C"),
        (Stopped(np.empty((0, 0)), "enough", failed=False), "complete", "enough"),
        (Stopped(np.empty((0, 0)), "burst"), "failed", "burst"),
    ],
)
def test_an_error_in_the_run_leaves_a_whole_file(tmp_path, error, status, reason):
    """Everything written so far is there, with the stop reason; of a foreign error its type too."""
    rows = table(layout(), 100)

    def fail():
        with McapRecorder(tmp_path / "a.mcap") as recorder:
            recorder.begin(plan())
            for block, signals in list(blocks(rows, 10))[:5]:
                recorder.write(block, signals)
            raise error

    with pytest.raises(type(error)):
        fail()
    log = open_log(tmp_path / "a.mcap")
    assert log.status == status
    assert log.results["reason"] == reason
    assert log.results["steps"] == 50
    assert log.results["end_ns"] == 50 * STEP_NS
    assert same_bits(log.rows("plant"), rows[:51, :5])
    assert log.content_hash() == log.results["content_hash"]


def test_a_full_disk_leaves_a_whole_file(tmp_path, monkeypatch, subtests):
    """The error names file and reason; what was flushed is a valid file with a true hash."""
    make_chunks_small(monkeypatch, 5000)
    rows = table(layout(), 1000)
    statuses = set()
    for room in range(12, 36, 3):
        path = tmp_path / f"{room}.mcap"
        monkeypatch.setattr(files, "create", lambda path, room=room: FullDisk(path, room))
        message = (
            rf"{room}\.mcap cannot be written further: No space left on device; .*= ([\d.]+) s"
        )
        with pytest.raises(LogWriteError, match=message) as raised:
            record(path, rows=rows, compression="none")
        log = open_log(path)
        count = len(log.rows("plant"))
        (end,) = re.findall(message, str(raised.value))
        statuses.add(log.status)
        with subtests.test(case=room):
            assert max(count - 1, 0) * STEP_NS / 1e9 == float(end)
            assert same_bits(log.rows("plant"), rows[:count, :5])
            if log.status == "failed":
                assert log.results["steps"] == count - 1
                assert log.content_hash() == log.results["content_hash"]
            with path.open("rb") as stream:
                reader = NonSeekingReader(stream, validate_crcs=True)
                assert len(list(reader.iter_messages("/plant"))) == count
    # Without room for the end of an ordinary file it stays as it was written.
    assert statuses <= {"failed", "unfinished"}


def test_the_result_takes_numpy_values(tmp_path):
    """What the report computes goes to result.json as it is."""
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.begin(plan())
        recorder.result({"theta": np.array([1.0, 2.0]), "count": np.int64(3)})
        recorder.result({"ok": np.True_, "path": tmp_path})
    result = json.loads(open_log(tmp_path / "a.mcap").attachment("result.json"))
    assert result["theta"] == [1.0, 2.0]
    assert result["count"] == 3
    assert result["ok"] is True
    assert result["path"] == str(tmp_path)


def test_messages_before_the_file_are_in_it(tmp_path):
    """A component may warn while the run is prepared; where nothing follows nothing is written."""
    path = tmp_path / "a.mcap"
    with McapRecorder(path) as recorder:
        recorder.message(0, "warning", "plant", "early")
        recorder.begin(plan())
        recorder.message(0, "info", "run", "late")
        recorder.write(*next(blocks(table(layout(), 10), 10)))
    assert [message.text for message in open_log(path).messages()] == ["early", "late"]
    recorder = McapRecorder(tmp_path / "b.mcap")
    with recorder:
        recorder.message(0, "warning", "plant", "early")
    assert not (tmp_path / "b.mcap").exists()


SHAPES = [(0, 0), (0, 1000), (40, 500), (9000, 10)]  # further elements, steps


@pytest.mark.fast("True")
@pytest.mark.parametrize("flushed", [False, True])
def test_no_log_is_larger_than_its_bound(tmp_path, monkeypatch, flushed, subtests):
    """Also with a flush after every step, as of a run with a second of work a step."""
    if flushed:
        make_chunks_small(monkeypatch, 2000)
    for compression, (wide, count) in product(("none", "zstd", "lz4"), SHAPES):
        steps = min(count, 100) if flushed else count
        path = tmp_path / f"{compression} {wide} {steps}.mcap"
        lay = layout(wide=wide)
        flush = 0.0 if flushed else 1.0
        with McapRecorder(path, compression=compression, flush=flush) as recorder:
            recorder.begin(plan(lay))
            bound = recorder.size_bound(steps)
            if steps:
                for block, signals in blocks(table(lay, steps), 1 if flushed else 10):
                    recorder.write(block, signals)
        with subtests.test(case=(compression, wide, steps)):
            assert path.stat().st_size <= bound


@pytest.mark.fast("0-2000")
@pytest.mark.parametrize(("wide", "steps"), [(0, 2000), (9000, 10)])
def test_the_bound_of_a_large_log_is_less_than_twice_its_size(tmp_path, wide, steps):
    """Of an uncompressed one over 1 GB; its size grows as between two short ones."""
    lay = layout(wide=wide)
    sizes = []
    for count in (steps, 2 * steps):
        path = tmp_path / f"{count}.mcap"
        with McapRecorder(path, compression="none") as recorder:
            recorder.begin(plan(lay))
            for block, signals in blocks(table(lay, count), 10):
                recorder.write(block, signals)
        sizes.append(path.stat().st_size)
    step_bytes = (sizes[1] - sizes[0]) / steps
    large = int(1e9 / step_bytes)
    with McapRecorder(tmp_path / "large.mcap", compression="none") as recorder:
        recorder.begin(plan(lay))
        assert large * step_bytes < recorder.size_bound(large) < 2.0 * large * step_bytes


def test_a_large_log_is_announced_before_the_first_step(tmp_path, monkeypatch):
    """Over 1 GB, and where the disk has less; otherwise nothing is said."""

    class Begun(Exception):
        pass

    def stop(time, end):
        raise Begun

    def notices(stop_time, free):
        monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
        said = []
        with pytest.raises(Begun):
            cosim.run(
                "academic",
                out=tmp_path / "a.mcap",
                force=True,
                set={"scenario.stop": stop_time},
                notice=said.append,
                progress=stop,
            )
        return said

    assert notices(1.0, 10**12) == []
    (text,) = notices(10_000.0, 10**12)
    assert text.startswith(f"{tmp_path}/a.mcap ")
    assert " GB" in text
    (text,) = notices(1.0, 10_000)
    assert text.startswith("warning: ")
    assert "1e-05 GB" in text


CLOCK = Clock(stop=100.0, step=1.0)


def test_rows_of_a_block_under_way_are_written_once():
    """After the flush interval those that are completed; when the block is written, the others."""
    written = []
    grown = threading.Event()

    def add(content):
        written.extend(zip(content.steps.tolist(), content.values[:, 0].tolist(), strict=True))
        if len(written) == 31:
            grown.set()

    writer = BackgroundWriter(add, capacity=25, width=1, interval=0.01)
    first = CLOCK.block_at(0, 10)
    second = CLOCK.block_at(10, 40)
    values = np.arange(51.0).reshape(-1, 1)
    writer.follow(lambda: (second.part(0, 20), values[10:31]))
    writer.write(first, values[:11], 0)
    try:
        assert grown.wait(10.0)  # more than a buffer holds
        writer.write(second, values[10:], 1)
    finally:
        rest = writer.close()
    add(rest)
    assert written == [(k, float(k)) for k in range(51)]


def test_rows_are_in_order_however_a_buffer_is_handed_over():
    """The run fills the next buffer while the thread looks at what is under way."""
    written = []
    count = 3000
    values = np.arange(10.0 * count + 1).reshape(-1, 1)
    under_way = [CLOCK.block_at(0, 0), values[:1]]
    writer = BackgroundWriter(
        lambda content: written.extend(content.steps.tolist()),
        capacity=7,
        width=1,
        interval=0.0,
    )
    writer.follow(lambda: tuple(under_way))
    writer.write(*under_way, 0)
    for number in range(count):
        block = CLOCK.block_at(10 * number, 10)
        under_way[:] = block, values[10 * number : 10 * number + 11]
        writer.write(block, values[10 * number : 10 * number + 11], 1)
    rest = writer.close()
    if rest is not None:
        written += rest.steps.tolist()
    assert written == list(range(10 * count + 1))


@pytest.mark.slow
def test_many_components_have_no_more_pieces_than_few(tmp_path):
    """A piece is what a chunk has of a component: it costs the same, however few rows it has.

    Of 1000 components a step takes 49 kB: chunks of 1 MiB would have 21 rows of each, in 3 pieces.
    """
    record(tmp_path / "a.mcap", steps=60, size=60, lay=many(1000))
    with (tmp_path / "a.mcap").open("rb") as stream:
        assert make_reader(stream).get_summary().statistics.chunk_count <= 1
