"""Chunks are those of MCAP, and indexes lead to their messages."""

from __future__ import annotations

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk, MessageIndex

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
    """A reader that trusts the indexes reads one topic from a time on."""
    make_chunks_small(monkeypatch, 20_000)
    record(tmp_path / "a.mcap", steps=1000)
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert len(reader.get_summary().chunk_indexes) > 3
        for index in reader.get_summary().chunk_indexes:
            assert set(index.message_index_offsets) <= {1, 2}
            for channel_id, offset in index.message_index_offsets.items():
                stream.seek(offset)
                assert stream.read(1) == b"\x07"
                assert int.from_bytes(stream.read(10)[8:], "little") == channel_id
        assert sum(1 for _ in reader.iter_messages("/plant", starting_at=900 * STEP_NS)) == 101


def test_message_indexes_lead_to_messages_of_any_size(tmp_path):
    """Those of /cosim/log stand behind the rows, each where the one before ends."""
    texts = ["a", "a longer one", "", "and the last"]
    messages = [(k * STEP_NS, "info", "run", text) for k, text in enumerate(texts)]
    record(tmp_path / "a.mcap", steps=10, messages=messages)
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
        (chunk,) = summary.chunk_indexes
        (number,) = [n for n, c in summary.channels.items() if c.topic == "/cosim/log"]
        stream.seek(chunk.chunk_start_offset + 9)
        content = zstandard.decompress(Chunk.read(ReadDataStream(stream)).data)
        stream.seek(chunk.message_index_offsets[number] + 9)
        index = MessageIndex.read(ReadDataStream(stream))
    assert [time_ns for time_ns, _ in index.records] == [time_ns for time_ns, *_ in messages]
    for (_, offset), (time_ns, *_, text) in zip(index.records, messages, strict=True):
        assert content[offset] == 5
        length = int.from_bytes(content[offset + 1 : offset + 9], "little")
        record_bytes = content[offset + 9 : offset + 9 + length]
        assert int.from_bytes(record_bytes[:2], "little") == number
        assert int.from_bytes(record_bytes[6:14], "little") == time_ns
        assert decode_log(record_bytes[22:]) == ("info", "run", text)
