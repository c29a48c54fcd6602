"""cosim: the plant of ``academic`` with constant inputs, as it is, or as an FMU."""

import time
from contextlib import ExitStack

import protocol

from cosim.blocks.source import constant
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from tests.bench.masters.core_systems import scenario


def plant_of(task, stop, resources):
    """Return the component."""
    if task["fmu"] is None:
        return scenario("academic", stop, resources).components["plant"]
    solver = None if task["method"] == "cs" else task["method"]
    interface_type = "cs" if task["method"] == "cs" else "me"
    options = FmuOptions(interface_type=interface_type, solver=solver)
    return resources.enter_context(load(task["fmu"], options)).component


def main():
    """Run."""
    task = protocol.task()
    stop = task["steps"] * task["step_ns"] / 1e9
    clock = Clock(stop=stop, step=task["step_ns"] / 1e9)
    with ExitStack() as resources:
        components = {
            "u": constant([1.0]),
            "delta": constant([0.5]),
            "plant": plant_of(task, stop, resources),
        }
        graph = Graph(components, {"plant.u": "u.y", "plant.delta": "delta.y"})
        plan = graph.prepare(clock.step_ns)
        memory = Memory()
        began = time.process_time()
        run(graph, clock, memory, plan)
        seconds = time.process_time() - began
    columns = memory["plant.x_a"]
    samples = [(sample, columns[sample]) for sample in task["samples"]]
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
