"""CPU time of ``cosim run academic``, beside that of its libraries and of its run.

Run with ``python tests/bench/bench_run.py [ROUNDS]``. CPU seconds (user and system) of

* whole: a process ``cosim run academic --out ...``, from its start to its end;
* libraries: a process that imports the third-party modules that are loaded when that command ends,
  and nothing else;
* run: loading the scenario and running it into a log file, a second time in one process.

Each is the median of shuffled rounds. The ratio, whole / (libraries + run), is that of a round.
The list of modules is printed, and the accuracy, as a faster wrong answer does not count. Bytecode
stands in a folder of its own, written before the first round, as it does after an installation.
"""

import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

ROUNDS = 9
TARGET = 1.3
ROOT = Path(__file__).parents[2]

# Prints the third-party modules that a command ends up with, in the order of their import, besides
# those that are there before it begins.
MODULES = """
import sys
before = list(sys.modules)
import atexit
def third_party():
    own = {"cosim", "__main__"}
    known = own | set(sys.stdlib_module_names)
    names = [name for name in sys.modules if name not in before]
    print(*[name for name in names if name.split(".")[0] not in known], file=sys.stderr)
atexit.register(third_party)
from cosim.__main__ import main
sys.argv[0] = "cosim"
main()
"""
LIBRARIES = """
import os, sys
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
from importlib import import_module
for name in sys.argv[1:]:
    import_module(name)
"""
RUN = """
import os, sys
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import time
import cosim
def run():
    began = time.process_time()
    cosim.run(cosim.load("academic"), out=sys.argv[1], force=True)
    return time.process_time() - began
run()
print(run())
"""


def environment(folder: str) -> dict[str, str]:
    """Return an environment in which this checkout is imported, and its bytecode kept."""
    variables = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "PYTHONPYCACHEPREFIX": str(Path(folder) / "bytecode"),
    }
    variables.pop("PYTHONDONTWRITEBYTECODE", None)
    return variables


def cpu_seconds(command: list[str], variables: dict[str, str]) -> float:
    """Return the CPU time of one process [s]."""
    with subprocess.Popen(command, env=variables, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return usage.ru_utime + usage.ru_stime


def third_party_modules(arguments: list[str], variables: dict[str, str]) -> list[str]:
    """Return the third-party modules that the command line ends up with."""
    done = subprocess.run(
        [sys.executable, "-c", MODULES, *arguments],
        env=variables,
        check=True,
        capture_output=True,
        text=True,
    )
    names = done.stderr.splitlines()[-1].split()
    return [name for name in names if not name.startswith("_sysconfigdata")]  # of Python itself


def print_modules(modules: Iterable[str]) -> None:
    """Print the packages that are imported, how many modules of each, and what of scipy."""
    counts: dict[str, int] = defaultdict(int)
    for name in modules:
        counts[name.split(".")[0]] += 1
    packages = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
    print(f"third-party packages, and modules of each: {packages}")
    parts = {name.split(".")[1] for name in modules if name.startswith("scipy.")}
    public = sorted(part for part in parts if not part.startswith("_"))
    print("of scipy:", ", ".join(public) or "nothing")


def main() -> None:
    """Print medians, the ratio and the accuracy."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else ROUNDS
    with tempfile.TemporaryDirectory() as folder:
        variables = environment(folder)
        log = Path(folder) / "academic.mcap"
        arguments = ["run", "academic", "--out", str(log), "--force"]
        whole = [sys.executable, "-m", "cosim", *arguments]
        modules = third_party_modules([*arguments, "--quiet"], variables)
        print_modules(modules)
        libraries = [sys.executable, "-c", LIBRARIES, *modules]
        run = [sys.executable, "-c", RUN, str(log)]

        def run_seconds() -> float:
            done = subprocess.run(run, env=variables, check=True, capture_output=True, text=True)
            return float(done.stdout)

        measures = {
            "whole": lambda: cpu_seconds(whole, variables),
            "libraries": lambda: cpu_seconds(libraries, variables),
            "run": run_seconds,
        }
        for measure in measures.values():  # writes the bytecode
            measure()
        order = random.Random(1)
        samples: dict[str, list[float]] = {name: [] for name in measures}
        for _ in range(rounds):
            for name in order.sample(list(measures), len(measures)):
                samples[name].append(measures[name]())
        for name, values in samples.items():
            print(f"{name:10s} {statistics.median(values):6.3f} s")
        floors = [a + b for a, b in zip(samples["libraries"], samples["run"], strict=True)]
        ratios = [a / b for a, b in zip(samples["whole"], floors, strict=True)]
        spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
        print(
            f"whole / (libraries + run): {statistics.median(ratios):.2f}, {spread} in {rounds} "
            f"rounds; target {TARGET}"
        )
        result = subprocess.run(
            [*whole, "--json"], env=variables, check=True, capture_output=True, text=True
        )
        values = json.loads(result.stdout)["values"]
        errors = ", ".join(f"{value['estimate']} {value['error']:.2g}" for value in values)
        print(f"accuracy: {errors}; log of {log.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
