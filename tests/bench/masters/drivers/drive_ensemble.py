"""Members of ``academic``: by cosim in one call, or by their kernels in a plain loop."""

import time
from contextlib import ExitStack

import numpy as np
import protocol
from drive_kernels import load_library, passes_of

from cosim.core.clock import Clock
from cosim.core.clock import seconds as seconds_of
from cosim.core.ensemble import run_members
from tests.bench.masters.core_systems import academic_member

STEPS = 40_000  # of a member
BLOCK = 1000  # rows of the plain loop, which stay in the cache


def by_cosim(task, clock, resources):
    """Return the time, and what is kept of each member."""
    graph = academic_member(0, clock.stop, resources)
    members = []
    for number in range(task["steps"]):
        other = academic_member(number, clock.stop, resources)
        members.append({"plant": other.components["plant"]})
    began = time.process_time()
    rows = run_members(graph, clock, members)
    return time.process_time() - began, rows.last, rows.squares


def by_kernels(task, clock, resources):
    """Return the same."""
    library = load_library(task)
    t = seconds_of(np.arange(STEPS + 1) * clock.step_ns)
    seconds = 0.0
    last = []
    squares = []
    for number in range(task["steps"]):
        graph = academic_member(number, clock.stop, resources)
        graph.prepare(clock.step_ns)
        width = graph.layout.width
        rows = np.empty((BLOCK + 1, width))
        graph.initialize(0.0, rows[0])
        (one,) = passes_of(graph.stages, library, width)
        totals = np.zeros((3, width))
        began = time.process_time()
        one.sum(t, clock.step, rows, totals)
        seconds += time.process_time() - began
        last.append(rows[0])
        squares.append(totals[2])
    return seconds, last, squares


def main():
    """Run."""
    task = protocol.task()
    clock = Clock(stop=STEPS * task["step_ns"] / 1e9, step=task["step_ns"] / 1e9)
    with ExitStack() as resources:
        run = by_cosim if task["library"] is None else by_kernels
        seconds, last, squares = run(task, clock, resources)
    samples = []
    for number in range(task["steps"]):
        samples.append((number, [*last[number], *squares[number]]))
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
