"""Members of a study, beside the plainest loops over the same pieces, in one process.

Run with ``python tests/bench/bench_studies.py``. CPU time of this process a member, medians of
rounds in turn.

* ``academic`` (40 s at 1 ms, without and with its identifier), another theta and another initial
  state each, five metrics: beside one call of ``cosim.core.ensemble.run_members`` with the same
  members, already built, which adds up their rows.
* A co-simulation FMU over 1 000 steps, driven by a source with other parameters each, or with
  other parameters of its own: beside a loop that loads it, builds its graph, runs and computes the
  metrics.

The metrics of both are compared, where both compute them.
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from cosim.blocks.source import sine
from cosim.core.clock import Clock
from cosim.core.ensemble import run_members
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.fmi.component import load as load_fmu
from cosim.fmi.options import FmuOptions
from cosim.fmi.unpacked import UnpackedFmus
from cosim.scenario.document.document import find
from cosim.scenario.preparing import build_experiment
from cosim.scenario.running.execution import load
from cosim.studies.contracts import MetricValue, StudyMember, StudySubject
from cosim.studies.measuring import MetricRecorder
from cosim.studies.members.runner import open_runner
from cosim.studies.metrics import parse_metrics
from tests.fmi.small import able, compiled

ROUNDS = 5
METRICS = {
    "rms": "rms(observer.delta - delta.y)",
    "last": "last(observer.delta)",
    "first": "first(t, abs(observer.delta - delta.y) < 1e-3)",
    "largest": "max(abs(plant.y))",
    "settling": "settling(plant.y)",
}
OF_FMU = {"rms": "rms(plant.y - u.y)", "last": "last(plant.y)", "largest": "max(abs(plant.x))"}
SCENARIO = """
scenario = { name = "fmu", stop = 1.0, step = 1e-3 }
[components]
u = { kind = "sine", amplitude = 1.0, rate = 3.0 }
plant = { kind = "fmu", path = "plant.fmu", start = { A = -1.0, B = 1.0, C = 1.0, x = 0.5 } }
[connections]
"plant.u" = "u.y"
"""
Edits = Mapping[str, Any]


def seconds(members: int, work: Callable[[], object]) -> float:
    """Return the CPU time of some work, a member [ms]."""
    began = time.process_time()
    work()
    return (time.process_time() - began) / members * 1e3


def compare(title: str, members: int, *works: Callable[[], object]) -> None:
    """Print the medians of two works, done in turn, and their ratio."""
    times: list[list[float]] = [[], []]
    for _ in range(ROUNDS):
        for samples, work in zip(times, works, strict=True):
            samples.append(seconds(members, work))
    own, plain = map(statistics.median, times)
    print(
        f"{title:42s} {own:8.3f} ms a member, beside {plain:8.3f} ms: ratio {own / plain:.3f}, "
        f"beyond 1.1 x {own - 1.1 * plain:+.3f} ms"
    )


def academic(folder: Path, *, identifies: bool) -> str:
    """Write ``academic``, without its identifier or with it; return the path."""
    text = find("academic").text
    if not identifies:
        begin = text.index("[components.identifier]")
        text = text[:begin] + text[text.index("[connections]") :]
        lines = [line for line in text.splitlines() if not line.startswith('"identifier.')]
        text = "\n".join(lines)
    path = folder / f"academic-{identifies}.toml"
    path.write_text(text)
    return str(path)


def academic_edits(number: int) -> Edits:
    """Return another theta and another initial state."""
    theta = -0.1 - 1e-4 * number
    return {"delta.terms[0].theta": theta, "plant.x_a0": [1.0 + 1e-3 * number, -1.0]}


def compare_academic(folder: Path, members: int, *, identifies: bool) -> None:
    """Compare members of ``academic`` with one call that has them built already."""
    path = academic(folder, identifies=identifies)
    edits = [academic_edits(number) for number in range(members)]
    scenario = load(path)
    with ExitStack() as resources:
        runner = resources.enter_context(open_runner(StudySubject(path, metrics=METRICS)))
        whole = build_experiment(scenario, resources, None)
        built = []
        for changes in edits:
            graph = build_experiment(scenario.set(changes), resources, None).graph
            built.append({name: graph.components[name] for name in ("plant", "delta")})

        def study() -> None:
            for number, changes in enumerate(edits):
                outcome = runner.run(StudyMember(number, changes))
                assert outcome.status == "complete", outcome.reason

        def ensemble() -> None:
            run_members(whole.graph, whole.clock, built)

        study()
        title = f"academic {'with' if identifies else 'without'} identifier, {members}"
        compare(title, members, study, ensemble)


def source_edits(number: int) -> Edits:
    """Return other parameters of the source."""
    return {"u.amplitude": 1.0 + 1e-3 * number, "u.rate": 3.0 + 1e-3 * number}


def fmu_edits(number: int) -> Edits:
    """Return other parameters of the FMU."""
    return {"plant.start.x": 0.5 + 1e-3 * number, "plant.start.A": -1.0 - 1e-3 * number}


def plain_member(
    fmu: Path, fmus: UnpackedFmus, recorder: MetricRecorder, edits: Edits
) -> Mapping[str, MetricValue]:
    """Load an FMU, run it behind its source, and return the metrics."""
    start = {"A": -1.0, "B": 1.0, "C": 1.0, "x": 0.5}
    for name in start:
        start[name] = edits.get(f"plant.start.{name}", start[name])
    amplitude = edits.get("u.amplitude", 1.0)
    rate = edits.get("u.rate", 3.0)
    with load_fmu(fmu, FmuOptions(start=start), unpacked=fmus) as opened:
        components = {"u": sine(amplitude=amplitude, rate=rate), "plant": opened.component}
        graph = Graph(components, {"plant.u": "u.y"})
        run(graph, Clock(1.0, 1e-3), recorder)
    return recorder.values()


def compare_fmu(folder: Path, members: int, edits_of: Callable[[int], Edits]) -> None:
    """Compare members with an FMU with the plainest loop."""
    fmu = folder / "plant.fmu"
    path = folder / "fmu.toml"
    path.write_text(SCENARIO)
    edits = [edits_of(number) for number in range(members)]
    recorder = MetricRecorder(parse_metrics(OF_FMU))
    with (
        closing(UnpackedFmus()) as fmus,
        open_runner(StudySubject(str(path), metrics=OF_FMU)) as runner,
    ):
        for number, changes in enumerate(edits):
            outcome = runner.run(StudyMember(number, changes))
            assert outcome.metrics == plain_member(fmu, fmus, recorder, changes)

        def study() -> None:
            for number, changes in enumerate(edits):
                runner.run(StudyMember(number, changes))

        def loop() -> None:
            for changes in edits:
                plain_member(fmu, fmus, recorder, changes)

        compare(f"FMU, {edits_of.__name__}, {members}", members, study, loop)


def main() -> None:
    """Print all of it; an argument gives how many members an FMU has, a fifth of it the others."""
    members = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        compare_academic(folder, max(2, members // 5), identifies=False)
        compare_academic(folder, max(2, members // 50), identifies=True)
        able(compiled(folder), folder / "plant.fmu", "state", "slopes", D=0.0)
        for edits_of in (source_edits, fmu_edits):
            compare_fmu(folder, members, edits_of)


if __name__ == "__main__":
    main()
