"""The log of a run that was killed is a log: it says so, is verified, and gives back its rows."""

import signal
import subprocess
import sys

import numpy as np
import pytest
from mcap.reader import make_reader

import cosim
from cosim.errors import LogError
from cosim.log.recovering import recover
from cosim.report.verification import verify
from tests.scenario.refusals import check_refused

RUN = """
import os, signal, sys, cosim
from cosim.errors import LogError

def kill(time, end):
    try:
        steps = cosim.open_log(sys.argv[1]).steps
    except LogError:
        return  # its rows have moved since it was opened
    if steps > 1000:
        os.kill(os.getpid(), signal.SIGKILL)

cosim.run("academic", out=sys.argv[1], flush=1e-3, progress=kill, block=500,
          set={"scenario.stop": 5.0})
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """Return the path of the log of a run whose process was killed."""
    path = tmp_path_factory.mktemp("killed") / "killed.mcap"
    process = subprocess.run([sys.executable, "-c", RUN, str(path)], check=False)
    assert process.returncode == -signal.SIGKILL
    return path


@pytest.mark.slow
def test_a_killed_log_has_every_bit_of_its_run(killed):
    """Up to the step that it ends at."""
    log = cosim.open_log(killed)
    whole = cosim.run("academic", set={"scenario.stop": 5.0})
    assert log.status == "unfinished"
    assert 1000 < log.steps < whole.steps
    assert log.end_ns == log.steps * log.step_ns
    assert log.recorded_hash is None
    for name in log.channels:
        rows = log.rows(name)
        expected = whole.rows(name)[: len(rows)]
        assert np.array_equal(rows.view(np.int64), expected.view(np.int64)), name


@pytest.mark.slow
def test_a_killed_log_is_verified_without_a_hash(killed, tmp_path):
    """It says that there is none to check; a flipped bit of a row is damage all the same."""
    verification = verify(cosim.open_log(killed), cosim.replay(killed))
    assert verification.passed
    assert verification.lines[0].startswith("no content hash: the log is unfinished")
    with killed.open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[-1]
    data = bytearray(killed.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data)
    with pytest.raises(LogError, match="is damaged at byte"):
        verify(cosim.open_log(broken), cosim.replay(broken))


@pytest.mark.slow
def test_the_recovered_log_of_a_killed_run_is_verified(killed, tmp_path):
    """It has a hash, which no run recorded, and nothing of how the run ended."""
    log = recover(killed, tmp_path / "saved.mcap").log
    assert (log.status, log.reason) == ("interrupted", "recovered from killed.mcap")
    verification = verify(log, cosim.replay(log))
    assert verification.passed
    assert "run recorded" not in "\n".join(verification.lines)


OPTIONS = [
    ({"flush": 0.0, "out": "a.mcap"}, r"flush: .*> 0, got 0\.0"),
    ({"flush": "1", "out": "a.mcap"}, "flush: .*'1'"),
    ({"flush": 1.0}, "flush applies to a log; expected out"),
    ({"sync": True}, "sync=True applies to a log; expected out"),
    ({"sync": 1, "out": "a.mcap"}, "sync: expected True or False, got 1"),
]


def test_options_of_writing_are_checked_before_the_run(tmp_path, monkeypatch):
    """Each with one error."""
    monkeypatch.chdir(tmp_path)
    check_refused(OPTIONS, lambda options: cosim.run("academic", **options))
    assert not list(tmp_path.iterdir())


def test_a_log_may_wait_for_the_disk(tmp_path):
    """The rows are the same."""
    log = cosim.run("academic", out=tmp_path / "a.mcap", sync=True, set={"scenario.stop": 0.2})
    assert cosim.open_log(log.path).content_hash() == log.recorded_hash
