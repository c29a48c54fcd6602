"""PathSim with ``pathsim-fmi``: blocks and a scope that keeps inputs and outputs at every step."""

import time

import numpy as np
import protocol
from pathsim import Connection, Simulation
from pathsim.blocks import Scope
from pathsim.solvers import EUF, RK4, RKDP54
from pathsim_fmi import CoSimulationFMU, ModelExchangeFMU

SOLVERS = {"cs": EUF, "rk4": RK4, "RK45": RKDP54}


def main() -> None:
    """Run."""
    task = protocol.task()
    lags = task["lags"]
    h = task["step_ns"] / 1e9
    blocks = []
    for lag in lags:
        if task["interface_type"] == "cs":
            blocks.append(CoSimulationFMU(lag["fmu"], instance_name=lag["name"], dt=h))
        else:
            blocks.append(ModelExchangeFMU(lag["fmu"], instance_name=lag["name"]))
    scope = Scope()
    connections = []
    for i in range(len(lags)):
        targets = [scope[2 * i]]
        for j, other in enumerate(lags):
            if other["source"] == i:
                targets += [blocks[j]["u"], scope[2 * j + 1]]
        connections.append(Connection(blocks[i]["y"], *targets))
    simulation = Simulation(
        [*blocks, scope], connections, dt=h, dt_max=h, Solver=SOLVERS[task["method"]], log=False
    )
    began = time.process_time()
    simulation.run((task["steps"] + 0.5) * h, adaptive=False)
    seconds = time.process_time() - began
    times, values = scope.read()
    numbers = np.rint(times / h).astype(int)
    samples = []
    for sample in task["samples"]:
        row = int(np.flatnonzero(numbers == sample)[-1])
        samples.append((sample, [values[2 * i][row] for i in range(len(lags))]))
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
