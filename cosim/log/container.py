"""An MCAP file as checked pieces: chunks, metadata, attachments, schemas, channels.

Message indexes are not used. Our chunks hold the messages of one channel after those of another,
and where a channel's end is found by comparing whole columns. Chunks of other tools, with the
channels' messages mixed, are read by the same code, a few messages at a time.
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
from typing import BinaryIO, Final, NamedTuple, TypeVar, final

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from mcap.summary import Summary

from cosim.errors import LogError
from cosim.log.chunks import (
    AHEAD,
    CHUNK_HEAD,
    MOST_BYTES,
    THREADS_AHEAD,
    ChunkHeader,
    Scratch,
    Workers,
    decompress_into,
    read_chunk_header,
)
from cosim.log.files import OwnFile, open_file
from cosim.log.layout import Records
from cosim.log.mcap_records import HEADER, record_header
from cosim.log.places import (
    ATTACHMENT_TIMES,
    MALFORMED,
    MOST_ATTACHED,
    RESCUE,
    Places,
    RecordSpan,
    check_attachment,
    damage_error,
    find_places,
    parsed,
    record_bounds,
)

_MESSAGE_KEY = 11  # bytes: opcode, length, channel id; equal in all messages of a channel
_MESSAGE_HEADER = 22  # bytes of a message's content before its data
_FIRST_WINDOW = 64  # records compared at once to begin with
_WINDOW_GROWTH = 8


class OtherRecord(NamedTuple):
    """A record that is not a message of a known channel."""

    opcode: int
    channel_id: int  # of a message; else 0
    content: bytes


def scan(
    data: bytes | memoryview, dtypes: Mapping[int, np.dtype[np.void]]
) -> Iterator[tuple[int, Records] | OtherRecord]:
    """Yield the records in ``data`` in their order.

    Parameters
    ----------
    data : bytes or memoryview
    dtypes : mapping of channel id to dtype
        Consecutive messages of these channels are yielded together, as channel id and records,
        which share the memory of ``data``; all other records one by one, copied.

    Raises
    ------
    ValueError
        If ``data`` is not a sequence of records, or a message has another size than its channel's
        dtype.
    """
    position = 0
    while position < len(data):
        opcode, stop = record_bounds(data, position)
        content = position + HEADER
        channel_id = 0
        dtype = None
        if opcode == Opcode.MESSAGE:
            if stop - content < _MESSAGE_HEADER:
                raise ValueError(f"a message of {stop - content} bytes is no message")
            channel_id = int.from_bytes(data[content : content + 2], "little")
            dtype = dtypes.get(channel_id)
        if dtype is None:
            yield OtherRecord(opcode, channel_id, bytes(data[content:stop]))
        elif stop - position != dtype.itemsize:
            raise ValueError(
                f"channel {channel_id}: expected messages of {dtype.itemsize} bytes, got "
                f"{stop - position}: re-encoded by another tool"
            )
        else:
            records = _consecutive_messages(data, position, dtype)
            yield channel_id, records
            stop = position + records.nbytes
        position = stop


def _consecutive_messages(
    data: bytes | memoryview, position: int, dtype: np.dtype[np.void]
) -> Records:
    """Return the records from ``position`` on with opcode, length and channel of the first."""
    size = dtype.itemsize
    room = (len(data) - position) // size
    key = data[position : position + _MESSAGE_KEY]
    second = position + size
    second_key = data[second : second + _MESSAGE_KEY]
    # Chunks of other tools mix the channels: a single message is the usual case there, and cheap.
    if room == 1 or second_key != key:
        return np.frombuffer(data, dtype, 1, position)
    records = np.frombuffer(data, dtype, room, position)
    first = records[0]
    count = 2
    window = _FIRST_WINDOW
    while count < room:
        candidates = records[count : count + window]
        same = candidates["opcode"] == first["opcode"]
        same &= candidates["length"] == first["length"]
        same &= candidates["channel_id"] == first["channel_id"]
        if not same.all():
            count += int(same.argmin())
            break
        count += len(candidates)
        window *= _WINDOW_GROWTH
    return records[:count]


_ATTEMPTS: Final = 5  # to open a file that a run writes to
_Declared = TypeVar("_Declared", records.Schema, records.Channel)


@final
class Container:
    """An MCAP file that is opened anew for every pass over it.

    Parameters
    ----------
    path : Path
    own : OwnFile, optional
        The file, where a run of this process has written it: the path may lead to another by now.
    find : callable
        Finds out where the records are, of a damaged file those that are intact.

    Raises
    ------
    LogError
        If the file is not MCAP, truncated or damaged.
    """

    def __init__(
        self,
        path: Path,
        own: OwnFile | None = None,
        *,
        find: Callable[[Path, BinaryIO], Places] = find_places,
    ) -> None:
        self.path = path
        self.own = own
        try:
            self._find_places(find)
        except OSError as error:
            reason = error.strerror or error
            raise LogError(f"{path} cannot be read: {reason}") from error
        chunk_indexes = self.summary.chunk_indexes
        self._chunk_indexes = {chunk.chunk_start_offset: chunk for chunk in chunk_indexes}

    def _find_places(self, find: Callable[[Path, BinaryIO], Places]) -> None:
        """Find out where the pieces stand; again where a run has written to the file meanwhile."""
        with self._stream() as stream:
            for attempt in range(_ATTEMPTS):
                self._identity = _identity(stream)
                try:
                    self.places = find(self.path, stream)
                except (LogError, *MALFORMED) as error:
                    if attempt < _ATTEMPTS - 1 and _identity(stream) != self._identity:
                        continue
                    if isinstance(error, LogError):
                        raise
                    reason = f"the summary cannot be read: {error}"
                    raise LogError(f"{self.path} is damaged: {reason}") from error
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
        memories = cycle(
            [(Scratch(), Scratch()) for _ in range(AHEAD if self._is_compressed else 1)]
        )
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
        self, stream: BufferedReader, span: RecordSpan, memory: tuple[Scratch, Scratch]
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
            data = memory[0].of_size(header.data_stop - header.data_start)
            data = data[: stream.readinto(data)]
        except MALFORMED as error:
            raise self.damage_error(span.start, str(error)) from error
        return partial(self._decompressed, span, header, data, memory[1])

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
        return found or self._declared(records.Schema, Opcode.SCHEMA)

    def channels(self) -> Mapping[int, records.Channel]:
        """Return the channels by id.

        They come from the summary, or else from outside the chunks, or else from inside.

        Raises
        ------
        LogError
            If a channel is damaged.
        """
        found: Mapping[int, records.Channel] = self.summary.channels
        return found or self._declared(records.Channel, Opcode.CHANNEL)

    def _declared(self, kind: type[_Declared], opcode: Opcode) -> dict[int, _Declared]:
        """Return what is declared, by id, outside of chunks, or else inside."""
        spans = self.places.others[opcode]
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
            for span in self.places.others[Opcode.METADATA]:
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
            return {names[span.start]: span for span in self.places.others[Opcode.ATTACHMENT]}
        with self.open() as stream:
            for span in self.places.others[Opcode.ATTACHMENT]:
                stream.seek(span.start + HEADER + ATTACHMENT_TIMES)
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
                reason = f"an attachment cannot be read: {error}; {RESCUE}"
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
    times = (index.message_start_time, index.message_end_time)
    expected = (*times, index.uncompressed_size, index.compression)
    if expected != (header.first_ns, header.last_ns, header.size, header.compression):
        raise ValueError("a chunk differs from its index")


def _identity(stream: BinaryIO) -> tuple[int, int, int]:
    """Return what changes when a file is replaced, its number, or when it is written to."""
    status = os.fstat(stream.fileno())
    return status.st_ino, status.st_size, status.st_mtime_ns
