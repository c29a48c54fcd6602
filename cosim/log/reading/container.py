"""An MCAP file as checked pieces: chunks, metadata, attachments, channels.

Where a log's own summary says where they are, only that is read; else the file is walked. Message
indexes are not used.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from functools import cached_property, partial
from io import BufferedReader, BytesIO
from itertools import cycle
from pathlib import Path
from typing import BinaryIO, final

from isal import isal_zlib
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.summary import Summary

from cosim.errors import LogError
from cosim.log.mcap_file.compression import MOST_BYTES, Scratch, decompress_into
from cosim.log.mcap_file.index import parse_summary, read_index
from cosim.log.mcap_file.own_file import OwnFile
from cosim.log.mcap_file.paths import open_file
from cosim.log.mcap_file.records import FOOTER_SIZE, HEADER, record_header
from cosim.log.mcap_file.walk import RecordSpan, damage_error, walk
from cosim.log.mcap_file.workers import AHEAD, THREADS_AHEAD, Workers
from cosim.log.reading.chunk_header import ChunkHeader, read_chunk_header
from cosim.log.reading.scan import OtherRecord, scan

# What parsing bytes from outside may raise.
MALFORMED = (McapError, ValueError, KeyError, TypeError, OverflowError, struct.error)

_READ_BYTES = 2**22
MOST_ATTACHED = 2**28  # bytes of an attachment
_ATTEMPTS = 5  # to open a file that a run writes to
_ATTACHMENT_TIMES = 16  # bytes: log time, creation time


@final
class _Memory:
    """What one chunk at a time is read and decompressed to."""

    def __init__(self) -> None:
        self.data = Scratch()
        self.records = Scratch()


@final
class Container:
    """An MCAP file that is opened anew for every pass over it.

    Parameters
    ----------
    path : Path
    own : OwnFile, optional
        The file, where a run of this process has written it: the path may lead to another by now.

    Attributes
    ----------
    is_unfinished : bool
        Whether it is still written, or its writer was killed.
    is_indexed : bool
        Whether cosim wrote it, so that its summary is whole, and each channel in order of time.

    Raises
    ------
    LogError
        If the file is not MCAP, truncated or damaged.
    """

    def __init__(self, path: Path, own: OwnFile | None = None) -> None:
        self.path = path
        self.own = own
        self.is_unfinished = False
        self.is_indexed = False
        try:
            self._index_steady()
        except OSError as error:
            reason = error.strerror or error
            raise LogError(f"{path} cannot be read: {reason}") from error

    def _index_steady(self) -> None:
        """Find out where the pieces stand; again where a run has written to the file meanwhile."""
        with self._stream() as stream:
            for attempt in range(_ATTEMPTS):
                self._identity = _identity(stream)
                try:
                    self._index(stream)
                except LogError:
                    if attempt == _ATTEMPTS - 1 or _identity(stream) == self._identity:
                        raise
                else:
                    # A summary that is replaced while it is read looks as if there was none.
                    if self.is_indexed or _identity(stream) == self._identity:
                        return

    def _index(self, stream: BinaryIO) -> None:
        """Find out where the pieces of the file stand."""
        try:
            index = read_index(self.path, stream)
        except MALFORMED as error:
            raise LogError(
                f"{self.path} is damaged: the summary cannot be read: {error}"
            ) from error
        if index is None:
            self.contents = walk(self.path, stream)
            self.summary = self._read_summary(stream)
        else:
            self.summary = index.summary
            self.contents = index.contents
        self.is_indexed = index is not None
        self.is_unfinished = index is not None and index.is_unfinished
        chunk_indexes = self.summary.chunk_indexes
        self._chunk_indexes = {chunk.chunk_start_offset: chunk for chunk in chunk_indexes}
        self._check_summary()
        if index is None:
            self._check_data(stream)

    def open(self) -> BufferedReader:
        """Open the file for a pass.

        Raises
        ------
        LogError
            If it cannot be read, or is not the file it was.
        """
        stream = self._stream()
        identity = _identity(stream)
        is_other = identity[0] != self._identity[0]
        # A log that is still written keeps what was in it.
        if is_other or not (self.is_unfinished or identity == self._identity):
            stream.close()
            raise self._changed()
        return stream

    def _changed(self) -> LogError:
        return LogError(f"{self.path} has changed since it was opened; open it again")

    def _stream(self) -> BufferedReader:
        stream = None if self.own is None else self.own.open()
        return open_file(self.path) if stream is None else stream

    def blocks(
        self,
        channel_ids: Collection[int] | None = None,
        *,
        first_ns: int | None = None,
        last_ns: int | None = None,
    ) -> Iterator[memoryview]:
        """Yield the message records chunk by chunk, decompressed and checked.

        Each is overwritten when the next one is asked for.

        Parameters
        ----------
        channel_ids : collection of int, optional
            Chunks that have no messages of these channels are not read; nor are those before
            ``first_ns`` or behind ``last_ns``.
        first_ns, last_ns : int, optional
            [ns]

        Raises
        ------
        LogError
            If a chunk is damaged or too large.
        """
        wanted = []
        for span in self.contents.data:
            if self._may_have(span, channel_ids, first_ns, last_ns):
                wanted.append(span)
        memories = cycle([_Memory() for _ in range(AHEAD if self._is_compressed else 1)])
        with self.open() as stream, closing(Workers(THREADS_AHEAD)) as workers:
            pieces = (self._piece(stream, span, next(memories)) for span in wanted)
            if self._is_compressed:
                yield from workers.ahead(pieces)
            else:
                for piece in pieces:
                    yield piece()

    @property
    def _is_compressed(self) -> bool:
        """Whether some chunks are compressed, as far as their indexes say."""
        chunks = self.summary.chunk_indexes
        return not chunks or any(index.compression for index in chunks)

    def _may_have(
        self,
        span: RecordSpan,
        channel_ids: Collection[int] | None,
        first_ns: int | None,
        last_ns: int | None,
    ) -> bool:
        """Return whether a chunk may have messages of some channels and time."""
        index = self._chunk_indexes.get(span.start)
        if index is None:
            return True
        if first_ns is not None and index.message_end_time < first_ns:
            return False
        if last_ns is not None and index.message_start_time > last_ns:
            return False
        in_chunk = index.message_index_offsets
        if channel_ids is None or not in_chunk:  # an index may leave out what the chunk has
            return True
        return not in_chunk.keys().isdisjoint(channel_ids)

    def shared_with(self, channel_ids: Collection[int]) -> set[int]:
        """Return the channels that are in half of the chunks of some channels or more."""
        counts: Counter[int] = Counter()
        chunks = 0
        for index in self.summary.chunk_indexes:
            in_chunk = index.message_index_offsets.keys()
            if in_chunk and in_chunk.isdisjoint(channel_ids):
                continue
            chunks += 1
            counts.update(in_chunk or self.summary.channels.keys())
        return {channel_id for channel_id, count in counts.items() if 2 * count >= chunks}

    def channels(self) -> Mapping[int, records.Channel]:
        """Return the channels by id.

        They come from the summary, or else from outside the chunks, or else from inside.

        Raises
        ------
        LogError
            If a channel is damaged.
        """
        in_summary: Mapping[int, records.Channel] = self.summary.channels
        if in_summary:
            return in_summary
        contents = self._channels_outside_chunks() or self._channels_inside_chunks()
        channels = {}
        for content in contents:
            try:
                channel = records.Channel.read(ReadDataStream(BytesIO(content)))
            except MALFORMED as error:
                raise LogError(
                    f"{self.path} is damaged: a channel cannot be read: {error}"
                ) from error
            channels[channel.id] = channel
        return channels

    def _channels_outside_chunks(self) -> list[bytes]:
        with self.open() as stream:
            return [self._record(stream, span)[HEADER:] for span in self.contents.channels]

    def _channels_inside_chunks(self) -> list[bytes]:
        contents = []
        try:
            for block in self.blocks():
                for record in scan(block, {}):
                    if isinstance(record, OtherRecord) and record.opcode == Opcode.CHANNEL:
                        contents.append(record.content)
        except ValueError as error:
            raise LogError(f"{self.path} is damaged: {error}") from error
        return contents

    def expected_messages(self, channel_id: int, message_bytes: int) -> int:
        """Return the largest number of messages that a channel may have.

        As many as the summary counts, but no more than the chunks can hold: the summary of a
        damaged file may ask for any amount of memory.
        """
        largest = self._data_bytes // message_bytes
        statistics = self.summary.statistics
        if statistics is None:
            return largest
        count: int = statistics.channel_message_counts.get(channel_id, 0)
        return min(count, largest)

    @cached_property
    def _data_bytes(self) -> int:
        """What the chunks can hold, and the messages outside them."""
        data_bytes = 0
        for span in self.contents.data:
            index = self._chunk_indexes.get(span.start)
            if span.opcode != Opcode.CHUNK:
                data_bytes += span.size
            elif index is None:
                data_bytes += MOST_BYTES
            else:
                data_bytes += min(index.uncompressed_size, MOST_BYTES)
        return data_bytes

    def metadata(self) -> Iterator[records.Metadata]:
        """Yield the metadata records.

        Raises
        ------
        LogError
            If one is damaged.
        """
        with self.open() as stream:
            for span in self.contents.metadata:
                try:
                    record = self._record(stream, span)
                    _check_header(record, span)
                    yield records.Metadata.read(_content(record))
                except MALFORMED as error:
                    raise self.damage_error(
                        span.start, f"a metadata record cannot be read: {error}"
                    ) from error

    def attachments(self) -> dict[str, RecordSpan]:
        """Return the attachments' names and where they are, without their content."""
        spans = {}
        if self.is_indexed:
            names = {index.offset: index.name for index in self.summary.attachment_indexes}
            return {names[span.start]: span for span in self.contents.attachments}
        with self.open() as stream:
            for span in self.contents.attachments:
                stream.seek(span.start + HEADER + _ATTACHMENT_TIMES)
                length = int.from_bytes(stream.read(4), "little")
                name = stream.read(min(length, span.size))  # no more, if the length is damaged
                spans[name.decode(errors="replace")] = span
        return spans

    def attachment(self, span: RecordSpan) -> bytes:
        """Return the content of an attachment, checked by its CRC.

        Raises
        ------
        LogError
            If it is damaged.
        """
        with self.open() as stream:
            record = self._record(stream, span, MOST_ATTACHED)
        checked = record[HEADER:-4]
        crc = int.from_bytes(record[-4:], "little")
        try:
            _check_header(record, span)
            if crc and isal_zlib.crc32(checked) != crc:
                reason = "the CRC of an attachment does not match its content"
                raise self.damage_error(span.start, reason)
            return bytes(records.Attachment.read(_content(record)).data)
        except MALFORMED as error:
            raise self.damage_error(span.start, f"an attachment cannot be read: {error}") from error

    def damage_error(self, offset: int, reason: str) -> LogError:
        """Return the error that names the byte at which the file is damaged.

        In a log that is still written, its last rows may have moved by now.
        """
        if self.is_unfinished:
            with self._stream() as stream:
                if _identity(stream) != self._identity:
                    return self._changed()
        return damage_error(self.path, offset, reason)

    def _record(self, stream: BinaryIO, span: RecordSpan, most: int = MOST_BYTES) -> bytes:
        """Read a record of at most ``most`` bytes: a sparse file may have any length."""
        if span.size > most:
            reason = f"a record of {span.size} bytes exceeds the limit of {most}"
            raise self.damage_error(span.start, reason)
        stream.seek(span.start)
        return stream.read(span.size)

    def _piece(
        self, stream: BufferedReader, span: RecordSpan, memory: _Memory
    ) -> Callable[[], memoryview]:
        """Read a chunk, or messages outside; return what decompresses and checks them."""
        if span.opcode != Opcode.CHUNK:
            messages = memoryview(self._record(stream, span))
            return lambda: messages
        try:
            header = read_chunk_header(stream, span)
            # Before decompressing: no CRC covers the header, and a wrong size may be a huge one.
            header.check(self._chunk_indexes.get(span.start))
            data = memory.data.of_size(header.data_length)
            data = data[: stream.readinto(data)]
        except MALFORMED as error:
            raise self.damage_error(span.start, str(error)) from error
        return partial(self._decompressed, span, header, data, memory.records)

    def _decompressed(
        self, span: RecordSpan, header: ChunkHeader, data: memoryview, scratch: Scratch
    ) -> memoryview:
        try:
            return decompress_into(
                scratch, data, header.compression, size=header.size, crc=header.crc
            )
        except MALFORMED as error:
            raise self.damage_error(span.start, str(error)) from error

    def _read_summary(self, stream: BinaryIO) -> Summary:
        """Read the summary; an empty one if there is none."""
        footer_start = self.contents.footer
        footer_span = RecordSpan(Opcode.FOOTER, footer_start, footer_start + FOOTER_SIZE)
        try:
            footer = records.Footer.read(_content(self._record(stream, footer_span)))
            start = footer.summary_start
            if not start:
                return Summary()
            # The CRC covers the summary and the footer up to the CRC itself, its last four bytes.
            crc_position = footer_span.stop - 4
            if not self.contents.data_end < start < footer_start:
                raise ValueError(f"invalid start: byte {start}")
            if footer.summary_crc and _crc(stream, start, crc_position) != footer.summary_crc:
                raise ValueError("the CRC of the summary does not match its content")
            section = [
                self._record(stream, span) for span in self.contents.summary if span.start >= start
            ]
            return parse_summary(b"".join(section))
        except MALFORMED as error:
            raise self.damage_error(footer_start, f"the summary cannot be read: {error}") from error

    def _check_summary(self) -> None:
        """Compare the pieces of the file with its summary."""
        contents = self.contents
        chunks = contents.chunks
        statistics = self.summary.statistics
        if statistics is not None:
            counts = (len(chunks), len(contents.metadata), len(contents.attachments))
            expected = (
                statistics.chunk_count,
                statistics.metadata_count,
                statistics.attachment_count,
            )
            if counts != expected:
                raise LogError(
                    f"{self.path} is damaged: expected {expected} chunks, metadata records and "
                    f"attachments, as in its summary, got {counts}"
                )
        chunk_starts = {span.start for span in chunks}
        without_chunk = self._chunk_indexes.keys() - chunk_starts
        if without_chunk:
            raise self.damage_error(min(without_chunk), "no chunk where its index says")

    def _check_data(self, stream: BinaryIO) -> None:
        """Check messages outside chunks, which only the CRC of all data covers."""
        contents = self.contents
        is_chunked = len(contents.chunks) == len(contents.data)
        if is_chunked or not contents.data_crc:
            return
        crc = _crc(stream, 0, contents.data_end)
        if crc != contents.data_crc:
            raise self.damage_error(contents.data_end, "the CRC of the data does not match")


def _check_header(record: bytes, span: RecordSpan) -> None:
    """Check that a record is what the summary says of it.

    Raises
    ------
    ValueError
        If it is not.
    """
    expected = record_header(span.opcode, span.size - HEADER)
    if record[:HEADER] != expected or len(record) != span.size:
        raise ValueError("the record differs from its index")


def _identity(stream: BinaryIO) -> tuple[int, int, int]:
    """Return what changes when a file is replaced, its number, or when it is written to."""
    status = os.fstat(stream.fileno())
    return status.st_ino, status.st_size, status.st_mtime_ns


def _content(record: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(record[HEADER:]))


def _crc(stream: BinaryIO, start: int, stop: int) -> int:
    """Compute the CRC-32 of the bytes ``start`` to ``stop``, piece by piece."""
    stream.seek(start)
    crc = 0
    for position in range(start, stop, _READ_BYTES):
        piece = stream.read(min(_READ_BYTES, stop - position))
        crc = isal_zlib.crc32(piece, crc)
    return crc
