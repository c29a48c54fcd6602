"""Guarded workers: a crash, a hang or an exit costs the member in it, and no other."""

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

import cosim
from cosim.errors import ChangedFileError, RunError, UsageError
from cosim.studies import verifying
from cosim.studies import workers as module
from cosim.studies.contracts import COMPLETE, StudyMember, StudySubject
from cosim.studies.verifying import verify_study
from cosim.studies.workers import LocalExecutor
from cosim.temporary import remove_abandoned
from tests.studies.deeds import (
    BAD,
    do,
    doing,
    executor,
    failures,
    outcomes_of,
    processes,
    wait_until,
)
from tests.studies.rogue_plants import rogue_plants

pytestmark = pytest.mark.usefixtures("worker_processes")


@pytest.mark.parametrize(
    "names",
    [
        ["abort", "sleep"],
        pytest.param([*BAD], marks=pytest.mark.slow, id="all"),
    ],
)
def test_as_many_members_fail_as_are_bad(names, tmp_path):
    """However each is lost, all others are completed."""
    members = [doing(n, names[n // 2] if n % 2 else "nothing") for n in range(2 * len(names))]
    outcomes = outcomes_of(tmp_path, members, timeout=3.0)
    assert len(outcomes) == len(members)
    found = failures(outcomes)
    assert found == {2 * n + 1: BAD[name][0] for n, name in enumerate(names)}
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


def test_a_worker_is_replaced_after_so_many_members(tmp_path):
    outcomes = outcomes_of(tmp_path, map(doing, range(3)), 1, members_per_worker=2)
    pids = [outcomes[number].metrics["pid"] for number in range(3)]
    assert [pids.index(pid) for pid in pids] == [0, 0, 2]


def test_an_outcome_is_carried_exactly_and_nothing_else_is_seen(tmp_path, capfd, monkeypatch):
    """Bits of floats, characters of texts; one thread for linear algebra; no temporary files."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    numbers = [0.1, -0.0, 5e-324, math.pi, math.inf, -math.inf, math.nan]
    given = {f"m{index}": number for index, number in enumerate(numbers)}
    given |= {"text": 'ä\n"\udcff' * 200_000, "none": None}
    member = doing(7, "prints", metrics=given, tells=["OMP_NUM_THREADS", "TMPDIR"])
    found = outcomes_of(tmp_path, [member])[7].metrics
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
        for taken in range(1, 301):
            yield doing(taken - 1)
        raise ValueError("no more")

    with executor(tmp_path, timeout=1.0) as workers:
        results = workers.run(members(), do)
        for done in range(290):
            assert next(results)[1].status == COMPLETE
            assert taken - done <= 4
            if done == 20:
                time.sleep(1.5)
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


def test_the_limit_follows_from_the_first_members(tmp_path):
    """It is ten times the longest of ten that were completed, at least a minute."""
    with executor(tmp_path, 1) as workers:
        assert workers._limit == 3600.0
        times = [0.1, 9.0, 8.0, *[7.0] * 7, 100.0]
        limits = [60.0, *[90.0] * 10]
        members = [doing(n, seconds=seconds) for n, seconds in enumerate(times)]
        assert [workers._limit for _ in workers.run(members, do)] == limits
    assert executor(tmp_path, timeout=3.0)._limit == 3.0


def test_what_no_member_can_be_run_with_ends_the_study(tmp_path):
    """What came before is kept, and so is the worker."""
    pids = set()
    with executor(tmp_path, 1) as workers:
        for does, error, text in (
            ("is refused", UsageError, "unknown kind 'plnat'"),
            ("is an error", RunError, "'a.fmu' is none"),
            ("finds a change", ChangedFileError, "^a.csv has changed(?!.*has changed)"),
        ):
            results = workers.run([doing(0), doing(1, does), doing(2)], do)
            pids.add(next(results)[1].metrics["pid"])
            with pytest.raises(error, match=text):
                next(results)
    assert len(pids) == 1


def test_a_subject_that_cannot_be_opened_is_one_error(tmp_path, monkeypatch):
    """Refused with its own text; a process that crashes there three times in a row is named."""
    with (
        LocalExecutor(StudySubject("acadmic"), 2) as workers,
        pytest.raises(UsageError, match="acadmic"),
    ):
        [*workers.run(map(StudyMember, range(9)))]
    monkeypatch.syspath_prepend(tmp_path)
    for opening, text, match in (
        (300.0, "import os; os.abort()", "crashes: SIGABRT, 3 times in a row"),
        (0.5, "import time; time.sleep(600)", r"hangs: did not end within 0\.5 s"),
    ):
        (tmp_path / "numpy.py").write_text(text)
        monkeypatch.setattr(module, "_OPENING", opening)
        with pytest.raises(RunError, match=rf"x\.toml' cannot be opened: {match}"):
            outcomes_of(tmp_path, [doing(0)])


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
from tests.studies.deeds import doing, outcomes_of

if sys.argv[1] == "raise":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
outcomes_of(Path("."), [doing(number, sys.argv[2], begun="begun") for number in range(2)])
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
    temporary, begun = tmp_path / "temporary", tmp_path / "begun"
    temporary.mkdir()
    begun.mkdir()
    root = str(Path(__file__).parents[2])
    with subprocess.Popen(
        [sys.executable, "-c", STUDY, how, does],
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(temporary), "PYTHONPATH": root},
        stderr=subprocess.DEVNULL,
    ) as process:
        wait_until(lambda: len(os.listdir(begun)) == 2 or process.poll() is not None)
        process.send_signal(number)
        exit_code = process.wait(5)
    assert exit_code == -number if how == "die" else exit_code != 0
    pids = {*map(int, os.listdir(begun))}
    assert len(pids) == 2
    wait_until(lambda: not processes().keys() & pids)
    monkeypatch.setattr("cosim.temporary._SETTLED", -60.0)
    remove_abandoned(temporary)
    assert os.listdir(temporary) == []


@pytest.mark.slow
def test_each_bad_fmu_costs_the_members_that_have_it(tmp_path, capfd, monkeypatch):
    """All others are completed, with the same metrics; what FMUs print is not seen.

    Logs of those that fail end there; run again, alone, each crashes or hangs as it did before.
    """
    reasons = {
        "HANGS_LATER": "hangs: did not end within 3 s",
        "CRASH": "crashes: SIGSEGV",
        "FAILS_STEP": "fmi2DoStep returned 3 (error)",
        "CRASHES_LATER": "crashes: SIGSEGV",
        "EXITS_LATER": "ends the process with exit code 3",
    }
    scenario, fmus = rogue_plants(tmp_path, "LIES", *reasons, "LOUD")
    notices = []
    given = {
        "vary": {"plant.path": fmus},
        "metrics": {"y": "last(plant.y)"},
        "out": tmp_path / "out",
        "workers": 2,
        "timeout": 3.0,
        "notice": notices.append,
    }
    study = cosim.study(scenario, keep="failed", **given)
    found = [reason.rpartition(".fmu: ")[2] for reason in study.failures.values()]
    assert dict(zip(study.failures, found, strict=True)) == dict(enumerate(reasons.values(), 1))
    first, *_, last = study.table().to_pylist()
    assert first["y"] == last["y"] is not None
    assert study.logs.keys() == {1, 3, 4, 5}
    assert [cosim.open_log(study.logs[n]).status for n in (1, 3)] == ["unfinished", "failed"]
    assert cosim.open_log(study.logs[1]).steps >= 1
    (text,) = notices
    assert "no log of members that failed: 2 (crashes: SIGSEGV, before a row of its log" in text
    left = {path.name for path in (tmp_path / "out" / "logs").iterdir()}
    assert left == {"1.mcap", "2.txt", "3.mcap", "4.mcap", "5.mcap"}
    assert cosim.study(scenario, keep=[0], **given).logs.keys() == {0, 1, 3, 4, 5}
    monkeypatch.setattr(verifying, "limit_again", lambda *_: 2.5)
    again = verify_study(tmp_path / "out", workers=2)
    assert (again.members, again.differences) == (tuple(range(7)), ())
    assert capfd.readouterr() == ("", "")
