"""A whole study, its dataset included, beside one call for the same members.

Run with ``python tests/bench/bench_whole_studies.py [MEMBERS]``. CPU time of this process and of
its worker, one at a time, from reading the study to the last part of its dataset: all imports,
planning, one worker, Parquet. Beside it one call of ``cosim.core.ensemble.run_members`` with the
same members, already built, in a process that has imported everything. ``academic``, 40 s at 1 ms,
another theta and another initial state each; five metrics.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.bench.bench_studies import METRICS, academic, academic_edits

STUDY = """
import sys
import cosim
cosim.study(sys.argv[1], cases=sys.argv[2], metrics=METRICS, out=sys.argv[3], workers=1)
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


def cases(path: Path, members: int) -> None:
    """Write the members as a table."""
    lines = ["delta.terms[0].theta,plant.x_a0"]
    for number in range(members):
        edits = academic_edits(number)
        lines.append(f'{edits["delta.terms[0].theta"]!r},"{edits["plant.x_a0"]}"')
    path.write_text("\n".join(lines) + "\n")


def study_seconds(scenario: str, table: Path, out: Path) -> float:
    """Return the CPU time of a process that runs the study, and of its worker [s]."""
    before = os.times()
    code = f"METRICS = {METRICS!r}\n{STUDY}"
    subprocess.run([sys.executable, "-c", code, scenario, str(table), str(out)], check=True)
    after = os.times()
    return (
        after.children_user - before.children_user + after.children_system - before.children_system
    )


def call_seconds(scenario: str, members: int) -> float:
    """Return the CPU time of the call alone [s]."""
    code = f"ROOT = {str(Path(__file__).parents[2])!r}\n{CALL}"
    done = subprocess.run(
        [sys.executable, "-c", code, scenario, str(members)],
        check=True,
        capture_output=True,
        text=True,
    )
    return float(done.stdout)


def main() -> None:
    """Print times and ratios, three rounds in turn."""
    members = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        table = folder / "cases.csv"
        cases(table, members)
        for identifies in (False, True):
            scenario = academic(folder, identifies=identifies)
            for number in range(3):
                own = study_seconds(scenario, table, folder / f"out-{identifies}-{number}")
                call = call_seconds(scenario, members)
                title = f"academic {'with' if identifies else 'without'} identifier"
                print(f"{title}, {members}: {own:.2f} s beside {call:.2f} s: {own / call:.3f}")


if __name__ == "__main__":
    main()
