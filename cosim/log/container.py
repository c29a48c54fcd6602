"""An MCAP file as checked pieces: chunks, metadata, attachments, channels.

Message indexes are not used, chunk indexes only to check what the chunks say of themselves.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, final

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.stream_reader import StreamReader
from mcap.summary import Summary

from cosim.errors import LogError
from cosim.log.compression import MOST_BYTES, decompress
from cosim.log.layout import HEADER
from cosim.log.scan import Loose, scan
from cosim.log.walk import RecordSpan, damage, walk

MALFORMED = (
    McapError,
    ValueError,
    KeyError,
    TypeError,
    OverflowError,
    struct.error,
)  # what parsing bytes from outside may raise

_READ_BYTES = 2**22
_SIZES = struct.Struct("<QQQI")  # of a chunk: first and last time, size, CRC


@final
class Container:
    """An MCAP file that is opened anew for every pass over it.

    Parameters
    ----------
    path : Path

    Raises
    ------
    LogError
        If the file is no MCAP, truncated or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._identity = _identity(path.stat())
            with path.open("rb") as stream:
                self.contents = walk(path, stream)
                self.summary = self._summary(stream)
                self._check(stream)
        except OSError as error:
            raise LogError(f"{path} cannot be read: {error.strerror or error}") from error

    def open(self) -> BinaryIO:
        """Open the file for a pass.

        Raises
        ------
        LogError
            If it is not the file it was.
        """
        try:
            stream = self.path.open("rb")
        except OSError as error:
            raise LogError(f"{self.path} cannot be read: {error.strerror or error}") from error
        if _identity(os.fstat(stream.fileno())) != self._identity:
            stream.close()
            raise LogError(f"{self.path} has changed since it was opened; open it again")
        return stream

    def blocks(self) -> Iterator[bytes]:
        """Give the message records chunk by chunk, decompressed and checked.

        Raises
        ------
        LogError
            If a chunk is damaged or too large.
        """
        with self.open() as stream:
            for place in self.contents.data:
                yield (
                    self._chunk(stream, place)
                    if place.opcode == Opcode.CHUNK
                    else _read(stream, place)
                )

    def channels(self) -> Mapping[int, records.Channel]:
        """Give the channels by id: from the summary, or else from outside the chunks, or else from inside."""
        told: Mapping[int, records.Channel] = self.summary.channels
        if told:
            return told
        with self.open() as stream:
            found = [_read(stream, place)[HEADER:] for place in self.contents.channels]
        for block in () if found else self.blocks():
            inside = (record for record in scan(block, {}) if isinstance(record, Loose))
            found += [record.content for record in inside if record.opcode == Opcode.CHANNEL]
        try:
            parsed = [records.Channel.read(ReadDataStream(BytesIO(content))) for content in found]
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: a channel cannot be read: {error}") from error
        return {channel.id: channel for channel in parsed}

    def expected(self, channel_id: int, size: int) -> int:
        """Say how many messages of ``size`` bytes to make room for: what the summary says, as far as the chunks can hold it."""
        told = (
            self.summary.statistics.channel_message_counts.get(channel_id, 0)
            if self.summary.statistics
            else 0
        )
        room = sum(
            MOST_BYTES if place.opcode == Opcode.CHUNK else place.stop - place.start
            for place in self.contents.data
        )
        return min(told, room // size)

    def metadata(self) -> Iterator[records.Metadata]:
        """Give the metadata records."""
        with self.open() as stream:
            for place in self.contents.metadata:
                try:
                    yield records.Metadata.read(_content(_read(stream, place)))
                except MALFORMED as error:
                    raise self.damaged(
                        place.start, f"a metadata record cannot be read: {error}"
                    ) from error

    def attachments(self) -> dict[str, RecordSpan]:
        """Give the attachments' names and places, without their content."""
        places = {}
        with self.open() as stream:
            for place in self.contents.attachments:
                stream.seek(place.start + HEADER + 16)  # behind two times
                head = stream.read(4)
                name = stream.read(min(int.from_bytes(head, "little"), place.stop - place.start))
                places[name.decode(errors="replace")] = place
        return places

    def attachment(self, place: RecordSpan) -> bytes:
        """Give the content of an attachment, checked by its CRC.

        Raises
        ------
        LogError
            If it is damaged.
        """
        with self.open() as stream:
            data = _read(stream, place)
        crc = int.from_bytes(data[-4:], "little")
        if crc and zlib.crc32(data[HEADER:-4]) != crc:
            raise self.damaged(place.start, "the CRC of an attachment does not fit its content")
        try:
            return bytes(records.Attachment.read(_content(data)).data)
        except MALFORMED as error:
            raise self.damaged(place.start, f"an attachment cannot be read: {error}") from error

    def damaged(self, offset: int, reason: str) -> LogError:
        """Make the error that says where the file is damaged."""
        return damage(self.path, offset, reason)

    def _chunk(self, stream: BinaryIO, place: RecordSpan) -> bytes:
        try:
            first, last, size, crc, compression, length = self._sizes(stream, place)
            index = self._indexes.get(place.start)
            told = index and (
                index.message_start_time,
                index.message_end_time,
                index.uncompressed_size,
                index.compression,
            )
            if told and told != (first, last, size, compression):
                raise ValueError("a chunk differs from its index")
            return decompress(stream.read(length), compression, size=size, crc=crc)
        except MALFORMED as error:
            raise self.damaged(place.start, str(error)) from error

    def _sizes(self, stream: BinaryIO, place: RecordSpan) -> tuple[int, int, int, int, str, int]:
        """Read a chunk up to its data: first and last time, size, CRC, compression, length of the data."""
        stream.seek(place.start + HEADER)
        first, last, size, crc = _SIZES.unpack(stream.read(_SIZES.size))
        compression = stream.read(min(int.from_bytes(stream.read(4), "little"), 16)).decode()
        (length,) = struct.unpack("<Q", stream.read(8))
        if stream.tell() + length > place.stop:
            raise ValueError(
                f"a chunk with {length} bytes of data in a record of {place.stop - place.start}"
            )
        return first, last, size, crc, compression, length

    def _summary(self, stream: BinaryIO) -> Summary:
        """Read the summary; an empty one if there is none."""
        place = RecordSpan(Opcode.FOOTER, self.contents.footer, self.contents.footer + FOOTER_SIZE)
        summary = Summary()
        try:
            footer = records.Footer.read(_content(_read(stream, place)))
            if not footer.summary_start:
                return summary
            stream.seek(footer.summary_start)
            data = stream.read()
            checked = data[: place.start - footer.summary_start + FOOTER_SIZE - 4]
            if footer.summary_crc and zlib.crc32(checked) != footer.summary_crc:
                raise ValueError("the CRC of the summary does not fit its content")
            for record in StreamReader(BytesIO(data), skip_magic=True).records:
                _collect(summary, record)
        except MALFORMED as error:
            raise self.damaged(place.start, f"the summary cannot be read: {error}") from error
        return summary

    def _check(self, stream: BinaryIO) -> None:
        """Compare the file with its summary; without chunks there is but the CRC of all data to check."""
        self._indexes = {index.chunk_start_offset: index for index in self.summary.chunk_indexes}
        chunks = [place.start for place in self.contents.data if place.opcode == Opcode.CHUNK]
        told = self.summary.statistics
        if told:
            found = len(chunks), len(self.contents.metadata), len(self.contents.attachments)
            needed = told.chunk_count, told.metadata_count, told.attachment_count
            if found != needed:
                raise LogError(
                    f"{self.path} is damaged: found {found} chunks, metadata records and attachments, its summary says {needed}"
                )
        if self._indexes.keys() - set(chunks):
            raise self.damaged(
                min(self._indexes.keys() - set(chunks)), "no chunk there, though its index says so"
            )
        bare = len(chunks) < len(self.contents.data)
        if (
            bare
            and self.contents.data_crc
            and _crc(stream, self.contents.data_end) != self.contents.data_crc
        ):
            raise self.damaged(self.contents.data_end, "the CRC of the data does not fit")


def _collect(summary: Summary, record: records.McapRecord) -> None:
    match record:
        case records.Statistics():
            summary.statistics = record
        case records.Channel():
            summary.channels[record.id] = record
        case records.ChunkIndex():
            summary.chunk_indexes.append(record)


def _identity(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_ino, status.st_size, status.st_mtime_ns


def _read(stream: BinaryIO, place: RecordSpan) -> bytes:
    stream.seek(place.start)
    return stream.read(place.stop - place.start)


def _content(record: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(record[HEADER:]))


def _crc(stream: BinaryIO, stop: int) -> int:
    stream.seek(0)
    crc = 0
    for start in range(0, stop, _READ_BYTES):
        crc = zlib.crc32(stream.read(min(_READ_BYTES, stop - start)), crc)
    return crc
