"""What is kept of the run of a member: its metrics, how far it came and how it ended."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any, Protocol, Self, final

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.passing_recorders import PassingRecorder
from cosim.core.recorders import EndOfRun, end_of_run
from cosim.core.recording import MessageLevel, Plan, Recorder, SignalEvent, Substep
from cosim.studies.contracts import MetricValue


class MetricSink(Recorder, Protocol):
    """A recorder that keeps of a run what metrics say of it."""

    def values(self) -> Mapping[str, MetricValue]:
        """Return the metrics by name, when the run is over."""
        ...


@final
class MemberRecorder(PassingRecorder):
    """Passes a run on to what keeps its metrics, and knows how far it came and how it ended.

    Attributes
    ----------
    sink : MetricSink
    steps : int
        Communication steps that were completed.
    end : EndOfRun
    """

    def __init__(self, sink: MetricSink) -> None:
        super().__init__(sink)
        self.sink = sink
        self.steps = 0
        self.end = EndOfRun()

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end = end_of_run(error)
        super().__exit__(error_type, error, trace)

    def write(self, block: Block, signals: Matrix) -> None:
        """Pass on."""
        self.steps = block.index + block.steps
        self._recorder.write(block, signals)


@final
class BothRecorders(PassingRecorder):
    """Passes a run on to two recorders.

    Parameters
    ----------
    recorder, other : Recorder
        What the first one cannot take ends the run for both.
    """

    def __init__(self, recorder: Recorder, other: Recorder) -> None:
        super().__init__(recorder)
        self._other = other

    def __enter__(self) -> Self:
        super().__enter__()
        self._other.__enter__()
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            super().__exit__(error_type, error, trace)
        finally:
            self._other.__exit__(error_type, error, trace)

    def begin(self, plan: Plan) -> None:
        """Pass on to both."""
        super().begin(plan)
        self._other.begin(plan)

    def write(self, block: Block, signals: Matrix) -> None:
        """Pass on to both."""
        super().write(block, signals)
        self._other.write(block, signals)

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Pass on to both."""
        super().message(time_ns, level, source, text)
        self._other.message(time_ns, level, source, text)

    def event(self, event: SignalEvent) -> None:
        """Pass on to both."""
        super().event(event)
        self._other.event(event)

    def substep(self, substep: Substep) -> None:
        """Pass on to both."""
        super().substep(substep)
        self._other.substep(substep)

    def result(self, values: Mapping[str, Any]) -> None:
        """Pass on to both."""
        super().result(values)
        self._other.result(values)
