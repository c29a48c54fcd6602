"""The records of any MCAP file in one pass, with at most one chunk in memory.

::

    file    = magic, records, DataEnd, summary, Footer, magic
    record  = opcode u1, length u8, content
    chunk   = records, compressed; a CRC of its own

The summary is not needed: the pass ends before it. The CRC of every chunk is checked before its
records are yielded, that of the data at its end, if the writer gave one.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

from isal import isal_zlib
from mcap.opcode import Opcode

from cosim.errors import LogError
from cosim.log.mcap_file.compression import MOST_BYTES, decompress
from cosim.log.mcap_file.records import HEADER, MAGIC
from cosim.log.mcap_file.walk import damage_error

RecordBounds = tuple[int, bytes, int, int]  # opcode; bytes, and where in them the content stands

_RECORD_HEADER: Final = struct.Struct("<BQ")
_CHUNK_HEADER: Final = struct.Struct("<QQQI")  # first and last time, size, CRC
_PIECE: Final = 2**20  # bytes of what is only skipped
_READ: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK})


def read_records(path: Path, stream: BinaryIO) -> Iterator[RecordBounds]:
    """Yield schemas, channels and messages in the order of the file, chunks decompressed.

    Raises
    ------
    LogError
        If the file is not MCAP, empty, truncated or damaged, or has a record that is too large.
    """
    size = os.fstat(stream.fileno()).st_size
    check_magic(path, stream, size)
    crc = isal_zlib.crc32(MAGIC)
    position = len(MAGIC)
    while True:
        header = stream.read(HEADER)
        opcode, length = _RECORD_HEADER.unpack(header) if len(header) == HEADER else (0, 0)
        stop = position + HEADER + length
        if len(header) < HEADER or stop > size:
            raise LogError(
                f"{path} is truncated: no complete record begins at byte {position} of {size}; "
                "recover the intact part with 'mcap recover'"
            )
        if opcode == Opcode.DATA_END:
            _check_data(path, position, stream.read(4), crc)
            return
        crc = isal_zlib.crc32(header, crc)
        if opcode in _READ:
            if length > MOST_BYTES:
                reason = f"a record of {length} bytes exceeds the limit of {MOST_BYTES}"
                raise damage_error(path, position, reason)
            content = stream.read(length)
            crc = isal_zlib.crc32(content, crc)
            try:
                yield from _records_of(opcode, content)
            except (ValueError, struct.error) as error:
                raise damage_error(path, position, str(error)) from error
        else:
            for begin in range(0, length, _PIECE):
                crc = isal_zlib.crc32(stream.read(min(_PIECE, length - begin)), crc)
        position = stop


def check_magic(path: Path, stream: BinaryIO, size: int) -> None:
    """Read the first bytes of a file, which say that it is an MCAP.

    Raises
    ------
    LogError
        If they do not.
    """
    magic = stream.read(len(MAGIC))
    if magic == MAGIC:
        return
    if not size:
        raise LogError(f"{path} is empty; expected an MCAP file")
    raise LogError(f"{path} is not an MCAP file: expected it to begin with {MAGIC!r}")


def _check_data(path: Path, position: int, content: bytes, crc: int) -> None:
    """Check the CRC of all data, where the writer gave one."""
    declared = int.from_bytes(content, "little")
    if declared and declared != crc:
        raise damage_error(path, position, "the CRC of the data does not match")


def _records_of(opcode: int, content: bytes) -> Iterator[RecordBounds]:
    """Yield a record, or those in a chunk."""
    if opcode != Opcode.CHUNK:
        yield opcode, content, 0, len(content)
        return
    block = _decompressed(content)
    for inner, begin, stop in records_in(block):
        if inner in _READ and inner != Opcode.CHUNK:
            yield inner, block, begin, stop


def _decompressed(content: bytes) -> bytes:
    """Return the records of a chunk, checked before and after they are decompressed.

    Raises
    ------
    ValueError, struct.error
        If they are too many, damaged, or compressed by something unknown.
    """
    _, _, size, crc = _CHUNK_HEADER.unpack_from(content)
    position = _CHUNK_HEADER.size
    (name_length,) = struct.unpack_from("<I", content, position)
    position += 4
    name = content[position : position + name_length].decode(errors="replace")
    position += name_length
    (data_length,) = struct.unpack_from("<Q", content, position)
    position += 8
    if position + data_length > len(content):
        raise ValueError(
            f"a chunk declares {data_length} bytes of data, but has {len(content)} in all"
        )
    data = content[position : position + data_length]
    return decompress(data, name, size=size, crc=crc)


def records_in(block: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of the content of records one after the other.

    Raises
    ------
    ValueError
        If the last one is not whole.
    """
    position = 0
    size = len(block)
    while position < size:
        if position + HEADER > size:
            raise ValueError(f"{size - position} surplus bytes in a chunk")
        opcode, length = _RECORD_HEADER.unpack_from(block, position)
        begin = position + HEADER
        position = begin + length
        if position > size:
            raise ValueError(f"a record of {length} bytes does not fit into its chunk")
        yield opcode, begin, position
