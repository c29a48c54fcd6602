"""The engine of every run and of every step by hand: a graph that advances over blocks.

::

    first row <- every component initialized with its inputs
    advance(block): rows 1 to K behind row 0
        until the end of the block, or where something stopped:
            every stage advances, by some steps at once (:mod:`cosim.core.stages.pacing`)
            yield the steps that all stages have completed
        with conditions: up to where one is met (:mod:`cosim.core.stages.looking_ahead`)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from operator import attrgetter
from time import perf_counter
from typing import Final, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.clock import Clock
from cosim.core.conditions import RunConditions
from cosim.core.contracts import Block, Stopped
from cosim.core.graph import Graph
from cosim.core.recorders import row_memory
from cosim.core.recording import Recorder, Substep
from cosim.core.stages.looking_ahead import LookingAhead
from cosim.core.stages.native_stage import advancing_stages
from cosim.core.stages.pacing import PIECE_WORK, Pacer
from cosim.errors import RunError, UsageError

BLOCK_BYTES: Final = 2**24  # of the rows of one block


@final
class Engine:
    """Advances a prepared graph, which it initializes.

    Parameters
    ----------
    graph : Graph
    clock : Clock
    recorder : Recorder
        Rows are computed in its memory, where it has any.
    divide : bool
        Whether blocks that take long come in pieces.
    conditions : RunConditions, optional
        Where one is met a block ends.

    Attributes
    ----------
    first_row : Vector, shape (width,)
        The initial values.
    stages : sequence of Advancing
        As they advance, in their order.
    limit : int
        The most steps of a block.
    conditions : RunConditions

    Raises
    ------
    NonFiniteError
        If an initial value is not finite.
    """

    def __init__(
        self,
        graph: Graph,
        clock: Clock,
        recorder: Recorder,
        *,
        divide: bool,
        conditions: RunConditions | None = None,
    ) -> None:
        width = graph.layout.row_width
        self.first_row = np.zeros(width)
        graph.initialize(clock.start_time, self.first_row)
        self.limit = max(1, BLOCK_BYTES // (8 * width + 8))
        self._graph = graph
        self._controls = graph.substep_controls
        self._initialization = graph.initializations
        self.conditions = RunConditions() if conditions is None else conditions
        self.conditions.begin(clock.start_time, self.first_row)
        self._divide = divide
        self._fixed = clock.block
        self.compile()
        self._end: Stopped | None = None
        self._recorder = recorder
        # left limits have no place in the memory of a recorder
        self._keeper = None if graph.layout.jumping else row_memory(recorder)
        self._steps = clock.steps
        self._current: tuple[Block, Matrix, Callable[[], int]] | None = None
        self._width = graph.layout.width
        self._rows = np.empty((min(self.limit, clock.steps) + 1, width))  # used again

    @property
    def work(self) -> float:
        """Wall time that a block should take [s]."""
        return self._pacer.work

    @property
    def error(self) -> RunError | None:
        """What stopped the graph in the last block; a condition does before all else."""
        return self._end or self._pacer.error

    def compile(self) -> None:
        """Compile the stages again, where a component is another one."""
        self.stages = advancing_stages(self._graph)
        self._pacer = Pacer(self.stages, divide=self._divide and not self.conditions)
        self._looking_ahead = LookingAhead(self._graph, self._pacer, self.conditions, self._fixed)

    def check_current(self) -> None:
        """Check that the components have the state of this engine.

        Raises
        ------
        UsageError
            If another one has initialized them.
        """
        if self._graph.initializations != self._initialization:
            raise UsageError(
                "another simulation of this graph has begun; build a graph with its own "
                "components for each simulation, as a component has one state"
            )

    def rows(self, block: Block, first: Vector) -> Matrix:
        """Return the rows of a block, shape (K+1, width), to be filled behind the first one.

        Their memory is that of the recorder, in which the first row is the last that was written,
        or is used again.
        """
        rows: Matrix | None = None
        if self._keeper is not None:
            rows = self._keeper(block, self._steps - block.index)
        if rows is None:
            rows = self._rows[: block.steps + 1]
        rows[0] = first
        return rows

    def advance(self, block: Block, signals: Matrix) -> Iterator[tuple[Block, Matrix]]:
        """Fill rows 1 to K; yield them in pieces, each behind the last row of the one before.

        Parameters
        ----------
        block : Block
        signals : Matrix, shape (K + 1, width)
            With row 0. Where the graph is stopped, with ``error``, no row behind that is filled.

        Raises
        ------
        UsageError
            If the components are those of another simulation since the last piece.
        """
        if self.conditions:
            for piece in self._advance_watched(block, signals):
                yield piece
                self.record_substeps(int(piece[0].time_ns[-1]))
            self._forget_substeps()
            return
        pacer = self._pacer
        pacer.begin(block)
        self._current = (block, signals, lambda: pacer.completed)
        reached = -1
        while reached < pacer.end:
            self.check_current()
            begin = max(reached, 0)
            try:
                reached = pacer.advance(block, signals)
            except BaseException:  # what is completed is passed on all the same
                reached = pacer.completed
                if reached > begin:
                    yield block.part(begin, reached), signals[begin : reached + 1]
                raise
            yield block.part(begin, reached), signals[begin : reached + 1]
            self.record_substeps(int(block.time_ns[reached]))
        self._forget_substeps()

    def rows_under_way(self) -> tuple[Block, Matrix] | None:
        """Return the rows of a block that are completed; see :class:`.Recorder`."""
        if self._current is None:
            return None
        block, signals, reached = self._current
        completed = min(reached(), block.steps)  # it may be that of the next block
        return block.part(0, completed), signals[: completed + 1, : self._width]

    def record_substeps(self, end_ns: int) -> None:
        """Record the substeps of the rows that were written, up to an instant [ns].

        Loops may be ahead of that, or have stopped inside a step, which has no row then.
        """
        substeps: list[Substep] = []
        for control in self._controls:
            substeps += control.drain(end_ns)
        for substep in sorted(substeps, key=attrgetter("begin")):
            self._recorder.substep(substep)

    def _forget_substeps(self) -> None:
        """Forget the substeps of a step that was not completed."""
        for control in self._controls:
            control.forget_from(0)

    def _advance_watched(self, block: Block, signals: Matrix) -> Iterator[tuple[Block, Matrix]]:
        """Advance up to where a condition is met; yield the initial values by themselves."""
        if block.index == 0:
            yield block.part(0, 0), signals[:1]
        self._end = self.conditions.end_at(float(block.time[0]))
        first = 0
        reached = 0
        self._current = (block, signals, lambda: reached)
        deadline = perf_counter() + PIECE_WORK
        while reached < block.steps and self._end is None:
            rest = block.part(reached, block.steps)
            try:
                self.check_current()
                reached += self._looking_ahead.advance(rest, signals[reached:])
            except BaseException:  # what is completed is passed on all the same
                yield block.part(first, reached), signals[first : reached + 1]
                raise
            self._end = self.conditions.end_at(float(block.time[reached]))
            if self._pacer.error is not None or self.conditions.came_true:
                break
            if perf_counter() > deadline:
                yield block.part(first, reached), signals[first : reached + 1]
                first = reached
                deadline = perf_counter() + PIECE_WORK
        if reached > first:
            yield block.part(first, reached), signals[first : reached + 1]
