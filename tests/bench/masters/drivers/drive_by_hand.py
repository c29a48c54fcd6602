"""cosim, by hand: an input is overridden, one step is taken, an output is read."""

import time
from contextlib import ExitStack

import protocol
from drive_cosim import graph_of_fmus

from cosim.core.clock import Clock
from cosim.core.simulation import Simulation


def main():
    """Run."""
    task = protocol.task()
    first = f"{task['lags'][0]['name']}.u"
    last = f"{task['lags'][-1]['name']}.y"
    values = [1e-6 * k for k in range(task["steps"])]
    clock = Clock(stop=task["steps"] * task["step_ns"] / 1e9, step=task["step_ns"] / 1e9)
    with ExitStack() as resources:
        simulation = Simulation(graph_of_fmus(task, resources), clock)
        y = 0.0
        began = time.process_time()
        for value in values:
            simulation[first] = value
            simulation.step(1)
            y = simulation[last][0]
        seconds = time.process_time() - began
    protocol.report(seconds, [(task["steps"], [y])])


if __name__ == "__main__":
    main()
