"""The log of a run as it grows: contents become chunks of one file, or of several in turn.

Each file is whole after every content. A next file begins before the first rows that belong there:
so each has rows, and a run that ends within the limit leaves an ordinary log. Its name is taken
when the file before is closed: whenever the run is killed, all files but the last are closed, and
that one is whole.
"""

from __future__ import annotations

import errno
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, final

from cosim.core.recorders import EndOfRun
from cosim.core.recording import Plan
from cosim.errors import LogError
from cosim.instants import Grid
from cosim.log.contents.content import combine_hashes
from cosim.log.contents.layout import Part, signals_json
from cosim.log.contents.result import (
    LastRow,
    ResultItems,
    end_group,
    part_items,
    result_items,
    with_whole,
)
from cosim.log.mcap_file.chunks import CHUNK_BYTES, one_chunk, separate_chunks
from cosim.log.mcap_file.compression import Compression
from cosim.log.mcap_file.head import FileHead
from cosim.log.mcap_file.live_file import LiveFile
from cosim.log.mcap_file.rotation import Rotation, part_path
from cosim.log.mcap_file.summary import RecordGroup
from cosim.log.mcap_file.unfinished import UnfinishedLog
from cosim.log.mcap_file.workers import Workers
from cosim.log.writing.buffer import RunContent, RunRows, joined
from cosim.log.writing.encoding import MessageEncoder
from cosim.log.writing.replaced_parts import replaced_parts

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
