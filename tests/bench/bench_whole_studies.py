"""A whole study, its dataset included, beside one call for the same members.

``python tests/bench/bench_whole_studies.py [MEMBERS [ROUNDS [academic] [identified] [fmu]]]``.

CPU time of this process and of its worker, one at a time, from reading the study to the last part
of its dataset: all imports, planning, one worker, Parquet. Modules are compiled before, as they are
after an installation. Beside it, in processes that have imported everything: the runner's loop over
the same members, and one call of ``cosim.core.ensemble.run_members`` with them, already built.
``academic``, 40 s at 1 ms, without its identifier and with it (*identified*), another theta and
another initial state each; five metrics.

Then ten times as many members of an FMU over 1 000 steps, with other parameters each, beside a loop
in one warm process that loads the FMU, runs it and computes the metrics; and the memory of the
process of the study after 1 000 members and at the end.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from cosim.fmi.unpacked import UnpackedFmus
from cosim.studies.measuring import MetricRecorder
from cosim.studies.metrics import parse_metrics
from tests.bench.bench_studies import (
    METRICS,
    OF_FMU,
    SCENARIO,
    Edits,
    academic,
    academic_edits,
    fmu_edits,
    plain_member,
    seconds,
)
from tests.fmi.small import able, compiled

STUDY = """
import resource
import sys
from pathlib import Path
import cosim
def resident(done, *_):
    if done in (1_000, 10_000):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        print(f"  memory after {done} members: {pages * resource.getpagesize() / 1e6:.1f} MB")
cosim.study(
    sys.argv[1], cases=sys.argv[2], metrics=METRICS, out=sys.argv[3], workers=1, progress=resident
)
"""
LOOP = """
import sys
import time
sys.path.insert(0, ROOT)
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.members.runner import open_runner
from tests.bench.bench_studies import METRICS, academic_edits
members = [StudyMember(number, academic_edits(number)) for number in range(int(sys.argv[2]))]
with open_runner(StudySubject(sys.argv[1], metrics=METRICS)) as runner:
    runner.run(members[0])
    began = time.process_time()
    for member in members:
        runner.run(member)
    print(time.process_time() - began)
"""
CALL = """
import sys
sys.path.insert(0, ROOT)
from contextlib import ExitStack
from cosim.core.ensemble import run_members
from cosim.scenario.preparing import build_experiment
from cosim.scenario.running.execution import load
from tests.bench.bench_studies import academic_edits, seconds
count = int(sys.argv[2])
scenario = load(sys.argv[1])
with ExitStack() as resources:
    whole = build_experiment(scenario, resources, None)
    built = []
    for number in range(count):
        graph = build_experiment(scenario.set(academic_edits(number)), resources, None).graph
        built.append({name: graph.components[name] for name in ("plant", "delta")})
    print(seconds(1, lambda: run_members(whole.graph, whole.clock, built)) / 1e3)
"""


def cases(path: Path, members: Sequence[Edits]) -> None:
    """Write the members as a table."""
    lines = [",".join(members[0])]
    for edits in members:
        lines.append(",".join(f'"{value!r}"' for value in edits.values()))
    path.write_text("\n".join(lines) + "\n")


def study_seconds(scenario: str, table: Path, out: Path, metrics: Mapping[str, str]) -> float:
    """Return the CPU time of a process that runs the study, and of its worker [s]."""
    before = os.times()
    code = f"METRICS = {dict(metrics)!r}\n{STUDY}"
    command = [sys.executable, "-c", code, scenario, str(table), str(out)]
    subprocess.run(command, check=True, env=with_compiled_modules(out.parent))
    after = os.times()
    return (
        after.children_user - before.children_user + after.children_system - before.children_system
    )


def with_compiled_modules(folder: Path) -> dict[str, str]:
    """Return an environment in which modules are compiled once."""
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(folder / "compiled")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    return environment


def seconds_of(text: str, scenario: str, members: int) -> float:
    """Return the CPU time that a program prints [s]."""
    code = f"ROOT = {str(Path(__file__).parents[2])!r}\n{text}"
    done = subprocess.run(
        [sys.executable, "-c", code, scenario, str(members)],
        check=True,
        capture_output=True,
        text=True,
    )
    return float(done.stdout)


def compare_academic(folder: Path, members: int, rounds: int, *, identifies: bool) -> None:
    """Print what a study costs beside a loop and a call, in turn."""
    edits = [academic_edits(number) for number in range(members)]
    table = folder / "cases.csv"
    cases(table, edits)
    first = folder / "first.csv"
    cases(first, edits[:1])
    scenario = academic(folder, identifies=identifies)
    study_seconds(scenario, first, folder / f"out-{identifies}", METRICS)
    for number in range(rounds):
        own = study_seconds(scenario, table, folder / f"out-{identifies}-{number}", METRICS)
        title = f"academic {'with' if identifies else 'without'} identifier, {members}"
        for name, text in (("loop", LOOP), ("call", CALL)):
            plain = seconds_of(text, scenario, members)
            print(f"{title}: {own:.2f} s beside a {name} of {plain:.2f} s: {own / plain:.3f}")


def compare_fmu(folder: Path, members: int, rounds: int) -> None:
    """Print what a member with an FMU costs in a study and in a loop, in turn."""
    fmu = able(compiled(folder), folder / "plant.fmu", "state", "slopes", D=0.0)
    scenario = folder / "fmu.toml"
    scenario.write_text(SCENARIO)
    edits = [fmu_edits(number) for number in range(members)]
    table = folder / "fmu.csv"
    cases(table, edits)
    recorder = MetricRecorder(parse_metrics(OF_FMU))
    for number in range(rounds):
        out = folder / f"out-fmu-{number}"
        own = study_seconds(str(scenario), table, out, OF_FMU) / members * 1e3
        with closing(UnpackedFmus()) as fmus:
            plain_member(fmu, fmus, recorder, edits[0])
            plain = seconds(members, partial(_run_all, fmu, fmus, recorder, edits))
        print(
            f"FMU, {members}: {own:.3f} ms a member beside {plain:.3f} ms, "
            f"beyond 1.1 x {own - 1.1 * plain:+.3f} ms"
        )


def _run_all(
    fmu: Path, fmus: UnpackedFmus, recorder: MetricRecorder, edits: Sequence[Edits]
) -> None:
    for changes in edits:
        plain_member(fmu, fmus, recorder, changes)


def main() -> None:
    """Print times and ratios, in turn."""
    members = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    rounds = int(sys.argv[2]) if len(sys.argv) > 2 else 3
    parts = sys.argv[3:] or ["academic", "identified", "fmu"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "academic" in parts:
            compare_academic(folder, members, rounds, identifies=False)
        if "identified" in parts:
            compare_academic(folder, members, rounds, identifies=True)
        if "fmu" in parts:
            compare_fmu(folder, 10 * members, rounds)


if __name__ == "__main__":
    main()
