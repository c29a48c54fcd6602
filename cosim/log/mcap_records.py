"""The records of an MCAP file that cosim writes itself, the head of a file, and its summary.

Records from 0x80 on are private: every reader skips them. Of the summary, which is encoded again at
every flush, a chunk's entry is encoded once; only the statistics and the places are new each time.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, TypeAlias, final

from isal import isal_zlib
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import McapRecord

# As in mcap.writer and mcap.reader, which load every compressor that is installed.
MAGIC: Final = b"\x89MCAP0\r\n"  # at both ends of a file

HOLE: Final = 0x80  # room that a file which is still written has for its next rows
SLOT: Final = 0x81  # room for a summary
PAD: Final = 0x82  # bytes without a meaning

RECORD_HEADER: Final = struct.Struct("<BQ")  # opcode, length
FOOTER: Final = struct.Struct("<BQQQI")  # opcode, length, summary, summary offsets, CRC
HEADER: Final = RECORD_HEADER.size  # bytes
FOOTER_SIZE: Final = FOOTER.size  # bytes
END_SIZE: Final = FOOTER_SIZE + len(MAGIC)  # bytes, of footer and magic
DATA_END_SIZE: Final = HEADER + 4  # bytes

_FOOTER_CONTENT: Final = FOOTER_SIZE - HEADER


def encoded(*items: McapRecord) -> bytes:
    """Return records as bytes, one after another."""
    builder = RecordBuilder()
    for item in items:
        item.write(builder)
    return bytes(builder.end())


def record_header(opcode: int, length: int) -> bytes:
    """Return the header of a record whose content has ``length`` bytes."""
    return RECORD_HEADER.pack(opcode, length)


def data_end(crc: int = 0) -> bytes:
    """Return the record that ends the data; CRC 0: not known."""
    return record_header(Opcode.DATA_END, 4) + crc.to_bytes(4, "little")


def footer(summary_start: int, offset_start: int, crc: int = 0) -> bytes:
    """Return the footer; CRC 0: not known."""
    return FOOTER.pack(Opcode.FOOTER, _FOOTER_CONTENT, summary_start, offset_start, crc)


IndexRecord: TypeAlias = records.ChunkIndex | records.MetadataIndex | records.AttachmentIndex
_INDEX_OPCODES = {
    records.ChunkIndex: Opcode.CHUNK_INDEX,
    records.AttachmentIndex: Opcode.ATTACHMENT_INDEX,
    records.MetadataIndex: Opcode.METADATA_INDEX,
}


class EncodedSummary(NamedTuple):
    """A summary for one place in the file."""

    data: bytes
    offset_start: int  # where its summary offsets begin, in the file


@dataclass(frozen=True, slots=True)
class IndexEntry:
    """What the summary needs of a record, or of a chunk."""

    index: IndexRecord  # its offsets are those in its ``RecordGroup`` until it is placed
    counts: dict[int, int]  # messages by channel id


@dataclass(frozen=True, slots=True)
class RecordGroup:
    """Whole records that are written side by side, and what the summary needs of them.

    Parameters
    ----------
    parts : sequence of bytes or memoryview
        The records, one part after the other; the first one has the header of a record whole.
    entries : sequence of IndexEntry
    crc : int
        CRC-32 of all parts.
    """

    parts: Sequence[bytes | memoryview]
    entries: Sequence[IndexEntry]
    crc: int

    @property
    def size(self) -> int:
        """The length of all parts [bytes]."""
        return sum(map(len, self.parts))

    def placed(self, position: int) -> list[IndexEntry]:
        """Return the entries of the group where it begins at ``position``."""
        return [placed_entry(entry, position) for entry in self.entries]


def placed_entry(entry: IndexEntry, position: int) -> IndexEntry:
    """Return an entry whose offsets count from the start of the file, not from ``position``."""
    index = entry.index
    if not isinstance(index, records.ChunkIndex):
        return IndexEntry(replace(index, offset=index.offset + position), entry.counts)
    offsets = {
        channel_id: offset + position for channel_id, offset in index.message_index_offsets.items()
    }
    placed_index = replace(
        index,
        chunk_start_offset=index.chunk_start_offset + position,
        message_index_offsets=offsets,
    )
    return IndexEntry(placed_index, entry.counts)


@final
class FileSummary:
    """What the summary of a file says.

    Parameters
    ----------
    schemas : sequence of Schema
    channels : sequence of Channel
    """

    def __init__(
        self, schemas: Sequence[records.Schema], channels: Sequence[records.Channel]
    ) -> None:
        self._statistics = records.Statistics(
            attachment_count=0,
            channel_count=len(channels),
            channel_message_counts={channel.id: 0 for channel in channels},
            chunk_count=0,
            message_count=0,
            message_end_time=0,
            message_start_time=0,
            metadata_count=0,
            schema_count=len(schemas),
        )
        self._schemas = encoded(*schemas)
        self._channels = encoded(*channels)
        self._indexes = {opcode: bytearray() for opcode in _INDEX_OPCODES.values()}

    def add(self, entries: Sequence[IndexEntry]) -> None:
        """Add what the file has for good."""
        for entry in entries:
            self._indexes[_INDEX_OPCODES[type(entry.index)]] += encoded(entry.index)
        self._statistics = _counted(self._statistics, entries)

    def encoded(self, start: int, entries: Sequence[IndexEntry] = ()) -> EncodedSummary:
        """Return the summary that begins at ``start``, with further entries for now."""
        statistics = _counted(self._statistics, entries)
        further = {opcode: bytearray() for opcode in self._indexes}
        for entry in entries:
            further[_INDEX_OPCODES[type(entry.index)]] += encoded(entry.index)
        groups: list[tuple[Opcode, bytes | bytearray]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, encoded(statistics)),
        ]
        for opcode, indexes in self._indexes.items():
            groups.append((opcode, indexes + further[opcode]))
        position = start
        offsets = []
        for opcode, data in groups:
            if data:
                offsets.append(records.SummaryOffset(opcode, position, len(data)))
            position += len(data)
        parts = [data for _, data in groups]
        return EncodedSummary(b"".join([*parts, encoded(*offsets)]), position)


def _counted(statistics: records.Statistics, entries: Sequence[IndexEntry]) -> records.Statistics:
    """Return the statistics of a file that has more records and chunks."""
    chunks = []
    metadata_count = statistics.metadata_count
    attachment_count = statistics.attachment_count
    counts = dict(statistics.channel_message_counts)
    for entry in entries:
        match entry.index:
            case records.MetadataIndex():
                metadata_count += 1
            case records.AttachmentIndex():
                attachment_count += 1
            case records.ChunkIndex():
                chunks.append(entry.index)
        for channel_id, count in entry.counts.items():
            counts[channel_id] += count
    starts = [chunk.message_start_time for chunk in chunks]
    ends = [chunk.message_end_time for chunk in chunks]
    if statistics.chunk_count:
        starts.append(statistics.message_start_time)
        ends.append(statistics.message_end_time)
    return replace(
        statistics,
        attachment_count=attachment_count,
        channel_message_counts=counts,
        chunk_count=statistics.chunk_count + len(chunks),
        message_count=sum(counts.values()),
        message_end_time=max(ends, default=0),
        message_start_time=min(starts, default=0),
        metadata_count=metadata_count,
    )


@final
class FileHead:
    """The records up to the first row.

    Parameters
    ----------
    library : str
        Name of the program that writes the file.
    """

    def __init__(self, *, library: str) -> None:
        self._parts = [MAGIC, encoded(records.Header(profile="", library=library))]
        self._size = sum(map(len, self._parts))
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._entries: list[IndexEntry] = []

    @property
    def data(self) -> bytes:
        """The bytes."""
        return b"".join(self._parts)

    def summary(self) -> FileSummary:
        """Return the summary of what is here."""
        summary = FileSummary(self._schemas, self._channels)
        summary.add(self._entries)
        return summary

    def channel(self, topic: str, *, schema: tuple[str, bytes], metadata: dict[str, str]) -> int:
        """Add a channel with its own protobuf schema; return the channel's id.

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
        self.copy([schema_record], [channel_record])
        return number

    def copy(self, schemas: Sequence[records.Schema], channels: Sequence[records.Channel]) -> None:
        """Add schemas and channels with the ids that they have."""
        self._schemas += schemas
        self._channels += channels
        self._append(encoded(*schemas, *channels))

    def metadata(self, name: str, items: dict[str, str]) -> None:
        """Add a metadata record."""
        self._add(metadata_group(name, items))

    def attachment(self, name: str, media_type: str, content: bytes) -> None:
        """Add an attachment, at time 0."""
        self._add(attachment_group(name, media_type, content))

    def _add(self, group: RecordGroup) -> None:
        self._entries += group.placed(self._size)
        self._append(b"".join(group.parts))

    def _append(self, data: bytes) -> None:
        self._parts.append(data)
        self._size += len(data)


def metadata_group(name: str, items: dict[str, str]) -> RecordGroup:
    """Return a metadata record."""
    data = encoded(records.Metadata(name=name, metadata=items))
    index = records.MetadataIndex(offset=0, length=len(data), name=name)
    return RecordGroup([data], [IndexEntry(index, {})], isal_zlib.crc32(data))


def attachment_group(name: str, media_type: str, content: bytes) -> RecordGroup:
    """Return an attachment, at time 0."""
    attachment = records.Attachment(
        create_time=0, log_time=0, name=name, media_type=media_type, data=content
    )
    data = encoded(attachment)
    index = records.AttachmentIndex(
        offset=0,
        length=len(data),
        log_time=0,
        create_time=0,
        data_size=len(content),
        name=name,
        media_type=media_type,
    )
    return RecordGroup([data], [IndexEntry(index, {})], isal_zlib.crc32(data))
