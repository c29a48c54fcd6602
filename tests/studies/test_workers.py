"""Guarded workers: a crash, a hang or an exit affects only the member in it."""

import math
import os
import platform
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cosim.errors import ChangedFileError, RunError, UsageError
from cosim.studies import workers as module
from cosim.studies.contracts import COMPLETE, FAILED, StudyMember, StudySubject
from cosim.studies.workers import LocalExecutor
from cosim.temporary import remove_abandoned
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS
from tests.studies.deeds import (
    SCENARIO,
    do,
    doing,
    executor,
    failures,
    outcomes_of,
    processes,
    wait_until,
)

pytestmark = pytest.mark.usefixtures("worker_processes")

BAD = {
    "SIGSEGV": "crashes: SIGSEGV",
    "abort": "crashes: SIGABRT",
    "SIGKILL": "crashes: SIGKILL",
    "SIGTERM": "crashes: SIGTERM",
    "SIGFPE": "crashes: SIGFPE",
    "SIGBUS": "crashes: SIGBUS",
    "signal 40": "crashes: signal 40",
    "_exit": "ends the process with exit code 0",
    "exit of C with 0": "ends the process with exit code 0",
    "exit of C with 3": "ends the process with exit code 3",
    "sys.exit": "ends the process with exit code 3",
    "sys.exit with a text": "ends the process with exit code 1",
    "sys.exit with nothing": "ends the process with exit code 0",
    "ValueError": "ValueError: invalid literal for int() with base 10: 'x'",
    "MemoryError": "MemoryError",
    "KeyboardInterrupt": "KeyboardInterrupt",
    "BaseException": "GeneratorExit",
    "leaves a process": "ends the process with exit code 4",
    "leaves a session": "ends the process with exit code 5",
    "closes files": "closes the pipe of its worker process",
    "replaces files": "closes the pipe of its worker process",
    "writes into files": "writes into the pipe of its worker process",
    "object": "TypeError: cannot pickle 'generator' object",
    "sleep": "hangs: did not end within 3 s",
    "ignores SIGTERM": "hangs: did not end within 3 s",
    "search in C": "hangs: did not end within 3 s",
}


@pytest.mark.parametrize(
    "names",
    [
        ["abort", "closes files", "sys.exit", "sleep"],
        pytest.param([*BAD], marks=pytest.mark.slow, id="all"),
    ],
)
def test_as_many_members_fail_as_are_bad(names, tmp_path):
    """However each is lost, all others are completed."""
    members = [doing(n, names[n // 2] if n % 2 else "nothing") for n in range(2 * len(names))]
    outcomes = outcomes_of(tmp_path, members, timeout=3.0)
    assert sorted(outcomes) == list(range(2 * len(names)))
    found = failures(outcomes)
    assert found == {2 * n + 1: BAD[name] for n, name in enumerate(names)}
    assert all(outcomes[n].worker.startswith(platform.node()) for n in found)


def test_a_crash_that_an_earlier_member_prepared_is_not_held_against_the_next(tmp_path):
    """The next is run once more, by a new worker; the lost one has ended by then."""
    members = [doing(number, "poison" if number == 1 else "nothing") for number in range(4)]
    with executor(tmp_path, 1) as workers:
        outcomes = {member.number: outcome for member, outcome in workers.run(members, do)}
        assert failures(outcomes) == {}
        pids = [outcomes[number].metrics["pid"] for number in range(4)]
        assert [pid == pids[0] for pid in pids] == [True, True, False, False]
        assert [pid in processes() for pid in pids[1:3]] == [False, True]
        ((_, later),) = workers.run([doing(0)], do)
        assert later.metrics["pid"] == pids[3]  # workers are kept for more members


def test_an_outcome_is_carried_exactly_and_nothing_else_is_seen(tmp_path, capfd, monkeypatch):
    """Bits of floats, characters of texts; one thread for linear algebra; no temporary files."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    numbers = [0.1, -0.0, 5e-324, math.pi, math.inf, -math.inf, math.nan]
    given = {f"m{index}": number for index, number in enumerate(numbers)}
    given |= {"text": 'ä\n"\udcff' * 200_000, "none": None}
    member = doing(7, "prints", metrics=given, tells=["OMP_NUM_THREADS", "TMPDIR"])
    found = outcomes_of(tmp_path, [member], 8)[7].metrics
    assert [*map(exact, map(found.get, given))] == [*map(exact, given.values())]
    assert found["OMP_NUM_THREADS"] == "1"
    assert found["TMPDIR"].startswith(f"{tmp_path}/cosim.workers-")
    assert os.listdir(tmp_path) == ["x.toml"]
    assert capfd.readouterr() == ("", "")


def exact(value):
    return struct.pack("d", value) if isinstance(value, float) else value


def test_members_are_taken_as_they_are_needed(tmp_path):
    """However many there are; a caller that comes late takes none for one that hangs."""
    taken = 0

    def members():
        nonlocal taken
        for number in range(300):
            taken += 1
            yield doing(number)
        raise ValueError("no more")

    most = 0
    with executor(tmp_path, timeout=1.0) as workers:
        results = workers.run(members(), do)
        for done in range(290):
            assert next(results)[1].status == COMPLETE
            most = max(most, taken - done)
            if done == 20:
                time.sleep(2.0)
        assert most <= 4
        with pytest.raises(ValueError, match="no more"):
            list(results)


def test_an_iterator_that_is_closed_ends_what_runs(tmp_path):
    """So does the executor, and what members started; it goes on with other members."""
    with executor(tmp_path) as workers:
        iterator = workers.run([doing(0, "starts a process"), doing(1, "sleep")], do)
        pid = next(iterator)[1].metrics["pid"]
        iterator.close()
        ((_, outcome),) = workers.run([doing(2)], do)
        assert outcome.metrics["pid"] == pid
    wait_until(lambda: all(group != pid for _, group in processes().values()))


def test_a_worker_is_replaced_after_so_many_members(tmp_path):
    """The member that all others wait for is not lost by that."""
    outcomes = outcomes_of(tmp_path, map(doing, range(5)), 1, members_per_worker=2)
    pids = [outcomes[number].metrics["pid"] for number in range(5)]
    assert len(set(pids)) == 3
    assert pids[0] == pids[1] != pids[2] == pids[3] != pids[4]


def test_the_limit_follows_from_the_first_members(tmp_path):
    """It is ten times the longest of ten that were completed, at least a minute."""
    with executor(tmp_path, 1) as workers:
        assert workers._limit == 3600.0
        for seconds, limit in ((0.1, 60.0), (9.0, 90.0), (8.0, 90.0)):
            [*workers.run([doing(0, seconds=seconds)], do)]
            assert workers._limit == limit
        [*workers.run([doing(n, seconds=7.0) for n in range(8)], do)]
        [*workers.run([doing(0, seconds=100.0)], do)]
        assert workers._limit == 90.0
    assert executor(tmp_path, timeout=3.0)._limit == 3.0


@pytest.mark.parametrize(
    ("does", "error"),
    [("is refused", UsageError), ("is an error", RunError), ("finds a change", ChangedFileError)],
)
def test_what_no_member_can_be_run_with_ends_the_study(does, error, tmp_path):
    """With the text of the error; what came before is kept."""
    with executor(tmp_path, 1) as workers:
        results = workers.run([doing(0), doing(1, does), doing(2)], do)
        assert next(results)[0].number == 0
        with pytest.raises(error, match={"is refused": "plnat"}.get(does, r"a\.")) as caught:
            next(results)
        assert str(caught.value).count("has changed") == (does == "finds a change")
        assert len([*workers.run([doing(2)], do)]) == 1


def test_a_subject_that_cannot_be_opened_is_one_error(tmp_path, monkeypatch):
    """Refused with its own text; a process that crashes there three times in a row is named."""
    with (
        LocalExecutor(StudySubject("acadmic"), 2) as workers,
        pytest.raises(UsageError, match="acadmic"),
    ):
        [*workers.run(map(StudyMember, range(9)))]
    monkeypatch.syspath_prepend(tmp_path)
    for text, match in (
        ("import os; os.abort()", "crashes: SIGABRT, 3 times in a row"),
        ("import time; time.sleep(600)", r"hangs: did not end within 0\.5 s"),
    ):
        (tmp_path / "numpy.py").write_text(text)
        with executor(tmp_path) as workers:
            monkeypatch.setattr(module, "_OPENING", 300.0 if "abort" in text else 0.5)
            with pytest.raises(RunError, match=rf"x\.toml' cannot be opened: {match}"):
                [*workers.run([doing(0)], do)]


@pytest.mark.parametrize(
    ("name", "value"), [("workers", 0), ("timeout", math.nan), ("members_per_worker", -1)]
)
def test_wrong_numbers_and_systems_are_refused(name, value, monkeypatch):
    """Before any process is started."""
    with pytest.raises(UsageError, match=f"^{name}: .*got {value}"):
        LocalExecutor(StudySubject("x"), **{"workers": 1, name: value})
    monkeypatch.setattr("sys.platform", "win32")
    with pytest.raises(UsageError, match="got Windows"):
        LocalExecutor(StudySubject("x"), 1)


STUDY = """
import signal, sys
from pathlib import Path
from tests.studies.deeds import do, doing, executor

if sys.argv[1] == "raise":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
with executor(Path("."), 2) as workers:
    list(workers.run([doing(number, sys.argv[2], begun="begun") for number in range(2)], do))
"""


@pytest.mark.parametrize(
    ("how", "number", "does"),
    [
        ("raise", signal.SIGINT, "sleep"),
        pytest.param("raise", signal.SIGTERM, "search in C", marks=pytest.mark.slow),
        ("die", signal.SIGKILL, "search in C"),
        pytest.param("die", signal.SIGTERM, "sleep", marks=pytest.mark.slow),
    ],
)
@pytest.mark.skipif(sys.platform != "linux", reason="the kernel ends the children of the killed")
def test_workers_end_with_their_parent(how, number, does, tmp_path, monkeypatch):
    """At once; temporary folders are removed, by the next that needs one at the latest."""
    for name in ("temporary", "begun"):
        (tmp_path / name).mkdir()
    environment = {**os.environ, "TMPDIR": str(tmp_path / "temporary")}
    environment["PYTHONPATH"] = str(Path(__file__).parents[2])
    arguments = [sys.executable, "-c", STUDY, how, does]
    with subprocess.Popen(
        arguments, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL
    ) as process:
        wait_until(lambda: len(os.listdir(tmp_path / "begun")) == 2 or process.poll() is not None)
        began = time.monotonic()
        process.send_signal(number)
        exit_code = process.wait(60)
    assert exit_code == -number if how == "die" else exit_code != 0
    assert time.monotonic() - began < 5.0
    pids = [*map(int, os.listdir(tmp_path / "begun"))]
    wait_until(lambda: not processes().keys() & set(pids))
    monkeypatch.setattr("cosim.temporary._SETTLED", -60.0)
    remove_abandoned(tmp_path / "temporary")
    assert os.listdir(tmp_path / "temporary") == []


@pytest.mark.slow
def test_each_bad_fmu_costs_the_members_that_have_it(tmp_path, capfd):
    """All others are completed, with the same metrics; what FMUs print is not seen."""
    reasons = {
        "CRASH": "crashes: SIGSEGV",
        "EXITS": "ends the process with exit code 3",
        "HANG": "hangs: did not end within 6 s",
        "FAILS_STEP": "fmi2DoStep returned 3 (error)",
    }
    for name in ("LIES", "LOUD", *reasons):
        compile_fmu(tmp_path / f"{name}.fmu", STATELESS, "rogue2.c", defines=(f"ROGUE={name}",))
    (tmp_path / "x.toml").write_text(SCENARIO + 'plant = { kind = "fmu", path = "LIES.fmu" }\n')
    names = ["LIES", "CRASH", "LOUD", "EXITS", "HANG", "LIES", "FAILS_STEP", "LOUD"]
    members = [
        StudyMember(number, swap={"plant": str(tmp_path / f"{name}.fmu")})
        for number, name in enumerate(names)
    ]
    subject = StudySubject(str(tmp_path / "x.toml"), metrics={"y": "last(plant.y)"})
    with LocalExecutor(subject, 2, timeout=6.0) as workers:
        outcomes = {names[m.number]: outcome for m, outcome in workers.run(members)}
    found = {name: o.reason.rpartition(".fmu: ")[2] for name, o in outcomes.items()}
    assert found == {**reasons, "LIES": "", "LOUD": ""}
    assert outcomes["LIES"].metrics == outcomes["LOUD"].metrics
    assert {name for name, o in outcomes.items() if o.status == FAILED} == reasons.keys()
    assert capfd.readouterr() == ("", "")
