"""The log of a run as it grows: contents become chunks; the file is whole after each of them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final, final

from cosim.core.recorders import EndOfRun
from cosim.core.recording import Plan
from cosim.instants import Grid
from cosim.log.contents.content import combine_hashes
from cosim.log.contents.layout import Part, signals_json
from cosim.log.contents.result import (
    LastRow,
    end_group,
    part_group,
    part_items,
    result_items,
    with_whole,
)
from cosim.log.mcap_file.chunks import CHUNK_BYTES, one_chunk, separate_chunks
from cosim.log.mcap_file.compression import Compression
from cosim.log.mcap_file.live_file import LiveFile
from cosim.log.mcap_file.summary import RecordGroup
from cosim.log.mcap_file.workers import Workers
from cosim.log.writing.buffer import RunContent, RunRows, joined
from cosim.log.writing.encoding import MessageEncoder

_FEW_CHANNEL_BYTES: Final = 2**14  # with less a channel shares the chunk with all others


@final
class LogStore:
    """Writes the contents of a run to a file, and further ones to next files.

    Parameters
    ----------
    file : LiveFile
    plan : Plan
    parts : sequence of (int, Part)
        MCAP channel ids with what they hold.
    compression : {"zstd", "lz4", "none"}

    Raises
    ------
    OSError
        From every method that writes; what was written before stays whole.
    """

    def __init__(
        self,
        file: LiveFile,
        plan: Plan,
        parts: Sequence[tuple[int, Part]],
        *,
        compression: Compression,
    ) -> None:
        self._file = file
        self._plan = plan
        self._compression = compression
        self._encoder = MessageEncoder(plan.layout, parts)
        self._has_few_channels = len(parts) * _FEW_CHANNEL_BYTES <= CHUNK_BYTES
        # Of the rows of the run by component; of a file behind the first one those of its own, too.
        self._hashes: tuple[dict[str, hashlib._Hash], ...] = (self._new_hashes(),)
        self._number = 1  # of the file
        self._first_ns: int | None = None  # of the rows of the file
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
    def row_bytes(self) -> float:
        """How many bytes of records a row has, on average."""
        return self._encoder.row_bytes

    def begin(self, start_ns: int) -> None:
        """Take the time of the first row."""
        self._start_ns = start_ns

    def add(self, content: RunContent) -> None:
        """Write a flush; its memory may be used again afterwards.

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

    @property
    def has_rows(self) -> bool:
        """Whether the file has any."""
        return self._first_ns is not None

    @property
    def size(self) -> int:
        """What the file holds [bytes]."""
        return self._file.size

    def go_on_in(self, file: LiveFile) -> None:
        """Write the end of the file as of a part of the log, and all that follows to a next one."""
        self._keep_tail()
        content_hash = self._content_hash(self._hashes[-1])
        self._file.commit(
            part_group(self._number, self._first_ns, self.last_row, content_hash=content_hash)
        )
        self._file.close()
        self._file = file
        self._hashes = (self._hashes[0], self._new_hashes())
        self._number += 1
        self._first_ns = None

    def finish(self, last: RunContent | None, end: EndOfRun, values: Mapping[str, Any]) -> None:
        """Write the last flush, the result and the end of the file."""
        if last is not None and not last.is_empty:
            size = self._tail_bytes + self._size(last)
            self._write(last, is_separate=size >= CHUNK_BYTES / 2)
        self.close(end, values)

    def close(self, end: EndOfRun, values: Mapping[str, Any]) -> None:
        """Write the result and the end of the file."""
        self._keep_tail()
        content_hash = self._content_hash(self._hashes[0])
        whole = result_items(end, self.last_row, content_hash=content_hash)
        own = whole
        if self._number > 1:
            own_hash = self._content_hash(self._hashes[-1])
            own = part_items(self._number, self._first_ns, whole, own_hash)
        group = end_group(own, values)
        if self._number > 1:
            group = with_whole(group, whole)
        self._file.commit(group)
        self._file.close()
        self._workers.close()

    def _new_hashes(self) -> dict[str, hashlib._Hash]:
        return {channel.name: hashlib.sha256() for channel in self._plan.layout.channels}

    def _content_hash(self, hashes: Mapping[str, hashlib._Hash]) -> str:
        components = []
        for channel in self._plan.layout.channels:
            declaration = signals_json(channel.interface)
            components.append((channel.name, declaration, hashes[channel.name].hexdigest()))
        return combine_hashes(components)

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.abandon()
        self._workers.close()

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

    def _hashed(self, rows: RunRows) -> tuple[dict[str, hashlib._Hash], ...]:
        """Return the hashes with further rows."""
        result = []
        for hashes in self._hashes:
            copied = {name: digest.copy() for name, digest in hashes.items()}
            self._encoder.hash_into(copied, rows)
            result.append(copied)
        return tuple(result)

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
        if is_separate and self._has_few_channels:
            return separate_chunks(batches, self._compression, self._workers)
        return one_chunk(batches, self._compression)
