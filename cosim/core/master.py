"""The master: advances a graph over the communication grid and hands every block to a recorder.

::

    plan   <- every component computes its design for the communication step
    row 0  <- every component initialized with its inputs
    for block in clock.blocks:
        for stage in graph.stages:
            stage.advance(block, signals)       # a cascade: one call; a loop: step by step
            a stage that stops early cuts the block for all
            so does the first value that is not finite, before anything downstream sees it
        yield block, signals                    # run: recorder.write(block, signals)
        end there, if something stopped
        row 0 <- the last row
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from cosim.arrays import Matrix
from cosim.core.clock import Clock
from cosim.core.contracts import Block, Design, Plan, Recorder, Stopped
from cosim.core.graph import Graph
from cosim.errors import RunError, UsageError

BLOCK_BYTES = 16 * 2**20  # memory for the rows of one block
TWO_SIMULATIONS = (
    "another simulation of this graph has begun, and its components have one state each; build a "
    "graph with components of its own for every simulation"
)


def run(
    graph: Graph,
    clock: Clock,
    recorder: Recorder,
    *,
    designs: Mapping[str, Design] | None = None,
    plan: Plan | None = None,
) -> None:
    """Run a graph from ``clock.start_time`` to ``clock.stop``.

    Parameters
    ----------
    graph : Graph
    clock : Clock
    recorder : Recorder
        Takes every block; is entered and left here, so that it is complete however the run ends.
    designs : mapping of component name to Design, optional
        Recorded design-time results to use instead of computing them.
    plan : Plan, optional
        What ``graph.prepare`` returned; left out, the graph is prepared here.

    Raises
    ------
    NonFiniteError
        At the first NaN or infinity outside an optional signal; everything before is recorded.
    Stopped
        If a component cannot go on; everything before is recorded. A regular stop ends the run
        without an error; its reason is recorded.
    """
    try:
        with recorder:
            if plan is None:
                plan = graph.prepare(clock.step_ns, designs)
            recorder.begin(plan)
            for block, signals in simulate(graph, clock, plan):
                recorder.write(block, signals)
    except Stopped as stop:
        if stop.failed:
            raise


def simulate(
    graph: Graph, clock: Clock, plan: Plan | None = None
) -> Iterator[tuple[Block, Matrix]]:
    """Yield block after block with its rows, shape (K+1, width); row 0 is the last one before.

    Between two blocks nothing is computed. The array is used again: copy what is kept.

    Parameters
    ----------
    graph : Graph
    clock : Clock
    plan : Plan, optional
        Returned by ``graph.prepare``; left out, the graph is prepared here.

    Raises
    ------
    NonFiniteError
        At the first NaN or infinity outside an optional signal.
    Stopped
        Where a component stops; also where that is a regular end (``failed`` False), which
        :func:`run` takes as the end. Both come after the last block.
    UsageError
        If another simulation of the graph has begun since the last block.
    """
    if plan is None:
        graph.prepare(clock.step_ns)
    limit = max(1, BLOCK_BYTES // (8 * graph.layout.width + 8))
    signals = np.zeros((min(limit, clock.steps) + 1, graph.layout.width))
    graph.initialize(clock.start_time, signals[0])
    initialization = graph.initializations
    for block in clock.blocks(limit):
        if graph.initializations != initialization:
            raise UsageError(TWO_SIMULATIONS)
        reached, error = _advance(graph, block, signals)
        yield reached, signals[: reached.steps + 1]
        if error is not None:
            raise error
        signals[0] = signals[reached.steps]


# What is not finite is named by the check; numpy's warnings would say the same without a name.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _advance(graph: Graph, block: Block, signals: Matrix) -> tuple[Block, RunError | None]:
    """Advance stage after stage; return the block that all completed, and the error that cut it."""
    error: RunError | None = None
    for stage in graph.stages:
        try:
            stage.advance(block, signals[: block.steps + 1])
        except Stopped as stop:
            error = stop
            block = block.cut(stop.steps)
        bad = graph.first_non_finite(stage, signals[1 : block.steps + 1])
        if bad is not None:
            error = bad.error(float(block.time[bad.row + 1]))
            block = block.cut(bad.row)
        if block.steps == 0:
            break
    return block, error
