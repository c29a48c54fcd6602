"""The records of an MCAP file that cosim writes itself, the head of a file, and its summary.

Records from 0x80 on are private: every reader skips them. Of the summary, which is encoded again at
every flush, a chunk's entry is encoded once; only the statistics and the places are new each time.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, TypeAlias, final

from isal import isal_zlib
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import McapRecord

from cosim.files import MCAP_MAGIC

# Not that of mcap.writer or mcap.reader, which load every compressor that is installed.
MAGIC: Final = MCAP_MAGIC

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

    def placed(self, position: int) -> IndexEntry:
        """Return it with offsets that count from the start of the file, not from ``position``."""
        index = self.index
        if not isinstance(index, records.ChunkIndex):
            return IndexEntry(replace(index, offset=index.offset + position), self.counts)
        offsets = {key: own + position for key, own in index.message_index_offsets.items()}
        start = index.chunk_start_offset + position
        placed = replace(index, chunk_start_offset=start, message_index_offsets=offsets)
        return IndexEntry(placed, self.counts)


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
        return [entry.placed(position) for entry in self.entries]


def joined_groups(groups: Iterable[RecordGroup]) -> RecordGroup:
    """Return groups side by side."""
    parts: list[bytes | memoryview] = []
    entries: list[IndexEntry] = []
    position = 0
    crc = 0
    for group in groups:
        parts += group.parts
        entries += group.placed(position)
        crc = isal_zlib.crc32_combine(crc, group.crc, group.size)
        position += group.size
    return RecordGroup(parts, entries, crc)


@dataclass(frozen=True, slots=True)
class FileSummary:
    """What the summary of a file says.

    Parameters
    ----------
    declared : tuple of bytes
        Schemas, channels.
    statistics : Statistics
    indexes : mapping of Opcode to bytes
        The records that tell where chunks, attachments and metadata are.
    """

    declared: tuple[bytes, bytes]
    statistics: records.Statistics
    indexes: Mapping[Opcode, bytes]

    @staticmethod
    def of(
        schemas: Sequence[records.Schema],
        channels: Sequence[records.Channel],
        entries: Sequence[IndexEntry] = (),
    ) -> FileSummary:
        """Return the summary of schemas, channels and other records."""
        statistics = records.Statistics(
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
        indexes = dict.fromkeys(_INDEX_OPCODES.values(), b"")
        summary = FileSummary((encoded(*schemas), encoded(*channels)), statistics, indexes)
        return summary.with_entries(entries)

    def with_entries(self, entries: Sequence[IndexEntry]) -> FileSummary:
        """Return the summary of a file that has more records and chunks."""
        further: dict[Opcode, list[IndexRecord]] = {opcode: [] for opcode in self.indexes}
        old = self.statistics
        counts = dict(old.channel_message_counts)
        spans = [(old.message_start_time, old.message_end_time)] if old.chunk_count else []
        for entry in entries:
            further[_INDEX_OPCODES[type(entry.index)]].append(entry.index)
            for channel_id, count in entry.counts.items():
                counts[channel_id] += count
            if isinstance(entry.index, records.ChunkIndex):
                spans.append((entry.index.message_start_time, entry.index.message_end_time))
        statistics = replace(
            old,
            attachment_count=old.attachment_count + len(further[Opcode.ATTACHMENT_INDEX]),
            channel_message_counts=counts,
            chunk_count=old.chunk_count + len(further[Opcode.CHUNK_INDEX]),
            message_count=sum(counts.values()),
            message_end_time=max((end for _, end in spans), default=0),
            message_start_time=min((start for start, _ in spans), default=0),
            metadata_count=old.metadata_count + len(further[Opcode.METADATA_INDEX]),
        )
        indexes = {key: data + encoded(*further[key]) for key, data in self.indexes.items()}
        return FileSummary(self.declared, statistics, indexes)

    def encoded(self, start: int) -> EncodedSummary:
        """Return the summary that begins at ``start``."""
        schemas, channels = self.declared
        groups = {
            Opcode.SCHEMA: schemas,
            Opcode.CHANNEL: channels,
            Opcode.STATISTICS: encoded(self.statistics),
            **self.indexes,
        }
        position = start
        offsets = []
        for opcode, data in groups.items():
            if data:
                offsets.append(records.SummaryOffset(opcode, position, len(data)))
            position += len(data)
        data = b"".join([*groups.values(), encoded(*offsets)])
        return EncodedSummary(data, position)


@final
class FileHead:
    """The records up to the first row.

    Parameters
    ----------
    library : str
        Name of the program that writes the file.
    """

    def __init__(self, *, library: str) -> None:
        self._data = bytearray(MAGIC + encoded(records.Header(profile="", library=library)))
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._entries: list[IndexEntry] = []

    @property
    def data(self) -> bytes:
        """The bytes."""
        return bytes(self._data)

    def summary(self) -> FileSummary:
        """Return the summary of what is here."""
        return FileSummary.of(self._schemas, self._channels, self._entries)

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
        self._data += encoded(*schemas, *channels)

    def metadata(self, name: str, items: dict[str, str]) -> None:
        """Add a metadata record."""
        self._add(metadata_group(name, items))

    def attachment(self, name: str, media_type: str, content: bytes) -> None:
        """Add an attachment, at time 0."""
        self._add(attachment_group(name, media_type, content))

    def _add(self, group: RecordGroup) -> None:
        self._entries += group.placed(len(self._data))
        self._data += b"".join(group.parts)


def metadata_group(name: str, items: dict[str, str]) -> RecordGroup:
    """Return a metadata record."""
    data = encoded(records.Metadata(name=name, metadata=items))
    return _group(data, records.MetadataIndex(0, len(data), name))


def attachment_group(name: str, media_type: str, content: bytes) -> RecordGroup:
    """Return an attachment, at time 0."""
    data = encoded(records.Attachment(0, 0, name, media_type, content))
    index = records.AttachmentIndex(0, len(data), 0, 0, len(content), name, media_type)
    return _group(data, index)


def _group(data: bytes, index: IndexRecord) -> RecordGroup:
    return RecordGroup([data], [IndexEntry(index, {})], isal_zlib.crc32(data))
