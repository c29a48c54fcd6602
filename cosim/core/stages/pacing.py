"""A block in pieces, each of short calls: so a run that turns slow still answers.

How slow a component is shows only once it has been called. So no call asks for more steps than
``CALL_WORK`` would do by its last one, nor for more than ``GROWTH`` times as many: a component that
turns a thousand times slower keeps the run for a second, once. After ``PIECE_WORK`` the block is
divided: what all stages have completed of it is passed on, and each stage goes on from where it is.
Steps that some stages are ahead are not computed again. The bits depend on none of this, as one
call of K steps is K calls of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from time import perf_counter
from typing import Final

import numpy as np

from cosim.arrays import Matrix
from cosim.core.clock import BLOCK_WORK
from cosim.core.contracts import Block
from cosim.core.stages.coupling import Advancing, Cut
from cosim.core.stages.native_stage import NativeStage
from cosim.errors import RunError

CALL_WORK: Final = 1e-3  # s of wall time that one call of a component should take
STAGE_WORK: Final = 5e-4  # s of wall time that a stage may take of a block: calls cost a tenth
PIECE_WORK: Final = 0.3  # s of wall time after which a block is divided
GROWTH: Final = 4  # steps of a call, at most, in units of those of the last


class Pacer:
    """Advances stages over a block, piece by piece.

    Parameters
    ----------
    stages : sequence of Advancing
        In their order.
    divide : bool
        Whether blocks that take long are divided.

    Attributes
    ----------
    end : int
        The last row that the block will have: that of its end, or where something stopped.
    error : RunError or None
        What stopped there.
    """

    def __init__(self, stages: Sequence[Advancing], *, divide: bool) -> None:
        self.end = 0
        self.error: RunError | None = None
        self._stages = [_PacedStage(stage) for stage in stages]
        self._patience = PIECE_WORK if divide else inf

    @property
    def work(self) -> float:
        """Wall time [s] that a block should take: of many stages the calls alone take longer."""
        return max(BLOCK_WORK, STAGE_WORK * len(self._stages))

    @property
    def completed(self) -> int:
        """The row that all stages have completed; another thread may ask."""
        return min((stage.completed for stage in self._stages), default=0)

    def begin(self, block: Block) -> None:
        """Begin a block."""
        self.end = block.steps
        self.error = None
        for stage in self._stages:
            stage.reached = 0

    # What is not finite is named by the check; numpy's warnings would say it without a name.
    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def advance(self, block: Block, signals: Matrix) -> int:
        """Advance every stage, by one call at least; return the row that all have reached."""
        deadline = perf_counter() + self._patience
        end = self.end
        for stage in self._stages:
            error = stage.advance(block, signals, end, deadline)
            if error is not None:
                self.error = error
                self.end = stage.reached
            end = min(end, stage.reached)
        return end


class _PacedStage:
    """A stage, the row that it has reached in a block, and how many steps its next call takes."""

    def __init__(self, stage: Advancing) -> None:
        self.reached = 0
        self._stage = stage
        self._shown = stage if isinstance(stage, NativeStage) else None
        self._steps = 1

    @property
    def completed(self) -> int:
        """The row that it has completed, also of a call under way."""
        reached = self.reached  # first: the call under way may end, and begins behind it then
        return reached + (self._shown.steps_under_way if self._shown else 0)

    def advance(self, block: Block, signals: Matrix, end: int, deadline: float) -> RunError | None:
        """Advance to row ``end``, or until it is late; return what stopped it."""
        while self.reached < end:
            steps = min(self._steps, end - self.reached)
            began = perf_counter()
            error = self._call(block, signals, steps)
            now = perf_counter()
            if error is not None:
                return error
            self._adapt(steps, now - began)
            if now > deadline:
                break
        return None

    def _call(self, block: Block, signals: Matrix, steps: int) -> RunError | None:
        begin = self.reached
        error: RunError | None = None
        part = block.part(begin, begin + steps)
        rows = signals[begin : begin + steps + 1]
        try:
            self._stage.advance(part, rows)
        except Cut as cut:
            error = cut.error
            steps = cut.steps
        self.reached += steps
        return error

    def _adapt(self, steps: int, elapsed: float) -> None:
        fitting = int(steps * CALL_WORK / max(elapsed, 1e-9))
        if fitting < steps:
            self._steps = max(1, fitting)
        elif steps == self._steps:
            # A shorter call, at the end of a block, says little about one of full length.
            self._steps = min(GROWTH * steps, fitting)
