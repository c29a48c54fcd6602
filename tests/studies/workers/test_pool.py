"""Guarded workers: a crash, a hang or an exit affects only the member in it."""

import os
import select
import sys
import time

import pytest

from cosim.errors import RunError, UsageError
from cosim.studies.contracts import COMPLETE
from cosim.studies.workers import member_times, pool, worker_process
from tests.studies.workers.pools import doing, failures, open_pool, outcomes_of

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("worker_processes")]


def is_alive(pid):
    """Return whether a process of this number is there, and no zombie."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


NEEDS_PROC = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

BAD = {
    3: ("SIGSEGV", "crashes: SIGSEGV"),
    7: ("abort", "crashes: SIGABRT"),
    8: ("SIGKILL", "crashes: SIGKILL"),
    9: ("SIGTERM", "crashes: SIGTERM"),
    20: ("_exit", "ends the process with exit code 0"),
    21: ("exit of C with 0", "ends the process with exit code 0"),
    22: ("exit of C with 3", "ends the process with exit code 3"),
    30: ("sys.exit", "ends the process with exit code 3"),
    31: ("sys.exit with a text", "ends the process with exit code 1"),
    32: ("sys.exit with nothing", "ends the process with exit code 0"),
    33: ("ValueError", "ValueError: invalid literal for int() with base 10: 'x'"),
    34: ("FmuError", "'a.fmu' is none"),
    35: ("MemoryError", "MemoryError"),
    36: ("KeyboardInterrupt", "KeyboardInterrupt"),
    40: ("leaves a process", "ends the process with exit code 4"),
    50: ("closes files", "closes the pipe of its worker process"),
    51: ("replaces files", "closes the pipe of its worker process"),
    55: ("writes into files", "writes into the pipe of its worker process"),
    56: ("answer for another", "writes into the pipe of its worker process"),
    57: ("answer with an object", "TypeError: 'object' object is not iterable"),
}


def test_as_many_members_fail_as_are_bad():
    """However each is lost, all others are completed, also those that waited behind it."""
    members = [doing(number, BAD.get(number, ["nothing"])[0]) for number in range(60)]
    outcomes = outcomes_of(members)
    assert sorted(outcomes) == list(range(60))
    assert failures(outcomes) == {number: reason for number, (_, reason) in BAD.items()}


def test_a_caller_that_comes_late_takes_no_member_for_one_that_hangs(tmp_path, monkeypatch):
    """What has been answered meanwhile is read before a worker is judged, if it is read late."""
    late = 0.0
    for module in (pool, worker_process):
        monkeypatch.setattr(module, "monotonic", lambda: time.monotonic() + late)
    members = [doing(number) for number in range(300)]
    members += [doing(number, "wait", until=str(tmp_path / str(number))) for number in (300, 301)]
    with open_pool(1, timeout=60.0) as workers:
        results = workers.run([*members, doing(302)])
        for member, _ in results:
            if member.number == 299:
                break
        (tmp_path / "300").touch()
        wait_for_reply(workers)
        late = 1000.0
        (tmp_path / "301").touch()
        assert failures({member.number: outcome for member, outcome in results}) == {}


def wait_for_reply(workers):
    """Wait until a reply of the only worker is there to be read."""
    (replies,) = workers._workers
    assert select.select([replies], [], [], 60.0)[0]


@pytest.mark.parametrize("does", ["sleep", "search in C"])
def test_a_hang_affects_only_its_member(does):
    """Also one that keeps Python's lock; those that waited behind it are completed."""
    members = [doing(number, does if number == 5 else "nothing") for number in range(40)]
    outcomes = outcomes_of(members, timeout=2.0)
    assert sorted(outcomes) == list(range(40))
    assert failures(outcomes) == {5: "hangs: did not end within 2 s"}
    assert 2.0 <= outcomes[5].wall_time < 60.0


def test_the_first_members_may_all_be_bad():
    """No worker has completed any, and yet each fails for itself."""
    outcomes = outcomes_of([doing(number, "SIGSEGV") for number in range(6)])
    assert failures(outcomes) == dict.fromkeys(range(6), "crashes: SIGSEGV")


def test_a_crash_that_an_earlier_member_prepared_is_not_held_against_the_next():
    """The next is run once more, as the first of a new worker, and completed there."""
    members = [doing(number, "poison" if number == 4 else "nothing") for number in range(20)]
    outcomes = outcomes_of(members, count=1)
    assert failures(outcomes) == {}
    assert len({outcome.worker for outcome in outcomes.values()}) == 2
    assert outcomes[4].worker != outcomes[5].worker


def test_a_process_that_outlives_its_worker_hides_no_loss():
    """It keeps the pipe open, in a session of its own, where no signal to the worker reaches it."""
    outcomes = outcomes_of([doing(number, "leaves a session") for number in range(1)], count=1)
    assert failures(outcomes) == {0: "ends the process with exit code 5"}


def test_output_of_members_is_discarded(capfd):
    """It is no reply, and not seen on the terminal."""
    outcomes = outcomes_of([doing(number, "prints") for number in range(4)])
    assert failures(outcomes) == {}
    assert capfd.readouterr() == ("", "")


def test_members_are_taken_as_they_are_needed():
    """At no time are many more taken than have their outcome, however many there are."""
    taken = 0
    most = 0

    def members():
        nonlocal taken
        for number in range(3000):
            taken += 1
            yield doing(number)

    with open_pool(2) as workers:
        for done, _ in enumerate(workers.run(members())):
            most = max(most, taken - done)
    assert taken == 3000
    # those of both workers, and the outcomes of one round: a pipe has 64 KiB
    assert most <= 2 * member_times.MOST_AHEAD + 65536 // 100


def test_members_larger_than_a_pipe_are_carried():
    """Neither process waits for the other where both pipes are full."""
    values = [float(number) for number in range(20_000)]
    members = [doing(number, metrics={"text": "x" * 200_000}, x=values) for number in range(12)]
    outcomes = outcomes_of(members)
    assert failures(outcomes) == {}
    assert {len(outcome.metrics["text"]) for outcome in outcomes.values()} == {200_000}


def test_a_worker_is_replaced_after_so_many_members():
    """With one worker at a time, too; each closes its runner."""
    outcomes = outcomes_of([doing(number) for number in range(7)], count=1, members_per_worker=3)
    assert failures(outcomes) == {}
    workers = [outcomes[number].worker for number in range(7)]
    assert len(set(workers[0:3])) == len(set(workers[3:6])) == 1
    assert len(set(workers)) == 3


def test_no_worker_is_started_for_nothing(tmp_path):
    """There are at most as many as members; without members there are none."""
    subject = {"ended": str(tmp_path)}
    assert outcomes_of([], count=8, subject=subject) == {}
    assert os.listdir(tmp_path) == []
    outcomes_of([doing(0)], count=8, subject=subject)
    assert len(os.listdir(tmp_path)) == 1


def test_workers_are_kept_for_more_members():
    """A second call runs in the processes of the first."""
    with open_pool(1) as workers:
        ((_, first),) = workers.run([doing(0)])
        ((_, second),) = workers.run([doing(0)])
    assert first.worker == second.worker


def test_runners_are_closed_at_the_end(tmp_path):
    """What they hold is freed, as where no process is lost; one that hangs there is ended."""
    outcomes_of([doing(0)], subject={"ended": str(tmp_path)})
    assert len(os.listdir(tmp_path)) == 1


@NEEDS_PROC
def test_an_end_that_hangs_is_not_waited_for(monkeypatch):
    """The outcomes are there, and the process is ended with all others."""
    monkeypatch.setattr(pool, "ENDING_LIMIT", 0.1)
    (outcome,) = outcomes_of([doing(0)], subject={"ending": "sleep"}).values()
    assert outcome.status == COMPLETE
    assert not is_alive(int(outcome.metrics["pid"]))


@NEEDS_PROC
def test_processes_of_members_end_with_their_worker():
    """Also where the worker itself is not lost."""
    members = [doing(number, "starts a process") for number in range(2)]
    with open_pool(1) as workers:
        pids = {int(outcome.metrics["pid"]) for _, outcome in workers.run(members)}
        (pid,) = pids
        assert groups().count(pid) == 3
    limit = time.monotonic() + 60.0
    while groups().count(pid) and time.monotonic() < limit:  # a killed process is not gone at once
        time.sleep(0.01)
    assert groups().count(pid) == 0


def groups():
    """Return the process group of each process that is no zombie."""
    found = []
    for name in filter(str.isdecimal, os.listdir("/proc")):
        try:
            with open(f"/proc/{name}/stat") as file:
                state, _, group = file.read().rpartition(")")[2].split()[:3]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if state != "Z":
            found.append(int(group))
    return found


def test_an_iterator_that_is_closed_ends_what_runs():
    """The pool goes on with other members."""
    with open_pool(2) as workers:
        iterator = workers.run([doing(0), doing(1, "sleep")])
        assert next(iterator)[0].number == 0
        iterator.close()
        assert [member.number for member, _ in workers.run([doing(2)])] == [2]


def test_an_error_of_the_members_reaches_the_caller():
    """It is raised where members are taken."""

    def members():
        yield doing(0)
        raise ValueError("no more")

    with pytest.raises(ValueError, match="no more"):
        outcomes_of(members())


@pytest.mark.parametrize("opener", ["open_doing", "refuse"])
def test_temporary_files_are_in_a_folder_that_is_removed(opener, tmp_path, monkeypatch):
    """Whatever the workers left there, and however the study ends."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    member = doing(0, "tell", variable="TMPDIR")
    if opener == "refuse":
        with pytest.raises(UsageError, match="plnat"):
            outcomes_of([member], opener=opener)
    else:
        (outcome,) = outcomes_of([member]).values()
        assert outcome.metrics["told"].startswith(f"{tmp_path}/cosim.workers-")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("given", "told"), [(None, "1"), ("3", "3")], ids=["by default", "as given"]
)
def test_a_worker_has_one_thread_for_linear_algebra(given, told, monkeypatch):
    """Unless the environment says otherwise: N workers have the cores already."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    (outcome,) = outcomes_of([doing(0, "tell", variable="OMP_NUM_THREADS")]).values()
    assert outcome.metrics["told"] == told


def test_an_opener_that_fails_otherwise_is_one_error():
    """It names the scenario and the error."""
    match = r"^'a\.toml' cannot be opened: ValueError: invalid literal for int\(\).*'x'$"
    with pytest.raises(RunError, match=match):
        outcomes_of([doing(0)], subject={"opening": "ValueError"})
    with pytest.raises(RunError, match=r"cannot be opened: AttributeError: .*'nobody'$"):
        outcomes_of([doing(0)], opener="nobody")
    with pytest.raises(RunError, match=r"cannot be opened: ends the process with exit code 3$"):
        outcomes_of([doing(0)], subject={"opening": "sys.exit"})


@pytest.mark.parametrize(
    ("does", "reason"),
    [("SIGSEGV", "crashes: SIGSEGV"), ("_exit", "ends the process with exit code 0")],
)
def test_a_worker_that_is_lost_while_it_opens_ends_the_study(does, reason):
    """After the third time in a row."""
    match = f"^the process that opens 'a.toml' {reason}, 3 times in a row; run 'cosim check'"
    with pytest.raises(RunError, match=match):
        outcomes_of([doing(number) for number in range(10)], subject={"opening": does})


def test_a_pool_that_could_not_open_says_so_again():
    """Each time it is asked: workers are not started for ever."""
    with open_pool(subject={"opening": "SIGSEGV"}) as workers:
        for _ in range(2):
            with pytest.raises(RunError, match="3 times in a row"):
                list(workers.run([doing(0)]))


def test_a_worker_that_hangs_while_it_opens_ends_the_study(monkeypatch):
    """Opening has a limit of its own, as models may be compiled."""
    monkeypatch.setattr(pool, "OPENING_LIMIT", 0.5)
    match = r"^the process that opens 'a\.toml' hangs: did not end within 0\.5 s$"
    with pytest.raises(RunError, match=match):
        outcomes_of([doing(0)], subject={"opening": "sleep"}, timeout=0.1)
