"""The write path: whole records appended to an MCAP file, and the summary that closes it.

All writes to the disk go through :meth:`Sink.append`, one call for every record or chunk. After a
failed write :meth:`Sink.rewind` goes back to a mark, so that the file can still be closed.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from cosim.arrays import Nanoseconds
from cosim.log.compression import Compression, compress
from cosim.log.layout import MAGIC

_RECORD_HEADER = struct.Struct("<BQ")  # opcode, length
_CHUNK_HEADER = struct.Struct("<QQQI")  # first and last time, size, CRC
_INDEX_HEADER = struct.Struct("<BQHI")  # opcode, length, channel id, bytes of entries
_FOOTER_LENGTH = 20  # bytes of its content
_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


@dataclass(frozen=True, slots=True)
class MessageBatch:
    """Message records of one channel that stand side by side in a chunk."""

    channel_id: int
    data: bytes | memoryview
    time_ns: Nanoseconds  # (n,)
    offsets: Nanoseconds  # (n,) [bytes], from the start of ``data``


@dataclass(frozen=True, slots=True)
class Mark:
    """A position between two records to go back to, and what had been written up to there."""

    position: int
    crc: int
    chunks: int
    metadata: int
    attachments: int


@dataclass(frozen=True, slots=True)
class _WrittenChunk:
    """What the summary needs of a chunk."""

    index: records.ChunkIndex
    counts: dict[int, int]  # messages by channel id


def encoded(*items: records.McapRecord) -> bytes:
    """Return records as bytes, one after another."""
    builder = RecordBuilder()
    for item in items:
        item.write(builder)
    return bytes(builder.end())


@final
class Sink:
    """An open file that records are appended to, with what its summary needs.

    Raises
    ------
    OSError
        From every method that writes.
    """

    def __init__(self, stream: io.RawIOBase, *, library: str) -> None:
        self._stream = stream
        self._position = 0
        self._crc = 0
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunks: list[_WrittenChunk] = []
        self._metadata: list[records.MetadataIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        header = encoded(records.Header(profile="", library=library))
        self.append(MAGIC + header)

    def append(self, data: bytes) -> int:
        """Write whole records; return the position they begin at."""
        remaining = memoryview(data)
        while remaining:
            written = self._stream.write(remaining)
            if not written:
                raise OSError("the file takes no more bytes")
            remaining = remaining[written:]
        # After the write: one that fails leaves position and CRC where the last record ended.
        start = self._position
        self._crc = zlib.crc32(data, self._crc)
        self._position += len(data)
        return start

    def mark(self) -> Mark:
        """Return the position reached."""
        chunks = len(self._chunks)
        metadata = len(self._metadata)
        attachments = len(self._attachments)
        return Mark(self._position, self._crc, chunks, metadata, attachments)

    def rewind(self, mark: Mark) -> None:
        """Forget, on the disk too, what was written since ``mark``."""
        # Truncating does not move the stream: without the seek the next write would leave a gap.
        self._stream.truncate(mark.position)
        self._stream.seek(mark.position)
        self._position = mark.position
        self._crc = mark.crc
        del self._chunks[mark.chunks :]
        del self._metadata[mark.metadata :]
        del self._attachments[mark.attachments :]

    def channel(self, topic: str, *, schema: tuple[str, bytes], metadata: dict[str, str]) -> int:
        """Write a channel with its own protobuf schema; return the channel's id.

        Parameters
        ----------
        topic : str
        schema : (str, bytes)
            Name of the message and serialized FileDescriptorSet.
        metadata : dict
        """
        number = len(self._channels) + 1
        name, descriptors = schema
        schema_record = records.Schema(id=number, data=descriptors, encoding="protobuf", name=name)
        channel_record = records.Channel(number, topic, "protobuf", metadata, number)
        self._schemas.append(schema_record)
        self._channels.append(channel_record)
        self.append(encoded(schema_record, channel_record))
        return number

    def metadata(self, name: str, items: dict[str, str]) -> None:
        """Write a metadata record."""
        data = encoded(records.Metadata(name=name, metadata=items))
        start = self.append(data)
        index = records.MetadataIndex(offset=start, length=len(data), name=name)
        self._metadata.append(index)

    def attachment(self, name: str, media_type: str, content: bytes) -> None:
        """Write an attachment, at time 0."""
        attachment = records.Attachment(
            create_time=0, log_time=0, name=name, media_type=media_type, data=content
        )
        data = encoded(attachment)
        start = self.append(data)
        index = records.AttachmentIndex(
            offset=start,
            length=len(data),
            log_time=0,
            create_time=0,
            data_size=len(content),
            name=name,
            media_type=media_type,
        )
        self._attachments.append(index)

    def chunk(self, batches: Sequence[MessageBatch], compression: Compression) -> None:
        """Write message records as one chunk, with its message indexes."""
        content = b"".join(batch.data for batch in batches)
        compressed = compress(content, compression)
        name = "" if compression == "none" else compression
        first_ns = int(min(batch.time_ns.min() for batch in batches))
        last_ns = int(max(batch.time_ns.max() for batch in batches))

        crc = zlib.crc32(content)
        header = _CHUNK_HEADER.pack(first_ns, last_ns, len(content), crc)
        header += struct.pack("<I", len(name))
        header += name.encode()
        header += struct.pack("<Q", len(compressed))
        length = len(header) + len(compressed)
        record_header = _RECORD_HEADER.pack(Opcode.CHUNK, length)
        indexes = _message_indexes(batches)
        # One write: chunk and indexes are on the disk together, or rewound together.
        data = b"".join([record_header, header, compressed, *indexes])
        start = self.append(data)

        chunk_length = _RECORD_HEADER.size + length
        index_offsets: dict[int, int] = {}
        counts: dict[int, int] = {}
        index_length = 0
        for batch, index in zip(batches, indexes, strict=True):
            index_offsets[batch.channel_id] = start + chunk_length + index_length
            counts[batch.channel_id] = len(batch.time_ns)
            index_length += len(index)
        chunk_index = records.ChunkIndex(
            chunk_length=chunk_length,
            chunk_start_offset=start,
            compression=name,
            compressed_size=len(compressed),
            message_end_time=last_ns,
            message_index_length=index_length,
            message_index_offsets=index_offsets,
            message_start_time=first_ns,
            uncompressed_size=len(content),
        )
        self._chunks.append(_WrittenChunk(chunk_index, counts))

    def close(self) -> None:
        """Write the end of the data and the summary, and close the file."""
        data_end = encoded(records.DataEnd(data_section_crc=self._crc))
        start = self._position + len(data_end)
        summary = b""
        offsets = []
        for opcode, group in self._summary_groups():
            encoded_group = encoded(*group)
            if encoded_group:
                group_start = start + len(summary)
                offset = records.SummaryOffset(opcode, group_start, len(encoded_group))
                offsets.append(offset)
            summary += encoded_group
        offset_start = start + len(summary)
        summary += encoded(*offsets)
        # The CRC covers the summary and the footer up to the CRC itself.
        footer_head = struct.pack("<BQQQ", Opcode.FOOTER, _FOOTER_LENGTH, start, offset_start)
        crc = zlib.crc32(summary + footer_head)
        footer = encoded(records.Footer(start, offset_start, crc))
        self.append(data_end + summary + footer + MAGIC)
        self._stream.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._stream.close()

    def _summary_groups(self) -> Iterable[tuple[Opcode, Sequence[records.McapRecord]]]:
        """Yield the records of the summary; those of one opcode must stand side by side."""
        yield Opcode.SCHEMA, self._schemas
        yield Opcode.CHANNEL, self._channels
        yield Opcode.STATISTICS, [self._statistics()]
        yield Opcode.CHUNK_INDEX, [chunk.index for chunk in self._chunks]
        yield Opcode.ATTACHMENT_INDEX, self._attachments
        yield Opcode.METADATA_INDEX, self._metadata

    def _statistics(self) -> records.Statistics:
        counts = {channel.id: 0 for channel in self._channels}
        for chunk in self._chunks:
            for channel_id, count in chunk.counts.items():
                counts[channel_id] += count
        starts = [chunk.index.message_start_time for chunk in self._chunks]
        ends = [chunk.index.message_end_time for chunk in self._chunks]
        return records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=sum(counts.values()),
            message_end_time=max(ends, default=0),
            message_start_time=min(starts, default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _message_indexes(batches: Sequence[MessageBatch]) -> list[bytes]:
    """Return the message index record of each batch; its offsets count from the chunk's records."""
    indexes = []
    batch_start = 0
    for batch in batches:
        entries = np.empty(len(batch.time_ns), _INDEX_ENTRY)
        entries["log_time"] = batch.time_ns
        entries["offset"] = batch.offsets + batch_start
        size = entries.nbytes
        length = _INDEX_HEADER.size - _RECORD_HEADER.size + size
        header = _INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, length, batch.channel_id, size)
        indexes.append(header + entries.tobytes())
        batch_start += len(batch.data)
    return indexes
