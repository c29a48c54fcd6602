"""The log of a run as it grows: contents become chunks of one file, or of several in turn.

Each file is whole after every content. A next file begins before the first rows that belong there:
so each has rows, and a run that ends within the limit leaves an ordinary log. Its name is taken
when the file before is closed: whenever the run is killed, all files but the last are closed, and
that one is whole.

Rows become message records by numpy, a flush at a time. A file that was a further one of a log
before is not removed for its name: ``run.part2.mcap`` may be anybody's. It has to say itself that
it is a part of a log, or have no steps to lose.
"""

from __future__ import annotations

import errno
import hashlib
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias, final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cosim.core.recorders import EndOfRun
from cosim.core.recording import Plan
from cosim.core.signals import Layout
from cosim.errors import CosimError, LogError, flag
from cosim.instants import Grid
from cosim.log.background import RunContent, WaitingMessage, joined
from cosim.log.chunks import (
    CHUNK_BYTES,
    Compression,
    MessageBatch,
    Workers,
    one_chunk,
    separate_chunks,
)
from cosim.log.files import (
    Rotation,
    UnfinishedLog,
    check_not_written,
    further_parts,
    part_path,
    refused,
)
from cosim.log.layout import Part, Records, blank_records, fill_values, record_dtype, signals_json
from cosim.log.live_file import LiveFile
from cosim.log.mcap_records import HEADER, FileHead, RecordGroup, joined_groups
from cosim.log.metadata import combine_hashes, hash_input
from cosim.log.preamble import (
    PART_REASON,
    PARTIAL,
    PARTIAL_STATUS,
    ResultItems,
    end_group,
    result_record,
    span_text,
)
from cosim.log.reader import open_log

_CHANNEL_BYTES = 2**21  # of a channel in a flush, as long as there are few
_LARGEST_FLUSH = 2**23  # bytes of records
_BUFFER_BYTES = 2**22  # of rows, where long periods leave few of them in a chunk
_DOUBLE_BYTES = 8
_SEQUENCE_MASK = 0xFFFFFFFF  # MCAP's sequence has 32 bits

_CHUNK: Final = 256  # bytes of a chunk beside its records, with its entry in the summary; 194
_CHUNK_CHANNEL: Final = 25  # bytes a chunk has for each channel: 15 in its index, 10 in the summary
_PADDING: Final = 16  # bytes before the header of a chunk that would cross a page; 9
_INDEX_ENTRY: Final = 16  # bytes that the index has for each message
_EXPANSION: Final = 255  # a compression makes a chunk longer by one part of this, at most
_END: Final = 8192  # bytes of the result and the records that close the file
_VALUE: Final = 64  # bytes of a value in the result, beside its name
_ESCAPED: Final = 6  # bytes of a character of a name in JSON

_MESSAGE = struct.Struct("<BQHIQQ")  # a message record up to its data

RowSelection: TypeAlias = slice | NDArray[np.intp]


def _capacity(layout: Layout, channels: int, row_bytes: float) -> int:
    """Return the number of rows of a flush, or of the buffer where periods are long."""
    flush_bytes = min(max(channels * _CHANNEL_BYTES, CHUNK_BYTES), _LARGEST_FLUSH)
    rows_in_flush = flush_bytes // max(row_bytes, 1.0)
    rows_in_buffer = max(_BUFFER_BYTES, flush_bytes) // (_DOUBLE_BYTES * max(layout.width, 1))
    return max(int(min(rows_in_flush, rows_in_buffer)), 1)


def _message_batch(messages: Sequence[WaitingMessage], grid: Grid) -> MessageBatch:
    """Return the records of messages of one channel, with the step's number as their sequence."""
    records = []
    for channel_id, time_ns, data in messages:
        length = _MESSAGE.size - HEADER + len(data)
        sequence = grid.number(time_ns) & _SEQUENCE_MASK
        header = _MESSAGE.pack(Opcode.MESSAGE, length, channel_id, sequence, time_ns, time_ns)
        records.append(header + data)
    times = np.array([message.time_ns for message in messages], dtype=np.int64)
    offsets = np.cumsum([0, *map(len, records[:-1])], dtype=np.int64)
    return MessageBatch(messages[0].channel_id, memoryview(b"".join(records)), times, offsets)


_FEW_CHANNEL_BYTES: Final = 2**14  # with less a channel shares the chunk with all others
_PIECES: Final = 8  # of a file, before compression: it becomes no larger by more than one


@final
class LogStore:
    """Writes the contents of a run to the files of its log.

    Parameters
    ----------
    place : UnfinishedLog
        Of the first file, which is created.
    plan : Plan
    head : FileHead
        What every file begins with.
    parts : mapping of channel id to Part
    compression, sync, rotation
        See :class:`cosim.log.McapRecorder`.

    Attributes
    ----------
    place, last_place : UnfinishedLog
        Of the file that is written; of the last one that is at its path, or will be.
    capacity : int
        Rows of a flush.
    steps, end_ns : int
        Of the last row.

    Raises
    ------
    LogError
        If the file cannot be created.
    UsageError
        If a file of the rotation has no room for rows.
    OSError
        From every method that writes; what was written before stays whole.
    """

    def __init__(
        self,
        place: UnfinishedLog,
        plan: Plan,
        head: FileHead,
        parts: Mapping[int, Part],
        *,
        compression: Compression,
        sync: bool = False,
        rotation: Rotation | None = None,
    ) -> None:
        self._first_place = place
        self.place = place
        self.last_place = place
        self._head = head
        self._plan = plan
        self._compression: Compression = compression
        self._sync = sync
        self._rotation = rotation
        if rotation is not None:
            rotation.check(plan.layout.channels, plan.step_ns, len(head.data))
        self._parts = parts
        self._blank: dict[int, Records] = {}  # by channel id, filled again every time
        sizes = [record_dtype(own.size).itemsize / own.channel.period for own in parts.values()]
        self._row_bytes = sum(sizes)  # of the records of a row, on average
        self.capacity = _capacity(plan.layout, len(parts), self._row_bytes)
        # Of the rows of the run by component; of a file behind the first one those of its own, too.
        self._hashes: tuple[dict[str, hashlib._Hash], ...] = (self._new_hashes(),)
        self._number = 1  # of the file
        self._first_ns: int | None = None  # of the rows of the file
        self._next_ns: int | None = None  # at which rows belong to a next file
        self._start_ns = 0
        self._tail: list[RunContent] = []  # what the file has in its tail
        self._tail_bytes = 0.0
        self.steps = 0
        self.end_ns = 0
        self._file = self._new_file(place)
        self._workers = Workers()

    def _new_file(self, place: UnfinishedLog) -> LiveFile:
        stream = place.create()
        with refused(f"{place.path} cannot be written"):
            return LiveFile(stream, self._head.data, self._head.summary(), sync=self._sync)

    def size_bound(self, steps: int) -> int:
        """Return how large the log of a run can become, without its messages [bytes].

        It is an upper bound for every compression, however often the file is flushed.
        """
        parts = self._parts.values()
        rows = steps + 1
        records = 0
        for part in parts:
            messages = steps // part.channel.period + 1
            records += messages * (record_dtype(part.size).itemsize + _INDEX_ENTRY)
        values = 0  # the last ones, in the result
        for channel in self._plan.layout.channels:
            for signal in channel.signals:
                name = len(channel.name) + len(signal.name)
                values += signal.size * (_VALUE + _ESCAPED * name)
        # A flush of few rows is joined by others until they make half a chunk, or by a full one.
        flushes = 2 * (rows // self.capacity + records // (CHUNK_BYTES // 2)) + 2
        overhead = flushes * (_PADDING + len(parts) * (_CHUNK + _CHUNK_CHANNEL))
        overhead += records // CHUNK_BYTES * _CHUNK
        # Twice the head: the summary repeats its schemas and channels.
        head = 2 * len(self._head.data)
        return records + records // _EXPANSION + overhead + head + values + _END

    def begin(self, start_ns: int) -> None:
        """Take the time of the first row, and publish the first file."""
        self._start_ns = start_ns
        if self._rotation is not None and self._rotation.span_ns is not None:
            self._next_ns = start_ns + self._rotation.span_ns
        self.publish()

    def publish(self) -> None:
        """Rename the first file to its path, the first time this is called.

        Raises
        ------
        LogError
            If that cannot be done, or a file that would be replaced or removed is written, or is
            no part of a log.
        """
        place = self._first_place
        if place.published:
            return
        replaced = replaced_parts(place.path) if place.force else []
        place.publish()
        for path in replaced:
            with suppress(OSError):  # the next file of this log cannot get its name then
                path.unlink()

    def add(self, content: RunContent) -> None:
        """Write a flush; its memory may be used again afterwards."""
        for part in self._by_file(content):
            self.place.check()
            self._add(part)

    def finish(self, last: RunContent | None, end: EndOfRun, values: Mapping[str, Any]) -> None:
        """Write the last flush, the result and the end of the file."""
        if last is not None and not last.is_empty:
            for part in self._by_file(last):  # also where the file is no longer at its path
                self._add(part)
        self.close(end, values)

    def close(self, end: EndOfRun, values: Mapping[str, Any]) -> None:
        """Write the result and the end of the file."""
        self._keep_tail()
        whole = self._end(end.status, end.reason, self._hashes[0])
        group = end_group(whole, values)
        if self._number > 1:
            of_part = end_group(self._end_of_part(), values)
            group = joined_groups([result_record(PARTIAL, whole), of_part])
        self._file.commit(group)
        self._file.close()
        self._workers.close()

    def fail(self, reason: str, values: Mapping[str, Any]) -> None:
        """Close the file with what it holds; where even that fails it is left as it is, whole."""
        end = EndOfRun("failed", f"the log could not be written further: {reason}")
        try:
            self.close(end, values)
        except OSError:
            self._file.abandon()
            self._workers.close()
        self.place.discard()  # a next file that has not got its name

    def _by_file(self, content: RunContent) -> Iterator[RunContent]:
        """Yield a content as it belongs to files; begin a next one before what belongs there."""
        rotation = self._rotation
        if rotation is None:
            yield content
        elif rotation.span_ns is not None:
            assert self._next_ns is not None
            while len(content.steps) and content.time_ns[-1] >= self._next_ns:
                early, content = content.split(self._next_ns)
                if not early.is_empty:
                    yield early
                if self._first_ns is not None:
                    self._go_on()
                self._next_ns += rotation.span_ns
            yield content
        elif rotation.size is not None:
            rows = max(int(rotation.size / _PIECES / max(self._row_bytes, 1.0)), 1)
            for piece in content.pieces(rows):
                is_large = self._first_ns is not None and self._file.size >= rotation.size
                if is_large and len(piece.steps):
                    self._go_on()
                yield piece

    def _go_on(self) -> None:
        """Close the file as a part of the log, and begin the next one, under its path at once."""
        self.place.check()
        path = part_path(self._first_place.path, self._number + 1)
        following = UnfinishedLog(path, force=False)
        try:
            file = self._new_file(following)
            self._keep_tail()
            self._file.commit(end_group(self._end_of_part(), {}))
            self._file.close()
        except (LogError, OSError) as error:
            following.discard()
            raise _as_os_error(error) from error
        self._file = file
        self.place = following
        self._hashes = (self._hashes[0], self._new_hashes())
        self._number += 1
        self._first_ns = None
        try:
            following.publish()
        except LogError as error:
            raise _as_os_error(error) from error
        self.last_place = following

    def _end_of_part(self) -> ResultItems:
        """Return what is recorded of the end of the file as one of several."""
        where = "without rows" if self._first_ns is None else span_text(self._first_ns, self.end_ns)
        reason = f"{PART_REASON}{self._number} of its log, {where}"
        return self._end(PARTIAL_STATUS, reason, self._hashes[-1])

    def _end(self, status: str, reason: str, hashes: Mapping[str, hashlib._Hash]) -> ResultItems:
        components = []
        for channel in self._plan.layout.channels:
            declaration = signals_json(channel.interface)
            components.append((channel.name, declaration, hashes[channel.name].hexdigest()))
        return {
            "status": status,
            "reason": reason,
            "steps": self.steps,
            "end_ns": self.end_ns,
            "content_hash": combine_hashes(components),
        }

    def _add(self, content: RunContent) -> None:
        """Write a content to the file.

        One that is large makes chunks that stay. Small ones are gathered, and written again with
        each other, until they are large together.
        """
        size = len(content.steps) * self._row_bytes  # of its records, about
        size += sum(len(message.data) for message in content.messages)
        is_large = size >= CHUNK_BYTES / 2
        if is_large:
            self._keep_tail()
        else:
            content = joined([content])  # a copy, to be kept
        is_full = is_large or self._tail_bytes + size >= CHUNK_BYTES
        whole = joined([*self._tail, content]) if self._tail else content
        hashing = self._workers.start(partial(self._hashed, content)) if is_full else None
        try:
            group = self._group(whole, is_separate=is_full)
            if group.entries:  # no component may have a row in the steps of a flush
                self._file.replace_tail(group)
        finally:
            hashes = self._hashed(content) if hashing is None else hashing.result()
        # Before anything else may fail: the file has these rows now.
        self._hashes = hashes
        if len(content.steps):
            if self._first_ns is None:
                self._first_ns = int(content.time_ns[0])
            self.steps = int(content.steps[-1])
            self.end_ns = int(content.time_ns[-1])
        if is_full:
            self._keep_tail()
        else:
            self._tail.append(content)
            self._tail_bytes += size

    def _keep_tail(self) -> None:
        self._file.keep_tail()
        self._tail = []
        self._tail_bytes = 0.0

    def _group(self, content: RunContent, *, is_separate: bool) -> RecordGroup:
        """Return a content as chunks, where asked for with one for every channel.

        Without a compression they may share the store's memory: valid until the next call.
        """
        batches = self._batches(content)
        if not batches:
            return RecordGroup((), (), 0)
        if is_separate and len(self._parts) * _FEW_CHANNEL_BYTES <= CHUNK_BYTES:
            return separate_chunks(batches, self._compression, self._workers)
        return one_chunk(batches, self._compression)

    def _batches(self, content: RunContent) -> list[MessageBatch]:
        """Return the message records, one batch per channel that has any."""
        selected = self._selected(content)
        batches = []
        for channel_id, part in self._parts.items():
            rows = selected[part.channel.period]
            batch = self._row_batch(channel_id, part, content, rows)
            if len(batch.time_ns):
                batches.append(batch)
        messages: dict[int, list[WaitingMessage]] = {}
        for message in content.messages:
            messages.setdefault(message.channel_id, []).append(message)
        grid = Grid(self._start_ns, self._plan.step_ns)
        return batches + [_message_batch(waiting, grid) for waiting in messages.values()]

    def _row_batch(
        self, channel_id: int, part: Part, rows: RunContent, selected: RowSelection
    ) -> MessageBatch:
        time_ns = rows.time_ns[selected]
        count = len(time_ns)
        blank = self._blank.get(channel_id)
        if blank is None or len(blank) < count:
            blank = blank_records(channel_id, part.size, count)
            self._blank[channel_id] = blank
        records = blank[:count]
        records["sequence"] = rows.steps[selected].astype(np.uint32)
        unsigned_ns = time_ns.view(np.uint64)  # else numpy would convert each
        records["log_time"] = unsigned_ns
        records["publish_time"] = unsigned_ns
        start = part.channel.start + part.columns.start
        fill_values(records, rows.values[selected, start : start + part.size])
        offsets = np.arange(0, records.nbytes, records.itemsize)
        return MessageBatch(channel_id, records.view(np.uint8).data, time_ns, offsets)

    def _selected(self, rows: RunContent) -> dict[int, RowSelection]:
        """Return for each period the rows that components of that period record."""
        selected: dict[int, RowSelection] = {}
        for period in {channel.period for channel in self._plan.layout.channels}:
            every = slice(len(rows.steps))
            selected[period] = every if period == 1 else np.flatnonzero(rows.steps % period == 0)
        return selected

    def _new_hashes(self) -> dict[str, hashlib._Hash]:
        return {channel.name: hashlib.sha256() for channel in self._plan.layout.channels}

    def _hashed(self, rows: RunContent) -> tuple[dict[str, hashlib._Hash], ...]:
        """Return the hashes with further rows."""
        result = tuple(
            {name: digest.copy() for name, digest in hashes.items()} for hashes in self._hashes
        )
        selected = self._selected(rows)
        for channel in self._plan.layout.channels:
            own = selected[channel.period]
            data = hash_input(rows.time_ns[own], rows.values[own, channel.columns])
            for hashes in result:
                hashes[channel.name].update(data)
        return result


def _as_os_error(error: LogError | OSError) -> OSError:
    """Return what the run is told of, as of any write that fails."""
    return error if isinstance(error, OSError) else OSError(errno.EIO, str(error))


def replaced_parts(first: Path) -> list[Path]:
    """Return the further files of the log at a path, which a new log there replaces.

    Raises
    ------
    LogError
        If a file is called as one of them, and does not say that it is, or a run writes to it.
    """
    paths = further_parts(first)
    for path in paths:
        check_not_written(path)
        if not _is_later_part(path):
            raise LogError(
                f"{path} is named like a part of the log {first}, but is not one, so it is not "
                "replaced; move it, or choose another path"
            )
    return paths


def check_place(place: UnfinishedLog) -> None:
    """Check that a log can be written to a place, and that no parts of another one stay beside it.

    Raises
    ------
    LogError
        If not; see :meth:`UnfinishedLog.check_free`.
    """
    place.check_free()
    if place.numbered:
        return
    parts = replaced_parts(place.path) if place.force else further_parts(place.path)
    if parts and not place.force:
        raise LogError(
            f"{parts[0]} exists, named like a part of an earlier log {place.path}; choose another "
            f"path, or {flag('force')} to replace that log with its parts"
        )


def _is_later_part(path: Path) -> bool:
    """Return whether a file says that it is a later part of a log, or has no steps."""
    with suppress(CosimError):
        log = open_log(path)
        if log.status == "unfinished":  # its run was killed, and did not come to say it
            return log.begins_late or not log.steps
        return log.status == PARTIAL_STATUS and log.reason.startswith(PART_REASON)
    return False
