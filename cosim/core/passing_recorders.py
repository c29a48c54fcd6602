"""Recorders that pass a run on to others, and do something of their own with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self, final

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.recorders import close, follow, row_memory
from cosim.core.recording import (
    MessageLevel,
    Plan,
    Recorder,
    RowsUnderWay,
    SignalEvent,
    Substep,
)


class PassingRecorder:
    """Passes everything on; a subclass says what else it does.

    Rows are computed in the memory of the other recorder only where a subclass offers it.

    Parameters
    ----------
    recorder : Recorder
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder

    def __enter__(self) -> Self:
        self._recorder.__enter__()
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._recorder.__exit__(error_type, error, trace)

    def begin(self, plan: Plan) -> None:
        """Pass on."""
        self._recorder.begin(plan)

    def follow(self, rows: RowsUnderWay) -> None:
        """Pass on; a subclass that changes rows changes these, too."""
        follow(self._recorder, rows)

    def write(self, block: Block, signals: Matrix) -> None:
        """Pass on."""
        self._recorder.write(block, signals)

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Pass on."""
        self._recorder.message(time_ns, level, source, text)

    def event(self, event: SignalEvent) -> None:
        """Pass on."""
        self._recorder.event(event)

    def substep(self, substep: Substep) -> None:
        """Pass on."""
        self._recorder.substep(substep)

    def result(self, values: Mapping[str, Any]) -> None:
        """Pass on."""
        self._recorder.result(values)


@final
class Watched(PassingRecorder):
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
        super().__init__(recorder)
        self._memory = row_memory(recorder)
        self._reached = reached
        self._began = began
        self._jumped = jumped
        self._ended = ended

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended(self._recorder, error)

    def begin(self, plan: Plan) -> None:
        """Pass on, then report."""
        super().begin(plan)
        if self._began is not None:
            self._began()

    def memory_for(self, block: Block, steps: int) -> Matrix | None:
        """Pass on."""
        return None if self._memory is None else self._memory.memory_for(block, steps)

    def event(self, event: SignalEvent) -> None:
        """Pass on, then report."""
        super().event(event)
        if self._jumped is not None:
            self._jumped(event)

    def write(self, block: Block, signals: Matrix) -> None:
        """Pass on, then report."""
        self._recorder.write(block, signals)
        self._reached(block, signals)


@final
class TwoRecorders:
    """Passes everything on to two recorders, one after the other.

    What one raises ends the run; both are closed all the same.

    Parameters
    ----------
    first : Recorder
        Keeps the run: where it has memory for rows, that is used.
    second : Recorder
    """

    def __init__(self, first: Recorder, second: Recorder) -> None:
        self._first = first
        self._second = second

    def __enter__(self) -> Self:
        self._first.__enter__()
        self._second.__enter__()
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self._first.__exit__(error_type, error, trace)
        finally:
            self._second.__exit__(error_type, error, trace)

    def begin(self, plan: Plan) -> None:
        """Pass on."""
        self._first.begin(plan)
        self._second.begin(plan)

    def follow(self, rows: RowsUnderWay) -> None:
        """Pass on."""
        follow(self._first, rows)
        follow(self._second, rows)

    def memory_for(self, block: Block, steps: int) -> Matrix | None:
        """Return the memory of the first."""
        memory = row_memory(self._first)
        return None if memory is None else memory.memory_for(block, steps)

    def write(self, block: Block, signals: Matrix) -> None:
        """Pass on."""
        self._first.write(block, signals)
        self._second.write(block, signals)

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Pass on."""
        self._first.message(time_ns, level, source, text)
        self._second.message(time_ns, level, source, text)

    def event(self, event: SignalEvent) -> None:
        """Pass on."""
        self._first.event(event)
        self._second.event(event)

    def substep(self, substep: Substep) -> None:
        """Pass on."""
        self._first.substep(substep)
        self._second.substep(substep)

    def result(self, values: Mapping[str, Any]) -> None:
        """Pass on."""
        self._first.result(values)
        self._second.result(values)
