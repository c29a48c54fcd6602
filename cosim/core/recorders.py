"""Recorders: Memory keeps a run and is its recording, Nothing keeps nothing; how a run ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds, read_only
from cosim.core.arguments import check_type
from cosim.core.contracts import Block, Stopped
from cosim.core.growing_rows import GrowingRows
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.signals import RunMessage, find_channel
from cosim.core.recording import (
    Following,
    MessageLevel,
    Plan,
    Recorder,
    RowMemory,
    RowsUnderWay,
    SignalEvent,
    Substep,
)
from cosim.core.signals import Channel
from cosim.errors import CosimError, Interrupted, LogError, UsageError, nearest
from cosim.instants import StepNs


@dataclass(frozen=True, slots=True)
class EndOfRun:
    """How a run ended, and its stop reason; a component that asked for the end gives one too."""

    status: Literal["complete", "failed", "interrupted"] = "complete"
    reason: str = ""


def end_of_run(error: BaseException | None) -> EndOfRun:
    """Return how a run ended by the error that it ended with."""
    match error:
        case None:
            return EndOfRun()
        case Stopped(failed=False):
            return EndOfRun("complete", str(error))
        case KeyboardInterrupt() | Interrupted():
            return EndOfRun("interrupted", str(error) or "interrupted by the user")
        case SystemExit() | GeneratorExit():  # who called has left; nothing has failed
            return EndOfRun("interrupted", error_text(error))
        case _:
            return EndOfRun("failed", error_text(error))


def error_text(error: BaseException) -> str:
    """Return what an error says; of one that is none of cosim with its type."""
    name = type(error).__name__
    text = str(error)
    if isinstance(error, CosimError):
        return text or name
    return f"{name}: {text}" if text else name


def _numbers(steps: range) -> NDArray[np.int64]:
    return np.arange(steps.start, steps.stop)


class Memory(RecordedRun):
    """Keeps every row of a run in memory; implements Recorder and Recording.

    Parameters
    ----------
    metadata : mapping, optional
        Of the run.
    attachments : mapping of name to content, optional
        Files that belong to it.
    """

    def __init__(
        self,
        metadata: Mapping[str, Any] | None = None,
        attachments: Mapping[str, bytes] | None = None,
    ) -> None:
        if metadata is not None:
            check_type("metadata", metadata, Mapping, UsageError)
        if attachments is not None:
            check_type("attachments", attachments, Mapping, UsageError)
        self._metadata: Mapping[str, Any] = metadata or {}
        self._attachments: Mapping[str, bytes] = attachments or {}
        self._channels: Mapping[str, Channel] = {}
        self._messages: list[RunMessage] = []
        self._events: list[SignalEvent] = []
        self._substeps: list[Substep] = []
        self._results: dict[str, Any] = {}
        self._rows = GrowingRows()
        self._times: list[Nanoseconds] = []
        self._steps: list[range] = []  # numbers of the steps
        self._end = EndOfRun()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end = end_of_run(error)

    def begin(self, plan: Plan) -> None:
        """Keep the layout."""
        self.plan = plan
        self._rows = GrowingRows(plan.layout.width)
        self._channels = plan.channels

    def memory_for(self, block: Block, steps: int) -> Matrix:
        """Return the memory where the rows of a block will stay; see :class:`RowMemory`."""
        return self._rows.place(block.steps, steps)

    def write(self, block: Block, signals: Matrix) -> None:
        """Keep the new rows; copy them where they are not in its memory already."""
        first = 0 if block.index == 0 and not self._rows.count else 1
        if first > block.steps:
            return
        self.__dict__.pop("_table", None)  # it was read while the run went on
        self._rows.append(signals, first)
        times = block.time_ns[first:]
        # those of a clock are never written to
        self._times.append(times.copy() if block.time_ns.flags.writeable else times)
        self._steps.append(range(block.index + first, block.index + block.steps + 1))

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Keep a message."""
        self._messages.append(RunMessage(time_ns, level, source, text))

    def event(self, event: SignalEvent) -> None:
        """Keep a jump."""
        self._events.append(event)

    def substep(self, substep: Substep) -> None:
        """Keep a substep."""
        self._substeps.append(substep)

    def result(self, values: Mapping[str, Any]) -> None:
        """Keep values of the end of the run."""
        self._results.update(values)

    def messages(self) -> list[RunMessage]:
        """Return the messages of the run and its components, in the order of time."""
        return sorted(self._messages, key=lambda message: message.time_ns)

    def events(self) -> list[SignalEvent]:
        """Return the jumps of signals, in the order of time."""
        return list(self._events)

    def substeps(self) -> list[Substep]:
        """Return the substeps of loops, in the order of where they begin."""
        return list(self._substeps)

    @property
    def results(self) -> Mapping[str, Any]:
        """What was recorded of the end of the run."""
        return self._results

    @property
    def label(self) -> str:
        """What was recorded to."""
        return "the run"

    @property
    def metadata(self) -> Mapping[str, Any]:
        """Metadata of the run."""
        return self._metadata

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return tuple(self._attachments)

    def attachment(self, name: str) -> bytes:
        """Return the content of an attachment.

        Raises
        ------
        LogError
            If there is none of that name.
        """
        if name not in self._attachments:
            known = nearest(name, self._attachments)
            raise LogError(f"{self.label} has no attachment {name!r}; {known}")
        return self._attachments[name]

    @property
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""
        return self.plan.step_ns

    @property
    def status(self) -> str:
        """How the run ended: ``complete``, ``failed`` or ``interrupted``."""
        return self._end.status

    @property
    def reason(self) -> str:
        """The stop reason; empty where the run came to its end."""
        return self._end.reason

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name; none before the run has begun."""
        return self._channels

    @property
    def schedule(self) -> Sequence[str]:
        """The stages of the run in their order."""
        return self.plan.schedule

    @property
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component had a zero-order hold."""
        return self.plan.held

    @cached_property
    def _table(self) -> tuple[Matrix, Nanoseconds, NDArray[np.int64]]:
        """All rows, their instants [ns] and the numbers of their steps."""
        no_numbers = np.empty(0, np.int64)
        rows = read_only(self._rows.all())
        times = np.concatenate([no_numbers, *self._times])
        steps = np.concatenate([no_numbers, *map(_numbers, self._steps)])
        return rows, times, steps

    def _is_kept(self, channel: Channel) -> NDArray[np.bool_]:
        _, _, steps = self._table
        kept: NDArray[np.bool_] = steps % channel.period == 0
        return kept

    def rows(self, component: str) -> Matrix:
        """Return all rows of a component: applied inputs, then outputs; shape (N, width).

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        """
        channel = find_channel(self.channels, component, source=self.label)
        rows, _, _ = self._table
        own_rows = rows[:, channel.columns]
        if channel.period == 1:
            return own_rows
        kept: Matrix = own_rows[self._is_kept(channel)]
        kept.flags.writeable = False
        return kept

    def time_ns(self, component: str) -> Nanoseconds:
        """Return the instants of a component's rows, shape (N,) [ns].

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        """
        channel = find_channel(self.channels, component, source=self.label)
        _, times, _ = self._table
        return times[self._is_kept(channel)]

    @property
    def end_ns(self) -> int:
        """The last recorded instant [ns]; 0 if there is none."""
        return int(self._times[-1][-1]) if self._times else 0

    @property
    def steps(self) -> int:
        """Number of the last recorded communication step."""
        return self._steps[-1][-1] if self._steps else 0


def row_memory(recorder: Recorder) -> RowMemory | None:
    """Return a recorder as what has the memory where rows will stay; None: it has none."""
    return recorder if isinstance(recorder, RowMemory) else None


def follow(recorder: Recorder, rows: RowsUnderWay) -> None:
    """Let a recorder follow the rows of a block under way, if it does that."""
    if isinstance(recorder, Following):
        recorder.follow(rows)


def close(recorder: Recorder, error: BaseException | None) -> None:
    """Close a recorder with the error that its run ended with; None: it came to its end."""
    if error is None:
        recorder.__exit__(None, None, None)
    else:
        recorder.__exit__(type(error), error, error.__traceback__)


class Nothing:
    """Keeps nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

    def begin(self, plan: Plan) -> None:
        """Do nothing."""

    def write(self, block: Block, signals: Matrix) -> None:
        """Do nothing."""

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Do nothing."""

    def event(self, event: SignalEvent) -> None:
        """Do nothing."""

    def substep(self, substep: Substep) -> None:
        """Do nothing."""

    def result(self, values: Mapping[str, Any]) -> None:
        """Do nothing."""
