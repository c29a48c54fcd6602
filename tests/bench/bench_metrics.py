"""What metrics cost of a run of ``academic``, beside one of which nothing is kept.

Run with ``python tests/bench/bench_metrics.py [ROUNDS]``. A member of a study, 40 s at 1 ms: the
graph is built and prepared once, ``cosim.core.master.run`` initializes and advances it. Two runs in
turn, in rounds of shuffled order, CPU seconds; the ratio is that of a round, its median is printed:

* with the recorder ``Nothing``;
* with a ``MetricRecorder`` of five metrics, their values included.

Without the identifier, whose run is the shortest, so that metrics weigh most, and with it; in
blocks as short as those of a study's members, and as long as time allows.
The values are printed beside those of numpy over the recorded rows, as a faster wrong answer does
not count.
"""

import random
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory, Nothing
from cosim.core.recording import Plan
from cosim.scenario.building.build import Builder
from cosim.scenario.running.execution import load
from cosim.studies.measuring import MetricRecorder
from cosim.studies.members import BLOCK_BYTES
from cosim.studies.metrics import parse_metrics
from tests.bench.masters.core_systems import without_identifier

ROUNDS = 31
TARGET = 0.04
METRICS = {
    "error": "rms(observer.delta - delta.y, t > 5)",
    "worst": "max(abs(observer.delta - delta.y), t > 5)",
    "converged": "first(t, abs(observer.delta - delta.y) < 0.1 for 100 ms)",
    "effort": "sqrt(integral(plant.y**2))",
    "settled": "settling(observer.delta, 0.5)",
}


def references(memory: Memory) -> dict[str, float]:
    """Return the metrics by numpy."""
    t = memory.t
    error = memory["observer.delta"] - memory["delta.y"]
    later = error[t > 5]
    near = np.abs(error) < 0.1
    held = np.flatnonzero(np.convolve(near, np.ones(101))[: len(near)] == 101)
    delta = memory["observer.delta"]
    outside = np.flatnonzero(np.abs(delta - delta[-1]) > 0.5)
    return {
        "error": np.sqrt(np.mean(later**2)),
        "worst": np.abs(later).max(),
        "converged": t[held[0]],
        "effort": np.sqrt(np.trapezoid(memory["plant.y"] ** 2, t)),
        "settled": t[outside[-1] + 1],
    }


def measure(graph: Graph, clock: Clock, rounds: int) -> None:
    """Print the medians of one graph."""
    plan = graph.prepare(clock.step_ns)
    recorder = MetricRecorder(parse_metrics(METRICS))
    runs: dict[str, Callable[[], object]] = {
        "nothing": lambda: run(graph, clock, Nothing(), plan),
        "metrics": lambda: (run(graph, clock, recorder, plan), recorder.values()),
    }
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds + 1):
        for name in random.sample([*runs], len(runs)):
            began = time.process_time()
            runs[name]()
            times[name].append(time.process_time() - began)
    pairs = zip(times["metrics"][1:], times["nothing"][1:], strict=True)
    shares = [metrics / nothing - 1.0 for metrics, nothing in pairs]
    nothing = statistics.median(times["nothing"][1:])
    spread = statistics.quantiles(shares, n=4)
    print(
        f"{len(graph.components)} components: nothing {nothing * 1e3:.2f} ms, metrics "
        f"+{statistics.median(shares):.1%} (quartiles {spread[0]:.1%}, {spread[2]:.1%}; "
        f"target {TARGET:.0%})"
    )
    print_values(graph, clock, plan, recorder)


def print_values(graph: Graph, clock: Clock, plan: Plan, recorder: MetricRecorder) -> None:
    """Print the values of the last run beside those of numpy."""
    memory = Memory()
    run(graph, clock, memory, plan)
    by_numpy = references(memory)
    for name, value in recorder.values().items():
        assert value is not None
        off = abs(value / by_numpy[name] - 1.0)
        print(f"  {name:10s} {value:.16g}, off from numpy by {off:.1e}: {METRICS[name]}")


def main() -> None:
    """Measure."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else ROUNDS
    with ExitStack() as resources:
        experiment = Builder(load("academic"), resources, block=None).experiment()
        clock = experiment.clock
        for graph in (without_identifier(experiment.graph), experiment.graph):
            block = BLOCK_BYTES // (8 * graph.layout.row_width)
            for fixed in (block, None):
                fixed_clock = Clock(clock.stop, clock.step, fixed)
                print(f"block: {fixed}")
                measure(graph, fixed_clock, rounds)


if __name__ == "__main__":
    main()
