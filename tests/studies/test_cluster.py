"""Studies on a scheduler and workers of dask: in processes of their own, or inside of this one."""

import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from cosim.digests import sha256_of
from cosim.errors import ChangedFileError, RunError, UsageError
from cosim.studies import cluster as module
from cosim.studies.cluster import ClusterExecutor, environment
from cosim.studies.contracts import COMPLETE, FAILED, MemberOutcome, StudyMember, StudySubject
from cosim.studies.workers import LocalExecutor
from tests.studies.dask_processes import LIMIT, cluster
from tests.studies.deeds import processes as alive
from tests.studies.deeds import wait_until

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("worker_processes")]
distributed = pytest.importorskip("distributed")

HERE = "/proc/self/cwd"  # another folder in every process
SCENARIO = """
scenario = { name = "x", stop = 0.2, step = 0.1 }
[components]
u = { kind = "table", file = "../u.csv" }
v = { kind = "table", file = "/proc/self/cwd/u.csv" }
acting = { kind = "python", class = "acting:Acting", seconds = 0.0, does = "nothing" }
"""
ACTING = """
import os
import time
import numpy as np
from cosim.core import Interface, Signal


class Acting:
    interface = Interface(outputs=(Signal("y", variability="discrete"),))

    def __init__(self, seconds: float, does: str):
        self.seconds = seconds
        self.does = does
        if does == "refuses":
            raise ValueError("it refuses")

    def initialize(self, t, u):
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([self.seconds])

    def advance(self, t, h, u):
        time.sleep(self.seconds)
        if self.does == "crashes":
            os.abort()
        if self.does == "ends dask":
            os.kill(os.getppid(), 9)
        return np.full((len(t) - 1, 1), self.seconds)
"""


@pytest.fixture
def study(tmp_path, monkeypatch):
    """Return a subject and its files, below a path that is this process's own."""
    folder = tmp_path / "study"
    (folder / "x").mkdir(parents=True)
    (folder / "x" / "s.toml").write_text(SCENARIO)
    (folder / "x" / "acting.py").write_text(ACTING)
    (folder / "u.csv").write_text("t,y\n0,1\n1,1\n")
    monkeypatch.chdir(folder)
    files = {f"{HERE}/{name}": sha256_of(name) for name in ("x/s.toml", "x/acting.py", "u.csv")}
    metrics = {"y": "last(acting.y)", "v": "last(v.y)"}
    return StudySubject(f"{HERE}/x/s.toml", metrics=metrics, digests=files)


@pytest.fixture(scope="module")
def processes(tmp_path_factory):
    with cluster(tmp_path_factory.mktemp("cluster")) as found:
        yield found


def acting(number, does="nothing", seconds=0.0):
    return StudyMember(number, {"acting.does": does, "acting.seconds": seconds})


def executor(scheduler, subject, notices=None, timeout=None):
    notice = [].append if notices is None else notices.append
    files = subject.digests
    return ClusterExecutor(scheduler, subject, acting(0), files, timeout=timeout, notice=notice)


def children(cluster):
    """Return the processes that workers have started."""
    pids = {worker.pid for worker in cluster.workers}
    return [parent for parent, _ in alive().values() if parent in pids]


def test_outcomes_are_those_of_this_machine_and_nothing_is_left(processes, study):
    """Files go to workers that lack them; members that crash, hang or are refused cost themselves.

    Processes and copies of files end with the study.
    """
    deeds = {3: "crashes", 5: "refuses", 8: "crashes"}
    members = [acting(n, deeds.get(n, "nothing"), n / 1000.0) for n in range(12)]
    members.append(acting(12, seconds=600.0))
    with executor(processes.address, study, timeout=3.0) as workers:
        found = {member.number: outcome for member, outcome in workers.run(members)}
        assert [outcome.status for _, outcome in workers.run([acting(0)])] == [COMPLETE]
        assert children(processes)
    with LocalExecutor(study, 2, timeout=3.0) as workers:
        needed = {member.number: outcome for member, outcome in workers.run(members)}
    assert found.keys() == needed.keys()
    for number, outcome in needed.items():
        assert plain(found[number]) == plain(outcome)
    assert sorted(n for n, outcome in found.items() if outcome.status == FAILED) == [3, 5, 8, 12]
    wait_until(lambda: not children(processes))
    wait_until(lambda: not [*processes.folder.rglob("s.toml")])


def plain(outcome):
    """Return an outcome without what depends on where it ran."""
    reason = outcome.reason.replace(os.path.realpath(HERE), HERE)
    own = {"wall_time": 0.0, "worker": "", "warnings": [*outcome.warnings]}
    return replace(outcome, reason=reason, **own)


def test_a_study_that_is_left_early_leaves_nothing_behind(processes, study):
    """Neither members that run nor those that wait."""
    with executor(processes.address, study) as workers:
        results = workers.run([acting(0), *(acting(n, seconds=200.0) for n in range(1, 9))])
        assert next(results)[0].number == 0
        results.close()
    wait_until(lambda: not children(processes))
    with distributed.Client(processes.address, set_as_default=False) as client:
        wait_until(lambda: client.run_on_scheduler(lambda dask_scheduler: not dask_scheduler.tasks))
        with executor(client, study) as workers:
            assert len([*workers.run(map(acting, range(4)))]) == 4


def test_a_file_that_changes_ends_the_study(processes, study):
    """On a worker that has the files where they were planned, too."""
    folder = os.path.realpath(HERE)
    scenario = f"{folder}/x/s.toml"
    Path(scenario).write_text(SCENARIO.replace(HERE, folder))
    files = {path.replace(HERE, folder): digest for path, digest in study.digests.items()}
    files[scenario] = sha256_of(scenario)
    with executor(processes.address, replace(study, scenario=scenario, digests=files)) as workers:
        assert len([*workers.run(map(acting, range(3)))]) == 3
        Path("u.csv").write_text("t,y\n0,2\n1,2\n")
        with pytest.raises(ChangedFileError, match=r"u\.csv has changed"):
            list(workers.run(map(acting, range(9))))


def test_workers_that_go_and_come_cost_nothing(tmp_path, study, monkeypatch):
    """Who has gone is named, and who comes later is used, or named if it is without cosim."""
    monkeypatch.setattr(module, "_SECONDS", 0.1)
    (tmp_path / "other" / "cosim").mkdir(parents=True)
    (tmp_path / "other" / "cosim" / "__init__.py").write_text("raise ImportError('no cosim')")
    notices = []
    with (
        cluster(tmp_path / "dask", workers=1) as own,
        executor(own.address, study, notices) as workers,
    ):
        found = {}
        for member, outcome in workers.run(acting(n, seconds=0.02) for n in range(200)):
            found[member.number] = outcome
            if len(found) == 3:  # the tasks that wait are for this worker only
                own.workers[0].kill()
                own.start_worker(PYTHONPATH=str(tmp_path / "other"))
                own.start_worker()
                own.start_worker()
            if len({o.worker for o in found.values()}) == 3:
                own.workers[2].kill()
        assert [own.workers[n].wait(LIMIT) for n in (0, 2)] == [-signal.SIGKILL] * 2
        assert len(found) == 200
        assert {outcome.status for outcome in found.values()} == {COMPLETE}
    assert sum("is gone" in text for text in notices) == 2
    assert sum("is not used: " in text and "cosim" in text for text in notices) == 1


def test_members_that_dask_gives_up_are_named(tmp_path, study, monkeypatch):
    """The others have outcomes; a scheduler that goes is one error."""
    monkeypatch.setattr(module, "_SECONDS", 0.1)
    allowed = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    found = []
    with (
        cluster(tmp_path / "dask", **allowed) as own,
        executor(own.address, study) as workers,
    ):
        members = [acting(n, "ends dask" if n == 7 else "nothing", 0.02) for n in range(60)]
        results = (member.number for member, _ in workers.run(members))
        with pytest.raises(RunError, match=r"dask gave up members (\d+, )*7\b"):
            found.extend(results)
        assert 7 not in found
        assert len(found) > 40
        results = workers.run(map(acting, range(10**6)))
        next(results)
        own.scheduler.kill()
        with pytest.raises(RunError, match=r"connection to the scheduler .*was lost"):
            list(results)


# --- a cluster inside of this process ---


@pytest.fixture
def client(monkeypatch):
    """Return a client of a cluster with one worker, where nobody waits for another."""
    monkeypatch.setattr(module, "PATIENCE", 0.1)
    with (
        distributed.LocalCluster(
            processes=False, n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0"
        ) as own,
        distributed.Client(own, set_as_default=False) as client,
    ):
        client.wait_for_workers(1, timeout=LIMIT)
        yield client


def refused(scheduler, subject, error, text):
    """Check what the run of a member is refused with; return what was noticed before."""
    notices = []
    with (
        executor(scheduler, subject, notices) as workers,
        pytest.raises(error, match=text),
    ):
        list(workers.run([acting(0)]))
    return notices


def test_what_computes_with_something_else_is_not_used(client, study, monkeypatch):
    """A worker is named; of the scheduler only what reads the tasks counts."""
    own = environment()
    monkeypatch.setattr(module, "environment", lambda: own | other)
    for key in own:
        other = {}
        workers = executor(client, study)
        other = {key: "other"}
        text = f"no worker can run .*inproc:.*{key} .*, got other"
        if key in ("Python", "cosim"):
            text = f"the scheduler cannot.*expected {key} .*got other"
        with pytest.raises(UsageError, match=text), workers:
            list(workers.run([acting(0)]))


def test_a_trial_that_cannot_be_built_names_the_worker(client, study):
    """Such as where the class of a user is not among the files; without workers nothing runs."""
    own = {path: digest for path, digest in study.digests.items() if "acting" not in path}
    Path("x/acting.py").unlink()
    text = r"no worker can run the study: inproc:.*acting"
    without = replace(study, digests=own)
    refused(client, without, UsageError, text)
    client.cluster.scale(0)
    wait_until(lambda: not client.nthreads())
    notices = refused(client, without, RunError, "the scheduler has no workers")
    assert "waiting 0.1 s" in notices[0]


def test_the_scheduler_holds_as_much_for_a_hundred_thousand_members(client, study, monkeypatch):
    """Two tasks a thread; members are taken as they are needed."""
    scheduler = client.cluster.scheduler
    most = [0, 0]
    taken = 0

    def members():
        nonlocal taken
        for taken in range(1, 100_001):
            yield StudyMember(taken - 1)

    monkeypatch.setattr(module, "_run_part", stub)
    with executor(client, study) as workers:
        threads = threading.active_count()
        for done, (member, outcome) in enumerate(workers.run(members())):
            assert member.number == outcome.number
            most = [max(most[0], len(scheduler.tasks)), max(most[1], taken - done)]
        assert threading.active_count() <= threads + 2
    assert taken == done + 1 == 100_000
    assert most[0] <= 4  # and one that is being forgotten, or asks a worker
    assert most[1] <= 3 * module.MOST


def stub(name, members):
    return 0.0, [MemberOutcome(member.number, COMPLETE) for member in members]
