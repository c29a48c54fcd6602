"""The summary of a log, and where it says that the pieces of the file stand.

A log of cosim is opened by its summary alone, however long it is. That of a closed file has a CRC
in the footer; that of one that is still written, or whose writer was killed, a seal after it.
Where there is neither, and in files of other tools, which may leave records out of their indexes,
the file is walked instead.
"""

from __future__ import annotations

import os
import struct
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from isal import isal_zlib
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.summary import Summary

from cosim.log.mcap_file.live_file import SEAL
from cosim.log.mcap_file.records import (
    END_SIZE,
    FOOTER,
    FOOTER_SIZE,
    HEADER,
    MAGIC,
    PAD,
    RECORD_HEADER,
)
from cosim.log.mcap_file.walk import FileContents, RecordSpan, damage_error

_LIBRARY: Final = "cosim/"  # what the name of ours begins with
_MOST_SUMMARY: Final = 2**30  # bytes
_MOST_NAME: Final = 2**10
_CRC_SIZE: Final = 4
_CHUNK_PLACE: Final = struct.Struct(
    "<QQQQI"
)  # first and last time, start, length, bytes of offsets
_INDEX_OFFSET: Final = struct.Struct("<HQ")  # channel, offset of its index
_CHUNK_NAME: Final = struct.Struct("<QI")  # length of the indexes, bytes of the compression's name
_CHUNK_SIZES: Final = struct.Struct("<QQ")  # compressed, uncompressed


def is_ours(stream: BinaryIO) -> bool:
    """Return whether cosim wrote the file, as its header says."""
    stream.seek(0)
    start = stream.read(len(MAGIC) + HEADER + _MOST_NAME)
    if start[: len(MAGIC)] != MAGIC or start[len(MAGIC) : len(MAGIC) + 1] != b"\x01":
        return False
    try:
        header = records.Header.read(ReadDataStream(BytesIO(start[len(MAGIC) + HEADER :])))
    except (McapError, ValueError):
        return False
    return str(header.library).startswith(_LIBRARY)


class LogIndex(NamedTuple):
    """What the summary of a log says."""

    summary: Summary
    contents: FileContents
    is_unfinished: bool  # the file is still written, or its writer was killed


def read_index(path: Path, stream: BinaryIO) -> LogIndex | None:
    """Return the summary of a log of ours and the pieces of the file; None: it has to be walked.

    Raises
    ------
    LogError
        If the summary is damaged.
    """
    size = stream.seek(0, os.SEEK_END)
    if size < len(MAGIC) + END_SIZE:
        return None
    footer_start = size - END_SIZE
    stream.seek(footer_start)
    end = stream.read(END_SIZE)
    opcode, length, start, offset_start, crc = FOOTER.unpack(end[:FOOTER_SIZE])
    is_footer = opcode == Opcode.FOOTER and length == FOOTER_SIZE - HEADER
    if not is_footer or end[FOOTER_SIZE:] != MAGIC or not start:
        return None
    if not is_ours(stream) and not (crc == 0 and _has_seal(stream, start, footer_start)):
        return None
    if not len(MAGIC) < start <= offset_start <= footer_start:
        raise damage_error(path, footer_start, f"invalid start of the summary: byte {start}")
    if footer_start - start > _MOST_SUMMARY:
        raise damage_error(
            path,
            footer_start,
            f"a summary of {footer_start - start} bytes exceeds the limit of {_MOST_SUMMARY}",
        )
    stream.seek(start)
    section = stream.read(footer_start - start)
    if crc:
        footer_head = end[: FOOTER_SIZE - _CRC_SIZE]
        is_whole = isal_zlib.crc32(footer_head, isal_zlib.crc32(section)) == crc
    else:
        section = _sealed(section, start)
        is_whole = offset_start <= start + len(section) and bool(section)
    if not is_whole:
        raise damage_error(path, start, "the CRC of the summary does not match its content")
    summary = parse_summary(section)
    return LogIndex(summary, _contents(summary), is_unfinished=not crc)


def _has_seal(stream: BinaryIO, start: int, stop: int) -> bool:
    """Return whether a seal vouches for a summary: no CRC does for the header before it."""
    if not len(MAGIC) < start < stop <= start + _MOST_SUMMARY:
        return False
    stream.seek(start)
    return bool(_sealed(stream.read(stop - start), start))


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


def parse_summary(section: bytes) -> Summary:
    """Return the summary that some records make.

    Raises
    ------
    McapError, ValueError, struct.error
        If they cannot be read.
    """
    summary = Summary()
    position = 0
    while position + HEADER <= len(section):
        opcode, length = RECORD_HEADER.unpack_from(section, position)
        stop = position + HEADER + length
        if stop > len(section):
            raise ValueError(f"a record of {length} bytes is longer than the summary")
        _add(summary, opcode, section[position + HEADER : stop])
        position = stop
    return summary


def _add(summary: Summary, opcode: int, content: bytes) -> None:
    data = ReadDataStream(BytesIO(content))
    match opcode:
        case Opcode.STATISTICS:
            summary.statistics = records.Statistics.read(data)
        case Opcode.CHANNEL:
            channel = records.Channel.read(data)
            summary.channels[channel.id] = channel
        case Opcode.CHUNK_INDEX:
            summary.chunk_indexes.append(_chunk_index(content))
        case Opcode.METADATA_INDEX:
            summary.metadata_indexes.append(records.MetadataIndex.read(data))
        case Opcode.ATTACHMENT_INDEX:
            summary.attachment_indexes.append(records.AttachmentIndex.read(data))


def _chunk_index(content: bytes) -> records.ChunkIndex:
    """Read what there may be thousands of, ten times as fast as mcap does."""
    start_time, end_time, start, length, offset_bytes = _CHUNK_PLACE.unpack_from(content)
    position = _CHUNK_PLACE.size
    offsets_end = position + offset_bytes
    entries = _INDEX_OFFSET.iter_unpack(content[position:offsets_end])
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
        message_index_offsets=dict(entries),
        message_start_time=start_time,
        uncompressed_size=size,
    )


def _contents(summary: Summary) -> FileContents:
    """Return where the pieces of a file stand, as its summary says."""
    contents = FileContents()
    for chunk in summary.chunk_indexes:
        stop = chunk.chunk_start_offset + chunk.chunk_length
        contents.data.append(RecordSpan(Opcode.CHUNK, chunk.chunk_start_offset, stop))
    contents.data.sort(key=lambda span: span.start)
    for metadata in summary.metadata_indexes:
        stop = metadata.offset + metadata.length
        contents.metadata.append(RecordSpan(Opcode.METADATA, metadata.offset, stop))
    for attachment in summary.attachment_indexes:
        stop = attachment.offset + attachment.length
        contents.attachments.append(RecordSpan(Opcode.ATTACHMENT, attachment.offset, stop))
    return contents
