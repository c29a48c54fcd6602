"""Many runs of one graph that differ in some of their components.

The structure is built once: names, wires, order, which inputs are held. Of each member only what
differs is prepared, and every component is initialized; then it runs as :func:`cosim.core.run` runs
it, with the same bits. Its rows are not kept: only the last one, and sums over the rows behind the
first, each added up in the order of time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.arguments import check_type
from cosim.core.clock import Clock
from cosim.core.contracts import Block, Component
from cosim.core.graph import Graph
from cosim.core.stages.coupling import Advancing, Cut
from cosim.core.stages.native_stage import advancing_stages
from cosim.errors import CosimError, RunError, UsageError
from cosim.native.stages.stage import accumulate

ROWS_BYTES: Final = 2**18  # of the rows of a block, which stay in the cache until they are added up


@dataclass(frozen=True, eq=False)
class EnsembleRows:
    """What is kept of the members of an ensemble; a member has one row in each array.

    Parameters
    ----------
    steps : array of int, shape (M,)
        Communication steps that were completed.
    last : Matrix, shape (M, width)
        The last row.
    counts, sums, squares : Matrix, shape (M, width)
        Over the rows behind the first: how many have a value, their sum, the sum of their squares.
    errors : tuple of CosimError or None
        What ended a member before its end; also the :class:`cosim.core.Stopped`
        of a regular end.
    """

    steps: NDArray[np.int64]
    last: Matrix
    counts: Matrix
    sums: Matrix
    squares: Matrix
    errors: tuple[CosimError | None, ...]


def run_members(
    graph: Graph, clock: Clock, members: Sequence[Mapping[str, Component]]
) -> EnsembleRows:
    """Run a graph once for each member, with the components of that member in their places.

    Parameters
    ----------
    graph : Graph
        Has its own components again afterwards.
    clock : Clock
    members : sequence of mapping of component name to Component
        What differs; each component has the interface of the one whose place it takes.

    Raises
    ------
    GraphError
        If there is no such component, or its interface is another one.
    AssumptionError
        If a component cannot be designed.
    UsageError
        If an argument is not what it should be.
    """
    check_type("graph", graph, Graph, UsageError)
    check_type("clock", clock, Clock, UsageError)
    graph.prepare(clock.step_ns)
    shape = (len(members), graph.layout.width)
    steps = np.zeros(len(members), np.int64)
    last = np.full(shape, np.nan)
    totals = np.zeros((3, *shape))
    errors: list[CosimError | None] = []
    own = dict(graph.components)
    try:
        for number, components in enumerate(members):
            graph.exchange({**own, **components}, clock.step_ns)
            member = _MemberRun(last[number], *totals[:, number])
            errors.append(member.run(graph, clock))
            steps[number] = member.steps
    finally:
        graph.exchange(own, clock.step_ns)
    counts, sums, squares = totals
    return EnsembleRows(steps, last, counts, sums, squares, tuple(errors))


class _MemberRun:
    """One run, whose rows are added up into given vectors of shape (width,)."""

    def __init__(self, last: Vector, counts: Vector, sums: Vector, squares: Vector) -> None:
        self.steps = 0
        self._last = last
        self._totals = (counts, sums, squares)

    def run(self, graph: Graph, clock: Clock) -> CosimError | None:
        """Run to the end, or return what ended it before."""
        limit = max(1, ROWS_BYTES // (8 * len(self._last)))
        rows = np.zeros((limit + 1, graph.layout.row_width))
        try:
            graph.initialize(clock.start_time, rows[0])
            self._last[:] = rows[0, : len(self._last)]
            stages = advancing_stages(graph)
            for block in clock.blocks(limit):
                completed = self._advance(stages, block, rows[: block.steps + 1])
                rows[0] = rows[completed]
                for control in graph.substep_controls:
                    control.drain(int(block.time_ns[-1]))  # nothing records them
        except CosimError as error:
            return error
        return None

    # What is not finite is named by the check; numpy's warnings would say it without a name.
    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def _advance(self, stages: Sequence[Advancing], block: Block, rows: Matrix) -> int:
        """Advance a block, and add up its rows; return how many steps it has."""
        end = block.steps
        error: RunError | None = None
        for stage in stages:
            if not end:
                break
            try:
                stage.advance(block.part(0, end), rows[: end + 1])
            except Cut as cut:
                end = cut.steps
                error = cut.error
        width = len(self._last)
        # a copy where left limits stand behind the signals
        accumulate(np.ascontiguousarray(rows[1 : end + 1, :width]), *self._totals)
        self._last[:] = rows[end, :width]
        self.steps += end
        if error is not None:
            raise error
        return end
