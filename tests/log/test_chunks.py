"""Chunks are those of MCAP, are decompressed within bounds, and are made by threads."""

from __future__ import annotations

import struct
import threading
import tracemalloc
import zlib
from contextlib import closing

import pytest
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk, MessageIndex

from cosim.errors import LogError
from cosim.log import open_log
from cosim.log.chunks import AHEAD, Workers
from cosim.log.messages import decode_log
from tests.log.recordings import (
    STEP_NS,
    make_chunks_small,
    record,
)


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


def test_message_indexes_lead_to_their_messages(tmp_path, monkeypatch):
    """Also to those of any size, behind the rows; a reader goes by them from a time on."""
    make_chunks_small(monkeypatch, 20_000)
    texts = ["a", "a longer one", "", "and the last"]
    messages = [(k * STEP_NS, "info", "run", text) for k, text in enumerate(texts)]
    record(tmp_path / "a.mcap", steps=1000, messages=messages)
    found = []
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream)
        chunks = reader.get_summary().chunk_indexes
        assert len(chunks) > 3
        for chunk in chunks:
            stream.seek(chunk.chunk_start_offset + 9)
            content = zstandard.decompress(Chunk.read(ReadDataStream(stream)).data)
            for number, offset in chunk.message_index_offsets.items():
                stream.seek(offset + 9)
                index = MessageIndex.read(ReadDataStream(stream))
                assert index.channel_id == number
                for time_ns, start in index.records:
                    opcode, length, channel_id = struct.unpack_from("<BQH", content, start)
                    assert (opcode, channel_id) == (5, number)
                    assert struct.unpack_from("<Q", content, start + 15) == (time_ns,)
                    if number == 3:
                        found.append(decode_log(content[start + 31 : start + 9 + length])[2])
        assert sum(1 for _ in reader.iter_messages("/plant", starting_at=900 * STEP_NS)) == 101
    assert found == texts


SIZE = 2**27  # of a chunk when it is expanded, twice what may be


def bomb(path, declared, packed, checksum):
    """Replace a log's only chunk by a packed one of ``SIZE`` bytes, ``declared`` declared."""
    data = path.read_bytes()
    with path.open("rb") as stream:
        (index,) = make_reader(stream).get_summary().chunk_indexes
    chunk = struct.pack("<QQQI", 0, 0, declared, checksum)
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


def test_a_decompression_bomb_is_refused_before_it_goes_off(tmp_path):
    """The declared size and the frame's are looked at first; the memory is not spent."""
    content = bytes(SIZE)
    packed = zstandard.compress(content)
    checksum = zlib.crc32(content)
    for declared, numbers in [(1000, "1000.*134217728"), (SIZE, "134217728.*67108864")]:
        path = tmp_path / f"{declared}.mcap"
        record(path, steps=10)
        bomb(path, declared, packed, checksum)
        log = open_log(path)
        tracemalloc.start()
        with pytest.raises(LogError, match=numbers):
            log.rows("plant")
        assert tracemalloc.get_traced_memory()[1] < 2**23
        tracemalloc.stop()


def test_results_come_in_the_order_of_the_work():
    """Of any number."""
    with closing(Workers()) as workers:
        for count in (0, 1, 2, 3, 50):
            works = ((lambda i=i: i * i) for i in range(count))
            assert list(workers.ahead(works)) == [i * i for i in range(count)]
            assert workers.map(lambda i: i * i, range(count)) == [i * i for i in range(count)]


def test_the_consumer_runs_jobs_instead_of_waiting():
    """The only thread is held by the first one, which ends when others have been done."""
    others_are_done = threading.Event()
    names = []

    def first():
        assert others_are_done.wait(60)

    def other():
        names.append(threading.current_thread().name)
        others_are_done.set()

    with closing(Workers(1)) as workers:
        begun = threading.Event()
        held = workers.start(lambda: (begun.set(), first()))
        assert begun.wait(60)
        assert len(list(workers.ahead(iter([other] * 6)))) == 6
        held.result()
    assert threading.current_thread().name in names


def test_a_job_starts_only_when_earlier_results_are_released():
    """So ``AHEAD`` of them may share as many pieces of memory in turn."""
    taken = []

    def works():
        for number in range(20):
            taken.append(number)
            yield lambda number=number: number

    with closing(Workers()) as workers:
        for result in workers.ahead(works()):
            assert len(taken) <= result + AHEAD


def test_an_error_comes_in_its_place():
    """What came before it is there."""

    def fail():
        raise ValueError("the third")

    with closing(Workers()) as workers:
        results = workers.ahead(iter([int, int, fail, int]))
        assert [next(results), next(results)] == [0, 0]
        with pytest.raises(ValueError, match="the third"):
            next(results)


def test_little_work_starts_no_thread():
    """One piece is done by who asks for it."""
    with closing(Workers()) as workers:
        (name,) = workers.ahead(iter([lambda: threading.current_thread().name]))
        assert name == threading.current_thread().name
        assert workers.map(lambda _: threading.current_thread().name, [1]) == [name]


def test_threads_end_with_the_block():
    """Also where not all results were taken."""
    before = threading.active_count()
    with closing(Workers()) as workers:
        next(workers.ahead(iter([int] * 10)))
        assert threading.active_count() > before
    assert threading.active_count() == before
