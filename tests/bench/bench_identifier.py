"""The time of output error: online in a run, and offline for many records of one experiment.

Run with ``python tests/bench/bench_identifier.py [MEMBERS]``. Processor time in one process, in
turn, median of several; the accuracy stands beside the time.

* ``academic-noisy``, 40 s at 1 ms, noise 1e-3, an estimate from all samples every 0.1 s, beside the
  same run without an identifier, and with least squares.
* 1000 records of that experiment with other noise, each fitted by itself from the same start.
"""

import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

import cosim
from cosim.scenario.document.document import find
from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, disturbed_plant
from cosim.theory.estimators.output_error import fit_output_error
from cosim.theory.plants.descriptor import reduce
from tests.theory.academic import THETA, academic, alpha

RUNS = 5
MEMBERS = 1000
SIGMA = 1e-3
LARGEST_RUN = 25.0  # times the run without an identifier
LARGEST_MEMBER = 0.1  # of the run with one
# over the deviation of the noise, amplitudes and x(0) unknown too
BOUND = np.array([7.0863e-3, 6.2226e-2])


def without_identifier() -> str:
    """Return the text of the scenario without its identifier."""
    text = find("academic-noisy").text
    before, rest = text.split("[components.identifier]", 1)
    _, after = rest.split("[connections]", 1)
    lines = (before + "[connections]" + after).splitlines()
    return "\n".join(line for line in lines if not line.startswith('"identifier.'))


def timed(scenario: str, out: Path, **settings: object) -> tuple[float, float, object]:
    """Return processor and wall time of a run [s], and its log."""
    changes = {key.replace("__", "."): value for key, value in settings.items()}
    wall = time.perf_counter()
    began = time.process_time()
    log = cosim.run(scenario, out=out, force=True, set=changes)
    return time.process_time() - began, time.perf_counter() - wall, log


def compare_runs(folder: Path) -> float:
    """Print the times of runs; return that of the one with output error."""
    plain = folder / "plain.toml"
    plain.write_text(without_identifier())
    runs = {
        "no identifier": (str(plain), {}),
        "least squares": ("academic-noisy", {"identifier__method": "least-squares"}),
        "output error": ("academic-noisy", {}),
    }
    processor: dict[str, list[float]] = {name: [] for name in runs}
    wall: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(RUNS):
        for name, (scenario, settings) in runs.items():
            used, elapsed, log = timed(scenario, folder / "log.mcap", **settings)
            processor[name].append(used)
            wall[name].append(elapsed)
    base = statistics.median(processor["no identifier"])
    for name in runs:
        used = statistics.median(processor[name])
        real_time = 40.0 / statistics.median(wall[name])
        print(f"{name:15s} {used:6.3f} s   {used / base:5.2f} x   {real_time:6.1f} x real time")
    error = np.abs(log["identifier.theta"][-1] - THETA) / (SIGMA * BOUND)  # type: ignore[index]
    print(f"error of theta {error[0]:.2f}, {error[1]:.2f} x the bound")
    online = statistics.median(processor["output error"])
    print(f"{online / base:.2f} x the run without identifier; at most {LARGEST_RUN:g} x")
    return online


def fit_members(folder: Path, members: int, online: float) -> None:
    """Print the time of a fit, and its root mean square error beside the bound."""
    _, _, log = timed("academic-noisy", folder / "log.mcap", sensor__noise=0.0)
    clean = np.reshape(log["plant.y"], (-1, 1))  # type: ignore[index]
    u = np.reshape(log["u.y"], (-1, 1))  # type: ignore[index]
    t = np.arange(len(clean)) * 1e-3
    factors = alpha(t)
    plant = disturbed_plant(reduce(academic()), [0, 0])
    families = (Exponential(), Exponential())
    start = np.array([-0.11, -0.28])
    errors = []
    used = 0.0
    for member in range(members):
        noise = SIGMA * np.random.default_rng(member).standard_normal(clean.shape)
        began = time.process_time()
        data = DataSet(t, clean + noise, u, factors)
        fit = fit_output_error([data], plant, families, start)
        used += time.process_time() - began
        errors.append((fit.theta - THETA) / (SIGMA * BOUND))
    each = used / members
    ratio = np.sqrt(np.mean(np.square(errors), axis=0))
    print(
        f"{members} members: {1e3 * each:.1f} ms each, {each / online:.3f} x the run with output "
        f"error; at most {LARGEST_MEMBER:g} x; errors {ratio[0]:.3f}, {ratio[1]:.3f} x the bound"
    )


def main() -> None:
    """Print times and ratios."""
    members = int(sys.argv[1]) if len(sys.argv) > 1 else MEMBERS
    with tempfile.TemporaryDirectory() as folder:
        online = compare_runs(Path(folder))
        fit_members(Path(folder), members, online)


if __name__ == "__main__":
    main()
