"""The summary of an MCAP file that grows, encoded again at every flush.

A chunk's entry is encoded once; only the statistics and the places are new each time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias, final

from mcap import records
from mcap.opcode import Opcode

from cosim.log.mcap_file.records import encoded

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
