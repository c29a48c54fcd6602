"""An MCAP file as checked pieces: chunks, metadata, attachments, schemas, channels.

Message indexes are not used.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from functools import cached_property, partial
from io import BufferedReader
from itertools import cycle
from pathlib import Path
from typing import BinaryIO, Final, TypeVar, final

from mcap import records
from mcap.opcode import Opcode
from mcap.summary import Summary

from cosim.errors import LogError
from cosim.log.mcap_file.chunks import CHUNK_HEAD, ChunkHeader, read_chunk_header
from cosim.log.mcap_file.compression import MOST_BYTES, Scratch, decompress_into
from cosim.log.mcap_file.own_file import OwnFile
from cosim.log.mcap_file.paths import open_file
from cosim.log.mcap_file.places import (
    MALFORMED,
    MOST_ATTACHED,
    RecordSpan,
    check_attachment,
    damage_error,
    indexed,
    parsed,
    searched,
    walked,
)
from cosim.log.mcap_file.records import HEADER, record_header
from cosim.log.mcap_file.workers import AHEAD, THREADS_AHEAD, Workers
from cosim.log.reading.scan import OtherRecord, scan

_ATTEMPTS: Final = 5  # to open a file that a run writes to
_ATTACHMENT_TIMES: Final = 16  # bytes: log time, creation time
_Declared = TypeVar("_Declared", records.Schema, records.Channel)


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
    is_damaged : bool
        Take what is intact of a file of cosim, wherever it stands, and refuse nothing.

    Raises
    ------
    LogError
        If the file is not MCAP, truncated or damaged.
    """

    def __init__(self, path: Path, own: OwnFile | None = None, *, is_damaged: bool = False) -> None:
        self.path = path
        self.own = own
        try:
            self._find_places(is_damaged=is_damaged)
        except OSError as error:
            reason = error.strerror or error
            raise LogError(f"{path} cannot be read: {reason}") from error
        chunk_indexes = self.summary.chunk_indexes
        self._chunk_indexes = {chunk.chunk_start_offset: chunk for chunk in chunk_indexes}

    def _find_places(self, *, is_damaged: bool) -> None:
        """Find out where the pieces stand; again where a run has written to the file meanwhile."""
        with self._stream() as stream:
            for attempt in range(_ATTEMPTS):
                self._identity = _identity(stream)
                try:
                    if is_damaged:
                        self.places = searched(self.path)
                    else:
                        self.places = indexed(self.path, stream) or walked(self.path, stream)
                except LogError:
                    if attempt == _ATTEMPTS - 1 or _identity(stream) == self._identity:
                        raise
                except MALFORMED as error:
                    if attempt == _ATTEMPTS - 1 or _identity(stream) == self._identity:
                        raise LogError(
                            f"{self.path} is damaged: the summary cannot be read: {error}"
                        ) from error
                else:
                    # A summary that is replaced while it is read looks as if there was none.
                    if self.places.is_indexed or _identity(stream) == self._identity:
                        return

    @property
    def summary(self) -> Summary:
        """What the summary of the file says; nothing, where it has none."""
        return self.places.summary

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
        if is_other or not (self.places.is_unfinished or identity == self._identity):
            stream.close()
            raise self._changed()
        return stream

    def _changed(self) -> LogError:
        return LogError(f"{self.path} has changed since it was opened; open it again")

    def _stream(self) -> BufferedReader:
        stream = None if self.own is None else self.own.open()
        return open_file(self.path) if stream is None else stream

    def damage_error(self, offset: int, reason: str) -> LogError:
        """Return the error that names the byte at which the file is damaged.

        In a log that is still written, its last rows may have moved by now.
        """
        if self.places.is_unfinished:
            with self._stream() as stream:
                if _identity(stream) != self._identity:
                    return self._changed()
        return damage_error(self.path, offset, reason)

    # --- messages ---

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
        for span in self.places.data:
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

    def _piece(
        self, stream: BufferedReader, span: RecordSpan, memory: _Memory
    ) -> Callable[[], memoryview]:
        """Read a chunk, or messages outside; return what decompresses and checks them."""
        if span.opcode != Opcode.CHUNK:
            messages = memoryview(self._record(stream, span, MOST_BYTES))
            return lambda: messages
        try:
            stream.seek(span.start)
            head = stream.read(min(CHUNK_HEAD, span.size))
            if head[:HEADER] != record_header(span.opcode, span.size - HEADER):
                raise ValueError("no chunk where its index says")
            header = read_chunk_header(head, span.size)
            # Before decompressing: no CRC covers the header, and a wrong size may be a huge one.
            _check_index(header, self._chunk_indexes.get(span.start))
            stream.seek(span.start + header.data_start)
            data = memory.data.of_size(header.data_stop - header.data_start)
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
        for span in self.places.data:
            index = self._chunk_indexes.get(span.start)
            if span.opcode != Opcode.CHUNK:
                data_bytes += span.size
            elif index is None:
                data_bytes += MOST_BYTES
            else:
                data_bytes += min(index.uncompressed_size, MOST_BYTES)
        return data_bytes

    # --- what messages are, and what stands beside them ---

    def schemas(self) -> Mapping[int, records.Schema]:
        """Return the schemas by id; see :meth:`channels`."""
        found: Mapping[int, records.Schema] = self.summary.schemas
        return found or self._declared(records.Schema, Opcode.SCHEMA, self.places.schemas)

    def channels(self) -> Mapping[int, records.Channel]:
        """Return the channels by id.

        They come from the summary, or else from outside the chunks, or else from inside.

        Raises
        ------
        LogError
            If a channel is damaged.
        """
        found: Mapping[int, records.Channel] = self.summary.channels
        return found or self._declared(records.Channel, Opcode.CHANNEL, self.places.channels)

    def _declared(
        self, kind: type[_Declared], opcode: Opcode, spans: Collection[RecordSpan]
    ) -> dict[int, _Declared]:
        """Return what is declared, by id, outside of chunks, or else inside."""
        contents = []
        declared: dict[int, _Declared] = {}
        try:
            with self.open() as stream:
                contents = [self._record(stream, span, MOST_BYTES)[HEADER:] for span in spans]
            if not spans:
                for block in self.blocks():
                    for record in scan(block, {}):
                        if isinstance(record, OtherRecord) and record.opcode == opcode:
                            contents.append(record.content)
            for content in contents:
                found = parsed(kind, content)
                declared.setdefault(found.id, found)
        except MALFORMED as error:
            name = kind.__name__.lower()
            raise LogError(f"{self.path} is damaged: a {name} cannot be read: {error}") from error
        return declared

    def metadata(self) -> Iterator[records.Metadata]:
        """Yield the metadata records.

        Raises
        ------
        LogError
            If one is damaged.
        """
        with self.open() as stream:
            for span in self.places.metadata:
                try:
                    yield parsed(records.Metadata, self._checked(stream, span, MOST_BYTES)[HEADER:])
                except MALFORMED as error:
                    reason = f"a metadata record cannot be read: {error}"
                    raise self.damage_error(span.start, reason) from error

    def attachments(self) -> dict[str, RecordSpan]:
        """Return the attachments' names and where they are, without their content."""
        spans = {}
        if self.places.is_indexed:
            names = {index.offset: index.name for index in self.summary.attachment_indexes}
            return {names[span.start]: span for span in self.places.attachments}
        with self.open() as stream:
            for span in self.places.attachments:
                stream.seek(span.start + HEADER + _ATTACHMENT_TIMES)
                length = int.from_bytes(stream.read(4), "little")
                name = stream.read(min(length, span.size))  # no more, if the length is damaged
                spans[name.decode(errors="replace")] = span
        return spans

    def attachment(self, span: RecordSpan) -> records.Attachment:
        """Return an attachment, checked by its CRC.

        Raises
        ------
        LogError
            If it is damaged.
        """
        with self.open() as stream:
            try:
                record = self._checked(stream, span, MOST_ATTACHED)
                check_attachment(record)
                found: records.Attachment = parsed(records.Attachment, record[HEADER:])
            except MALFORMED as error:
                reason = f"an attachment cannot be read: {error}"
                raise self.damage_error(span.start, reason) from error
        return found

    def _checked(self, stream: BinaryIO, span: RecordSpan, most: int) -> bytes:
        """Read a record, and check that it is what the summary says of it."""
        record = self._record(stream, span, most)
        expected = record_header(span.opcode, span.size - HEADER)
        if record[:HEADER] != expected or len(record) != span.size:
            raise ValueError("the record differs from its index")
        return record

    def _record(self, stream: BinaryIO, span: RecordSpan, most: int) -> bytes:
        """Read a record of at most ``most`` bytes: a sparse file may have any length."""
        if span.size > most:
            reason = f"a record of {span.size} bytes exceeds the limit of {most}"
            raise self.damage_error(span.start, reason)
        stream.seek(span.start)
        return stream.read(span.size)


def _check_index(header: ChunkHeader, index: records.ChunkIndex | None) -> None:
    """Check that a chunk is what its index says; None: it has none.

    Raises
    ------
    ValueError
        If they differ.
    """
    if index is None:
        return
    differs = (
        index.message_start_time != header.first_ns
        or index.message_end_time != header.last_ns
        or index.uncompressed_size != header.size
        or index.compression != header.compression
    )
    if differs:
        raise ValueError("a chunk differs from its index")


def _identity(stream: BinaryIO) -> tuple[int, int, int]:
    """Return what changes when a file is replaced, its number, or when it is written to."""
    status = os.fstat(stream.fileno())
    return status.st_ino, status.st_size, status.st_mtime_ns
