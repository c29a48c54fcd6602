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
from dataclasses import asdict, dataclass
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
from cosim.log.background import RunContent, RunRows, WaitingMessage, joined
from cosim.log.chunks import (
    CHUNK_BYTES,
    Compression,
    MessageBatch,
    Workers,
    one_chunk,
    separate_chunks,
)
from cosim.log.files import Rotation, further_parts, part_path
from cosim.log.layout import Part, Records, blank_records, group_columns, record_dtype, signals_json
from cosim.log.live_file import LiveFile
from cosim.log.mcap_records import HEADER, FileHead, RecordGroup
from cosim.log.metadata import combine_hashes, hash_input
from cosim.log.preamble import (
    PART_REASON,
    PARTIAL_STATUS,
    LastRow,
    ResultItems,
    end_group,
    part_items,
    result_items,
    with_whole,
)
from cosim.log.reader import open_log
from cosim.log.unfinished import UnfinishedLog, check_not_written

_CHANNEL_BYTES = 2**21  # of a channel in a flush, as long as there are few
_LARGEST_FLUSH = 2**23  # bytes of records
_BUFFER_BYTES = 2**22  # of rows, where long periods leave few of them in a chunk
_DOUBLE_BYTES = 8
_SEQUENCE_MASK = 0xFFFFFFFF  # MCAP's sequence has 32 bits

_MESSAGE = struct.Struct("<BQHIQQ")  # a message record up to its data

RowSelection: TypeAlias = slice | NDArray[np.intp]


@final
class MessageEncoder:
    """Makes the message records of rows.

    Parameters
    ----------
    layout : Layout
    parts : sequence of (int, Part)
        MCAP channel ids with what they hold.
    """

    def __init__(self, layout: Layout, parts: Sequence[tuple[int, Part]]) -> None:
        self._layout = layout
        self._parts = parts
        self._blank: dict[int, Records] = {}  # by channel id, filled again every time
        self.row_bytes = _row_bytes([part for _, part in parts])
        self.capacity = _capacity(layout, len(parts), self.row_bytes)

    def batches(self, content: RunContent, grid: Grid) -> list[MessageBatch]:
        """Return the message records, one batch per channel that has any.

        They share the encoder's memory: valid until the next call.

        Parameters
        ----------
        content : RunContent
        grid : Grid
            The communication points: the sequence of messages that are not rows.
        """
        selected = self._selected(content.rows)
        batches = []
        for channel_id, part in self._parts:
            rows = selected[part.channel.period]
            batch = self._batch(channel_id, part, content.rows, rows)
            if len(batch.time_ns):
                batches.append(batch)
        messages: dict[int, list[WaitingMessage]] = {}
        for message in content.messages:
            messages.setdefault(message.channel_id, []).append(message)
        for waiting in messages.values():
            batches.append(_message_batch(waiting, grid))
        return batches

    def _batch(
        self, channel_id: int, part: Part, rows: RunRows, selected: RowSelection
    ) -> MessageBatch:
        time_ns = rows.time_ns[selected]
        records = self._records(channel_id, part.size, len(time_ns))
        records["sequence"] = rows.steps[selected].astype(np.uint32)
        unsigned_ns = time_ns.view(np.uint64)  # else numpy would convert each
        records["log_time"] = unsigned_ns
        records["publish_time"] = unsigned_ns
        part_start = part.channel.start + part.columns.start
        for group, columns in group_columns(part.size).items():
            start = part_start + columns.start
            stop = part_start + columns.stop
            records[group]["value"] = rows.values[selected, start:stop]
        offsets = np.arange(0, records.nbytes, records.itemsize)
        return MessageBatch(channel_id, records.view(np.uint8).data, time_ns, offsets)

    def _records(self, channel_id: int, size: int, count: int) -> Records:
        """Return records with everything constant filled in."""
        blank = self._blank.get(channel_id)
        if blank is None or len(blank) < count:
            blank = blank_records(channel_id, size, count)
            self._blank[channel_id] = blank
        return blank[:count]

    def hash_into(self, hashes: dict[str, hashlib._Hash], rows: RunRows) -> None:
        """Add rows to the content hashes of their components."""
        selected = self._selected(rows)
        for channel in self._layout.channels:
            own = selected[channel.period]
            values = rows.values[own, channel.columns]
            hashes[channel.name].update(hash_input(rows.time_ns[own], values))

    def _selected(self, rows: RunRows) -> dict[int, RowSelection]:
        """Return for each period the rows that components of that period record."""
        selected: dict[int, RowSelection] = {}
        for period in {channel.period for channel in self._layout.channels}:
            every = slice(len(rows.steps))
            selected[period] = every if period == 1 else np.flatnonzero(rows.steps % period == 0)
        return selected


def _row_bytes(parts: Sequence[Part]) -> float:
    """Return how many bytes of records a row has, on average."""
    total = 0.0
    for part in parts:
        total += record_dtype(part.size).itemsize / part.channel.period
    return total


def _capacity(layout: Layout, channels: int, row_bytes: float) -> int:
    """Return the number of rows of a flush, or of the buffer where periods are long."""
    flush_bytes = min(max(channels * _CHANNEL_BYTES, CHUNK_BYTES), _LARGEST_FLUSH)
    rows_in_flush = flush_bytes // max(row_bytes, 1.0)
    rows_in_buffer = max(_BUFFER_BYTES, flush_bytes) // (_DOUBLE_BYTES * max(layout.width, 1))
    return max(int(min(rows_in_flush, rows_in_buffer)), 1)


def _message_batch(messages: Sequence[WaitingMessage], grid: Grid) -> MessageBatch:
    """Return the records of messages of any size in one channel.

    Their sequence is the number of the communication step.
    """
    records = []
    times = []
    offsets = []
    size = 0
    for channel_id, time_ns, data in messages:
        length = _MESSAGE.size - HEADER + len(data)
        sequence = grid.number(time_ns) & _SEQUENCE_MASK
        header = _MESSAGE.pack(Opcode.MESSAGE, length, channel_id, sequence, time_ns, time_ns)
        records.append(header + data)
        times.append(time_ns)
        offsets.append(size)
        size += len(header) + len(data)
    return MessageBatch(
        messages[0].channel_id,
        memoryview(b"".join(records)),
        np.array(times, dtype=np.int64),
        np.array(offsets, dtype=np.int64),
    )


_FEW_CHANNEL_BYTES: Final = 2**14  # with less a channel shares the chunk with all others
_PIECES: Final = 8  # of a file, before compression: it becomes no larger by more than one


@dataclass(frozen=True, slots=True)
class LogOptions:
    """How the log of a run is written; see :class:`cosim.log.McapRecorder`."""

    compression: Compression = "zstd"
    force: bool = False
    sync: bool = False
    rotation: Rotation | None = None


@final
class LogStore:
    """Writes the contents of a run to the files of its log.

    Parameters
    ----------
    place : UnfinishedLog
        Of the first file, which is created.
    file : LiveFile
    head : FileHead
        What every file begins with.
    plan : Plan
    parts : sequence of (int, Part)
        MCAP channel ids with what they hold.
    options : LogOptions

    Attributes
    ----------
    last_place : UnfinishedLog
        Of the last file that is at its path, or will be.
    last_row : LastRow

    Raises
    ------
    OSError
        From every method that writes; what was written before stays whole.
    """

    def __init__(
        self,
        place: UnfinishedLog,
        file: LiveFile,
        head: FileHead,
        plan: Plan,
        parts: Sequence[tuple[int, Part]],
        options: LogOptions,
    ) -> None:
        self._first_place = place
        self._place = place
        self.last_place = place
        self._file = file
        self._head = head
        self._plan = plan
        self._options = options
        self._encoder = MessageEncoder(plan.layout, parts)
        self._has_few_channels = len(parts) * _FEW_CHANNEL_BYTES <= CHUNK_BYTES
        # Of the rows of the run by component; of a file behind the first one those of its own, too.
        self._hashes: tuple[dict[str, hashlib._Hash], ...] = (self._new_hashes(),)
        self._number = 1  # of the file
        self._first_ns: int | None = None  # of the rows of the file
        self._next_ns: int | None = None  # at which rows belong to a next file
        self._workers = Workers()
        self._start_ns = 0
        self._tail: list[RunContent] = []  # what the file has in its tail
        self._tail_bytes = 0.0
        self.last_row = LastRow()

    @property
    def capacity(self) -> int:
        """The number of rows of a flush."""
        return self._encoder.capacity

    @property
    def path(self) -> Path:
        """Where the file is that is written."""
        return self._place.path

    def begin(self, start_ns: int) -> None:
        """Take the time of the first row, and publish the first file."""
        self._start_ns = start_ns
        rotation = self._options.rotation
        if rotation is not None and rotation.span_ns is not None:
            self._next_ns = start_ns + rotation.span_ns
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
        replaced = replaced_parts(place.path) if self._options.force else []
        place.publish()
        for path in replaced:
            with suppress(OSError):  # the next file of this log cannot get its name then
                path.unlink()

    def add(self, content: RunContent) -> None:
        """Write a flush; its memory may be used again afterwards."""
        for part in self._by_file(content):
            self._place.check()
            self._add(part)

    def finish(self, last: RunContent | None, end: EndOfRun, values: Mapping[str, Any]) -> None:
        """Write the last flush, the result and the end of the file."""
        if last is not None and not last.is_empty:
            if self._options.rotation is not None:
                self.add(last)
            else:
                size = self._tail_bytes + self._size(last)
                self._write(last, is_separate=size >= CHUNK_BYTES / 2)
        self.close(end, values)

    def close(self, end: EndOfRun, values: Mapping[str, Any]) -> None:
        """Write the result and the end of the file."""
        self._keep_tail()
        whole = result_items(end, self.last_row, content_hash=self._content_hash(self._hashes[0]))
        group = end_group(whole, values)
        if self._number > 1:
            group = with_whole(end_group(self._part_items(whole), values), whole)
        self._file.commit(group)
        self._file.close()
        self._workers.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.abandon()
        self._workers.close()

    # --- several files ---

    def _by_file(self, content: RunContent) -> Iterator[RunContent]:
        """Yield a content as it belongs to files; begin a next one before what belongs there."""
        rotation = self._options.rotation
        while self._next_ns is not None and content.reaches(self._next_ns):
            early, content = content.split(self._next_ns)
            if not early.is_empty:
                yield early
            if self._first_ns is not None:
                self._go_on()
            assert rotation is not None
            assert rotation.span_ns is not None
            self._next_ns += rotation.span_ns
        if rotation is None or rotation.size is None:
            yield content
            return
        rows = max(int(rotation.size / _PIECES / max(self._encoder.row_bytes, 1.0)), 1)
        for piece in content.pieces(rows):
            is_large = self._first_ns is not None and self._file.size >= rotation.size
            if is_large and len(piece.rows.steps):
                self._go_on()
            yield piece

    def _go_on(self) -> None:
        """Close the file as a part of the log, and begin the next one, under its path at once."""
        self._place.check()
        path = part_path(self._first_place.path, self._number + 1)
        following = UnfinishedLog(path, force=False)
        try:
            stream = following.create()
            summary = self._head.summary()
            file = LiveFile(stream, self._head.data, summary, sync=self._options.sync)
            self._keep_tail()
            self._file.commit(end_group(self._part_items(asdict(self.last_row)), {}))
            self._file.close()
        except (LogError, OSError) as error:
            following.discard()
            raise _as_os_error(error) from error
        self._file = file
        self._place = following
        self._hashes = (self._hashes[0], self._new_hashes())
        self._number += 1
        self._first_ns = None
        try:
            following.publish()
        except LogError as error:
            raise _as_os_error(error) from error
        self.last_place = following

    def _part_items(self, last_row: Mapping[str, Any]) -> ResultItems:
        """Return what is recorded of the end of the file as one of several."""
        own_hash = self._content_hash(self._hashes[-1])
        return part_items(self._number, self._first_ns, last_row, own_hash)

    def discard(self) -> None:
        """Remove the file that is written if it was not published."""
        self._place.discard()

    # --- one file ---

    def _add(self, content: RunContent) -> None:
        """Write a content to the file.

        One that is large makes chunks that stay. Small ones are gathered, and written again with
        each other, until they are large together.
        """
        size = self._size(content)
        is_large = size >= CHUNK_BYTES / 2
        if is_large:
            self._keep_tail()
        else:
            content = joined([content])  # a copy, to be kept
        is_full = is_large or self._tail_bytes + size >= CHUNK_BYTES
        self._write(content, is_separate=is_full)
        if is_full:
            self._keep_tail()
        else:
            self._tail.append(content)
            self._tail_bytes += size

    def _write(self, content: RunContent, *, is_separate: bool) -> None:
        """Write the tail again, with a content behind it."""
        whole = joined([*self._tail, content]) if self._tail else content
        hashing = self._workers.start(partial(self._hashed, content.rows)) if is_separate else None
        try:
            group = self._group(whole, is_separate=is_separate)
            if group.entries:  # no component may have a row in the steps of a flush
                self._file.replace_tail(group)
        finally:
            hashes = self._hashed(content.rows) if hashing is None else hashing.result()
        # Before anything else may fail: the file has these rows now.
        self._hashes = hashes
        if len(content.rows.steps):
            if self._first_ns is None:
                self._first_ns = int(content.rows.time_ns[0])
            self.last_row = LastRow(int(content.rows.steps[-1]), int(content.rows.time_ns[-1]))

    def _keep_tail(self) -> None:
        self._file.keep_tail()
        self._tail = []
        self._tail_bytes = 0.0

    def _size(self, content: RunContent) -> float:
        """Return how many bytes of records a content has, about."""
        size = len(content.rows.steps) * self._encoder.row_bytes
        return size + sum(len(message.data) for message in content.messages)

    def _group(self, content: RunContent, *, is_separate: bool) -> RecordGroup:
        """Return a content as chunks, where asked for with one for every channel."""
        batches = self._encoder.batches(content, Grid(self._start_ns, self._plan.step_ns))
        if not batches:
            return RecordGroup((), (), 0)
        compression = self._options.compression
        if is_separate and self._has_few_channels:
            return separate_chunks(batches, compression, self._workers)
        return one_chunk(batches, compression)

    # --- hashes ---

    def _new_hashes(self) -> dict[str, hashlib._Hash]:
        return {channel.name: hashlib.sha256() for channel in self._plan.layout.channels}

    def _hashed(self, rows: RunRows) -> tuple[dict[str, hashlib._Hash], ...]:
        """Return the hashes with further rows."""
        result = []
        for hashes in self._hashes:
            copied = {name: digest.copy() for name, digest in hashes.items()}
            self._encoder.hash_into(copied, rows)
            result.append(copied)
        return tuple(result)

    def _content_hash(self, hashes: Mapping[str, hashlib._Hash]) -> str:
        components = []
        for channel in self._plan.layout.channels:
            declaration = signals_json(channel.interface)
            components.append((channel.name, declaration, hashes[channel.name].hexdigest()))
        return combine_hashes(components)


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


def check_no_parts(first: Path, *, force: bool) -> None:
    """Check that there are no further files beside the path of a new log, or that they may go.

    Raises
    ------
    LogError
        If there are some and they shall stay, or if they are not parts of a log.
    """
    parts = replaced_parts(first) if force else further_parts(first)
    if parts and not force:
        raise LogError(
            f"{parts[0]} exists, named like a part of an earlier log {first}; choose another "
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
