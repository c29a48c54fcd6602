"""Chunks are decompressed within bounds."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import pytest
import zstandard
from mcap.reader import make_reader

from cosim.errors import LogError
from cosim.log import open_log
from tests.log.recordings import (
    record,
)

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
