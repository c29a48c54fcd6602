"""The time of ``cosim check`` and ``cosim run`` for an FMU with 200000 variables, and FMPy's.

Run with ``python tests/bench/bench_many.py``. Whole processes, in turn, median of three; FMPy reads
and simulates what ``cosim run`` does.
"""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.fmi.many import many

RUNS = 3
VARIABLES = 200_000
SCENARIO = """
[scenario]
name = "many"
stop = 1.0
step = 0.01
[components]
plant = { kind = "fmu", path = "many.fmu" }
u = { kind = "constant", value = 1.0, unit = "m" }
[connections]
"plant.u" = "u.y"
"""
FMPY = (
    "import sys, fmpy; "
    "result = fmpy.simulate_fmu(sys.argv[1], stop_time=1.0, output_interval=0.01, "
    "start_values={'u': 1.0}); print(result['y1'][-1])"
)


def seconds(command: list[str]) -> float:
    """Time one process."""
    began = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - began


def main() -> None:
    """Print medians and ratios."""
    with tempfile.TemporaryDirectory() as folder:
        fmu = many(Path(folder) / "many.fmu", VARIABLES)
        scenario = Path(folder) / "many.toml"
        scenario.write_text(SCENARIO)
        log = Path(folder) / "many.mcap"
        cosim = [sys.executable, "-m", "cosim"]
        commands = {
            "fmpy, read and simulate": [sys.executable, "-c", FMPY, str(fmu)],
            "cosim check": [*cosim, "check", str(fmu)],
            "cosim run": [*cosim, "run", str(scenario), "--out", str(log), "--force"],
            "cosim info": [*cosim, "info", str(fmu), "--json"],
        }
        times: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(RUNS):
            for name, command in commands.items():
                times[name].append(seconds(command))
    medians = {name: statistics.median(samples) for name, samples in times.items()}
    base = medians["fmpy, read and simulate"]
    for name, median in medians.items():
        print(f"{name:24s} {median:6.2f} s   {median / base:5.2f} x FMPy")


if __name__ == "__main__":
    main()
