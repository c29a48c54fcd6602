"""The log of a run as it grows: contents become chunks; the file is whole after each of them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final, final

from cosim.core.recorders import EndOfRun
from cosim.core.recording import Plan
from cosim.log.buffer import RunContent, RunRows, joined
from cosim.log.chunks import CHUNK_BYTES, one_chunk, separate_chunks
from cosim.log.compression import Compression
from cosim.log.content import combine_hashes
from cosim.log.encoding import MessageEncoder
from cosim.log.layout import Part, signals_json
from cosim.log.live_file import LiveFile
from cosim.log.result import LastRow, result_group
from cosim.log.summary import RecordGroup
from cosim.log.workers import Workers

_FEW_CHANNEL_BYTES: Final = 2**14  # with less a channel shares the chunk with all others


@final
class LogStore:
    """Writes the contents of a run to a file.

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
        self._hashes = {channel.name: hashlib.sha256() for channel in plan.layout.channels}
        self._workers = Workers()
        self._start_ns = 0
        self._tail: list[RunContent] = []  # what the file has in its tail
        self._tail_bytes = 0.0
        self.last_row = LastRow()

    @property
    def capacity(self) -> int:
        """The number of rows of a flush."""
        return self._encoder.capacity

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

    def finish(self, last: RunContent | None, end: EndOfRun, values: Mapping[str, Any]) -> None:
        """Write the last flush, the result and the end of the file."""
        if last is not None and not last.is_empty:
            size = self._tail_bytes + self._size(last)
            self._write(last, is_separate=size >= CHUNK_BYTES / 2)
        self.close(end, values)

    def close(self, end: EndOfRun, values: Mapping[str, Any]) -> None:
        """Write the result and the end of the file."""
        self._keep_tail()
        components = []
        for channel in self._plan.layout.channels:
            declaration = signals_json(channel.interface)
            digest = self._hashes[channel.name].hexdigest()
            components.append((channel.name, declaration, digest))
        content_hash = combine_hashes(components)
        self._file.commit(
            result_group(end, self.last_row, content_hash=content_hash, values=values)
        )
        self._file.close()
        self._workers.close()

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
            self.last_row = LastRow(int(content.rows.steps[-1]), int(content.rows.time_ns[-1]))

    def _hashed(self, rows: RunRows) -> dict[str, hashlib._Hash]:
        """Return the hashes with further rows."""
        hashes = {name: digest.copy() for name, digest in self._hashes.items()}
        self._encoder.hash_into(hashes, rows)
        return hashes

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
        batches = self._encoder.batches(
            content, start_ns=self._start_ns, step_ns=self._plan.step_ns
        )
        if not batches:
            return RecordGroup(b"", (), 0)
        if is_separate and self._has_few_channels:
            return separate_chunks(batches, self._compression, self._workers)
        return one_chunk(batches, self._compression)
