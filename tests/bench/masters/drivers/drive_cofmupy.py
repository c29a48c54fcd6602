"""CoFmuPy: its coordinator, Gauss-Seidel, with the outputs that its master keeps."""

import time

import protocol
from cofmupy import Coordinator


def main() -> None:
    """Run."""
    task = protocol.task()
    if task["method"] != "cs":
        protocol.refuse("it is for co-simulation")
    lags = task["lags"]
    fmus = [{"id": lag["name"], "path": lag["fmu"]} for lag in lags]
    connections = []
    for lag in lags:
        if lag["source"] is not None:
            source = {"id": lags[lag["source"]]["name"], "variable": "y"}
            target = {"id": lag["name"], "variable": "u"}
            connections.append({"source": source, "target": target})
    coordinator = Coordinator()
    configuration = {
        "fmus": fmus,
        "connections": connections,
        "cosim_method": "gauss_seidel",
        "iterative": False,
    }
    coordinator.start(configuration)
    h = task["step_ns"] / 1e9
    began = time.process_time()
    for _ in range(task["steps"]):
        coordinator.do_step(h)
    seconds = time.process_time() - began
    results = coordinator.get_results()
    samples = []
    for sample in task["samples"]:
        row = sample - 1  # it has the outputs at the end of the step
        samples.append((sample, [results[lag["name"], "y"][row] for lag in lags]))
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
