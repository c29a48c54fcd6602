"""The write path: whole records appended to an MCAP file, and the summary that closes it.

All writes to the disk go through :meth:`Sink.append`, one call for every record or chunk. After a failed write
:meth:`Sink.rewind` goes back to a mark, so that the file can still be closed.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from cosim.arrays import Nanoseconds
from cosim.log.compression import Compression, compress

_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


@dataclass(frozen=True, slots=True)
class Run:
    """Message records of one channel that stand side by side in a chunk."""

    channel_id: int
    data: bytes | memoryview
    time_ns: Nanoseconds  # (n,)
    offsets: Nanoseconds  # (n,) [bytes], from the start of ``data``


@dataclass(frozen=True, slots=True)
class Mark:
    """A place between two records to go back to."""

    position: int
    crc: int
    chunks: int
    metadata: int
    attachments: int


def encoded(*items: records.McapRecord) -> bytes:
    """Encode records one after another."""
    builder = RecordBuilder()
    for item in items:
        item.write(builder)
    return bytes(builder.end())


@final
class Sink:
    """Appends records to an open file and keeps what the summary needs.

    Raises
    ------
    OSError
        From every method that writes.
    """

    def __init__(self, stream: io.RawIOBase, *, library: str) -> None:
        self._stream = stream
        self._position = self._crc = 0
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunks: list[tuple[records.ChunkIndex, dict[int, int]]] = []
        self._metadata: list[records.MetadataIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self.append(MCAP0_MAGIC + encoded(records.Header(profile="", library=library)))

    def append(self, data: bytes) -> int:
        """Write whole records; give the position they begin at."""
        rest = memoryview(data)
        while rest:
            written = self._stream.write(rest)
            if not written:
                raise OSError("the file takes no more bytes")
            rest = rest[written:]
        start = self._position
        self._crc = zlib.crc32(data, self._crc)
        self._position += len(data)
        return start

    def mark(self) -> Mark:
        """Remember the place reached."""
        return Mark(
            self._position,
            self._crc,
            len(self._chunks),
            len(self._metadata),
            len(self._attachments),
        )

    def rewind(self, mark: Mark) -> None:
        """Forget, on the disk too, what was written since ``mark``."""
        self._stream.truncate(mark.position)
        self._stream.seek(mark.position)
        self._position, self._crc = mark.position, mark.crc
        del (
            self._chunks[mark.chunks :],
            self._metadata[mark.metadata :],
            self._attachments[mark.attachments :],
        )

    def channel(self, topic: str, *, schema: tuple[str, bytes], metadata: dict[str, str]) -> int:
        """Write a channel with its own protobuf schema (name, FileDescriptorSet); give the channel's id."""
        number = len(self._channels) + 1
        self._schemas.append(
            records.Schema(id=number, data=schema[1], encoding="protobuf", name=schema[0])
        )
        self._channels.append(records.Channel(number, topic, "protobuf", metadata, number))
        self.append(encoded(self._schemas[-1], self._channels[-1]))
        return number

    def metadata(self, name: str, items: dict[str, str]) -> None:
        """Write a metadata record."""
        data = encoded(records.Metadata(name=name, metadata=items))
        self._metadata.append(
            records.MetadataIndex(offset=self.append(data), length=len(data), name=name)
        )

    def attachment(self, name: str, media_type: str, content: bytes) -> None:
        """Write an attachment, at time 0."""
        data = encoded(
            records.Attachment(
                create_time=0, log_time=0, name=name, media_type=media_type, data=content
            )
        )
        start = self.append(data)
        self._attachments.append(
            records.AttachmentIndex(start, len(data), 0, 0, len(content), name, media_type)
        )

    def chunk(self, runs: Sequence[Run], compression: Compression) -> None:
        """Write message records as one chunk, with its message indexes."""
        content = b"".join(run.data for run in runs)
        packed = compress(content, compression)
        name = "" if compression == "none" else compression
        first, last = (
            min(int(run.time_ns.min()) for run in runs),
            max(int(run.time_ns.max()) for run in runs),
        )
        label = struct.pack("<I", len(name)) + name.encode()
        sizes = (
            struct.pack("<QQQI", first, last, len(content), zlib.crc32(content))
            + label
            + struct.pack("<Q", len(packed))
        )
        length = len(sizes) + len(packed)
        pieces = [struct.pack("<BQ", Opcode.CHUNK, length), sizes, packed, *_indexes(runs)]
        start = self.append(b"".join(pieces))

        index = records.ChunkIndex(
            9 + length, start, name, len(packed), last, 0, {}, first, len(content)
        )
        for run, piece in zip(runs, pieces[3:], strict=True):
            index.message_index_offsets[run.channel_id] = (
                start + 9 + length + index.message_index_length
            )
            index.message_index_length += len(piece)
        self._chunks.append((index, {run.channel_id: len(run.time_ns) for run in runs}))

    def close(self) -> None:
        """Write the end of the data and the summary, and close the file."""
        end = encoded(records.DataEnd(data_section_crc=self._crc))
        start = self._position + len(end)
        summary, offsets = b"", []
        for opcode, group in self._groups():
            part = encoded(*group)
            if part:
                offsets.append(records.SummaryOffset(opcode, start + len(summary), len(part)))
            summary += part
        offset_start = start + len(summary)
        summary += encoded(*offsets)
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
        footer = records.Footer(start, offset_start, zlib.crc32(summary + head))
        self.append(end + summary + encoded(footer) + MCAP0_MAGIC)
        self._stream.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._stream.close()

    def _groups(self) -> Iterable[tuple[Opcode, Sequence[records.McapRecord]]]:
        yield Opcode.SCHEMA, self._schemas
        yield Opcode.CHANNEL, self._channels
        yield Opcode.STATISTICS, [self._statistics()]
        yield Opcode.CHUNK_INDEX, [index for index, _ in self._chunks]
        yield Opcode.ATTACHMENT_INDEX, self._attachments
        yield Opcode.METADATA_INDEX, self._metadata

    def _statistics(self) -> records.Statistics:
        counts = dict.fromkeys((channel.id for channel in self._channels), 0)
        for _, chunk in self._chunks:
            for number, count in chunk.items():
                counts[number] += count
        return records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=sum(counts.values()),
            message_end_time=_limit(max, [index.message_end_time for index, _ in self._chunks]),
            message_start_time=_limit(min, [index.message_start_time for index, _ in self._chunks]),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _limit(choose: Callable[[list[int]], int], times: list[int]) -> int:
    return choose(times) if times else 0


def _indexes(runs: Sequence[Run]) -> list[bytes]:
    pieces, base = [], 0
    for run in runs:
        entries = np.empty(len(run.time_ns), _INDEX_ENTRY)
        entries["log_time"], entries["offset"] = run.time_ns, run.offsets + base
        size = entries.nbytes
        pieces.append(
            struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + size, run.channel_id, size)
            + entries.tobytes()
        )
        base += len(run.data)
    return pieces
