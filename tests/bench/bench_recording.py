"""What recording costs a run: beside the run without a log, and the same rows recorded alone.

For the scenario ``academic`` and for a ring of three FMUs (co-simulation, FMI 3) of a million
steps: processor time of all threads; and the longest that the run was held up, beside the time that
it took for the block that it then recorded: blocks become longer in a run. Every figure is the
median of rounds of all three. Run with
``python tests/bench/bench_recording.py [FOLDER]``.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from statistics import median

import numpy as np

import cosim
from cosim.core.clock import Clock
from cosim.core.contracts import Block
from cosim.core.graph import Graph
from cosim.core.master import run as run_graph
from cosim.core.recorders import Nothing, Tee
from cosim.core.recording import Plan, Recorder
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.log import McapRecorder
from tests.bench.masters.building import build_fmus
from tests.bench.masters.systems import ring

ROUNDS = 7
STEPS = 1_000_000
LONG = 200.0  # s of academic


class Captured(Nothing):
    """Keeps the blocks of a run."""

    def begin(self, plan: Plan) -> None:
        """Keep the plan."""
        self.plan = plan
        self.blocks: list[tuple[Block, np.ndarray]] = []

    def write(self, block: Block, signals: np.ndarray) -> None:
        """Keep a copy."""
        times = block.time_ns.copy()
        kept = Block(block.index, times, times / 1e9, block.h)
        self.blocks.append((kept, signals.copy()))


class Timed(Tee):
    """Measures how long each block holds up the run."""

    def __init__(self, recorder: McapRecorder) -> None:
        super().__init__(recorder)
        self._recorder = recorder
        self.writes: list[float] = []
        self.between: list[float] = []

    def begin(self, plan: Plan) -> None:
        """Pass on."""
        self._recorder.begin(plan)
        self._last = time.perf_counter()

    def write(self, block: Block, signals: np.ndarray) -> None:
        """Pass on, and measure."""
        began = time.perf_counter()
        self.between.append(began - self._last)
        self._recorder.write(block, signals)
        self._last = time.perf_counter()
        self.writes.append(self._last - began)


def academic(recorder: Recorder) -> None:
    """Run the scenario into a recorder."""
    cosim.run("academic", set={"scenario.stop": LONG}, recorder=recorder)


def ring_of_fmus(folder: Path, resources: ExitStack) -> Callable[[Recorder], None]:
    """Return what runs the ring into a recorder."""
    system = ring(3)
    components = {}
    connections = {}
    paths = build_fmus(system, "3", "cs", folder)
    for number, lag in enumerate(system.lags):
        options = FmuOptions(interface_type="cs")
        fmu = resources.enter_context(load(paths[number], options, instance_name=f"lag{number}"))
        components[f"lag{number}"] = fmu.component
        connections[f"lag{number}.u"] = f"lag{lag.source}.y"
    graph = Graph(components, connections)
    clock = Clock(stop=STEPS * 1e-3, step=1e-3)

    def run(recorder: Recorder) -> None:
        run_graph(graph, clock, recorder)

    return run


def processor(task: Callable[..., object], *arguments: object) -> float:
    """Return the processor time of a task, of all threads [s]."""
    began = time.process_time()
    task(*arguments)
    return time.process_time() - began


def replayed(captured: Captured, path: Path) -> None:
    """Record the kept blocks alone."""
    with McapRecorder(path, force=True) as recorder:
        recorder.begin(captured.plan)
        for block, signals in captured.blocks:
            recorder.write(block, signals)


def report(name: str, run: Callable[[Recorder], None], path: Path) -> None:
    """Print the figures of a run."""
    captured = Captured()
    run(captured)
    ratios = []
    stalls = []
    for _ in range(ROUNDS):
        without = processor(run, Nothing())
        alone = processor(replayed, captured, path)
        timed = Timed(McapRecorder(path, force=True))
        with_log = processor(run, timed)
        ratios.append(with_log / (without + alone))
        longest = int(np.argmax(timed.writes))
        stalls.append(timed.writes[longest] / timed.between[longest])
    blocks = len(captured.blocks)
    print(
        f"{name}: {median(ratios):.2f} x (the run without a log, {without:.2f} s, + its rows "
        f"alone, {alone:.2f} s); the longest stall is {median(stalls):.2f} x the time of "
        f"its block, of {blocks}"
    )


def main() -> None:
    """Print all figures."""
    with (
        tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as name,
        ExitStack() as resources,
    ):
        folder = Path(name)
        report("academic", academic, folder / "a.mcap")
        report("ring of 3 FMUs", ring_of_fmus(folder, resources), folder / "a.mcap")


if __name__ == "__main__":
    main()
