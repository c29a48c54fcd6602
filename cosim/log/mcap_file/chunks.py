"""Chunks: message records compressed, with CRC and message indexes, and what the summary needs.

Where a flush has enough rows every channel gets chunks of its own, so that a reader of one
component reads no other.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from isal import isal_zlib
from mcap import records
from mcap.opcode import Opcode

from cosim.arrays import Nanoseconds
from cosim.log.mcap_file.compression import (
    MOST_BYTES,
    Compression,
    Scratch,
    compress,
    decompress_into,
)
from cosim.log.mcap_file.records import HEADER, record_header
from cosim.log.mcap_file.summary import IndexEntry, RecordGroup, placed_entry
from cosim.log.mcap_file.workers import Workers

CHUNK_BYTES: Final = 2**20  # of records, uncompressed
_SMALL: Final = 2**14  # bytes: channels with less share a chunk
_CHUNK_TIMES = struct.Struct("<QQQI")  # first and last time, size, CRC
_INDEX_HEADER = struct.Struct("<BQHI")  # opcode, length, channel id, bytes of entries


@dataclass(frozen=True, slots=True)
class MessageBatch:
    """Message records of one channel that are adjacent in a chunk."""

    channel_id: int
    data: memoryview
    time_ns: Nanoseconds  # (n,)
    offsets: Nanoseconds  # (n,) [bytes], from the start of ``data``


@dataclass(frozen=True, slots=True)
class _Chunk:
    """A chunk with its indexes, at byte 0 of nothing."""

    parts: Sequence[bytes | memoryview]
    size: int
    crc: int  # of all parts
    entry: IndexEntry


def one_chunk(batches: Sequence[MessageBatch], compression: Compression) -> RecordGroup:
    """Return all messages as one chunk, in memory of its own."""
    chunk = _chunk(batches, compression)
    return RecordGroup([b"".join(chunk.parts)], [chunk.entry], chunk.crc)


def separate_chunks(
    batches: Sequence[MessageBatch], compression: Compression, workers: Workers
) -> RecordGroup:
    """Return the messages of every channel as chunks of their own; channels with few share some.

    Without a compression they share the memory of the batches.
    """
    contents = _contents(batches)
    if compression == "none":
        # There is so little to do that threads would mostly wait for the interpreter.
        return _grouped([_chunk(content, compression) for content in contents])
    return _grouped(workers.map(lambda content: _chunk(content, compression), contents))


def _grouped(chunks: Sequence[_Chunk]) -> RecordGroup:
    parts: list[bytes | memoryview] = []
    entries: list[IndexEntry] = []
    position = 0
    crc = 0
    for chunk in chunks:
        entries.append(placed_entry(chunk.entry, position))
        parts += chunk.parts
        position += chunk.size
        crc = isal_zlib.crc32_combine(crc, chunk.crc, chunk.size)
    return RecordGroup(parts, entries, crc)


def _contents(batches: Sequence[MessageBatch]) -> Iterator[list[MessageBatch]]:
    """Yield what goes into each chunk."""
    shared: list[MessageBatch] = []
    shared_bytes = 0
    for batch in batches:
        size = len(batch.data)
        if size >= _SMALL:
            for piece in _pieces(batch):
                yield [piece]
            continue
        if shared and shared_bytes + size > CHUNK_BYTES:
            yield shared
            shared = []
            shared_bytes = 0
        shared.append(batch)
        shared_bytes += size
    if shared:
        yield shared


def _pieces(batch: MessageBatch) -> Iterator[MessageBatch]:
    """Yield the messages of a batch in batches that fit into a chunk."""
    first = 0
    count = len(batch.offsets)
    while first < count:
        start = int(batch.offsets[first])
        stop = int(np.searchsorted(batch.offsets, start + CHUNK_BYTES, side="right")) - 1
        # The last message that begins within reach may end beyond it.
        if len(batch.data) - start <= CHUNK_BYTES:
            stop = count
        stop = max(stop, first + 1)
        end = len(batch.data) if stop == count else int(batch.offsets[stop])
        offsets = batch.offsets[first:stop] - start
        yield MessageBatch(
            batch.channel_id, batch.data[start:end], batch.time_ns[first:stop], offsets
        )
        first = stop


def _chunk(batches: Sequence[MessageBatch], compression: Compression) -> _Chunk:
    content = batches[0].data
    if len(batches) > 1:
        content = memoryview(b"".join(batch.data for batch in batches))
    compressed = compress(content, compression)
    name = "" if compression == "none" else compression
    first_ns = int(min(batch.time_ns.min() for batch in batches))
    last_ns = int(max(batch.time_ns.max() for batch in batches))
    content_crc = isal_zlib.crc32(content)
    header = _CHUNK_TIMES.pack(first_ns, last_ns, len(content), content_crc)
    header += struct.pack("<I", len(name)) + name.encode() + struct.pack("<Q", len(compressed))
    length = len(header) + len(compressed)
    indexes = _message_indexes(batches)
    chunk_length = HEADER + length
    index_offsets = {}
    counts = {}
    index_length = 0
    for batch, index in zip(batches, indexes, strict=True):
        index_offsets[batch.channel_id] = chunk_length + index_length
        counts[batch.channel_id] = len(batch.time_ns)
        index_length += len(index)
    chunk_index = records.ChunkIndex(
        chunk_length=chunk_length,
        chunk_start_offset=0,
        compression=name,
        compressed_size=len(compressed),
        message_end_time=last_ns,
        message_index_length=index_length,
        message_index_offsets=index_offsets,
        message_start_time=first_ns,
        uncompressed_size=len(content),
    )
    head = record_header(Opcode.CHUNK, length) + header
    # Without a compression the CRC of the content is known already.
    compressed_crc = content_crc if compressed is content else isal_zlib.crc32(compressed)
    crc = isal_zlib.crc32_combine(isal_zlib.crc32(head), compressed_crc, len(compressed))
    for index in indexes:
        crc = isal_zlib.crc32(index, crc)
    parts = [head, compressed, *indexes]
    return _Chunk(parts, chunk_length + index_length, crc, IndexEntry(chunk_index, counts))


def _message_indexes(batches: Sequence[MessageBatch]) -> list[bytes]:
    """Return the message index record of each batch; its offsets count from the chunk's records."""
    indexes = []
    batch_start = 0
    for batch in batches:
        entries = np.empty((len(batch.time_ns), 2), "<i8")
        entries[:, 0] = batch.time_ns
        np.add(batch.offsets, batch_start, out=entries[:, 1])
        length = _INDEX_HEADER.size - HEADER + entries.nbytes
        header = _INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, length, batch.channel_id, entries.nbytes)
        indexes.append(header + entries.tobytes())
        batch_start += len(batch.data)
    return indexes


# --- reading ---

_CHUNK_HEADER: Final = struct.Struct("<QQQII")  # times, size, CRC, length of the name
_MOST_NAME: Final = 16  # bytes of a compression's name, more than any that is known has
CHUNK_HEAD: Final = HEADER + _CHUNK_HEADER.size + _MOST_NAME + 8  # bytes that have what follows


class ChunkHeader(NamedTuple):
    """A chunk's record up to its data, which no CRC covers: what else is known checks it."""

    first_ns: int
    last_ns: int
    size: int  # of the records, uncompressed [bytes]
    crc: int
    compression: str
    data_start: int  # from the start of the record
    data_stop: int


def read_chunk_header(record: bytes, size: int) -> ChunkHeader:
    """Read a chunk up to its data.

    Parameters
    ----------
    record : bytes
        Its first ``CHUNK_HEAD`` bytes at least, as far as it has these.
    size : int
        Of the record [bytes].

    Raises
    ------
    ValueError, struct.error
        If the sizes in it do not fit together.
    """
    first_ns, last_ns, content_size, crc, name_length = _CHUNK_HEADER.unpack_from(record, HEADER)
    if name_length > _MOST_NAME:
        raise ValueError(f"the name of a compression has {name_length} bytes")
    name_start = HEADER + _CHUNK_HEADER.size
    name_stop = name_start + name_length
    compression = record[name_start:name_stop].decode()
    (length,) = struct.unpack_from("<Q", record, name_stop)
    data_start = name_stop + 8
    if data_start + length > size:
        raise ValueError(f"a chunk declares {length} bytes of data in a record of {size}")
    if length > MOST_BYTES:
        raise ValueError(f"a chunk of {length} bytes exceeds the limit of {MOST_BYTES}")
    return ChunkHeader(
        first_ns, last_ns, content_size, crc, compression, data_start, data_start + length
    )


def decompressed(record: bytes) -> memoryview:
    """Return the records of a chunk, checked before and after they are decompressed.

    Raises
    ------
    ValueError, struct.error
        If they are too many, damaged, or compressed by something unknown.
    """
    header = read_chunk_header(record, len(record))
    data = record[header.data_start : header.data_stop]
    return decompress_into(Scratch(), data, header.compression, size=header.size, crc=header.crc)
