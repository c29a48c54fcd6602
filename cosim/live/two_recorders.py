"""Two recorders of one run: the first keeps it, the second shows it."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self, final

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.recorders import memory_of
from cosim.core.recording import MessageLevel, Plan, Recorder, SignalEvent, Substep


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

    def memory_for(self, block: Block, steps: int) -> Matrix | None:
        """Return the memory of the first."""
        return memory_of(self._first, block, steps)

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
