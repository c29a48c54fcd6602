"""The recorder that writes an MCAP file: one topic per component, readable by any MCAP tool."""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import RawIOBase
from pathlib import Path
from types import TracebackType
from typing import Any, Self, final

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.recorders import EndOfRun, end_of_run
from cosim.core.recording import MessageLevel, Plan, SignalEvent, Substep
from cosim.core.signals import Interface
from cosim.errors import LogError, LogWriteError, RunError
from cosim.interrupts import uninterrupted
from cosim.log.buffer import RowBuffer, message_batch
from cosim.log.compression import Compression
from cosim.log.content import combine_hashes
from cosim.log.environment import library_name
from cosim.log.layout import Part, signals_json, split_channel
from cosim.log.messages import encode_event, encode_log, encode_substep
from cosim.log.paths import check_new_log, log_path
from cosim.log.preamble import (
    EVENT_TOPIC,
    LOG_TOPIC,
    STEP_TOPIC,
    Attachment,
    write_event_channel,
    write_parts,
    write_preamble,
    write_step_channel,
)
from cosim.log.reader import Log
from cosim.log.result import LastRow, write_result
from cosim.log.sink import Mark, Sink
from cosim.log.size import size_bound
from cosim.log.unfinished import UnfinishedLog

_FLUSH_AFTER = 1.0  # s of wall time
_MOST_WAITING = 10_000  # substeps, before they are written
_CHECKPOINTS = 16  # chunks that may be given up to make room for the file's end on a full disk


@dataclass(frozen=True, slots=True)
class _Checkpoint:
    """What the file held at a mark: to close it there after a failed write."""

    mark: Mark
    hashes: dict[str, hashlib._Hash]
    last_row: LastRow


@final
class McapRecorder:
    """Record a run to an MCAP file.

    The file is created by :meth:`begin` under a hidden name, stands at its path from the first
    :meth:`write` on, and is completed when the ``with`` block ends, however it ends. A run that is
    refused before its first row leaves nothing, and an existing log as it was; one that failed at
    its start, or had no rows, leaves a log without rows.

    Parameters
    ----------
    path : Path or str
        File to write; missing folders are created.
    force : bool
        Replace a file that exists, at the first row.
    numbered : bool
        Where a file exists, write to the next free one of ``x-2.mcap``, ``x-3.mcap``, ...; which
        it is, ``path`` says from the first row on.
    compression : {"zstd", "lz4", "none"}
    kinds : mapping of component name to str
        Kinds of the components, as the scenario calls them.
    metadata : mapping of record name to its items
        Metadata records, such as ``cosim.run``, ``cosim.connections``,
        ``cosim.component.<name>`` (parameters).
    attachments : sequence of Attachment
    events : bool
        Signals may jump at communication points: there is a channel ``/cosim/event`` for that.
    substeps : bool
        Loops take substeps: there is a channel ``/cosim/step`` for them.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        force: bool = False,
        numbered: bool = False,
        compression: Compression = "zstd",
        kinds: Mapping[str, str] | None = None,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        attachments: Sequence[Attachment] = (),
        events: bool = False,
        substeps: bool = False,
    ) -> None:
        self._force = force
        self._numbered = numbered
        self._compression = compression
        self._kinds = kinds or {}
        self._metadata = metadata or {}
        self._attachments = attachments
        self._result: dict[str, Any] = {}
        self._has_events = events
        self._has_substeps = substeps
        self._channel_ids: dict[str, int] = {}  # of what is no signal, by topic
        # what is to be written there: time [ns] and data
        self._waiting: dict[str, list[tuple[int, bytes]]] = {LOG_TOPIC: []}
        self._last_row = LastRow()
        self._file = UnfinishedLog(log_path(path), force=force, numbered=numbered)
        self._sink: Sink | None = None
        self._checkpoints: deque[_Checkpoint] = deque(maxlen=_CHECKPOINTS)

    @property
    def path(self) -> Path:
        """Where the file is, or will be."""
        return self._file.path

    def recorded(self) -> Log:
        """Return the log that was written: this very file, whatever stands at its path by now.

        Raises
        ------
        LogError
            If nothing was written.
        """
        if not self._file.published:
            raise LogError(f"{self.path} was not written")
        return Log(self.path, self._file.own)

    def __enter__(self) -> Self:
        """Refuse a path that a log cannot be written to.

        Raises
        ------
        LogError
            If the file exists and is to stay, the path is a folder, or its folder takes no files.
        """
        check_new_log(self.path, force=self._force, numbered=self._numbered)
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Write what is buffered, the result and the summary; remove what was refused.

        Raises
        ------
        LogError
            If a log without rows cannot get its path.
        LogWriteError
            If the file cannot be written to.
        """
        with uninterrupted():
            try:
                if self._sink is not None and self._is_worth_keeping(error):
                    # First: if the end cannot be written, what could be is at its path.
                    self._file.publish()
                    self._complete(self._sink, end_of_run(error))
            finally:
                self._file.discard()
                self._sink = None

    def _is_worth_keeping(self, error: BaseException | None) -> bool:
        """Return whether the log has rows, or must record why it has none."""
        return self._file.published or error is None or isinstance(error, RunError)

    def begin(self, plan: Plan) -> None:
        """Create the file and write everything known before the run.

        Raises
        ------
        LogError
            If the file cannot be created.
        """
        with uninterrupted():
            self._begin(plan, self._file.create())

    def _begin(self, plan: Plan, stream: RawIOBase) -> None:
        parts = self._parts(plan)
        try:
            sink = Sink(stream, library=library_name())
            channel_ids = write_parts(sink, parts)
            self._channel_ids[LOG_TOPIC] = write_preamble(
                sink, plan, metadata=self._metadata, attachments=self._attachments
            )
            if self._has_events:
                self._channel_ids[EVENT_TOPIC] = write_event_channel(sink)
            if self._has_substeps:
                self._channel_ids[STEP_TOPIC] = write_step_channel(sink)
        except OSError as error:
            reason = error.strerror or error
            raise LogError(f"{self.path} cannot be written: {reason}") from error
        self._interfaces: dict[str, Interface] = {}
        self._hashes: dict[str, hashlib._Hash] = {}
        for channel in plan.layout.channels:
            self._interfaces[channel.name] = channel.interface
            self._hashes[channel.name] = hashlib.sha256()
        numbered_parts = list(zip(channel_ids, parts, strict=True))
        self._buffer = RowBuffer(plan.layout, numbered_parts)
        self._plan = plan
        self._step_ns = plan.step_ns
        self._start_ns = 0  # the first row says it
        # Last: with a sink the file is completed, and that needs everything above.
        self._sink = sink
        self._add_checkpoint()

    def size_bound(self, steps: int) -> int:
        """Return how large the file can become in a run of so many steps [bytes].

        An upper bound without the messages, of any compression; known once the run has begun.
        """
        assert self._sink is not None
        start = self._sink.mark().position
        parts = self._parts(self._plan)
        return size_bound(parts, steps, start=start, capacity=self._buffer.capacity)

    def _parts(self, plan: Plan) -> list[Part]:
        parts = []
        for channel in plan.layout.channels:
            kind = self._kinds.get(channel.name, "")
            parts += split_channel(channel, kind=kind, step_ns=plan.step_ns)
        return parts

    def write(self, block: Block, signals: Matrix) -> None:
        """Record rows 1 to K of ``signals``, shape (K+1, width); of the very first block row 0 too.

        Raises
        ------
        LogError
            If another file has been created at the path before the first row.
        LogWriteError
            If the file cannot be written to, or a time is negative.
        """
        if block.time_ns[0] < 0:
            raise LogWriteError(
                f"{self.path}: time {block.time_ns[0]} ns; the times of a log begin at 0"
            )
        is_first = not self._file.published
        if is_first:
            self._start_ns = int(block.time_ns[0]) - block.index * self._step_ns
            with uninterrupted():
                self._file.publish()
        row = 0 if is_first and block.index == 0 else 1
        while row <= block.steps:
            row = self._buffer.append(block, signals, row)
            if self._buffer.full or time.monotonic() - self._flushed >= _FLUSH_AFTER:
                self._write_chunk()

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Record a message of the run or of a component at a simulation time [ns].

        It goes to ``/cosim/log`` with the next chunk.
        """
        data = encode_log(time_ns, level, source, text)
        self._waiting[LOG_TOPIC].append((time_ns, data))

    def event(self, event: SignalEvent) -> None:
        """Record a jump of a signal; it goes to ``/cosim/event`` with the next chunk."""
        assert self._has_events
        self._waiting.setdefault(EVENT_TOPIC, []).append((event.time_ns, encode_event(event)))

    def substep(self, substep: Substep) -> None:
        """Record a substep of a loop; it goes to ``/cosim/step`` with the next chunk."""
        assert self._has_substeps
        waiting = self._waiting.setdefault(STEP_TOPIC, [])
        waiting.append((substep.begin_ns, encode_substep(substep)))
        if len(waiting) >= _MOST_WAITING:
            self._write_chunk()

    def result(self, values: Mapping[str, Any]) -> None:
        """Add values to ``result.json``, which is written at the end.

        Parameters
        ----------
        values : mapping of str to JSON values, numpy arrays and numbers, or paths
            A key that was added before is replaced.
        """
        self._result.update(values)

    def _write_chunk(self) -> None:
        # Between the checkpoint and the cleared buffer, an interrupt would write the rows twice.
        with uninterrupted():
            try:
                self._flush()
            except OSError as error:
                self._fail(error)

    def _flush(self) -> None:
        """Write what is buffered as one chunk."""
        assert self._sink is not None
        batches = self._buffer.message_batches()
        for topic, messages in self._waiting.items():
            if not messages:
                continue
            batch = message_batch(
                messages,
                channel_id=self._channel_ids[topic],
                start_ns=self._start_ns,
                step_ns=self._step_ns,
            )
            batches.append(batch)
        if batches:
            self._sink.chunk(batches, self._compression)
        # Before the checkpoint: it takes the hashes and the last row of what the file holds now.
        self._buffer.hash_into(self._hashes)
        self._last_row = self._buffer.last_row or self._last_row
        self._add_checkpoint()
        # After the checkpoint: until then the rows are needed, to be written again.
        self._buffer.clear()
        for messages in self._waiting.values():
            messages.clear()

    def _add_checkpoint(self) -> None:
        """Store what the file holds now, and when."""
        assert self._sink is not None
        mark = self._sink.mark()
        hashes = _copied(self._hashes)  # the originals go on
        self._checkpoints.append(_Checkpoint(mark, hashes, self._last_row))
        self._flushed = time.monotonic()

    def _fail(self, error: OSError) -> None:
        """Close the file where it was last whole.

        Where the disk has no room for the file's end, chunks are given up, the latest first.

        Raises
        ------
        LogWriteError
            Always.
        """
        sink = self._sink
        assert sink is not None
        self._sink = None  # whatever happens now, nothing more is written after the end
        reason = error.strerror or str(error)
        end = EndOfRun("failed", f"the log could not be written further: {reason}")
        self._result.pop("last", None)  # of rows that may have to be given up
        outcome = "it has no end"
        while self._checkpoints:
            checkpoint = self._checkpoints.pop()
            with suppress(OSError):  # no room here: make more at the checkpoint before
                sink.rewind(checkpoint.mark)
                self._close(sink, checkpoint, end)
                outcome = f"up to t = {checkpoint.last_row.end_ns / 1e9} s it is a valid file"
                break
        else:
            sink.abandon()
        raise LogWriteError(
            f"{self.path} cannot be written further: {reason}; {outcome}"
        ) from error

    def _complete(self, sink: Sink, end: EndOfRun) -> None:
        """Write the rest and the end of the file, from its last checkpoint on."""
        try:
            # A write that was interrupted left half a chunk, and its rows are in the buffer still:
            # file and hashes go back to the checkpoint before the rows are written again.
            checkpoint = self._checkpoints[-1]
            sink.rewind(checkpoint.mark)
            self._hashes = _copied(checkpoint.hashes)
            self._flush()
            self._close(sink, self._checkpoints[-1], end)
        except OSError as failure:
            self._fail(failure)

    def _close(self, sink: Sink, checkpoint: _Checkpoint, end: EndOfRun) -> None:
        """Write the result and the end of the file."""
        components = []
        for name, digest in checkpoint.hashes.items():
            declaration = signals_json(self._interfaces[name])
            components.append((name, declaration, digest.hexdigest()))
        content_hash = combine_hashes(components)
        write_result(sink, end, checkpoint.last_row, content_hash=content_hash, values=self._result)
        sink.close()


def _copied(hashes: Mapping[str, hashlib._Hash]) -> dict[str, hashlib._Hash]:
    return {name: digest.copy() for name, digest in hashes.items()}
