"""The recorder that writes an MCAP file: one topic per component, readable by any MCAP tool."""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from io import RawIOBase
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, final

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.recorders import EndOfRun, end_of_run
from cosim.core.recording import MessageLevel, Plan, RowsUnderWay, SignalEvent, Substep
from cosim.core.signals import Channel
from cosim.errors import LogError, LogWriteError, RunError
from cosim.instants import NANOSECONDS, Grid
from cosim.interrupts import uninterrupted
from cosim.log.background import FLUSH_INTERVAL, BackgroundWriter, WaitingMessage
from cosim.log.chunks import CHUNK_BYTES, Compression
from cosim.log.files import Rotation
from cosim.log.layout import Part, record_dtype, split_channel
from cosim.log.live_file import LiveFile
from cosim.log.mcap_records import FileHead
from cosim.log.messages import encode_event, encode_log, encode_substep
from cosim.log.metadata import library_name
from cosim.log.preamble import (
    EVENT_TOPIC,
    LOG_TOPIC,
    STEP_TOPIC,
    Attachment,
    add_event_channel,
    add_parts,
    add_preamble,
    add_step_channel,
)
from cosim.log.reader import Log
from cosim.log.store import LogOptions, LogStore, check_no_parts
from cosim.log.unfinished import UnfinishedLog

_CHUNK: Final = 256  # bytes of a chunk beside its records, with its entry in the summary; 194
_CHUNK_CHANNEL: Final = 25  # bytes a chunk has for each channel: 15 in its index, 10 in the summary
_PADDING: Final = 16  # bytes before the header of a chunk that would cross a page; 9
_INDEX_ENTRY: Final = 16  # bytes that the index has for each message
_EXPANSION: Final = 255  # a compression makes a chunk longer by one part of this, at most
_END: Final = 8192  # bytes of the result and the records that close the file
_VALUE: Final = 64  # bytes of a value in the result, beside its name
_ESCAPED: Final = 6  # bytes of a character of a name in JSON


def size_bound(parts: Sequence[Part], steps: int, *, start: int, capacity: int) -> int:
    """Return how large the log of a run can become, without its messages [bytes].

    It is an upper bound for every compression, however often the file is flushed.

    Parameters
    ----------
    parts : sequence of Part
    steps : int
        Of the run.
    start : int
        Bytes of the file before its first row.
    capacity : int
        Rows of a flush.
    """
    rows = steps + 1
    records = 0
    for part in parts:
        messages = steps // part.channel.period + 1
        records += messages * (record_dtype(part.size).itemsize + _INDEX_ENTRY)
    channels = {part.channel.name: part.channel for part in parts}
    values = sum(map(_result_bytes, channels.values()))
    # A flush of few rows is joined by others until they make half a chunk, or by a full one.
    flushes = 2 * (rows // capacity + records // (CHUNK_BYTES // 2)) + 2
    flush_overhead = _PADDING + len(parts) * (_CHUNK + _CHUNK_CHANNEL)
    overhead = flushes * flush_overhead + records // CHUNK_BYTES * _CHUNK
    # Twice the start: the summary repeats its schemas and channels.
    return records + records // _EXPANSION + overhead + 2 * start + values + _END


def _result_bytes(channel: Channel) -> int:
    """Return how long the last values of a channel are in the result, at most."""
    total = 0
    for signal in channel.signals:
        name = len(channel.name) + len(signal.name)
        total += signal.size * (_VALUE + _ESCAPED * name)
    return total


_GONE: Final = (errno.ENOENT, errno.ESTALE)  # the file at its path is not that of the run


@final
class McapRecorder:
    """Record a run to an MCAP file.

    The file is created by :meth:`begin` under a hidden name, is at its path from the first
    :meth:`write` on, and is completed when the ``with`` block ends, however it ends. It can be
    opened at any instant; where the process is killed it has all but the last flush interval. A
    run that is refused before its first row leaves nothing, and an existing log as it was; one
    that failed at its start, or had no rows, leaves a log without rows.

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
    flush : float
        After how much wall time a row is in the file at the latest [s].
    sync : bool
        Wait for the disk at every flush: a loss of power leaves what was flushed, too.
    rotation : Rotation, optional
        When the log goes on in a next file.
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
        flush: float = FLUSH_INTERVAL,
        sync: bool = False,
        rotation: Rotation | None = None,
    ) -> None:
        self._options = LogOptions(compression, force, sync, rotation)
        self._numbered = numbered
        self._kinds = kinds or {}
        self._metadata = metadata or {}
        self._attachments = attachments
        self._result: dict[str, Any] = {}
        self._has_events = events
        self._has_substeps = substeps
        self._channel_ids: dict[str, int] = {}  # of what is no signal, by topic
        self._flush = flush
        self._file = UnfinishedLog(path, force=force, numbered=numbered)
        self._writer: BackgroundWriter | None = None
        self._early: list[tuple[str, int, bytes]] = []  # messages before the file

    @property
    def path(self) -> Path:
        """Where the file is, or will be; the first one, if there are several."""
        return self._file.path

    def recorded(self) -> Log:
        """Return the log that was written: this very file, whatever is at its path by now.

        If there are several files, it is the last one.

        Raises
        ------
        LogError
            If nothing was written.
        """
        if not self._file.published:
            raise LogError(f"{self.path} was not written")
        last = self._store.last_place
        return Log(last.path, last.own)

    def __enter__(self) -> Self:
        """Refuse a path that a log cannot be written to.

        Raises
        ------
        LogError
            If the file exists and is to stay, the path is a folder, or its folder takes no files.
        """
        self._file.check_free()
        if not self._numbered:
            check_no_parts(self.path, force=self._options.force)
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
                if self._writer is not None and self._is_worth_keeping(error):
                    # First: if the end cannot be written, what could be is at its path.
                    self._store.publish()
                    self._complete(self._writer, end_of_run(error))
            finally:
                if self._writer is not None:
                    self._writer.stop()
                self._writer = None
                self._file.discard()

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
        head = FileHead(library=library_name())
        parts = self._parts(plan)
        numbered_parts = list(zip(add_parts(head, parts), parts, strict=True))
        self._channel_ids[LOG_TOPIC] = add_preamble(
            head,
            plan,
            metadata=self._metadata,
            attachments=self._attachments,
            kinds=self._kinds,
        )
        if self._has_events:
            self._channel_ids[EVENT_TOPIC] = add_event_channel(head)
        if self._has_substeps:
            self._channel_ids[STEP_TOPIC] = add_step_channel(head)
        rotation = self._options.rotation
        if rotation is not None:
            rotation.check(plan.layout.channels, plan.step_ns, len(head.data))
        try:
            file = LiveFile(stream, head.data, head.summary(), sync=self._options.sync)
        except OSError as error:
            reason = error.strerror or error
            raise LogError(f"{self.path} cannot be written: {reason}") from error
        self._store = LogStore(self._file, file, head, plan, numbered_parts, self._options)
        self._plan = plan
        self._head_bytes = len(head.data)
        # Last: with a writer the file is completed, and that needs everything above.
        self._writer = BackgroundWriter(
            self._store.add,
            capacity=self._store.capacity,
            width=plan.layout.width,
            interval=self._flush,
        )
        for topic, time_ns, message in self._early:
            self._write_message(topic, time_ns, message)

    def size_bound(self, steps: int) -> int:
        """Return how large the file can become in a run of so many steps [bytes].

        An upper bound without the messages, of any compression; known once the run has begun.
        """
        parts = self._parts(self._plan)
        return size_bound(parts, steps, start=self._head_bytes, capacity=self._store.capacity)

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
            raise LogWriteError(f"{self.path}: expected a time >= 0, got {block.time_ns[0]} ns")
        is_first = not self._file.published
        if is_first:
            first = Grid(int(block.time_ns[0]), self._plan.step_ns)
            start_ns = first.stamp(-block.index)
            with uninterrupted():
                self._store.begin(start_ns)
        row = 0 if is_first and block.index == 0 else 1
        assert self._writer is not None
        try:
            self._writer.write(block, signals, row)
        except OSError as error:
            self._fail(error)

    def follow(self, rows: RowsUnderWay) -> None:
        """Write what is computed of a block under way after the flush interval, too."""
        assert self._writer is not None
        self._writer.follow(rows)

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Record a message of the run or of a component at a simulation time [ns]."""
        self._write_message(LOG_TOPIC, time_ns, encode_log(time_ns, level, source, text))

    def event(self, event: SignalEvent) -> None:
        """Record a jump of a signal."""
        assert self._has_events
        self._write_message(EVENT_TOPIC, event.time_ns, encode_event(event))

    def substep(self, substep: Substep) -> None:
        """Record a substep of a loop."""
        assert self._has_substeps
        self._write_message(STEP_TOPIC, substep.begin_ns, encode_substep(substep))

    def _write_message(self, topic: str, time_ns: int, data: bytes) -> None:
        if self._writer is None:  # not begun, or ended: after an error a run may have more to say
            self._early.append((topic, time_ns, data))
            return
        message = WaitingMessage(self._channel_ids[topic], time_ns, data)
        try:
            self._writer.message(message)
        except OSError as error:
            self._fail(error)

    def result(self, values: Mapping[str, Any]) -> None:
        """Add values to ``result.json``, which is written at the end.

        Parameters
        ----------
        values : mapping of str to JSON values, numpy arrays and numbers, or paths
            A key that was added before is replaced.
        """
        self._result.update(values)

    def _complete(self, writer: BackgroundWriter, end: EndOfRun) -> None:
        """Write the rest and the end of the file."""
        try:
            rest = writer.close()
            self._store.finish(rest, end, self._result)
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        """Close the file with what it holds; where even that fails it is left as it is, whole.

        Raises
        ------
        LogWriteError
            Always.
        """
        self._writer = None  # whatever happens now, nothing more is written after the end
        reason = error.strerror or str(error)
        end = EndOfRun("failed", f"the log could not be written further: {reason}")
        self._result.pop("last", None)  # of rows that are not in the file
        try:
            self._store.close(end, self._result)
        except OSError:
            self._store.abandon()
        self._store.discard()
        text = f"{self._store.path} cannot be written further: {reason}"
        if error.errno not in _GONE:
            end_ns = self._store.last_row.end_ns
            text += f"; the log is valid up to t = {end_ns / NANOSECONDS} s"
        raise LogWriteError(text) from error
