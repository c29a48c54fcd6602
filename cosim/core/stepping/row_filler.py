"""The rows of some steps, filled by the stages of a graph, and recorded."""

from __future__ import annotations

from collections.abc import Iterator
from ctypes import addressof, c_char
from functools import partial
from time import perf_counter
from typing import Any, Final, final

from cosim.arrays import Matrix
from cosim.core.clock import Clock
from cosim.core.contracts import Block
from cosim.core.recording import Recorder
from cosim.core.signals import Layout
from cosim.core.stages.coupling import Cut
from cosim.core.stages.engine import Engine
from cosim.core.stages.left_limits import record
from cosim.core.stages.native_stage import NativeStage
from cosim.core.stages.pacing import PIECE_WORK
from cosim.core.stepping.fault_injection import VaryingFaults
from cosim.errors import RunError

POINTS: Final = 4096  # communication points whose times are computed at once
DOUBLE: Final = 8  # bytes


@final
class StepTimes:
    """The times of the steps of a clock, computed for many of them at once.

    Parameters
    ----------
    clock : Clock
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._look_ahead(0, 1)

    def block(self, index: int, count: int) -> Block:
        """Return some steps behind a communication point."""
        first = index - self._ahead.index
        if not 0 <= first <= self._ahead.steps - count:
            self._look_ahead(index, count)
            first = 0
        return self._ahead.part(first, first + count)

    def address(self, index: int) -> int:
        """Return where the time of a communication point stands in memory, and that of the next."""
        first = index - self._ahead.index
        if not 0 <= first < self._ahead.steps:
            self._look_ahead(index, 1)
            first = 0
        return self._address + first * DOUBLE

    def _look_ahead(self, index: int, count: int) -> None:
        """Compute the times of the next steps, at least of ``count``."""
        steps = min(max(count, POINTS), self._clock.steps - index)
        self._ahead = self._clock.block_at(index, steps)
        self._address = self._ahead.time.ctypes.data


@final
class RowFiller:
    """Fills and records rows behind the one that is reached.

    Parameters
    ----------
    engine : Engine
    layout : Layout
    recorder : Recorder
    varying : VaryingFaults
        Determined anew at every communication point, where there are any.
    times : StepTimes
    h : float
        Communication step [s].
    is_recorded : bool

    Attributes
    ----------
    reached : int
        The last row that is complete, of those that are to be filled; also where that fails.
    """

    def __init__(
        self,
        engine: Engine,
        layout: Layout,
        recorder: Recorder,
        varying: VaryingFaults,
        times: StepTimes,
        *,
        h: float,
        is_recorded: bool,
    ) -> None:
        self.reached = 0
        self._engine = engine
        self._layout = layout
        self._recorder = recorder
        self._varying = varying
        self._times = times
        self._h = h
        self._is_recorded = is_recorded
        self._find_compiled()

    def compile(self) -> None:
        """Compile the stages again, where a component is another one."""
        self._engine.compile()
        self._find_compiled()

    def _find_compiled(self) -> None:
        """Find the stages in compiled code, if all of them are, and nobody looks at their rows."""
        stages = self._engine.stages
        compiled = [stage for stage in stages if isinstance(stage, NativeStage)]
        is_watched = self._is_recorded or self._engine.conditions
        is_compiled = len(compiled) == len(stages) and not is_watched
        self._compiled = compiled if is_compiled else []

    def fill(self, index: int, signals: Matrix) -> RunError | None:
        """Fill all rows behind row 0; return what stopped before the last one.

        Parameters
        ----------
        index : int
            Number of the communication point of row 0.
        signals : Matrix, shape (K + 1, width)
        """
        count = len(signals) - 1
        if count == 1 and self._compiled and not self._varying.are_there:
            return self._fill_one(index, signals)
        return self.fill_block(self._times.block(index, count), signals)

    def fill_block(self, block: Block, signals: Matrix) -> RunError | None:
        """Fill rows 1 to K of a block; return what stopped before the last one."""
        self.reached = 0
        for part, rows in self._pieces(block, signals):
            if part.steps:
                record(self._recorder, self._layout, part, rows)
                self.reached += part.steps
        return self._engine.error

    def _fill_one(self, index: int, signals: Matrix) -> RunError | None:
        """Fill row 1 by stages in compiled code alone, where the engine would cost more."""
        self.reached = 0
        memory: Any = signals
        rows = addressof(c_char.from_buffer(memory))  # a tenth of what .ctypes costs
        addresses = (self._times.address(index), rows)
        next_step = partial(self._times.block, index, 1)
        reached = 1
        error: RunError | None = None
        for stage in self._compiled:
            try:
                stage.advance_at(addresses, signals, self._h, next_step)
            except Cut as cut:
                reached = cut.steps
                error = cut.error
                if not reached:
                    break
        self.reached = reached
        return error

    def _pieces(self, block: Block, signals: Matrix) -> Iterator[tuple[Block, Matrix]]:
        """Advance; yield what is completed: of steps that are taken one by one, many at once."""
        if not self._varying.are_there:
            yield from self._engine.advance(block, signals)
            return
        first = 0
        reached = 0
        deadline = perf_counter() + PIECE_WORK
        error: RunError | None = None
        while reached < block.steps and error is None:
            try:
                reached += self._take_step(block.part(reached, reached + 1), signals[reached:])
            except BaseException:
                yield block.part(first, reached), signals[first : reached + 1]
                raise
            error = self._engine.error
            if self._engine.conditions.came_true:
                break
            if perf_counter() > deadline:
                yield block.part(first, reached), signals[first : reached + 1]
                first = reached
                deadline = perf_counter() + PIECE_WORK
        yield block.part(first, reached), signals[first : reached + 1]

    def _take_step(self, step: Block, signals: Matrix) -> int:
        """Determine faults at the next point, and advance to it; return 0 if that failed."""
        self._varying.determine(step.index + 1, signals[0])
        parts = self._engine.advance(step, signals[:2])
        return sum(part.steps for part, _ in parts)
