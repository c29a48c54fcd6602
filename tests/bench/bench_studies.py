"""Studies beside loops: ``python tests/bench/bench_studies.py [SECTION ...]``.

``members`` runs members of ``academic`` of 0.2 s and of 10 s simulated as a study, with one worker
and with two, beside a loop of ``cosim.run`` and ``cosim.metrics`` in this process: ratios of wall
times, the start of workers included. ``--members N`` of 10 s (default 60; five times as many of
0.2 s).

``plan`` prints by how much the memory of a process grows that plans 100 000 members and begins to
run them, against 100 members.

``cluster`` does the same for 1 000 000 members on a LocalCluster, and prints how many tasks its
scheduler has had at most.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cosim

METRICS = {"error": "rms(observer.delta - delta.y)"}
KEY = "observer.filter_rate"
MEMORY = """
import resource, sys
import cosim
count, scheduler, out = int(sys.argv[1]), sys.argv[2] or None, sys.argv[3]
def stop(done, *_):
    if done == 50:
        raise KeyboardInterrupt
try:
    cosim.study("academic", vary={"observer.filter_rate": {"uniform": [100.0, 200.0]}},
        samples=count, set={"scenario.stop": 0.01}, metrics={"error": "rms(delta.y)"}, out=out,
        workers=1, scheduler=scheduler, progress=stop)
except KeyboardInterrupt:
    pass
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
"""


def study_seconds(stop: float, members: int, workers: int) -> float:
    """Return the wall time of a study."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        cosim.study(
            "academic",
            vary={KEY: {"linear": [100.0, 200.0], "points": members}},
            metrics=METRICS,
            set={"scenario.stop": stop},
            out=folder,
            workers=workers,
        )
        return time.perf_counter() - began


def loop_seconds(stop: float, members: int) -> float:
    """Return the wall time of the same members, one after the other."""
    began = time.perf_counter()
    for number in range(members):
        rate = 100.0 + 100.0 * number / members
        log = cosim.run("academic", set={"scenario.stop": stop, KEY: rate})
        cosim.metrics(log, METRICS)
    return time.perf_counter() - began


def compare_members(count: int) -> None:
    """Print how studies compare with loops."""
    cosim.run("academic", set={"scenario.stop": 0.2})
    for stop, members in ((0.2, 5 * count), (10.0, count)):
        loop = loop_seconds(stop, members)
        one, two = (study_seconds(stop, members, workers) for workers in (1, 2))
        print(
            f"{members} members of {stop:g} s: one worker {one / loop:.2f} of the loop "
            f"({1e3 * one / members:.1f} ms a member); two workers {loop / two / 2:.2f} of two "
            "loops"
        )


def memory(count: int, scheduler: str = "") -> float:
    """Return the largest memory of a process that begins a study [MB]."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", MEMORY, str(count), scheduler, folder]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def compare_plans() -> None:
    """Print what many members cost in memory."""
    few, many = memory(100), memory(100_000)
    print(f"100 000 members planned: {many - few:.0f} MB more than 100")


def compare_clusters() -> None:
    """Print what a million members cost on a cluster."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        most = 0
        tasks = cluster.scheduler.tasks

        def watch() -> None:
            nonlocal most
            most = max(most, len(tasks))
            cluster.loop.call_later(0.05, watch)

        cluster.loop.add_callback(watch)
        few = memory(100, cluster.scheduler_address)
        many = memory(1_000_000, cluster.scheduler_address)
        print(
            f"1 000 000 members planned on a cluster: {many - few:.0f} MB more than 100; at most "
            f"{most} tasks in the scheduler"
        )


def main() -> None:
    """Compare what is asked for."""
    sections = {"plan": compare_plans, "cluster": compare_clusters}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sections", nargs="*", help="members, plan, cluster; all by default")
    parser.add_argument("--members", type=int, default=60)
    options = parser.parse_args()
    chosen = options.sections or ["members", *sections]
    if "members" in chosen:
        compare_members(options.members)
    for name, compare in sections.items():
        if name in chosen:
            compare()


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))
    main()
