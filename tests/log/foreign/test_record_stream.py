"""Files of other tools that are damaged, or made to do harm."""

from __future__ import annotations

import pytest
from mcap.writer import CompressionType, IndexType, Writer

from cosim.errors import LogError
from tests.log.foreign.field_logs import COMPRESSIONS, COUNT, EPOCH, read, write_json


def damaged(path, change):
    data = bytearray(path.read_bytes())
    change(data)
    path.write_bytes(data)
    return path


def chunk_start(data):
    """Return where the content of the first chunk begins."""
    position = 8
    while data[position] != 6:
        position += 9 + int.from_bytes(data[position + 1 : position + 9], "little")
    return position + 9


def test_files_that_are_no_mcap_are_refused(tmp_path):
    """With what they are."""
    path = tmp_path / "x.mcap"
    for content, text in [
        (b"", "is empty; expected an MCAP file"),
        (b"t,y\n0,1\n", "is not an MCAP file: expected (?!.*t,y)"),
        (b"\x89MCAP0\r\n", "is truncated at byte 8: .*'mcap recover'"),
    ]:
        path.write_bytes(content)
        with pytest.raises(LogError, match=rf"x\.mcap {text}"):
            read(path, "/t.x")


@pytest.fixture
def plain(tmp_path):
    rows = [(EPOCH + index, {"x": index}) for index in range(COUNT)]
    options = {"index_types": IndexType.NONE}  # of chunks, with which they are compared first
    return write_json(tmp_path / "log.mcap", {"/t": rows}, **options)


def test_a_bomb_is_refused_before_it_is_decompressed(plain):
    """A chunk of few bytes that declares 2**40."""

    def declare(data):
        begin = chunk_start(data) + 16
        data[begin : begin + 8] = (2**40).to_bytes(8, "little")

    with pytest.raises(LogError, match=r"1099511627776 bytes .*67108864"):
        read(damaged(plain, declare), "/t.x")


def test_a_chunk_that_holds_more_than_it_declares_is_refused(plain):
    """No byte more than that is decompressed."""

    def declare(data):
        begin = chunk_start(data) + 16
        data[begin : begin + 8] = (100).to_bytes(8, "little")

    with pytest.raises(LogError, match=r"is damaged at byte \d+: a chunk declares 100 bytes"):
        read(damaged(plain, declare), "/t.x")


def test_unknown_compression_is_refused(plain):
    """With the name, and those that are known."""

    def rename(data):
        begin = chunk_start(data) + 32
        assert data[begin : begin + 4] == b"zstd"
        data[begin : begin + 4] = b"brot"

    with pytest.raises(LogError, match="compression: expected zstd, lz4 or none, got 'brot'"):
        read(damaged(plain, rename), "/t.x")


def test_damaged_chunks_are_refused(tmp_path):
    """One bit in the data of a chunk, which its CRC covers."""
    rows = [(EPOCH + index, {"x": index}) for index in range(COUNT)]

    def flip(data):
        data[chunk_start(data) + 300] ^= 1

    for name, compression in COMPRESSIONS.items():
        path = write_json(tmp_path / f"{name}.mcap", {"/t": rows}, compression=compression)
        with pytest.raises(LogError, match=rf"{name}\.mcap is damaged at byte \d+"):
            read(damaged(path, flip), "/t.x")


def test_damaged_messages_outside_chunks_are_refused(tmp_path):
    """Where the writer gave a CRC of the data."""
    rows = [(EPOCH + index, {"x": 1000 + index}) for index in range(COUNT)]
    options = {"use_chunking": False, "enable_data_crcs": True}
    path = write_json(tmp_path / "log.mcap", {"/t": rows}, **options)

    def change(data):
        data[data.index(b'"x": 1') + 5] = ord("2")

    with pytest.raises(LogError, match="the CRC of the data does not match"):
        read(damaged(path, change), "/t.x")


def test_a_truncated_file_is_refused(plain):
    """With the way out."""

    def cut(data):
        del data[chunk_start(data) + 300 :]

    with pytest.raises(LogError, match=r"is truncated.*'mcap recover'"):
        read(damaged(plain, cut), "/t.x")


def test_a_damaged_summary_is_refused(plain):
    """With the byte."""

    def change(data):
        data[-60] ^= 1

    with pytest.raises(LogError, match=r"is damaged at byte \d+"):
        read(damaged(plain, change), "/t.x")


def test_a_large_message_is_refused(tmp_path, monkeypatch):
    """Outside of chunks, where a length may say anything."""
    monkeypatch.setattr("cosim.log.container.MOST_BYTES", 1000)
    rows = [(EPOCH, {"x": 1, "text": "x" * 2000})]
    path = write_json(tmp_path / "log.mcap", {"/t": rows}, use_chunking=False)
    with pytest.raises(LogError, match=r"a record of \d+ bytes .*1000"):
        read(path, "/t.x")


def test_only_the_asked_topics_are_decoded(tmp_path):
    """What stands in the others does not matter."""
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.LZ4)
        writer.start()
        for topic, encoding, data in (("/a", "json", b'{"x": 1}'), ("/a.b", "cbor", b"\xff")):
            channel = writer.register_channel(topic, encoding, 0)
            writer.add_message(channel, EPOCH, data, EPOCH)
        writer.finish()
    assert read(path, "/a.x")[0].values.tolist() == [[1.0]]
