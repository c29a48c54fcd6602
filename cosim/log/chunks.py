"""Chunks: message records compressed, with CRC and message indexes, and what the summary needs.

Where a flush has enough rows every channel gets chunks of its own, so that a reader of one
component reads no other. 32 kB of zstd can hold 1 GiB, and a decompressor limited to 1000 bytes
still returned 100 MiB: the declared size is checked before anything is decompressed, and the
decompressor is bounded by it. Compression, CRCs and hashes of large pieces leave the interpreter to
others: two threads take little more than half the time.
"""

from __future__ import annotations

import os
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, islice
from typing import Final, Literal, NamedTuple, TypeVar, final

import numpy as np
import zstandard
from isal import isal_zlib
from mcap import records
from mcap.opcode import Opcode

from cosim.arrays import Nanoseconds
from cosim.log.mcap_records import HEADER, IndexEntry, RecordGroup, joined_groups, record_header

Compression = Literal["zstd", "lz4", "none"]
MOST_BYTES = 64 * 2**20  # a chunk of ours has about 1 to 32 MiB
_LEVEL = 1


def compress(data: memoryview, compression: Compression) -> bytes | memoryview:
    """Compress a chunk's records; without a compression they are returned themselves."""
    if compression == "zstd":
        return zstandard.ZstdCompressor(level=_LEVEL).compress(data)
    if compression == "lz4":
        import lz4.frame  # rarely needed

        return bytes(lz4.frame.compress(data))
    return data


@final
class Scratch:
    """Memory for one chunk after another: pages that are new cost half as much as zstd itself."""

    def __init__(self) -> None:
        self._memory = memoryview(b"")

    def of_size(self, size: int) -> memoryview:
        """Return ``size`` bytes, the same ones again; what is in them is left as it was."""
        if size > len(self._memory):
            # A little more: chunks differ by some rows.
            self._memory = memoryview(bytearray(size + size // 8))
        return self._memory[:size]


def decompress_into(
    scratch: Scratch, data: bytes | memoryview, compression: str, *, size: int, crc: int
) -> memoryview:
    """Decompress a chunk's records and check them.

    Parameters
    ----------
    scratch : Scratch
        Where they are decompressed to, if they are not ``data`` themselves.
    data : bytes or memoryview
    compression : str
        As MCAP writes it: ``"zstd"``, ``"lz4"`` or empty.
    size : int
        Declared size of the records [bytes].
    crc : int
        Declared CRC-32 of the records; 0: the writer gave none.

    Raises
    ------
    ValueError
        If the chunk is too large, has another size or CRC than declared, or cannot be
        decompressed.
    """
    # First of all: nothing may be decompressed, or allocated, for a size that is refused.
    if size > MOST_BYTES:
        raise ValueError(f"a chunk of {size} bytes exceeds the limit of {MOST_BYTES}")
    if compression == "zstd":
        records = _decompress_zstd(scratch, data, size)
    elif compression == "lz4":
        records = _decompress_lz4(data, size)
    elif not compression:
        records = memoryview(data)
    else:
        raise ValueError(f"compression: expected zstd, lz4 or none, got {compression!r}")
    if len(records) != size:
        raise ValueError(f"a chunk does not have the {size} bytes that it declares")
    if crc and isal_zlib.crc32(records) != crc:
        raise ValueError("the CRC of a chunk does not match its content")
    return records


def _decompress_zstd(scratch: Scratch, data: bytes | memoryview, size: int) -> memoryview:
    try:
        frame_size = zstandard.get_frame_parameters(data).content_size
        if frame_size not in (zstandard.CONTENTSIZE_UNKNOWN, size):
            raise ValueError(f"a chunk declares {size} bytes, but expands to {frame_size}")
        memory = scratch.of_size(size + 1)  # one more, to notice a longer chunk
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            return memory[: stream.readinto(memory)]
    except zstandard.ZstdError as error:
        raise ValueError(f"a chunk cannot be decompressed: {error}") from error


def _decompress_lz4(data: bytes | memoryview, size: int) -> memoryview:
    import lz4.frame  # rarely needed

    try:
        # One byte more than declared, to notice a longer chunk.
        decompressor = lz4.frame.LZ4FrameDecompressor()
        return memoryview(decompressor.decompress(data, max_length=size + 1))
    except (RuntimeError, EOFError) as error:
        raise ValueError(f"a chunk cannot be decompressed: {error}") from error


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_THREADS: Final = 2
# Beside the caller, who takes the results and makes some calls, too: more threads than processors
# would only wait.
THREADS_AHEAD: Final = max(1, min(_THREADS, (os.cpu_count() or 1) - 1))
AHEAD: Final = 4  # calls that are begun while the result of the first one is still used


def _called(work: Callable[[], _Result]) -> Future[_Result]:
    """Make a call here; its error is raised where the result is asked for."""
    outcome: Future[_Result] = Future()
    try:
        outcome.set_result(work())
    except BaseException as error:
        outcome.set_exception(error)
    return outcome


def _first_result(begun: deque[tuple[Future[_Result], Callable[[], _Result]]]) -> _Result:
    """Remove the first of some calls and return its result; make others rather than wait for it."""
    for place, (outcome, work) in enumerate(begun):
        if begun[0][0].done():
            break
        if outcome.cancel():  # no thread has begun it
            begun[place] = (_called(work), work)
    return begun.popleft()[0].result()


@final
class Workers:
    """Threads, which are started when there is work for them.

    Parameters
    ----------
    threads : int
        How many at most.
    """

    def __init__(self, threads: int = _THREADS) -> None:
        self._threads = threads

    @cached_property
    def _executor(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._threads, thread_name_prefix="cosim log")

    def start(self, work: Callable[[], _Result]) -> Future[_Result]:
        """Start some work in a thread."""
        return self._executor.submit(work)

    def map(self, work: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
        """Return the results of some work on each item, in their order."""
        every = list(items)
        if len(every) < _THREADS:
            return [work(item) for item in every]
        return list(self._executor.map(work, every))

    def ahead(self, works: Iterator[Callable[[], _Result]]) -> Iterator[_Result]:
        """Yield the results of some calls in their order; the next ones are begun before.

        Where the caller would wait for a result it makes one of the calls itself. A call is taken
        from ``works`` when the result of the call ``AHEAD`` before it is no longer used.
        """
        few = list(islice(works, 2))
        if len(few) < 2:
            for work in few:
                yield work()
            return
        begun: deque[tuple[Future[_Result], Callable[[], _Result]]] = deque()
        for work in chain(few, works):
            begun.append((self.start(work), work))
            if len(begun) == AHEAD:
                yield _first_result(begun)
        while begun:
            yield _first_result(begun)

    def close(self) -> None:
        """End the threads, when they have done what they began."""
        if "_executor" in self.__dict__:
            self._executor.shutdown(cancel_futures=True)
            del self._executor


CHUNK_BYTES: Final = 2**20  # of records, uncompressed
_SMALL: Final = 2**14  # bytes: channels with less share a chunk
_CHUNK_HEADER: Final = struct.Struct("<QQQII")  # times, size, CRC, length of the name
_INDEX_HEADER = struct.Struct("<BQHI")  # opcode, length, channel id, bytes of entries


@dataclass(frozen=True, slots=True)
class MessageBatch:
    """Message records of one channel that are adjacent in a chunk."""

    channel_id: int
    data: memoryview
    time_ns: Nanoseconds  # (n,)
    offsets: Nanoseconds  # (n,) [bytes], from the start of ``data``


def one_chunk(batches: Sequence[MessageBatch], compression: Compression) -> RecordGroup:
    """Return all messages as one chunk, in memory of its own."""
    chunk = _chunk(batches, compression)
    return RecordGroup([b"".join(chunk.parts)], chunk.entries, chunk.crc)


def separate_chunks(
    batches: Sequence[MessageBatch], compression: Compression, workers: Workers
) -> RecordGroup:
    """Return the messages of every channel as chunks of their own; channels with few share some.

    Without a compression they share the memory of the batches.
    """
    contents = _contents(batches)
    if compression == "none":
        # There is so little to do that threads would mostly wait for the interpreter.
        return joined_groups(_chunk(content, compression) for content in contents)
    return joined_groups(workers.map(lambda content: _chunk(content, compression), contents))


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
    ends = np.append(batch.offsets[1:], len(batch.data))
    first = 0
    start = 0
    while first < len(ends):
        stop = max(int(np.searchsorted(ends, start + CHUNK_BYTES, side="right")), first + 1)
        end = int(ends[stop - 1])
        offsets = batch.offsets[first:stop] - start
        data = batch.data[start:end]
        yield MessageBatch(batch.channel_id, data, batch.time_ns[first:stop], offsets)
        first = stop
        start = end


def _chunk(batches: Sequence[MessageBatch], compression: Compression) -> RecordGroup:
    content = batches[0].data
    if len(batches) > 1:
        content = memoryview(b"".join(batch.data for batch in batches))
    compressed = compress(content, compression)
    name = "" if compression == "none" else compression
    first_ns = int(min(batch.time_ns.min() for batch in batches))
    last_ns = int(max(batch.time_ns.max() for batch in batches))
    content_crc = isal_zlib.crc32(content)
    header = _CHUNK_HEADER.pack(first_ns, last_ns, len(content), content_crc, len(name))
    header += name.encode() + struct.pack("<Q", len(compressed))
    head = record_header(Opcode.CHUNK, len(header) + len(compressed)) + header
    chunk_length = len(head) + len(compressed)
    # Without a compression the CRC of the content is known already.
    compressed_crc = content_crc if compressed is content else isal_zlib.crc32(compressed)
    crc = isal_zlib.crc32_combine(isal_zlib.crc32(head), compressed_crc, len(compressed))
    parts = [head, compressed]
    index_offsets = {}
    index_length = 0
    batch_start = 0
    for batch in batches:
        index = _message_index(batch, batch_start)
        index_offsets[batch.channel_id] = chunk_length + index_length
        crc = isal_zlib.crc32(index, crc)
        parts.append(index)
        index_length += len(index)
        batch_start += len(batch.data)
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
    counts = {batch.channel_id: len(batch.time_ns) for batch in batches}
    return RecordGroup(parts, [IndexEntry(chunk_index, counts)], crc)


def _message_index(batch: MessageBatch, start: int) -> bytes:
    """Return the index record of a batch that begins at ``start`` of its chunk's records."""
    entries = np.empty((len(batch.time_ns), 2), "<i8")
    entries[:, 0] = batch.time_ns
    np.add(batch.offsets, start, out=entries[:, 1])
    length = _INDEX_HEADER.size - HEADER + entries.nbytes
    header = _INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, length, batch.channel_id, entries.nbytes)
    return header + entries.tobytes()


# --- reading ---

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
