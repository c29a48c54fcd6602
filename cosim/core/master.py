"""The master: advances a graph over the communication grid and hands every block to a recorder.

::

    plan   <- every component computes its design for the communication step
    row 0  <- every component initialized with its inputs
    for block in clock.blocks:
        until its end is reached:               # at once, unless something is slow
            for stage in graph.stages:
                stage.advance(block, signals)   # a cascade: all at once; a loop: step by step
                a stage that stops early cuts the block for all
                so does the first value that is not finite, before anything downstream sees it
                and the first row where ``until`` is true: stages that are ahead go back to it
            yield block, signals                # run: recorder.write(block, signals)
        end there, if something stopped
        row 0 <- the last row
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from cosim.arrays import Matrix
from cosim.core.arguments import check_recorder, check_type
from cosim.core.clock import Clock
from cosim.core.conditions import RunConditions, conditions_until
from cosim.core.contracts import Block, Design, Stopped
from cosim.core.graph import Graph
from cosim.core.recorders import Nothing, follow
from cosim.core.recording import Plan, Recorder
from cosim.core.stages.engine import Engine
from cosim.core.stages.left_limits import record
from cosim.errors import UsageError


def run(
    graph: Graph,
    clock: Clock,
    recorder: Recorder,
    plan: Plan | None = None,
    *,
    designs: Mapping[str, Design] | None = None,
    until: str | None = None,
) -> None:
    """Run a graph from ``clock.start_time`` to ``clock.stop``.

    Parameters
    ----------
    graph : Graph
    clock : Clock
    recorder : Recorder
        Takes every block; is entered and left here, so that it is complete however the run ends.
        A block that takes long comes in pieces, so that the run can be watched and ended.
    plan : Plan, optional
        What ``graph.prepare`` returned; left out, the graph is prepared here.
    designs : mapping of component name to Design, optional
        Recorded designs to use where the graph is prepared here.
    until : str, optional
        A condition (:mod:`cosim.core.conditions`): where it is met the run ends, regularly.

    Raises
    ------
    NonFiniteError
        At the first NaN or infinity outside an optional signal; everything before is recorded.
    Stopped
        If a component cannot go on; everything before is recorded. A regular stop ends the run
        without an error; its reason is recorded.
    UsageError
        If an argument is not what it should be, the plan is not that of the graph and the clock, or
        there are designs beside it.
    """
    _check(graph, clock, plan)
    check_recorder(recorder)
    conditions = conditions_until(until, graph.layout, clock)
    if plan is not None and designs is not None:
        raise UsageError("expected a plan or designs, got both; a plan includes designs")
    try:
        with recorder:
            if plan is None:
                plan = graph.prepare(clock.step_ns, designs)
            recorder.begin(plan)
            for block, signals in _advance(graph, clock, recorder, conditions, divide=True):
                record(recorder, graph.layout, block, signals)
    except Stopped as stop:
        if stop.failed:
            raise


def simulate(
    graph: Graph, clock: Clock, plan: Plan | None = None
) -> Iterator[tuple[Block, Matrix]]:
    """Yield block after block with its rows, shape (K+1, width); row 0 is the last one before.

    Between two blocks nothing is computed. The array is used again: copy what is kept. Blocks have
    the length that the clock fixes; where it fixes none, some components may be ahead of a block.

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
        If another simulation of the graph has begun since the last block, or an argument is not
        what it should be.
    """
    _check(graph, clock, plan)
    if plan is None:
        graph.prepare(clock.step_ns)
    divide = clock.block is None
    for block, signals in _advance(graph, clock, Nothing(), RunConditions(), divide=divide):
        yield block, signals[:, : graph.layout.width]


def _check(graph: Graph, clock: Clock, plan: Plan | None) -> None:
    check_type("graph", graph, Graph, UsageError)
    check_type("clock", clock, Clock, UsageError)
    if plan is None:
        return
    check_type("plan", plan, Plan, UsageError)
    if plan.step_ns != clock.step_ns or plan.layout != graph.layout:
        raise UsageError(
            "plan: expected the result of graph.prepare for this graph and clock, got one for "
            f"another graph, or for steps of {plan.step_ns} ns (the clock has {clock.step_ns} ns)"
        )


def _advance(
    graph: Graph, clock: Clock, recorder: Recorder, conditions: RunConditions, *, divide: bool
) -> Iterator[tuple[Block, Matrix]]:
    """Initialize a prepared graph, and yield its blocks; those that take long in pieces."""
    engine = Engine(graph, clock, recorder, divide=divide, conditions=conditions)
    follow(recorder, engine.rows_under_way)
    row = engine.first_row
    for block in clock.blocks(engine.limit, engine.work):
        signals = engine.rows(block, row)
        yield from engine.advance(block, signals)
        if engine.error is not None:
            raise engine.error
        row = signals[block.steps]
