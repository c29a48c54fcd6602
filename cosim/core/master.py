"""The master: advances a graph over the communication grid and hands every block to a recorder.

::

    plan   <- every component computes its design for the communication step
    row 0  <- every component initialized with its inputs
    for block in clock.blocks:
        for stage in graph.stages:
            stage.advance(block, signals)       # a cascade: one call; a loop: step by step
            a stage that stops early cuts the block for all
            so does the first value that is not finite, before anything downstream sees it
        recorder.write(block, signals)
        end there, if something stopped
        row 0 <- the last row
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cosim.arrays import Matrix
from cosim.core.clock import Clock
from cosim.core.contracts import Block, Design, Recorder, Stopped
from cosim.core.graph import Graph, NonFinite
from cosim.errors import NonFiniteError, RunError

BLOCK_BYTES = 16 * 2**20  # memory for the rows of one block


def run(
    graph: Graph, clock: Clock, recorder: Recorder, *, designs: Mapping[str, Design] | None = None
) -> None:
    """Run a graph from 0 to ``clock.stop``.

    Parameters
    ----------
    graph : Graph
    clock : Clock
    recorder : Recorder
        Takes every block; is entered and left here, so that it is complete however the run ends.
    designs : mapping of component name to Design, optional
        Recorded design-time results to use instead of computing them.

    Raises
    ------
    NonFiniteError
        At the first NaN or infinity outside an optional signal; everything before is recorded.
    Stopped
        If a component cannot go on; everything before is recorded. A regular stop ends the run without an error; its reason is
        told to the recorder.
    """
    try:
        with (
            recorder,
            np.errstate(over="ignore", invalid="ignore", divide="ignore"),
        ):  # what is not finite is named below
            recorder.begin(graph.prepare(clock.step_ns, designs))
            limit = max(1, BLOCK_BYTES // (8 * graph.layout.width + 8))
            signals = np.zeros((min(limit, clock.steps) + 1, graph.layout.width))
            graph.initialize(0.0, signals[0])
            _need_finite_start(graph, signals[:1])
            for block in clock.blocks(limit):
                done, end = _advance(graph, block, signals)
                recorder.write(done, signals[: done.steps + 1])
                if end is not None:
                    raise end
                signals[0] = signals[done.steps]
    except Stopped as stop:
        if stop.failed:
            raise


def _advance(graph: Graph, block: Block, signals: Matrix) -> tuple[Block, RunError | None]:
    """Advance stage after stage; give the block as far as all of them came, and what ended it there."""
    end: RunError | None = None
    for stage in graph.stages:
        try:
            stage.advance(block, signals[: block.steps + 1])
        except Stopped as stop:
            end, block = stop, block.cut(stop.steps)
        bad = graph.first_non_finite(stage, signals[1 : block.steps + 1])
        if bad is not None:
            end, block = _non_finite(bad, float(block.time[bad.row + 1])), block.cut(bad.row)
        if block.steps == 0:
            break
    return block, end


def _need_finite_start(graph: Graph, signals: Matrix) -> None:
    for stage in graph.stages:
        bad = graph.first_non_finite(stage, signals)
        if bad is not None:
            raise _non_finite(bad, 0.0)


def _non_finite(bad: NonFinite, t: float) -> NonFiniteError:
    return NonFiniteError(
        f"{bad.label!r} became {bad.value} at t = {t} s; the log keeps everything before"
    )
