"""An MCAP file as a list of places: where its chunks, metadata and attachments stand, checked against the summary.

The file is walked from record to record by their lengths; message and chunk indexes are hints that are checked, never trusted. A
truncated file is told from a damaged one, with the byte.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
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
from mcap.writer import MCAP0_MAGIC

from cosim.errors import LogError
from cosim.log.compression import decompress
from cosim.log.layout import HEADER

MALFORMED = (McapError, ValueError, KeyError, TypeError, OverflowError, struct.error)  # what parsing bytes from outside may raise

_LOOSE = (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)  # records that may stand outside chunks
_SPAN_BYTES = 2**22  # of loose records that are read at once
_SIZES = struct.Struct("<QQQI")  # of a chunk: first and last time, size, CRC


@dataclass(frozen=True, slots=True)
class Place:
    """Where a record, or a span of loose records, stands: from ``start`` to ``stop``, its header included."""

    opcode: int  # 0: a span
    start: int
    stop: int


@dataclass(slots=True)
class Contents:
    """What a file holds, in the order of the file."""

    data: list[Place] = field(default_factory=list)  # chunks and spans
    metadata: list[Place] = field(default_factory=list)
    attachments: list[Place] = field(default_factory=list)
    data_end: int = 0
    data_crc: int = 0
    footer: int = 0


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
                self.contents = self._walk(stream)
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
                yield _read(stream, place) if place.opcode == 0 else self._chunk(stream, place)

    def metadata(self) -> Iterator[records.Metadata]:
        """Give the metadata records."""
        with self.open() as stream:
            for place in self.contents.metadata:
                try:
                    yield records.Metadata.read(_content(_read(stream, place)))
                except MALFORMED as error:
                    raise self.damaged(place.start, f"a metadata record cannot be read: {error}") from error

    def attachments(self) -> dict[str, Place]:
        """Give the attachments' names and places, without their content."""
        places = {}
        with self.open() as stream:
            for place in self.contents.attachments:
                stream.seek(place.start + HEADER + 16)  # behind two times
                head = stream.read(4)
                name = stream.read(min(int.from_bytes(head, "little"), place.stop - place.start))
                places[name.decode(errors="replace")] = place
        return places

    def attachment(self, place: Place) -> bytes:
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
        return LogError(f"{self.path} is damaged at byte {offset}: {reason}")

    def _chunk(self, stream: BinaryIO, place: Place) -> bytes:
        try:
            first, last, size, crc, compression, length = self._sizes(stream, place)
            index = self._indexes.get(place.start)
            told = index and (index.message_start_time, index.message_end_time, index.uncompressed_size, index.compression)
            if told and told != (first, last, size, compression):
                raise ValueError("a chunk differs from its index")
            return decompress(stream.read(length), compression, size=size, crc=crc)
        except MALFORMED as error:
            raise self.damaged(place.start, str(error)) from error

    def _sizes(self, stream: BinaryIO, place: Place) -> tuple[int, int, int, int, str, int]:
        """Read a chunk up to its data: first and last time, size, CRC, compression, length of the data."""
        stream.seek(place.start + HEADER)
        first, last, size, crc = _SIZES.unpack(stream.read(_SIZES.size))
        compression = stream.read(min(int.from_bytes(stream.read(4), "little"), 16)).decode()
        (length,) = struct.unpack("<Q", stream.read(8))
        if stream.tell() + length > place.stop:
            raise ValueError(f"a chunk with {length} bytes of data in a record of {place.stop - place.start}")
        return first, last, size, crc, compression, length

    def _walk(self, stream: BinaryIO) -> Contents:
        """Go from record to record up to the footer."""
        size = stream.seek(0, os.SEEK_END)
        stream.seek(0)
        magic = stream.read(len(MCAP0_MAGIC))
        if magic != MCAP0_MAGIC:
            raise LogError(f"{self.path} is no MCAP file: it begins with {magic!r}, needed {MCAP0_MAGIC!r}")
        contents, at, opcode = Contents(), len(MCAP0_MAGIC), 0
        while opcode != Opcode.FOOTER:
            stream.seek(at)
            head = stream.read(HEADER)
            stop = at + HEADER + int.from_bytes(head[1:], "little")
            if len(head) < HEADER or stop > size:
                raise self._cut(stream, at, size)
            opcode = head[0]
            _sort(contents, Place(opcode, at, stop))
            if opcode == Opcode.DATA_END and not contents.data_end:
                contents.data_end, contents.data_crc = at, int.from_bytes(stream.read(4), "little")
            at = stop
        stream.seek(at)
        if stream.read(len(MCAP0_MAGIC) + 1) != MCAP0_MAGIC:
            raise self._cut(stream, at, size)
        return contents

    def _cut(self, stream: BinaryIO, at: int, size: int) -> LogError:
        stream.seek(max(size - len(MCAP0_MAGIC), 0))
        if stream.read() == MCAP0_MAGIC:
            return self.damaged(at, "no whole record begins there")
        return LogError(f"{self.path} is truncated at byte {size}: its last whole record ends at byte {at}, a footer is missing")

    def _summary(self, stream: BinaryIO) -> Summary:
        """Read the summary; an empty one if there is none."""
        place = Place(Opcode.FOOTER, self.contents.footer, self.contents.footer + FOOTER_SIZE)
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
            raise self.damaged(min(self._indexes.keys() - set(chunks)), "no chunk there, though its index says so")
        if len(chunks) < len(self.contents.data) and self.contents.data_crc:
            if _crc(stream, self.contents.data_end) != self.contents.data_crc:
                raise self.damaged(self.contents.data_end, "the CRC of the data does not fit")


def _sort(contents: Contents, place: Place) -> None:
    """Put a record where it belongs."""
    if place.opcode == Opcode.FOOTER:
        contents.footer = place.start
    elif contents.data_end:
        return  # the summary repeats what was there
    elif place.opcode == Opcode.CHUNK:
        contents.data.append(place)
    elif place.opcode == Opcode.METADATA:
        contents.metadata.append(place)
    elif place.opcode == Opcode.ATTACHMENT:
        contents.attachments.append(place)
    elif place.opcode in _LOOSE:
        last = contents.data[-1] if contents.data else None
        if last and last.opcode == 0 and last.stop == place.start and place.stop - last.start <= _SPAN_BYTES:
            contents.data[-1] = Place(0, last.start, place.stop)
        else:
            contents.data.append(Place(0, place.start, place.stop))


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


def _read(stream: BinaryIO, place: Place) -> bytes:
    stream.seek(place.start)
    return stream.read(place.stop - place.start)


def _content(record: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(record[HEADER:]))


def _crc(stream: BinaryIO, stop: int) -> int:
    stream.seek(0)
    crc = 0
    for start in range(0, stop, _SPAN_BYTES):
        crc = zlib.crc32(stream.read(min(_SPAN_BYTES, stop - start)), crc)
    return crc
