"""Recorders that pass a run on to others, and do something of their own with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
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

    What one raises ends the run; all are closed all the same. Rows are computed in the memory of
    another recorder only where a subclass offers it.

    Parameters
    ----------
    recorders : Recorder
        One after the other.
    """

    def __init__(self, *recorders: Recorder) -> None:
        self._recorder = recorders[0]
        self._recorders = recorders

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
                closing.callback(recorder.__exit__, error_type, error, trace)

    def begin(self, plan: Plan) -> None:
        """Pass on."""
        for recorder in self._recorders:
            recorder.begin(plan)

    def follow(self, rows: RowsUnderWay) -> None:
        """Pass on; a subclass that changes rows changes these, too."""
        for recorder in self._recorders:
            follow(recorder, rows)

    def write(self, block: Block, signals: Matrix) -> None:
        """Pass on."""
        for recorder in self._recorders:
            recorder.write(block, signals)

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Pass on."""
        for recorder in self._recorders:
            recorder.message(time_ns, level, source, text)

    def event(self, event: SignalEvent) -> None:
        """Pass on."""
        for recorder in self._recorders:
            recorder.event(event)

    def substep(self, substep: Substep) -> None:
        """Pass on."""
        for recorder in self._recorders:
            recorder.substep(substep)

    def result(self, values: Mapping[str, Any]) -> None:
        """Pass on."""
        for recorder in self._recorders:
            recorder.result(values)


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
class TwoRecorders(PassingRecorder):
    """Passes everything on to two recorders; where the first has memory for rows, that is used."""

    def memory_for(self, block: Block, steps: int) -> Matrix | None:
        """Return the memory of the first."""
        memory = row_memory(self._recorder)
        return None if memory is None else memory.memory_for(block, steps)
