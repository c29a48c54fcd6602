"""cosim: a graph of FMUs, run with the recorder in memory."""

import time
from contextlib import ExitStack

import protocol

from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions


def graph_of_fmus(task, resources):
    """Build the graph of a task; the FMUs are closed with ``resources``."""
    lags = task["lags"]
    solver = None if task["method"] == "cs" else task["method"]
    options = FmuOptions(interface_type=task["interface_type"], solver=solver)
    components = {}
    connections = {}
    for lag in lags:
        fmu = resources.enter_context(load(lag["fmu"], options, instance_name=lag["name"]))
        components[lag["name"]] = fmu.component
        if lag["source"] is not None:
            connections[f"{lag['name']}.u"] = f"{lags[lag['source']]['name']}.y"
    return Graph(components, connections)


def main():
    """Run."""
    task = protocol.task()
    clock = Clock(stop=task["steps"] * task["step_ns"] / 1e9, step=task["step_ns"] / 1e9)
    with ExitStack() as resources:
        graph = graph_of_fmus(task, resources)
        plan = graph.prepare(clock.step_ns)
        memory = Memory()
        began = time.process_time()
        run(graph, clock, memory, plan)
        seconds = time.process_time() - began
    columns = [memory[f"{lag['name']}.y"] for lag in task["lags"]]
    samples = []
    for sample in task["samples"]:
        samples.append((sample, [column[sample] for column in columns]))
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
