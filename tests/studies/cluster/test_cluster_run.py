"""Studies on a scheduler and workers in processes of their own, over TCP on loopback."""

import os
import re
import signal
import threading
import time

import fsspec
import pytest

from cosim.errors import RunError, UsageError
from cosim.studies.cluster import cluster_run
from cosim.studies.cluster.cluster_run import run_on_cluster
from cosim.studies.cluster.connection import connect
from cosim.studies.dataset import StudyDataset
from cosim.studies.workers.pool import WorkerPool
from tests.studies.cluster.planned import OPENER, SUBJECT, CountedMembers, assert_same, identity
from tests.studies.cluster.processes import LIMIT, cluster

pytestmark = pytest.mark.slow


def run(scheduler, design, place, **options):
    """Run a study in a new dataset; return its table."""
    with StudyDataset.open_or_create(place, identity(len(design))) as dataset:
        run_on_cluster(
            scheduler, SUBJECT, design, dataset, str(place), files={}, opener=OPENER, **options
        )
        assert dataset.missing() == []
        return dataset.read()


def local(design, place):
    """Run a study in one worker of this machine, which takes no time; return its table."""
    design = CountedMembers(len(design), **{**design.same, "cost": 0.0, "sleeps": 0.0})
    with (
        StudyDataset.open_or_create(place, identity(len(design))) as dataset,
        WorkerPool(OPENER, SUBJECT, 1) as pool,
    ):
        for result in pool.run(design.members()):
            dataset.add(*result)
        return dataset.read()


def parts(folder):
    """Return the names of the parts in a folder."""
    return sorted(path.name for path in (folder / "parts").iterdir())


@pytest.mark.usefixtures("worker_processes")
def test_content_is_that_of_the_local_run(two_workers, tmp_path):
    """In every column but wall time and worker, members that crash included; the same parts."""
    design = CountedMembers(210, cost=1e-3, crashes=True)
    counts = []
    found = run(two_workers.address, design, tmp_path / "a", progress=lambda *c: counts.append(c))
    assert_same(found, local(design, tmp_path / "b"))
    assert parts(tmp_path / "a") == parts(tmp_path / "b")
    assert counts[-1] == (210, 210, 25)  # 19 elevenths and 6 that crash
    assert not [path for path in (tmp_path / "a").iterdir() if path.name.startswith("_cosim")]


def test_outcomes_come_back_where_workers_do_not_reach_the_dataset(two_workers, tmp_path):
    """A dataset in the memory of this process is written by this process."""
    design = CountedMembers(90)
    try:
        found = run(two_workers.address, design, "memory://cluster")
    finally:
        fsspec.filesystem("memory").rm("/cluster", recursive=True)
    assert_same(found, local(design, tmp_path / "b"))


def test_a_study_goes_on_with_what_is_missing(two_workers, tmp_path):
    """Members in the journal, and in parts, are not run again."""
    design = CountedMembers(100, marks=str(tmp_path))
    place = tmp_path / "a"
    with StudyDataset.open_or_create(place, identity(100)) as dataset:
        with WorkerPool(OPENER, SUBJECT, 1) as pool:
            for result in pool.run(design.members(0, 50)):
                dataset.add(*result)
        run_on_cluster(
            two_workers.address, SUBJECT, design, dataset, str(place), files={}, opener=OPENER
        )
        assert dataset.missing() == []
    marks = [path.name.partition("-")[0] for path in tmp_path.glob("*-*")]
    assert sorted(map(int, marks)) == list(range(100))


def test_a_worker_killed_in_the_middle_costs_nothing(tmp_path):
    """Every member is there once, with the content of the local run; who has gone is named."""
    named = tmp_path / "named"
    waiting = {"waiting from": 100, "waits for": str(named)}
    design = CountedMembers(300, sleeps=0.01, marks=str(tmp_path), **waiting)
    notices = []

    def note(text):
        notices.append(text)
        named.touch()

    with cluster(tmp_path / _made(tmp_path, "cluster")) as processes:
        victim = processes.workers[0]
        killer = threading.Thread(
            target=_kill_after, args=(victim, tmp_path, 60), kwargs={"workers": 2}, daemon=True
        )
        killer.start()
        found = run(processes.address, design, tmp_path / "a", notice=note)
        killer.join(LIMIT)
        assert victim.wait(LIMIT) == -signal.SIGKILL
    assert [re.sub("tcp://[^ ]*", "X", text) for text in notices] == ["worker X is gone; 1 is left"]
    assert found.column("member").to_pylist() == list(range(300))
    assert_same(found, local(design, tmp_path / "b"))


@pytest.mark.campaign
def test_a_worker_that_comes_later_is_used(tmp_path):
    """It is checked first, as the others were."""
    design = CountedMembers(400, cost=0.01, marks=str(tmp_path))
    with cluster(tmp_path / _made(tmp_path, "cluster"), workers=1) as processes:
        begun = threading.Thread(target=_start_after, args=(processes, tmp_path, 5), daemon=True)
        begun.start()
        found = run(processes.address, design, tmp_path / "a")
        begun.join(LIMIT)
    assert found.num_rows == 400
    assert len(set(found.column("worker").to_pylist())) == 2


def test_a_worker_without_cosim_is_named_and_not_used(two_workers, tmp_path):
    """The others run the study."""
    worker = two_workers.start_worker(PYTHONPATH=_without_cosim(tmp_path))
    try:
        with connect(two_workers.address) as client:
            client.wait_for_workers(3, timeout=LIMIT)
        notices = []
        found = run(two_workers.address, CountedMembers(8), tmp_path / "a", notice=notices.append)
    finally:
        worker.kill()
        worker.wait(LIMIT)
    assert found.num_rows == 8
    (notice,) = notices
    assert re.match(r"worker tcp://.* is not used: .*ImportError.*there is no cosim", notice)


def test_a_scheduler_without_cosim_is_one_error(tmp_path):
    """It reads the tasks; nothing is run."""
    folder = tmp_path / _made(tmp_path, "cluster")
    with (
        cluster(folder, workers=0, PYTHONPATH=_without_cosim(tmp_path)) as processes,
        pytest.raises(UsageError, match=r"^the scheduler at tcp://.* cannot read .*: ImportError"),
    ):
        run(processes.address, CountedMembers(8), tmp_path / "a")


def test_ctrl_c_leaves_what_came_and_nothing_on_its_way(two_workers, tmp_path):
    """The same study goes on from there."""
    design = CountedMembers(150, sleeps=0.02)

    def interrupt(done, planned, failed):
        if 4 <= done < 150:
            os.kill(os.getpid(), signal.SIGINT)

    place = tmp_path / "a"
    with StudyDataset.open_or_create(place, identity(150)) as dataset:
        with pytest.raises(KeyboardInterrupt):
            run_on_cluster(
                two_workers.address,
                SUBJECT,
                design,
                dataset,
                str(place),
                files={},
                opener=OPENER,
                progress=interrupt,
            )
        assert 4 <= len(dataset) < 150
    with connect(two_workers.address) as client:
        assert client.run_on_scheduler(_queued) == 0
    assert_same(run(two_workers.address, design, place), local(design, tmp_path / "b"))


@pytest.mark.campaign
def test_a_scheduler_that_goes_is_one_error(tmp_path):
    """What came is in the dataset."""
    design = CountedMembers(3000, cost=0.01, marks=str(tmp_path))
    with cluster(tmp_path / _made(tmp_path, "cluster"), workers=1) as processes:
        killer = threading.Thread(
            target=_kill_after, args=(processes.scheduler, tmp_path, 60), daemon=True
        )
        killer.start()
        with (
            StudyDataset.open_or_create(tmp_path / "a", identity(3000)) as dataset,
            pytest.raises(
                RunError, match=r"the connection to tcp://.* was lost; run the same study again"
            ),
        ):
            run_on_cluster(
                processes.address,
                SUBJECT,
                design,
                dataset,
                str(tmp_path / "a"),
                files={},
                opener=OPENER,
            )
        killer.join(LIMIT)


def test_members_that_dask_gives_up_are_named(tmp_path):
    """The others are in the dataset: one whose member ended the worker costs those beside it."""
    design = CountedMembers(200, sleeps=0.01, **{"ends the worker of dask": 50})
    folder = tmp_path / _made(tmp_path, "cluster")
    with (
        cluster(folder, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0") as processes,
        StudyDataset.open_or_create(tmp_path / "a", identity(200)) as dataset,
    ):
        with pytest.raises(RunError, match=r"dask gave up members \d+-\d+.*every worker that ran"):
            run_on_cluster(
                processes.address,
                SUBJECT,
                design,
                dataset,
                str(tmp_path / "a"),
                files={},
                opener=OPENER,
            )
        missing = [number for part in dataset.missing() for number in part]
        assert 50 in missing
        assert len(missing) < 150


def test_a_task_that_dask_gives_up_is_not_given_to_another_worker(tmp_path, monkeypatch):
    """Though the worker that it ended was the only one, and has been missed before dask says so."""
    monkeypatch.setattr(cluster_run, "LOOK", 0.0)
    design = CountedMembers(40, sleeps=0.01, **{"ends the worker of dask": 0})
    folder = tmp_path / _made(tmp_path, "cluster")
    allowed = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    with (
        cluster(folder, workers=1, **allowed) as processes,
        StudyDataset.open_or_create(tmp_path / "a", identity(40)) as dataset,
    ):
        (first,) = processes.workers
        other = threading.Thread(target=_replace, args=(processes, first), daemon=True)
        other.start()
        with pytest.raises(RunError, match=r"dask gave up members 0-0"):
            run_on_cluster(
                processes.address,
                SUBJECT,
                design,
                dataset,
                str(tmp_path / "a"),
                files={},
                opener=OPENER,
            )
        other.join(LIMIT)
        assert [process.poll() for process in processes.workers] == [-signal.SIGKILL, None]
        assert dataset.missing()[0].start == 0
        assert len(dataset) >= 38  # what waited on that worker was given up with it


@pytest.mark.usefixtures("bucket")
def test_workers_write_into_a_bucket(two_workers, tmp_path, monkeypatch):
    """Most members do not go through this process where storage is shared."""
    design = CountedMembers(400, sleeps=0.005)
    added = []
    add = StudyDataset.add

    def count(self, member, outcome):
        added.append(member.number)
        add(self, member, outcome)

    monkeypatch.setattr(StudyDataset, "add", count)
    monkeypatch.setattr(StudyDataset, "write_part", None)  # of whole parts that came back
    found = run(two_workers.address, design, "s3://studies/cluster")
    assert len(added) < 200
    assert_same(found, local(design, tmp_path / "b"))


def _queued(dask_scheduler):
    """Return how many tasks wait, or run and are still wanted."""
    return sum(
        task.state in ("waiting", "queued", "no-worker") for task in dask_scheduler.tasks.values()
    )


def _without_cosim(folder):
    """Return a path on which there is no cosim."""
    package = folder / _made(folder, "other") / _made(folder / "other", "cosim")
    (package / "__init__.py").write_text("raise ImportError('there is no cosim')")
    return str(folder / "other")


def _made(folder, name):
    (folder / name).mkdir()
    return name


def _kill_after(process, folder, count, workers=1):
    """Kill a process once some members have begun, in all workers."""
    _wait_for_marks(folder, count, workers)
    process.kill()


def _replace(processes, worker):
    """Start another worker once one has ended."""
    worker.wait(LIMIT)
    processes.start_worker()


def _start_after(processes, folder, count):
    _wait_for_marks(folder, count)
    processes.start_worker()


def _wait_for_marks(folder, count, workers=1):
    """Wait until some members have begun, in some processes."""
    until = time.monotonic() + LIMIT
    while time.monotonic() < until:
        marks = [path.name for path in folder.glob("*-*")]
        if len(marks) >= count and len({mark.partition("-")[2] for mark in marks}) >= workers:
            return
        time.sleep(0.01)
