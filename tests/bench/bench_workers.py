"""What guarded workers cost beside plain loops, in time and memory; and that each loss is one.

Run with ``python tests/bench/bench_workers.py``. Two workers and two processes that run the same
members in a plain loop, without any guard, take turns five times; their starts are counted.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[2]))

from cosim.studies.contracts import FAILED, StudyMember, StudySubject
from cosim.studies.workers.pool import WorkerPool

ROOT = Path(__file__).parents[2]
PROCESSES = 2
MEMBERS = 1500
ROUNDS = 5
SUBJECT = StudySubject(
    "academic",
    set={"scenario.stop": 0.2},
    metrics={"error": "rms(observer.delta - delta.y)"},
)
OPENER = "cosim.studies.members.runner:open_runner"
TRIVIAL = "tests.studies.workers.runners:open_doing"
TRIVIAL_MEMBERS = 20_000
BAD = ("SIGSEGV", "abort", "_exit", "exit of C with 3", "sleep", "search in C", "closes files")
LOOP = """
import sys
sys.path.insert(0, {root!r})
from cosim.studies.members.runner import open_runner
from tests.bench.bench_workers import SUBJECT, members
with open_runner(SUBJECT) as runner:
    for member in members({first}, {last}):
        assert runner.run(member).status == "complete"
"""


class Cost(NamedTuple):
    """Of some members [s]: wall time, and the time of this process and of its children."""

    wall: float
    processor: float


def members(first: int, last: int) -> Iterator[StudyMember]:
    """Yield members of the scenario, each with another initial state."""
    for number in range(first, last):
        yield StudyMember(number, set={"plant.x_a0[0]": 0.1 + 1e-5 * number})


def processor_time() -> float:
    """Return that of this process and of the children that have ended [s]."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in both)


def run_loops() -> None:
    """Run half of the members in each of two processes."""
    step = MEMBERS // PROCESSES
    loops = [
        subprocess.Popen(
            [sys.executable, "-c", LOOP.format(root=str(ROOT), first=k, last=k + step)]
        )
        for k in range(0, MEMBERS, step)
    ]
    assert [loop.wait() for loop in loops] == [0] * PROCESSES


def run_workers() -> None:
    """Run all of them in two workers."""
    with WorkerPool(OPENER, SUBJECT, PROCESSES) as pool:
        outcomes = [outcome for _, outcome in pool.run(members(0, MEMBERS))]
    assert len(outcomes) == MEMBERS
    assert all(outcome.status == "complete" for outcome in outcomes)


def run_trivial() -> None:
    """Run members that do nothing."""
    with WorkerPool(TRIVIAL, SUBJECT, 1) as pool:
        for _ in pool.run(members(0, TRIVIAL_MEMBERS)):
            pass


def cost_of(work: Callable[[], None]) -> Cost:
    """Return what a function costs."""
    wall = time.perf_counter()
    processor = processor_time()
    work()
    return Cost(time.perf_counter() - wall, processor_time() - processor)


def resident() -> float:
    """Return the memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def compare_rates() -> None:
    """Print the rate of two workers over that of two loops."""
    ratios = []
    shares = []
    for _ in range(ROUNDS):
        loops = cost_of(run_loops)
        workers = cost_of(run_workers)
        ratios.append(loops.wall / workers.wall)
        shares.append(workers.processor / loops.processor)
        print(f"loops {loops.wall:.2f} s, workers {workers.wall:.2f} s: {ratios[-1]:.3f}")
    print(f"rate of workers over loops, median: {statistics.median(ratios):.3f}")
    print(f"processor time of workers over loops, median: {statistics.median(shares):.3f}")


def measure_overhead() -> None:
    """Print what a member costs that does nothing, in parent and worker together."""
    cost = cost_of(run_trivial)
    processor = 1e3 * cost.processor / TRIVIAL_MEMBERS
    print(
        f"trivial members: {processor:.4f} ms of processor time, "
        f"{TRIVIAL_MEMBERS / cost.wall:.0f} a second in one worker"
    )


def measure_memory() -> None:
    """Print the memory of this process after 1 000, 10 000 and 100 000 members."""
    sizes = {}
    with WorkerPool(TRIVIAL, SUBJECT, PROCESSES) as pool:
        for done, _ in enumerate(pool.run(members(0, 100_000)), 1):
            if done in (1_000, 10_000, 100_000):
                sizes[done] = resident()
    base = sizes[1_000]
    text = ", ".join(f"{done}: {size:.1f} MB ({size / base:.3f})" for done, size in sizes.items())
    print(f"memory of the parent after members {text}")


def count_losses() -> None:
    """Print how many members fail of a thousand, of which some crash or hang."""
    bad = {number: BAD[number // 7 % len(BAD)] for number in range(3, 1000, 70)}
    given = [StudyMember(n, set={"does": bad.get(n, "nothing")}) for n in range(1000)]
    with WorkerPool(TRIVIAL, SUBJECT, PROCESSES, timeout=2.0) as pool:
        outcomes = [outcome for _, outcome in pool.run(given)]
    failed = {outcome.number: outcome.reason for outcome in outcomes if outcome.status == FAILED}
    assert sorted(outcome.number for outcome in outcomes) == list(range(1000))
    assert sorted(failed) == sorted(bad)
    print(f"{len(bad)} bad members of {len(outcomes)}: {len(failed)} failures")
    for number, reason in sorted(failed.items()):
        print(f"  {number:3d} {bad[number]:16s} {reason}")


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the loops, as workers have it
    measure_overhead()
    measure_memory()
    count_losses()
    compare_rates()
