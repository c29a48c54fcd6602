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


def main() -> None:
    """Run."""
    task = protocol.task()
    lags = task["lags"]
    steps = task["steps"]
    solver = None if task["method"] == "cs" else task["method"]
    options = FmuOptions(interface_type=task["interface_type"], solver=solver)
    connections = {}
    for lag in lags:
        if lag["source"] is not None:
            connections[f"{lag['name']}.u"] = f"{lags[lag['source']]['name']}.y"
    with ExitStack() as stack:
        components = {}
        for lag in lags:
            fmu = stack.enter_context(load(lag["fmu"], options, instance_name=lag["name"]))
            components[lag["name"]] = fmu.component
        graph = Graph(components, connections)
        step = task["step_ns"] / 1e9
        clock = Clock(stop=steps * task["step_ns"] / 1e9, step=step)
        plan = graph.prepare(clock.step_ns)
        memory = Memory()
        began = time.process_time()
        run(graph, clock, memory, plan)
        seconds = time.process_time() - began
    rows = [memory.rows(lag["name"])[:, -1] for lag in lags]
    samples = []
    for sample in task["samples"]:
        samples.append((sample, [outputs[sample] for outputs in rows]))
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
