"""The recorder that writes an MCAP file: one topic per component, readable by any MCAP tool."""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, final

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.recorders import end_of_run
from cosim.core.recording import Plan, RowsUnderWay
from cosim.errors import LogError, LogWriteError, RunError
from cosim.instants import NANOSECONDS, Grid
from cosim.interrupts import uninterrupted
from cosim.log.background import FLUSH_INTERVAL, BackgroundWriter, WaitingMessage
from cosim.log.chunks import Compression
from cosim.log.files import Rotation, UnfinishedLog
from cosim.log.preamble import EVENT_TOPIC, STEP_TOPIC, Attachment, MessageEncoder, begin_file
from cosim.log.reader import Log
from cosim.log.store import LogStore, check_place

_GONE: Final = (errno.ENOENT, errno.ESTALE)  # the file at its path is not that of the run


@final
class McapRecorder(MessageEncoder):
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
        self._kinds = kinds or {}
        self._metadata = metadata or {}
        self._attachments = attachments
        self._result: dict[str, Any] = {}
        self._topics = [EVENT_TOPIC] * events + [STEP_TOPIC] * substeps
        self._channel_ids: dict[str, int] = {}  # of what is no signal, by topic
        self._flush = flush
        self._file = UnfinishedLog(path, force=force, numbered=numbered)
        self._new_store = partial(
            LogStore, self._file, compression=compression, sync=sync, rotation=rotation
        )
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
        check_place(self._file)
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
                    try:
                        rest = self._writer.close()
                        self._store.finish(rest, end_of_run(error), self._result)
                    except OSError as failure:
                        self._fail(failure)
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
            self._begin(plan)

    def _begin(self, plan: Plan) -> None:
        head, parts, self._channel_ids = begin_file(
            plan,
            metadata=self._metadata,
            attachments=self._attachments,
            kinds=self._kinds,
            topics=self._topics,
        )
        self._store = self._new_store(plan, head, parts)
        self._step_ns = plan.step_ns
        # Last: with a writer the file is completed, and that needs everything above.
        self._writer = BackgroundWriter(
            self._store.add,
            capacity=self._store.capacity,
            width=plan.layout.width,
            interval=self._flush,
        )
        for topic, time_ns, message in self._early:
            self._add_message(topic, time_ns, message)

    def size_bound(self, steps: int) -> int:
        """Return how large the file can become in a run of so many steps [bytes].

        An upper bound without the messages, of any compression; known once the run has begun.
        """
        return self._store.size_bound(steps)

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
            first = Grid(int(block.time_ns[0]), self._step_ns)
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

    def _add_message(self, topic: str, time_ns: int, data: bytes) -> None:
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

    def _fail(self, error: OSError) -> None:
        """Close the file with what it holds; where even that fails it is left as it is, whole.

        Raises
        ------
        LogWriteError
            Always.
        """
        self._writer = None  # whatever happens now, nothing more is written after the end
        reason = error.strerror or str(error)
        self._result.pop("last", None)  # of rows that are not in the file
        self._store.fail(reason, self._result)
        text = f"{self._store.place.path} cannot be written further: {reason}"
        if error.errno not in _GONE:
            text += f"; the log is valid up to t = {self._store.end_ns / NANOSECONDS} s"
        raise LogWriteError(text) from error
