"""The time of a communication step of an FMU in model exchange, beside co-simulation.

Run with ``python tests/bench/bench_model_exchange.py``. The exported plant of ``academic`` as both;
processor time, in turn, median of several. The error is the largest one of the outputs against the
exact solution in the FMU; the last column shows whether a step costs more the longer the run is.
"""

import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from cosim.fmi.component import load
from cosim.fmi.driving.solvers import STEPPING
from cosim.fmi.options import FmuOptions
from cosim.scenario.exporting import export_component

RUNS = 3
SHORT = 1000  # steps
LONG = 8000
STEP = 1e-3  # s
BLOCK = 500


def simulate(path: Path, options: FmuOptions, steps: int) -> tuple[float, np.ndarray]:
    """Run an FMU in blocks; return the processor time [s] of a step, and the outputs."""
    with load(path, options) as fmu:
        component = fmu.component
        n_u = component.interface.n_u
        t = STEP * np.arange(steps + 1)
        u = np.column_stack([np.sin((1.0 + i) * t) for i in range(n_u)])
        component.prepare(STEP, np.zeros(n_u, np.bool_), {})
        component.initialize(0.0, u[0])
        component.outputs(0.0, u[0])
        rows = []
        began = time.process_time()
        for k in range(0, steps, BLOCK):
            rows.append(component.advance(t[k : k + BLOCK + 1], STEP, u[k : k + BLOCK + 1]))
        return (time.process_time() - began) / steps, np.concatenate(rows)


def main() -> None:
    """Print medians and ratios."""
    names = {"co-simulation": FmuOptions(interface_type="cs")}
    for solver in STEPPING:
        names[solver] = FmuOptions(interface_type="me", solver=solver)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plant.fmu"
        export_component("academic", "plant", path)
        times: dict[tuple[str, int], list[float]] = {}
        outputs = {}
        for _ in range(RUNS):
            for name, options in names.items():
                for steps in (SHORT, LONG):
                    seconds, outputs[name] = simulate(path, options, steps)
                    times.setdefault((name, steps), []).append(seconds)
    base = statistics.median(times["co-simulation", LONG])
    for name in names:
        long = statistics.median(times[name, LONG])
        short = statistics.median(times[name, SHORT])
        error = np.abs(outputs[name] - outputs["co-simulation"]).max()
        print(
            f"{name:14s} {1e6 * long:8.1f} us a step   {long / base:6.2f} x co-simulation   "
            f"error {error:8.1e}   {long / short:5.2f} x the time of a shorter run"
        )


if __name__ == "__main__":
    main()
