"""ecos: a whole stretch of steps in one call. It keeps nothing: its only recorder is a CSV file."""

import ctypes
import sys
import time
from pathlib import Path

import protocol


def main() -> None:
    """Run."""
    # Its library needs that of oneTBB, which its package does not bring.
    for tbb in sorted(Path(sys.prefix, "lib").glob("libtbb.so.*")):
        ctypes.CDLL(str(tbb), ctypes.RTLD_GLOBAL)
    from ecospy import EcosSimulation, EcosSimulationStructure
    from ecospy.lib import EcosLib

    task = protocol.task()
    if task["method"] != "cs":
        protocol.refuse("it is for co-simulation")
    EcosLib.set_log_level("err")
    lags = task["lags"]
    structure = EcosSimulationStructure()
    for lag in lags:
        structure.add_model(lag["name"], lag["fmu"])
    for lag in lags:
        if lag["source"] is not None:
            source = lags[lag["source"]]["name"]
            structure.make_real_connection(f"{source}::y", f"{lag['name']}::u")
    simulation = EcosSimulation(task["step_ns"] / 1e9, structure=structure)
    if not simulation.init():
        protocol.refuse(EcosLib.get_last_error())
    reached = 0
    samples = []
    began = time.process_time()
    for sample in task["samples"]:
        simulation.step(sample - reached)
        reached = sample
        samples.append((sample, [simulation.get_real(f"{lag['name']}::y") for lag in lags]))
    simulation.step(task["steps"] - reached)
    seconds = time.process_time() - began
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
