"""The recorder that writes an MCAP file: one topic per component, readable by any MCAP tool."""

from __future__ import annotations

import hashlib
import json
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self, final

import numpy as np

from cosim.arrays import Matrix
from cosim.core.contracts import Block, Plan, Stopped
from cosim.core.signals import Interface
from cosim.errors import Interrupted, LogError, LogWriteError
from cosim.log.buffer import RowBuffer, message_run
from cosim.log.compression import Compression
from cosim.log.content import combine
from cosim.log.environment import library
from cosim.log.layout import signals_json, split
from cosim.log.metadata import seal
from cosim.log.preamble import Attachment, write_parts, write_preamble
from cosim.log.schema import Level, encode_log
from cosim.log.sink import Mark, Sink, create

RESULT = "cosim.result"
RESULT_FILE = "result.json"

_FLUSH_AFTER = 1.0  # s of wall time
_MARKS = 16  # chunks that may be given up to make room for the end of the file on a full disk


@dataclass(frozen=True, slots=True)
class _Reached:
    """The last row of a run."""

    steps: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class _Saved:
    """What the file held at a mark: to close it there after a failed write."""

    mark: Mark
    hashes: dict[str, hashlib._Hash]
    reached: _Reached


@final
class McapRecorder:
    """Record a run to an MCAP file.

    The file is created by :meth:`begin` and completed when the ``with`` block ends, however it ends.

    Parameters
    ----------
    path : Path or str
        File to write; missing folders are created.
    force : bool
        Replace a file that exists.
    compression : {"zstd", "lz4", "none"}
    kinds : mapping of component name to str
        Kinds of the components, as the scenario calls them.
    metadata : mapping of record name to its items
        Metadata records, such as ``cosim.run``, ``cosim.connections``, ``cosim.component.<name>`` (parameters).
    attachments : sequence of Attachment

    Attributes
    ----------
    result : dict
        Goes to ``result.json`` at the end; JSON values.
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
        self.result: dict[str, Any] = {}
        self._force, self._compression = force, compression
        self._kinds, self._metadata, self._attachments = kinds or {}, metadata or {}, attachments
        self._sink: Sink | None = None
        self._saved: deque[_Saved] = deque(maxlen=_MARKS)
        self._messages: list[tuple[int, bytes]] = []
        self._reached: _Reached | None = None

    def __enter__(self) -> Self:
        """Refuse a path that exists.

        Raises
        ------
        LogError
            If the file exists and ``force`` is false.
        """
        if not self._force and self.path.exists():
            raise LogError(f"{self.path} exists; choose another path, or --force to replace it")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Write what is buffered, the result and the summary.

        Raises
        ------
        LogWriteError
            If the file cannot be written to.
        """
        if self._sink is None:
            return
        try:
            self._sink.rewind(self._saved[-1].mark)  # where an interrupt came within a write
            self._hashes = _copied(self._saved[-1].hashes)
            self._flush()
            self._close(self._sink, self._saved[-1], _outcome(error))
        except OSError as failure:
            self._fail(failure)
        self._sink = None

    def begin(self, plan: Plan) -> None:
        """Create the file and write everything known before the run.

        Raises
        ------
        LogError
            If the file cannot be created.
        """
        channels = plan.layout.channels
        parts = [p for c in channels for p in split(c, kind=self._kinds.get(c.name, ""), step_ns=plan.step_ns)]
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self._force:
                self.path.unlink(missing_ok=True)  # whoever has the old file open keeps it whole
            stream = create(self.path)
        except OSError as error:
            raise LogError(f"{self.path} cannot be created: {error.strerror or error}") from error
        try:
            sink = Sink(stream, library=library())
            ids = write_parts(sink, parts)
            self._log_id = write_preamble(sink, plan, metadata=self._metadata, attachments=self._attachments)
        except OSError as error:
            stream.close()
            self.path.unlink()
            raise LogError(f"{self.path} cannot be written: {error.strerror or error}") from error
        self._interfaces: dict[str, Interface] = {channel.name: channel.interface for channel in channels}
        self._hashes = {channel.name: hashlib.sha256() for channel in channels}
        self._buffer = RowBuffer(plan.layout, list(zip(ids, parts, strict=True)))
        self._step_ns = plan.step_ns
        self._sink = sink
        self._save()

    def write(self, block: Block, signals: Matrix) -> None:
        """Take rows 1 to K of ``signals``, shape (K+1, width); of the very first block row 0 too.

        Raises
        ------
        LogWriteError
            If the file cannot be written to, or a time is negative.
        """
        if block.time_ns[0] < 0:
            raise LogWriteError(f"{self.path}: time {block.time_ns[0]} ns; the times of a log begin at 0")
        row = 0 if block.index == 0 and self._reached is None else 1
        while row <= block.steps:
            row = self._buffer.take(block, signals, row)
            self._reached = _Reached(block.index + row - 1, int(block.time_ns[row - 1]))
            if self._buffer.full or time.monotonic() - self._flushed >= _FLUSH_AFTER:
                self._write_chunk()

    def message(self, time_ns: int, level: Level, name: str, text: str) -> None:
        """Record a message of the run or of a component at a simulation time [ns] on ``/cosim/log``."""
        self._messages.append((time_ns, encode_log(time_ns, level, name, text)))

    def _write_chunk(self) -> None:
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
        self._save()
        self._buffer.clear()
        self._messages.clear()

    def _save(self) -> None:
        """Remember what the file holds now, and when."""
        assert self._sink is not None
        self._saved.append(_Saved(self._sink.mark(), _copied(self._hashes), self._reached or _Reached(0, 0)))
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
        while self._saved:
            saved = self._saved.pop()
            with suppress(OSError):
                sink.rewind(saved.mark)
                self._close(sink, saved, ("failed", f"the log could not be written further: {reason}"))
                whole = f"up to {saved.reached.end_ns} ns it is a valid file"
                break
        else:
            sink.abandon()
            whole = "it has no end"
        raise LogWriteError(f"{self.path} cannot be written further: {reason}; {whole}") from error

    def _close(self, sink: Sink, saved: _Saved, outcome: tuple[str, str]) -> None:
        """Write the result and the end of the file."""
        digests = [(name, signals_json(self._interfaces[name]), digest.hexdigest()) for name, digest in saved.hashes.items()]
        items = {"status": outcome[0], "reason": outcome[1], **asdict(saved.reached), "content_hash": combine(digests)}
        sink.metadata(RESULT, seal(RESULT, {key: str(value) for key, value in items.items()}))
        text = json.dumps({**self.result, **items}, default=_plain, indent=2)
        sink.attachment(RESULT_FILE, "application/json", text.encode())
        sink.close()


def _copied(hashes: Mapping[str, hashlib._Hash]) -> dict[str, hashlib._Hash]:
    return {name: digest.copy() for name, digest in hashes.items()}


def _outcome(error: BaseException | None) -> tuple[str, str]:
    """Name how the run ended, and why."""
    match error:
        case None:
            return "complete", ""
        case Stopped(failed=False):
            return "complete", str(error)
        case KeyboardInterrupt() | Interrupted():
            return "interrupted", str(error) or "interrupted by the user"
        case _:
            return "failed", str(error) or type(error).__name__


def _plain(value: object) -> object:
    """Give numpy values and paths as JSON can say them."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else str(value)
