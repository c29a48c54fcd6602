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
from cosim.core.contracts import Block, MessageLevel, Plan
from cosim.core.recorders import EndOfRun, end_of_run
from cosim.core.signals import Interface
from cosim.errors import LogError, LogWriteError, RunError
from cosim.log.buffer import RowBuffer, message_run
from cosim.log.compression import Compression
from cosim.log.content import combine
from cosim.log.unfinished import UnfinishedLog
from cosim.log.environment import library
from cosim.log.interrupts import uninterrupted
from cosim.log.layout import signals_json, split
from cosim.log.preamble import Attachment, write_parts, write_preamble
from cosim.log.result import LastRow, write_result
from cosim.log.schema import encode_log
from cosim.log.sink import Mark, Sink

_FLUSH_AFTER = 1.0  # s of wall time
_MARKS = 16  # chunks that may be given up to make room for the end of the file on a full disk


@dataclass(frozen=True, slots=True)
class _Saved:
    """What the file held at a mark: to close it there after a failed write."""

    mark: Mark
    hashes: dict[str, hashlib._Hash]
    reached: LastRow


@final
class McapRecorder:
    """Record a run to an MCAP file.

    The file is created by :meth:`begin` under a hidden name, stands at its path from the first :meth:`write` on, and is
    completed when the ``with`` block ends, however it ends. A run that is refused before its first row leaves nothing, and an
    existing log as it was; one that failed at its start, or had no rows, leaves a log without rows.

    Parameters
    ----------
    path : Path or str
        File to write; missing folders are created.
    force : bool
        Replace a file that exists, at the first row.
    compression : {"zstd", "lz4", "none"}
    kinds : mapping of component name to str
        Kinds of the components, as the scenario calls them.
    metadata : mapping of record name to its items
        Metadata records, such as ``cosim.run``, ``cosim.connections``, ``cosim.component.<name>`` (parameters).
    attachments : sequence of Attachment
    """

    def __init__(
        self,
        path: Path | str,
        *,
        force: bool = False,
        compression: Compression = "zstd",
        kinds: Mapping[str, str] | None = None,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        attachments: Sequence[Attachment] = (),
    ) -> None:
        self.path = Path(path)
        self._result: dict[str, Any] = {}
        self._force, self._compression = force, compression
        self._kinds, self._metadata, self._attachments = kinds or {}, metadata or {}, attachments
        self._unfinished = UnfinishedLog(self.path, force=force)
        self._sink: Sink | None = None
        self._saved: deque[_Saved] = deque(maxlen=_MARKS)
        self._messages: list[tuple[int, bytes]] = []
        self._reached = LastRow()

    def __enter__(self) -> Self:
        """Refuse a path that exists.

        Raises
        ------
        LogError
            If the file exists and ``force`` is false, or the path is a folder.
        """
        if self.path.is_dir():
            raise LogError(
                f"{self.path} is a folder; name a file, such as {self.path / 'run.mcap'}"
            )
        if not self._force and self.path.exists():
            raise LogError(f"{self.path} exists; choose another path, or --force to replace it")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
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
                wanted = self._unfinished.published or error is None or isinstance(error, RunError)
                if self._sink is not None and wanted:
                    self._unfinished.publish()
                    self._complete(self._sink, end_of_run(error))
            finally:
                self._unfinished.discard()
                self._sink = None

    def begin(self, plan: Plan) -> None:
        """Create the file and write everything known before the run.

        Raises
        ------
        LogError
            If the file cannot be created.
        """
        with uninterrupted():
            self._begin(plan, self._unfinished.create())

    def _begin(self, plan: Plan, stream: RawIOBase) -> None:
        channels = plan.layout.channels
        parts = [
            p
            for c in channels
            for p in split(c, kind=self._kinds.get(c.name, ""), step_ns=plan.step_ns)
        ]
        try:
            sink = Sink(stream, library=library())
            ids = write_parts(sink, parts)
            self._log_id = write_preamble(
                sink, plan, metadata=self._metadata, attachments=self._attachments
            )
        except OSError as error:
            raise LogError(f"{self.path} cannot be written: {error.strerror or error}") from error
        self._interfaces: dict[str, Interface] = {
            channel.name: channel.interface for channel in channels
        }
        self._hashes = {channel.name: hashlib.sha256() for channel in channels}
        self._buffer = RowBuffer(plan.layout, list(zip(ids, parts, strict=True)))
        self._step_ns = plan.step_ns
        self._sink = sink
        self._save()

    def write(self, block: Block, signals: Matrix) -> None:
        """Take rows 1 to K of ``signals``, shape (K+1, width); of the very first block row 0 too.

        Raises
        ------
        LogError
            If another file has come to stand at the path before the first row.
        LogWriteError
            If the file cannot be written to, or a time is negative.
        """
        if block.time_ns[0] < 0:
            raise LogWriteError(
                f"{self.path}: time {block.time_ns[0]} ns; the times of a log begin at 0"
            )
        first = not self._unfinished.published
        if first:
            with uninterrupted():
                self._unfinished.publish()
        row = 0 if first and block.index == 0 else 1
        while row <= block.steps:
            row = self._buffer.take(block, signals, row)
            if self._buffer.full or time.monotonic() - self._flushed >= _FLUSH_AFTER:
                self._write_chunk()

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Record a message of the run or of a component at a simulation time [ns].

        It goes to ``/cosim/log`` with the next chunk.
        """
        self._messages.append((time_ns, encode_log(time_ns, level, source, text)))

    def result(self, values: Mapping[str, Any]) -> None:
        """Add values to ``result.json``, which is written at the end.

        Parameters
        ----------
        values : mapping of str to JSON values, numpy arrays and numbers, or paths
            A key given before is replaced.
        """
        self._result.update(values)

    def _write_chunk(self) -> None:
        with (
            uninterrupted()
        ):  # between the mark and the cleared buffer, an interrupt would write the rows twice
            try:
                self._flush()
            except OSError as error:
                self._fail(error)

    def _flush(self) -> None:
        """Write what is buffered as one chunk."""
        assert self._sink is not None
        runs = self._buffer.runs()
        if self._messages:
            runs.append(message_run(self._messages, channel_id=self._log_id, step_ns=self._step_ns))
        if runs:
            self._sink.chunk(runs, self._compression)
        self._buffer.hash_into(self._hashes)
        self._reached = self._buffer.reached or self._reached
        self._save()
        self._buffer.clear()
        self._messages.clear()

    def _save(self) -> None:
        """Remember what the file holds now, and when."""
        assert self._sink is not None
        self._saved.append(_Saved(self._sink.mark(), _copied(self._hashes), self._reached))
        self._flushed = time.monotonic()

    def _fail(self, error: OSError) -> None:
        """Close the file where it was whole last, giving up chunks if the disk has no room for the end.

        Raises
        ------
        LogWriteError
            Always.
        """
        sink, self._sink = self._sink, None
        assert sink is not None
        reason = error.strerror or str(error)
        self._result.pop("last", None)  # rows may have to be given up
        while self._saved:
            saved = self._saved.pop()
            with suppress(OSError):
                sink.rewind(saved.mark)
                self._close(
                    sink,
                    saved,
                    EndOfRun("failed", f"the log could not be written further: {reason}"),
                )
                whole = f"up to t = {saved.reached.end_ns / 1e9} s it is a valid file"
                break
        else:
            sink.abandon()
            whole = "it has no end"
        raise LogWriteError(f"{self.path} cannot be written further: {reason}; {whole}") from error

    def _complete(self, sink: Sink, end: EndOfRun) -> None:
        try:
            sink.rewind(self._saved[-1].mark)  # where a write was not finished
            self._hashes = _copied(self._saved[-1].hashes)
            self._flush()
            self._close(sink, self._saved[-1], end)
        except OSError as failure:
            self._fail(failure)

    def _close(self, sink: Sink, saved: _Saved, end: EndOfRun) -> None:
        """Write the result and the end of the file."""
        digests = [
            (name, signals_json(self._interfaces[name]), digest.hexdigest())
            for name, digest in saved.hashes.items()
        ]
        write_result(sink, end, saved.reached, content_hash=combine(digests), more=self._result)
        sink.close()


def _copied(hashes: Mapping[str, hashlib._Hash]) -> dict[str, hashlib._Hash]:
    return {name: digest.copy() for name, digest in hashes.items()}
