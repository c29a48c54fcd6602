"""The time of a verdict for a record at times with jitter, over that for equal steps.

Run with ``python tests/bench/bench_jitter.py``. The academic example, 40 s at 1 ms, noise of 1e-3,
times with a jitter of 0.1 ms: every interval is discretized for itself. CPU time, best of three,
with the error of theta beside it.
"""

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from cosim.theory.assessment.assessing import assess
from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, disturbed_plant
from cosim.theory.estimators.output_error import OutputErrorProblem
from cosim.theory.plants.descriptor import reduce
from tests.scenario.kinds.test_field_data import TRUTH, academic, alpha, outputs_at
from tests.theory.academic import THETA

RUNS = 3
FAMILIES = (Exponential(), Exponential())
START = np.array([-0.05, -0.5])


def record(jitter: float) -> DataSet:
    """Return samples with noise, of another solver."""
    rng = np.random.default_rng(1)
    t = np.arange(40001) * 1e-3
    t[1:] += rng.uniform(-jitter, jitter, len(t) - 1)
    y = outputs_at(t, TRUTH[:, np.newaxis])
    y += 1e-3 * rng.standard_normal(y.shape)
    return DataSet(t, y, np.sin(t)[:, np.newaxis], alpha(t))


def main() -> None:
    """Print times and their ratios."""
    plant = disturbed_plant(reduce(academic()), [0, 0])
    records = {"equal steps": record(0.0), "jitter": record(1e-4)}
    for name, start in (("from a start", START), ("searched", None)):
        times = {}
        for kind, data in records.items():
            best = np.inf
            for _ in range(RUNS):
                began = time.process_time()
                assessment = assess(OutputErrorProblem([data], plant, FAMILIES), start)
                best = min(best, time.process_time() - began)
            times[kind] = best
            error = np.abs(assessment.fit.theta - THETA).max()
            print(f"{name}, {kind}: {best:.2f} s, error of theta {error:.1e}")
        print(f"{name}: jitter costs {times['jitter'] / times['equal steps']:.1f} times as much")


if __name__ == "__main__":
    main()
