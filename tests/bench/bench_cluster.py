"""Studies on dask.distributed: what a cluster costs beside the members, and a million members.

``python tests/bench/bench_cluster.py [overhead] [million]``

*overhead*: a scheduler and two workers in processes of their own, over TCP on loopback; members
sleep for 20 and for 100 ms, so that the processors of this machine are not what is measured. Time:
two workers times the time from the first look at the cluster to the last outcome in the dataset,
against the sum of the members' wall times; with and without opening the study; and that time
against the time of the same study in two local workers. Processors: what scheduler, workers and
this process used beside the guarded children.

*million*: members that cost nothing, in workers inside of this process, without guarded children:
what is left is planning, the scheduler, and the writing of parts. Tasks of 1000 members, then of
100, where what limits is the number of tasks a second.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from typing import NamedTuple

from distributed import Client, LocalCluster

sys.path.insert(0, str(Path(__file__).parents[2]))

from cosim.studies.cluster import study_plugin
from cosim.studies.cluster.cluster_run import run_on_cluster
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.workers.pool import WorkerPool
from tests.studies.cluster.planned import (
    OPENER,
    SUBJECT,
    CountedMembers,
    CountedRunner,
    identity,
)
from tests.studies.cluster.processes import cluster

SECONDS = 60  # of a study
SLEEPS = (0.02, 0.1)  # of a member [s]
WORKERS = 2


def processor_time(pid):
    """Return what a process has used, without its children [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100


def overhead(folder):
    """Print what a cluster costs beside the members, and beside the same study run locally."""
    with cluster(folder, WORKERS) as processes:
        pids = [process.pid for process in [processes.scheduler, *processes.workers]]
        run_study(folder / "first", processes, CountedMembers(100, sleeps=0.1))
        for sleep in SLEEPS:
            design = CountedMembers(round(SECONDS * WORKERS / sleep), sleeps=sleep)
            local = local_times(folder / f"local-{sleep}", design)
            before = [*map(processor_time, pids), time.process_time()]
            times = run_study(folder / f"cluster-{sleep}", processes, design)
            after = [*map(processor_time, pids), time.process_time()]
            used = [late - early for early, late in zip(before, after, strict=True)]
            print(
                f"{len(design)} members of {1e3 * times.members / len(design):.2f} ms, "
                f"{times.all:.2f} s on {WORKERS} workers; {times.of_members()}; beside "
                f"{local.all:.2f} s in local workers ({local.of_members()}) "
                f"{100 * (times.all / local.all - 1):+.2f} %; processors beside the children: "
                f"scheduler {used[0]:.2f} s, workers {sum(used[1:-1]):.2f} s, "
                f"this process {used[-1]:.2f} s, together {100 * sum(used) / times.members:.2f} %"
            )


class Times(NamedTuple):
    """How long a study took, and its members [s]; behind its first outcome, too."""

    all: float
    members: float
    behind_first: float
    members_behind_first: float

    def of_members(self):
        """Return what a study takes beside its members."""
        whole = WORKERS * self.all / self.members - 1
        behind = WORKERS * self.behind_first / self.members_behind_first - 1
        return f"{100 * whole:.2f} % beside the members, {100 * behind:.2f} % behind the first"


def times_of(dataset, run, count):
    """Return the times of a study that ``run(progress)`` runs."""
    arrivals = []
    began = time.perf_counter()
    run(lambda done, *_: arrivals.append((time.perf_counter(), done)))
    ended = time.perf_counter()
    members = sum(dataset.read(["wall_time"]).column("wall_time").to_pylist())
    first = next(arrival for arrival in arrivals if arrival[1])
    share = (count - first[1]) / count
    return Times(ended - began, members, arrivals[-1][0] - first[0], members * share)


def run_study(place, processes, design):
    """Return the times of a study on a cluster."""
    with StudyDataset.open_or_create(place, identity(len(design), part_size=100)) as dataset:

        def run(progress):
            settings = {"files": {}, "opener": OPENER, "progress": progress}
            run_on_cluster(processes.address, SUBJECT, design, dataset, str(place), **settings)

        return times_of(dataset, run, len(design))


def local_times(place, design):
    """Return the times of a study in workers of this process."""
    with StudyDataset.open_or_create(place, identity(len(design), part_size=100)) as dataset:

        def run(progress):
            members = design.members()
            with WorkerPool(OPENER, SUBJECT, WORKERS) as pool:
                for result in pool.run(members):
                    dataset.add(*result)
                    progress(len(dataset))

        return times_of(dataset, run, len(design))


class InProcess:
    """Runs members in the thread that asks."""

    def __init__(self, opener, subject, *, timeout):
        self._runner = CountedRunner()

    def submit(self, members):
        """Return outcomes as a future."""
        future = Future()
        future.set_result([self._runner.run(member) for member in members])
        return future

    def shutdown(self):
        """Do nothing."""


def memory():
    """Return the most that this process had [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def million(folder, members, part_size):
    """Print what the scheduler has to do for very many members."""
    study_plugin.MemberExecutor = InProcess
    with (
        LocalCluster(
            processes=False, n_workers=4, threads_per_worker=1, dashboard_address="127.0.0.1:0"
        ) as local,
        Client(local, set_as_default=False) as client,
        StudyDataset.open_or_create(
            folder / f"x{part_size}", identity(members, part_size=part_size)
        ) as dataset,
    ):
        most = [0]
        ended = threading.Event()

        def count():
            while not ended.wait(0.02):
                most[0] = max(most[0], len(local.scheduler.tasks))

        counter = threading.Thread(target=count)
        counter.start()
        before = memory()
        began = time.perf_counter()
        run_on_cluster(
            client,
            SUBJECT,
            CountedMembers(members),
            dataset,
            str(folder / f"x{part_size}"),
            files={},
            opener=OPENER,
        )
        seconds = time.perf_counter() - began
        ended.set()
        counter.join()
        parts = len(list((folder / f"x{part_size}" / "parts").iterdir()))
        print(
            f"{members} members in parts of {part_size}: {seconds:.1f} s, {parts} parts, "
            f"{parts / seconds:.0f} tasks a second, at most {most[0]} tasks in the scheduler; "
            f"{before:.0f} MB before, at most {memory():.0f} MB (client, scheduler and workers)"
        )


def main(names):
    """Run what is asked for."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        if "overhead" in names:
            overhead(folder)
        if "million" in names:
            million(folder, 10_000, 1000)
            million(folder, 1_000_000, 1001)
            million(folder, 200_000, 20)


if __name__ == "__main__":
    main(sys.argv[1:] or ["overhead", "million"])
