"""The pieces of a file are found and checked, or the file is refused."""

from __future__ import annotations

import io
import os
import struct
import zlib

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from cosim.errors import LogError
from cosim.log import open_log
from cosim.log.chunks import MOST_BYTES
from tests.log.crafting import put_together, rewrite, take_apart


def test_only_a_regular_file_is_a_log(tmp_path):
    """A pipe is not waited for, a device not read, a folder named."""
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "zero.mcap").symlink_to("/dev/zero")
    for name, kind in (("pipe", "a pipe"), ("folder", "a folder"), ("zero", "a device")):
        with pytest.raises(LogError, match=rf"{name}\.mcap.*{kind}"):
            open_log(tmp_path / f"{name}.mcap")


MAGIC = b"\x89MCAP0\r\n"


def sparse(path, opcode, content, length):
    """Write an MCAP file with one record of some length, most of it a hole."""
    with path.open("wb") as stream:
        stream.write(MAGIC + struct.pack("<BQ", 1, 8) + bytes(8))  # Header
        stream.write(struct.pack("<BQ", opcode, length) + content)
        stream.seek(length - len(content), os.SEEK_CUR)
        stream.write(struct.pack("<BQI", 15, 4, 0) + struct.pack("<BQQQI", 2, 20, 0, 0, 0))
        stream.write(MAGIC)


def test_a_record_of_any_length_is_refused_unread(tmp_path, subtests):
    """A sparse file has any length, and takes no room on the disk."""
    records = {
        "metadata": (12, b""),
        "chunk": (6, struct.pack("<QQQIIQ", 0, 0, 100, 0, 0, 2**40 - 40)),
        "message outside chunks": (5, bytes(22)),
    }
    for name, (opcode, content) in records.items():
        sparse(tmp_path / "a.mcap", opcode, content, 2**40)
        with subtests.test(case=name), pytest.raises(LogError, match=rf"\d+ bytes .*{MOST_BYTES}"):
            open_log(tmp_path / "a.mcap")


def test_a_summary_elsewhere_is_damage(short_log, tmp_path):
    """It stands between the end of the data and the footer."""
    path = tmp_path / "a.mcap"
    data = bytearray(short_log.read_bytes())
    for start in (8, 2**40):
        data[-28:-8] = struct.pack("<QQI", start, 0, 0)
        path.write_bytes(data)
        with pytest.raises(LogError, match=rf"a\.mcap is damaged.* byte {start}"):
            open_log(path)


def test_a_flip_in_messages_outside_chunks_is_found(short_log, tmp_path):
    """By the CRC of all data, where its writer gave one."""
    content = take_apart(short_log)
    copy = put_together(content, tmp_path / "b.mcap", use_chunking=False, enable_data_crcs=True)
    assert open_log(copy).content_hash() == open_log(short_log).recorded_hash
    data = bytearray(copy.read_bytes())
    position = data.index(content.messages[5][3]) + 4  # inside of a double
    data[position] ^= 1
    copy.write_bytes(data)
    with pytest.raises(LogError, match="the CRC of the data does not match"):
        open_log(copy)


def test_a_flip_may_hide_a_row_in_a_channel_that_is_not_declared(short_log, tmp_path):
    """Where its writer gave no CRC, and no number of messages."""
    content = take_apart(short_log)
    options = {"use_chunking": False, "use_statistics": False}
    copy = put_together(content, tmp_path / "b.mcap", **options)
    data = bytearray(copy.read_bytes())
    position = data.index(content.messages[5][3]) - 22  # its channel
    data[position] ^= 64
    copy.write_bytes(data)
    with pytest.raises(LogError, match=r"damaged: a message of the undeclared channel 6\d"):
        open_log(copy).rows("plant")


def test_files_that_are_no_logs_are_named(tmp_path):
    """Missing, foreign and other people's files."""
    path = tmp_path / "a.mcap"
    with pytest.raises(LogError, match=r"a\.mcap cannot be read: No such file"):
        open_log(path)
    path.write_bytes(b"hello, world")  # not shown: it may be any file of this machine
    with pytest.raises(LogError, match=r"a\.mcap is not an MCAP file: expected (?!.*hello)"):
        open_log(path)
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    writer.register_channel("/tf", "json", 0)
    writer.finish()
    path.write_bytes(stream.getvalue())
    with pytest.raises(
        LogError, match=r"a\.mcap: expected a log of cosim, got .* of another tool.*/tf"
    ):
        open_log(path)


def test_an_index_without_its_chunk_is_damage(short_log, tmp_path):
    """Where the summary says that there is a chunk, there is one."""
    path = tmp_path / "a.mcap"
    with short_log.open("rb") as stream:
        (index,) = make_reader(stream).get_summary().chunk_indexes
    data = bytearray(short_log.read_bytes())
    found = index.chunk_start_offset.to_bytes(8, "little")
    position = data.rindex(found)
    data[position : position + 8] = (index.chunk_start_offset + 1).to_bytes(8, "little")
    summary_start = int.from_bytes(data[-28:-20], "little")
    data[-12:-8] = zlib.crc32(data[summary_start:-12]).to_bytes(4, "little")
    path.write_bytes(data)
    start = index.chunk_start_offset + 1
    with pytest.raises(LogError, match=rf"damaged at byte {start}: no chunk"):
        open_log(path).rows("plant")


def test_a_chunk_without_crc_is_read(short_log, tmp_path):
    """0 says that its writer gave none."""
    rewrite(short_log, tmp_path / "b.mcap", enable_crcs=False)
    assert open_log(tmp_path / "b.mcap").content_hash() == open_log(short_log).recorded_hash
