"""Workers end with the process that started them, and leave nothing, however that ends."""

import os
import select
import signal
import subprocess
import sys
from contextlib import ExitStack, contextmanager

import pytest

from cosim.temporary import remove_abandoned

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="waits for processes of others"),
]

# each worker completes a member, and says that it has begun the next
STUDY = """
import signal, sys
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.workers.pool import WorkerPool

if sys.argv[1] == "raise":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
members = [StudyMember(number) for number in range(2)]
opener = "tests.studies.workers.runners:open_doing"
with WorkerPool(opener, StudySubject("a.toml"), 2) as pool:
    list(pool.run(members))
    hangs = [StudyMember(number, set={"does": sys.argv[2], "begun": "."}) for number in range(2)]
    list(pool.run(hangs))
"""


@contextmanager
def running_study(folder, *arguments):
    """Start a study of two members that hang; yield its process and handles of its workers."""
    environment = {**os.environ, "TMPDIR": str(folder / "temporary")}
    (folder / "temporary").mkdir()
    (folder / "begun").mkdir()
    with ExitStack() as stack:
        process = subprocess.Popen(
            [sys.executable, "-c", STUDY, *arguments],
            cwd=folder / "begun",
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
        )
        stack.enter_context(process)
        stack.callback(process.kill)
        workers = []
        for pid in pids_when_begun(process, folder / "begun"):
            handle = os.pidfd_open(pid)
            stack.callback(os.close, handle)
            workers.append(handle)
        yield process, workers


def pids_when_begun(process, folder):
    """Return the workers that have begun their members."""
    for _ in range(6000):
        names = os.listdir(folder)
        if len(names) == 2:
            return map(int, names)
        try:
            process.wait(0.01)
        except subprocess.TimeoutExpired:
            continue
        break
    return pytest.fail(f"has not begun: {process.stderr.read()}")


def have_ended(handles):
    """Return whether all those processes end within a minute."""
    return all(select.select([handle], [], [], 60.0)[0] for handle in handles)


@pytest.mark.parametrize("does", ["sleep", "search in C"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_study_that_is_interrupted_ends_its_workers(number, does, tmp_path):
    """It does not wait for members, and removes its temporary folder."""
    with running_study(tmp_path, "raise", does) as (process, workers):
        process.send_signal(number)
        assert process.wait(60) != 0
        assert have_ended(workers)
    assert os.listdir(tmp_path / "temporary") == []


@pytest.mark.parametrize("does", ["sleep", "search in C"])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_study_that_is_killed_ends_its_workers(number, does, tmp_path, monkeypatch):
    """Its temporary folder is removed by the next that needs one."""
    with running_study(tmp_path, "die", does) as (process, workers):
        process.send_signal(number)
        assert process.wait(60) == -number
        assert have_ended(workers)
    assert len(os.listdir(tmp_path / "temporary")) == 1
    monkeypatch.setattr("cosim.temporary._SETTLED", -60.0)
    remove_abandoned(tmp_path / "temporary")
    assert os.listdir(tmp_path / "temporary") == []
