"""Where the records of an MCAP file stand: by its summary, or by a walk.

A log of cosim is opened by its summary alone, however long it is. That of a closed file has a CRC
in the footer; that of one that is still written, or whose writer was killed, a seal after it.
Where there is neither, and in files of other tools, which may leave records out of their indexes,
the file is walked from record to record by their lengths.
"""

from __future__ import annotations

import os
import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

from isal import isal_zlib
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.summary import Summary

from cosim.errors import LogError
from cosim.log.live_file import SEAL
from cosim.log.mcap_records import (
    END_SIZE,
    FOOTER,
    FOOTER_SIZE,
    HEADER,
    MAGIC,
    PAD,
    RECORD_HEADER,
)

# what parsing bytes from outside may raise
MALFORMED: Final = (McapError, ValueError, KeyError, TypeError, OverflowError, struct.error)
MOST_ATTACHED: Final = 2**28  # bytes of an attachment
OWN_LIBRARY: Final = "cosim/"  # what the name of ours begins with
RESCUE: Final = "recover the intact part with 'cosim recover', which reports what is lost"

_MOST_SUMMARY: Final = 2**30  # bytes
_MOST_NAME: Final = 2**10
_SPAN_BYTES: Final = 2**22  # of messages outside chunks that are read as one piece
_READ_BYTES: Final = 2**22
ATTACHMENT_TIMES: Final = 16  # bytes: log time, creation time


class RecordSpan(NamedTuple):
    """Bytes ``start`` to ``stop`` of a record, or of messages outside chunks, headers included."""

    opcode: int
    start: int
    stop: int

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self.stop - self.start


@dataclass(slots=True)
class Places:
    """Where the records of a file stand, in its order, and what its summary says.

    Parameters
    ----------
    data : list of RecordSpan
        Chunks, and spans of messages outside chunks.
    others : dict of opcode to list of RecordSpan
        Metadata and attachments; schemas and channels outside chunks, which an index leaves out, as
        its summary repeats them.
    summary : Summary
        Empty where there is none.
    is_indexed : bool
        Whether cosim wrote the file, so that its summary is whole, and each channel in order of
        time.
    is_unfinished : bool
        Whether it is still written, or its writer was killed.
    """

    data: list[RecordSpan] = field(default_factory=list)
    others: dict[int, list[RecordSpan]] = field(default_factory=lambda: defaultdict(list))
    summary: Summary = field(default_factory=Summary)
    is_indexed: bool = False
    is_unfinished: bool = False

    @property
    def chunks(self) -> list[RecordSpan]:
        """The chunks among the data."""
        return [span for span in self.data if span.opcode == Opcode.CHUNK]

    def add(self, opcode: int, start: int, stop: int) -> None:
        """Add a record of the data section; messages side by side are one span."""
        if opcode not in (Opcode.CHUNK, Opcode.MESSAGE):
            self.others[opcode].append(RecordSpan(opcode, start, stop))
            return
        if opcode == Opcode.MESSAGE and self.data:
            last = self.data[-1]
            is_adjacent = last.opcode == Opcode.MESSAGE and last.stop == start
            if is_adjacent and stop - last.start <= _SPAN_BYTES:
                start = last.start
                del self.data[-1]
        self.data.append(RecordSpan(opcode, start, stop))


def damage_error(path: Path, offset: int, reason: str) -> LogError:
    """Return the error that names the byte at which a file is damaged."""
    return LogError(f"{path} is damaged at byte {offset}: {reason}")


def parsed(kind: Any, content: bytes | memoryview) -> Any:
    """Read the content of a record; raises what is in ``MALFORMED``."""
    return kind.read(ReadDataStream(BytesIO(content)))


def record_bounds(block: bytes | memoryview, position: int) -> tuple[int, int]:
    """Return opcode and end of the record that begins at a place of a chunk's content.

    Raises
    ------
    ValueError
        If no whole record is there.
    """
    if position + HEADER > len(block):
        raise ValueError(f"{len(block) - position} surplus bytes in a chunk")
    opcode, length = RECORD_HEADER.unpack_from(block, position)
    stop: int = position + HEADER + length
    if stop > len(block):
        raise ValueError(f"a record of {length} bytes does not fit into its chunk")
    return opcode, stop


def records_in(block: bytes | memoryview) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of the content of records one after the other.

    Raises
    ------
    ValueError
        If the last one is not whole.
    """
    position = 0
    while position < len(block):
        opcode, stop = record_bounds(block, position)
        yield opcode, position + HEADER, stop
        position = stop


def library_of(stream: BinaryIO) -> str | None:
    """Return what wrote the file, as its header says; None: it has no header."""
    stream.seek(0)
    start = stream.read(len(MAGIC) + HEADER + _MOST_NAME)
    if start[: len(MAGIC)] != MAGIC or start[len(MAGIC) : len(MAGIC) + 1] != b"\x01":
        return None
    try:
        return str(parsed(records.Header, start[len(MAGIC) + HEADER :]).library)
    except MALFORMED:
        return None


def is_ours(stream: BinaryIO) -> bool:
    """Return whether cosim wrote the file, as its header says."""
    return (library_of(stream) or "").startswith(OWN_LIBRARY)


# --- the summary ---


class _Footer(NamedTuple):
    """The footer of a file: where it stands, and where the summary and its offsets do."""

    position: int
    start: int
    offset_start: int
    crc: int
    head: bytes  # up to the CRC, which covers it


def _footer(stream: BinaryIO) -> _Footer | None:
    """Return the footer at the end of a file; None: there is none."""
    position = stream.seek(0, os.SEEK_END) - END_SIZE
    if position < len(MAGIC):
        return None
    stream.seek(position)
    end = stream.read(END_SIZE)
    opcode, length, start, offset_start, crc = FOOTER.unpack(end[:FOOTER_SIZE])
    is_footer = opcode == Opcode.FOOTER and length == FOOTER_SIZE - HEADER
    if not is_footer or end[FOOTER_SIZE:] != MAGIC:
        return None
    return _Footer(position, start, offset_start, crc, end[: FOOTER_SIZE - 4])


def _section(path: Path, stream: BinaryIO, footer: _Footer) -> bytes:
    """Return the bytes of the summary, checked by the CRC of the footer if that has one.

    Raises
    ------
    LogError
        If they are damaged.
    """
    size = footer.position - footer.start
    if not len(MAGIC) < footer.start <= footer.position:
        reason = f"invalid start of the summary: byte {footer.start}"
        raise damage_error(path, footer.position, reason)
    if size > _MOST_SUMMARY:
        reason = f"a summary of {size} bytes exceeds the limit of {_MOST_SUMMARY}"
        raise damage_error(path, footer.position, reason)
    stream.seek(footer.start)
    section = stream.read(size)
    if footer.crc and isal_zlib.crc32(footer.head, isal_zlib.crc32(section)) != footer.crc:
        reason = "the CRC of the summary does not match its content"
        raise damage_error(path, footer.start, reason)
    return section


def read_summary(path: Path, stream: BinaryIO) -> Summary:
    """Return the summary of any file; an empty one if it has none.

    Raises
    ------
    LogError
        If it is damaged.
    """
    footer = _footer(stream)
    if footer is None or not footer.start:
        return Summary()
    try:
        return _parse_summary(_section(path, stream, footer))
    except MALFORMED as error:
        reason = f"the summary cannot be read: {error}"
        raise damage_error(path, footer.position, reason) from error


def _parse_summary(section: bytes) -> Summary:
    summary = Summary()
    for opcode, begin, stop in records_in(section):
        content = section[begin:stop]
        match opcode:
            case Opcode.STATISTICS:
                summary.statistics = parsed(records.Statistics, content)
            case Opcode.SCHEMA:
                schema = parsed(records.Schema, content)
                summary.schemas[schema.id] = schema
            case Opcode.CHANNEL:
                channel = parsed(records.Channel, content)
                summary.channels[channel.id] = channel
            case Opcode.CHUNK_INDEX:
                summary.chunk_indexes.append(_chunk_index(content))
            case Opcode.METADATA_INDEX:
                summary.metadata_indexes.append(parsed(records.MetadataIndex, content))
            case Opcode.ATTACHMENT_INDEX:
                summary.attachment_indexes.append(parsed(records.AttachmentIndex, content))
    return summary


_CHUNK_PLACE: Final = struct.Struct("<QQQQI")  # times, start, length, bytes of offsets
_INDEX_OFFSET: Final = struct.Struct("<HQ")  # channel, offset of its index
_CHUNK_NAME: Final = struct.Struct("<QI")  # length of the indexes, bytes of the compression's name
_CHUNK_SIZES: Final = struct.Struct("<QQ")  # compressed, uncompressed


def _chunk_index(content: bytes) -> records.ChunkIndex:
    """Read what there may be thousands of, ten times as fast as mcap does."""
    start_time, end_time, start, length, offset_bytes = _CHUNK_PLACE.unpack_from(content)
    position = _CHUNK_PLACE.size
    offsets_end = position + offset_bytes
    index_length, name_length = _CHUNK_NAME.unpack_from(content, offsets_end)
    name_start = offsets_end + _CHUNK_NAME.size
    name_end = name_start + name_length
    compressed_size, size = _CHUNK_SIZES.unpack_from(content, name_end)
    return records.ChunkIndex(
        chunk_length=length,
        chunk_start_offset=start,
        compression=content[name_start:name_end].decode(),
        compressed_size=compressed_size,
        message_end_time=end_time,
        message_index_length=index_length,
        message_index_offsets=dict(_INDEX_OFFSET.iter_unpack(content[position:offsets_end])),
        message_start_time=start_time,
        uncompressed_size=size,
    )


def find_places(path: Path, stream: BinaryIO) -> Places:
    """Return where a file has its records.

    Raises
    ------
    LogError
        If it is not MCAP, truncated or damaged; or another of what is malformed.
    """
    return indexed(path, stream) or walked(path, stream)


# --- by the summary ---


def indexed(path: Path, stream: BinaryIO) -> Places | None:
    """Return where a log of ours has its records, as its summary says; None: it has to be walked.

    Raises
    ------
    LogError
        If the summary is damaged.
    """
    footer = _footer(stream)
    if footer is None or not footer.start:
        return None
    section = _section(path, stream, footer)
    sealed = b"" if footer.crc else _sealed(section, footer.start)
    if not sealed and not is_ours(stream):  # no CRC vouches for the header that says so
        return None
    if not footer.crc:
        section = sealed
        if not section:
            reason = "the CRC of the summary does not match its content"
            raise damage_error(path, footer.start, reason)
    if not footer.start <= footer.offset_start <= footer.start + len(section):
        reason = f"invalid start of the summary: byte {footer.start}"
        raise damage_error(path, footer.position, reason)
    summary = _parse_summary(section)
    places = Places(summary=summary, is_indexed=True, is_unfinished=not footer.crc)
    for chunk in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        start = chunk.chunk_start_offset
        places.add(Opcode.CHUNK, start, start + chunk.chunk_length)
    for metadata in summary.metadata_indexes:
        places.add(Opcode.METADATA, metadata.offset, metadata.offset + metadata.length)
    for attachment in summary.attachment_indexes:
        places.add(Opcode.ATTACHMENT, attachment.offset, attachment.offset + attachment.length)
    _check_counts(path, places)
    return places


def _check_counts(path: Path, places: Places) -> None:
    """Compare the records of a file with its statistics.

    Raises
    ------
    LogError
        If there are others.
    """
    statistics = places.summary.statistics
    if statistics is None:
        return
    others = [len(places.others[opcode]) for opcode in (Opcode.METADATA, Opcode.ATTACHMENT)]
    counts = (len(places.chunks), *others)
    expected = (statistics.chunk_count, statistics.metadata_count, statistics.attachment_count)
    if counts != expected:
        raise LogError(
            f"{path} is damaged: expected {expected} chunks, metadata records and attachments, as "
            f"in its summary, got {counts}"
        )


def _sealed(section: bytes, start: int) -> bytes:
    """Return the summary that a seal vouches for; nothing: there is none."""
    position = 0
    while position + HEADER <= len(section):
        opcode, length = RECORD_HEADER.unpack_from(section, position)
        if opcode == PAD:
            seal = section[position + HEADER : position + HEADER + SEAL.size]
            summary = section[:position]
            fits = seal == SEAL.pack(start, position, isal_zlib.crc32(summary))
            return summary if fits else b""
        position += HEADER + length
    return b""


# --- by a walk ---


def walked(path: Path, stream: BinaryIO) -> Places:
    """Return where a file has its records, by the headers of all of them.

    Messages outside chunks are checked by the CRC of the data, if its writer gave one.

    Raises
    ------
    LogError
        If the file is not MCAP, truncated or damaged; the error of a truncated file differs from
        that of a damaged one, and both name the byte.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    if stream.read(len(MAGIC)) != MAGIC:
        # what else stands there is not shown: a stranger's scenario may name any file
        what = f"not an MCAP file: expected it to begin with {MAGIC!r}"
        raise LogError(f"{path} is {what if size else 'empty; expected an MCAP file'}")
    places = Places()
    position = len(MAGIC)
    data_end = 0
    opcode = 0
    while opcode != Opcode.FOOTER:
        stream.seek(position)
        header = stream.read(HEADER)
        length = int.from_bytes(header[1:], "little")
        stop = position + HEADER + length
        if len(header) < HEADER or stop > size:
            raise _incomplete(path, stream, places, position=position, size=size)
        opcode = header[0]
        if opcode == Opcode.DATA_END and not data_end:
            data_end = position
            data_crc = int.from_bytes(stream.read(4), "little")
        elif not data_end:  # the summary repeats records
            places.add(opcode, position, stop)
        position = stop
    stream.seek(position)
    if stream.read(len(MAGIC) + 1) != MAGIC:  # nothing may follow it
        raise _incomplete(path, stream, places, position=position, size=size)
    places.summary = read_summary(path, stream)
    _check_counts(path, places)
    starts = {span.start for span in places.chunks}
    without = [i.chunk_start_offset for i in places.summary.chunk_indexes]
    if not starts.issuperset(without):
        place = min(start for start in without if start not in starts)
        raise damage_error(path, place, "no chunk where its index says")
    has_messages = len(places.chunks) < len(places.data)
    if has_messages and data_end and data_crc and data_crc != _crc(stream, data_end):
        raise damage_error(path, data_end, "the CRC of the data does not match")
    return places


def _crc(stream: BinaryIO, stop: int) -> int:
    """Compute the CRC-32 of the bytes before ``stop``, piece by piece."""
    stream.seek(0)
    crc = 0
    for position in range(0, stop, _READ_BYTES):
        crc = isal_zlib.crc32(stream.read(min(_READ_BYTES, stop - position)), crc)
    return crc


def _incomplete(
    path: Path, stream: BinaryIO, places: Places, *, position: int, size: int
) -> LogError:
    """Return the error of a file of ``size`` bytes with no whole record at ``position``.

    A file that ends with the magic was closed, so a length in it is wrong; else its end is missing.
    """
    stream.seek(max(size - len(MAGIC), len(MAGIC)))
    if stream.read() == MAGIC:
        return damage_error(path, position, "no complete record begins there")
    rescue = "it has no complete row: run it again"
    if position > len(MAGIC) and not is_ours(stream):  # else who wrote it is cut off, too
        rescue = "recover the intact part with 'mcap recover'"
    elif places.chunks:
        # A chunk holds rows of some components, so that others may end long before it.
        stream.seek(places.chunks[-1].start + HEADER + 8)  # after the time of its first message
        end_ns = int.from_bytes(stream.read(8), "little")
        rescue = f"its last complete chunk ends at t = {end_ns / 1e9} s: run it again, or {RESCUE}"
    return LogError(
        f"{path} is truncated at byte {size}: its end is missing, as after an interrupted "
        f"copy; {rescue}"
    )


def check_attachment(record: bytes, *, needs_crc: bool = False) -> None:
    """Check the CRC of an attachment.

    Raises
    ------
    ValueError
        If it does not match, or there is none and one is needed.
    """
    crc = int.from_bytes(record[-4:], "little")
    if (needs_crc or crc) and isal_zlib.crc32(record[HEADER:-4]) != crc:
        raise ValueError("the CRC of an attachment does not match its content")
