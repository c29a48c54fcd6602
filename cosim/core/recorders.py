"""Recorders: a run kept in memory, passed on to several, or a slice of it; how a run ended."""

from __future__ import annotations

import math
import mmap
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from types import TracebackType
from typing import Any, Final, Literal, Self, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds, read_only
from cosim.core.arguments import check_type
from cosim.core.contracts import Block, Stopped
from cosim.core.recorded.partial import PartialRecord, RecordSelection, partial_layout
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.selection import chosen_signals
from cosim.core.recorded.signals import RunMessage
from cosim.core.recording import (
    MessageLevel,
    Plan,
    Recorder,
    RowMemory,
    RowsUnderWay,
    SignalEvent,
    Substep,
    TimedRows,
)
from cosim.core.signals import Channel, column_names
from cosim.errors import CosimError, Interrupted, LogError, UsageError, nearest
from cosim.instants import StepNs

MEMORY_BYTES: Final = 2**30  # of rows that are taken at a time
_ALL: Final = RecordSelection()
_LAST: Final = "last"  # the values of all signals at the end, by the names of their elements


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
        self._first = 0  # number of the step of the first row
        self._end = EndOfRun()

    # --- as a recorder ---

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
        """Return the memory where the rows of a block will stay; see :class:`Recorder`."""
        return self._rows.place(block.steps, steps)

    def write(self, block: Block, signals: Matrix) -> None:
        """Keep the new rows; copy them where they are not in its memory already."""
        first = 0 if block.index == 0 and not self._rows.count else 1
        if first > block.steps:
            return
        if not self._rows.count:
            self._first = block.index + first
        self.__dict__.pop("_table", None)  # it was read while the run went on
        self._rows.append(signals, first)
        times = block.time_ns[first:]
        # those of a clock are never written to
        self._times.append(times.copy() if block.time_ns.flags.writeable else times)

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

    # --- as a recording ---

    @property
    def label(self) -> str:
        """What was recorded to."""
        return "the run"

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
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component had a zero-order hold."""
        return self.plan.held

    @property
    def schedule(self) -> Sequence[str]:
        """The stages of the run in their order."""
        return self.plan.schedule

    @property
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""
        return self.plan.step_ns

    @property
    def steps(self) -> int:
        """Number of the last recorded communication step."""
        return self._first + self._rows.count - 1 if self._rows.count else 0

    @property
    def end_ns(self) -> int:
        """The last recorded instant [ns]; 0 if there is none."""
        return int(self._times[-1][-1]) if self._times else 0

    @property
    def metadata(self) -> Mapping[str, Any]:
        """Metadata of the run."""
        return self._metadata

    @property
    def results(self) -> Mapping[str, Any]:
        """What was recorded of the end of the run."""
        return self._results

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

    def messages(self) -> list[RunMessage]:
        """Return the messages of the run and its components, in the order of time."""
        return sorted(self._messages, key=lambda message: message.time_ns)

    def events(self) -> list[SignalEvent]:
        """Return the jumps of signals, in the order of time."""
        return list(self._events)

    def substeps(self) -> list[Substep]:
        """Return the substeps of loops, in the order of where they begin."""
        return list(self._substeps)

    @cached_property
    def _table(self) -> TimedRows:
        """The instants of all steps [ns], and their rows."""
        times = np.concatenate([np.empty(0, np.int64), *self._times])
        times.flags.writeable = False
        return times, read_only(self._rows.all())

    def _timed_rows(self, channel: Channel) -> TimedRows:
        times, rows = self._table
        own = slice(-self._first % channel.period, None, channel.period)
        return times[own], rows[own, channel.columns]


class Nothing(Recorder):
    """Keeps nothing."""

    def __init__(self) -> None:  # a protocol's takes everything
        return


# --- runs that are passed on ---


def row_memory(recorder: Recorder) -> RowMemory | None:
    """Return what gives the memory where rows will stay; None: a recorder has none."""
    found: RowMemory | None = getattr(recorder, "memory_for", None)
    return found


def close(recorder: Recorder, error: BaseException | None) -> None:
    """Close a recorder with the error that its run ended with; None: it came to its end."""
    if error is None:
        recorder.__exit__(None, None, None)
    else:
        recorder.__exit__(type(error), error, error.__traceback__)


class Tee(Recorder):
    """Passes a run on to several recorders, one after the other, and reports how far it is.

    What one raises ends the run; all are closed all the same. Rows are computed in the memory of
    the first, where that has any.

    Parameters
    ----------
    recorders : Recorder
    began, jumped, said, reached, ended : callable, optional
        Called with what has been passed on: before the first step; with every event; with every
        message; with every block and its rows. The last one closes each recorder, with the error
        that the run ended with; left out: :func:`close`.
    """

    def __init__(
        self,
        *recorders: Recorder,
        began: Callable[[], None] | None = None,
        jumped: Callable[[SignalEvent], None] | None = None,
        said: Callable[[RunMessage], None] | None = None,
        reached: Callable[[Block, Matrix], None] | None = None,
        ended: Callable[[Recorder, BaseException | None], None] = close,
    ) -> None:
        self._recorders = recorders
        self._memory = row_memory(recorders[0])
        self._began = began
        self._jumped = jumped
        self._said = said
        self._reached = reached
        self._ended = ended

    def __enter__(self) -> Self:
        for recorder in self._recorders:
            recorder.__enter__()
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with ExitStack() as closing:
            for recorder in reversed(self._recorders):
                closing.callback(self._ended, recorder, error)

    def begin(self, plan: Plan) -> None:
        """Pass on, then report."""
        for recorder in self._recorders:
            recorder.begin(plan)
        if self._began is not None:
            self._began()

    def memory_for(self, block: Block, steps: int) -> Matrix | None:
        """Return the memory of the first."""
        return None if self._memory is None else self._memory(block, steps)

    def follow(self, rows: RowsUnderWay) -> None:
        """Pass on to those that follow the rows of a block under way."""

        def part() -> tuple[Block, Matrix] | None:
            found = rows()
            return None if found is None else self._part(*found)

        for recorder in self._recorders:
            follow(recorder, part)

    def write(self, block: Block, signals: Matrix) -> None:
        """Pass on, then report."""
        part = self._part(block, signals)
        if part is not None:
            for recorder in self._recorders:
                recorder.write(*part)
            if self._reached is not None:
                self._reached(*part)

    def _part(self, block: Block, signals: Matrix) -> tuple[Block, Matrix] | None:
        """Return what is passed on of a block: all of it; None: nothing."""
        return block, signals

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Pass on, then report."""
        for recorder in self._recorders:
            recorder.message(time_ns, level, source, text)
        if self._said is not None:
            self._said(RunMessage(time_ns, level, source, text))

    def event(self, event: SignalEvent) -> None:
        """Pass on, then report."""
        for recorder in self._recorders:
            recorder.event(event)
        if self._jumped is not None:
            self._jumped(event)

    def substep(self, substep: Substep) -> None:
        """Pass on."""
        for recorder in self._recorders:
            recorder.substep(substep)

    def result(self, values: Mapping[str, Any]) -> None:
        """Pass on."""
        for recorder in self._recorders:
            recorder.result(values)


def follow(recorder: Recorder, rows: RowsUnderWay) -> None:
    """Let a recorder follow the rows of a block under way, if it does that."""
    take: Callable[[RowsUnderWay], None] | None = getattr(recorder, "follow", None)
    if take is not None:
        take(rows)


@final
class Watched(Tee):
    """Passes everything on to another recorder, and reports how far the run is.

    Parameters
    ----------
    recorder : Recorder
    reached : callable
        Called with every block and its rows after they have been recorded; what it raises ends the
        run, cleanly.
    began : callable, optional
        Called once, before the first step.
    jumped : callable, optional
        Called with every event.
    ended : callable, optional
        Called at the end with the other recorder, which still takes results and is to be closed
        then, and the error that the run ended with. Left out: :func:`close`.
    """

    def __init__(
        self,
        recorder: Recorder,
        reached: Callable[[Block, Matrix], None],
        *,
        began: Callable[[], None] | None = None,
        jumped: Callable[[SignalEvent], None] | None = None,
        ended: Callable[[Recorder, BaseException | None], None] = close,
    ) -> None:
        super().__init__(recorder, reached=reached, began=began, jumped=jumped, ended=ended)


@final
class Slice(Tee):
    """Passes on the chosen signals, from a communication point on, which then is number 0.

    The run itself stays the same, to the last bit.

    Parameters
    ----------
    recorder : Recorder
    selection : RecordSelection
    beside : mapping of component name to Channel, optional
        As of :func:`chosen_signals`.
    index : int
        Number of the communication point.
    begin_ns : int, optional
        Its instant; what is before that is left out. None: all is passed on.
    """

    def __init__(
        self,
        recorder: Recorder,
        selection: RecordSelection = _ALL,
        *,
        beside: Mapping[str, Channel] | None = None,
        index: int = 0,
        begin_ns: int | None = None,
    ) -> None:
        super().__init__(recorder)
        self._memory = None  # it has rows of another width
        self._selection = selection
        self._beside = beside or {}
        self._index = index
        self._begin_ns = -math.inf if begin_ns is None else begin_ns
        self._columns: slice | NDArray[np.intp] = slice(None)
        self._labels: frozenset[str] | None = None

    def begin(self, plan: Plan) -> None:
        """Pass on the plan of what is chosen."""
        declared = plan.channels
        signals = chosen_signals(declared, self._selection, beside=self._beside)
        layout, columns = partial_layout(plan.layout, signals, self._selection.every)
        partial = PartialRecord(self._selection, declared)
        chosen = {channel.name: channel for channel in layout.channels}
        if not all(partial.is_whole(name, chosen) for name in declared):
            is_start = columns == list(range(len(columns)))
            self._columns = slice(len(columns)) if is_start else np.array(columns, np.intp)
            self._labels = frozenset(column_names(layout))
            plan = replace(plan, layout=layout, partial=partial)
        super().begin(plan)

    def _part(self, block: Block, signals: Matrix) -> tuple[Block, Matrix] | None:
        """Return the chosen rows and columns; a recorder picks of the rows by their periods."""
        left_out = max(0, self._index - block.index)
        if left_out > block.steps:
            return None
        if self._index:
            part = block.part(left_out, block.steps)
            block = replace(part, index=part.index - self._index)
        return block, signals[left_out:, self._columns]

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Pass on what is not before the point."""
        if time_ns >= self._begin_ns:
            super().message(time_ns, level, source, text)

    def event(self, event: SignalEvent) -> None:
        """Pass on what is not before the point."""
        if event.time_ns >= self._begin_ns:
            super().event(event)

    def substep(self, substep: Substep) -> None:
        """Pass on what does not begin before the point."""
        if substep.begin_ns >= self._begin_ns:
            super().substep(substep)

    def result(self, values: Mapping[str, Any]) -> None:
        """Pass on; of the last row the elements that are chosen."""
        last = values.get(_LAST)
        if self._labels is not None and isinstance(last, Mapping):
            kept = {label: value for label, value in last.items() if label in self._labels}
            values = {**values, _LAST: kept}
        super().result(values)


# --- memory that grows with a run ---


@final
class GrowingRows:
    """The rows of a run, written where they stay; memory is taken as it is needed.

    Parameters
    ----------
    width : int
        Columns of a row.

    Attributes
    ----------
    count : int
        How many rows there are.
    """

    def __init__(self, width: int = 0) -> None:
        self.count = 0
        self._width = width
        self._parts: list[Matrix] = []  # what is full
        self._memory = np.empty((0, width))
        self._begin = 0  # rows of the memory that are kept
        self._end = 0

    def place(self, steps: int, expected: int) -> Matrix:
        """Return rows for some steps; row 0 is the last row that there is, or the first.

        ``expected`` is how many steps are still to come: memory that the run will fill anyway is
        taken at once, and untouched costs nothing.
        """
        begin = max(self._end - 1, 0)
        if begin + steps >= len(self._memory):
            self._take(max(steps, min(expected, MEMORY_BYTES // (8 * self._width + 1))))
            begin = 0
        return self._memory[begin : begin + steps + 1]

    def _take(self, steps: int) -> None:
        """Take memory for more rows, and begin it with the last one."""
        memory = untouched_rows(steps + 1, self._width)
        if self.count:
            memory[0] = self._memory[self._end - 1]
            self._parts.append(self._memory[self._begin : self._end])
            self._begin = 1
            self._end = 1
        self._memory = memory

    def append(self, signals: Matrix, first: int) -> None:
        """Keep the rows from ``first`` on, where row 0 is the last that there is, or the first."""
        steps = len(signals) - 1
        place = self.place(steps, steps)
        if place.ctypes.data != signals.ctypes.data:
            place[first:] = signals[first:]
        if not self.count:
            self._begin = first
            self._end = first
        self._end += steps + 1 - first
        self.count += steps + 1 - first

    def all(self) -> Matrix:
        """Return all rows, shape (count, width)."""
        last = self._memory[self._begin : self._end]
        if not self._parts:
            return last
        whole = np.concatenate([*self._parts, last])
        self._parts = []
        self._memory = whole
        self._begin = 0
        self._end = len(whole)
        return whole


def untouched_rows(count: int, width: int) -> Matrix:
    """Return memory for rows that are written once, one behind the other.

    numpy asks the system for huge pages where an array is large. On a virtual machine their first
    touch costs several times as much as that of ordinary pages, and more than the steps.
    """
    size = max(1, 8 * count * width)
    if sys.platform == "win32":
        memory = mmap.mmap(-1, size)
    else:
        memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
    return np.frombuffer(memory, np.float64, count * width).reshape(count, width)
