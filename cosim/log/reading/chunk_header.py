"""A chunk's record up to its data, which no CRC covers: it is checked by what else is known."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import BinaryIO

from mcap import records

from cosim.log.mcap_file.compression import MOST_BYTES
from cosim.log.mcap_file.records import HEADER, record_header
from cosim.log.mcap_file.walk import RecordSpan

_CHUNK_HEADER = struct.Struct("<QQQI")  # first and last time, size, CRC
_LONGEST_NAME = 16  # of a compression, more than any that is known


@dataclass(frozen=True, slots=True)
class ChunkHeader:
    """A chunk's record up to its data."""

    first_ns: int
    last_ns: int
    size: int  # of the records, uncompressed [bytes]
    crc: int
    compression: str
    data_length: int

    def check(self, index: records.ChunkIndex | None) -> None:
        """Check that it is what the chunk's index says; None: the chunk has none.

        Raises
        ------
        ValueError
            If they differ.
        """
        if index is None:
            return
        differs = (
            index.message_start_time != self.first_ns
            or index.message_end_time != self.last_ns
            or index.uncompressed_size != self.size
            or index.compression != self.compression
        )
        if differs:
            raise ValueError("a chunk differs from its index")


def read_chunk_header(stream: BinaryIO, span: RecordSpan) -> ChunkHeader:
    """Read a chunk up to its data.

    Raises
    ------
    ValueError, struct.error
        If the record is too short, or another than its index says.
    """
    stream.seek(span.start)
    if stream.read(HEADER) != record_header(span.opcode, span.size - HEADER):
        raise ValueError("no chunk where its index says")
    fixed = stream.read(_CHUNK_HEADER.size)
    first_ns, last_ns, size, crc = _CHUNK_HEADER.unpack(fixed)
    name_length = int.from_bytes(stream.read(4), "little")
    compression = stream.read(min(name_length, _LONGEST_NAME)).decode()
    (data_length,) = struct.unpack("<Q", stream.read(8))
    if stream.tell() + data_length > span.stop:
        raise ValueError(f"a chunk declares {data_length} bytes of data in a record of {span.size}")
    if data_length > MOST_BYTES:
        raise ValueError(f"a chunk of {data_length} bytes exceeds the limit of {MOST_BYTES}")
    return ChunkHeader(first_ns, last_ns, size, crc, compression, data_length)
