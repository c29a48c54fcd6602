"""cosim: a graph without FMUs, run with the recorder in memory."""

import time
from contextlib import ExitStack

import protocol

from cosim.core.clock import Clock
from cosim.core.master import run
from cosim.core.recorders import Memory
from tests.bench.masters.core_systems import graph_of


def main() -> None:
    """Run."""
    task = protocol.task()
    stop = task["steps"] * task["step_ns"] / 1e9
    clock = Clock(stop=stop, step=task["step_ns"] / 1e9)
    with ExitStack() as resources:
        graph = graph_of(task["system"], stop, resources)
        plan = graph.prepare(clock.step_ns)
        memory = Memory()
        began = time.process_time()
        run(graph, clock, memory, plan)
        seconds = time.process_time() - began
    columns = [memory[signal] for signal in task["watched"]]
    samples = []
    for sample in task["samples"]:
        samples.append((sample, [column[sample] for column in columns]))
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
