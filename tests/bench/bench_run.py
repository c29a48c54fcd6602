"""The time of ``cosim run academic``, beside that of starting Python and importing the libraries.

Run with ``python tests/bench/bench_run.py``. Whole processes, in turn, median of several; the
accuracy stands beside the time.
"""

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

RUNS = 5
LIBRARIES = (
    "import numpy, scipy.linalg, pydantic, typer, rich.console, rich.table, mcap.records, "
    "zstandard, google.protobuf"
)


def seconds(command: list[str]) -> float:
    """Time one process."""
    began = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - began


def main() -> None:
    """Print medians and ratios."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "academic.mcap"
        run = [
            sys.executable,
            "-m",
            "cosim",
            "run",
            "academic",
            "--out",
            str(log),
            "--force",
            "--json",
            "--profile",
        ]
        commands = {
            "python -c pass": [sys.executable, "-c", "pass"],
            "import of the libraries": [sys.executable, "-c", LIBRARIES],
            "cosim --help": [sys.executable, "-m", "cosim", "--help"],
            "cosim run academic": run,
        }
        times: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(RUNS):
            for name, command in commands.items():
                times[name].append(seconds(command))
        medians = {name: statistics.median(samples) for name, samples in times.items()}
        base = medians["import of the libraries"]
        for name, median in medians.items():
            print(f"{name:28s} {median:6.3f} s   {median / base:5.2f} x the imports")
        result = subprocess.run(run, check=True, capture_output=True, text=True)
        summary = json.loads(result.stdout)
        print(
            "of it:", ", ".join(f"{part} {value:.3f} s" for part, value in summary["wall"].items())
        )
        print(
            "in the run:",
            ", ".join(f"{part} {value:.4f} s" for part, value in summary["profile"].items()),
        )
        errors = ", ".join(
            f"{value['estimate']} {value['error']:.2g}" for value in summary["values"]
        )
        print(f"accuracy: {errors}; log of {log.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
