"""A process that is killed leaves a log that every reader opens, with all that was flushed."""

from __future__ import annotations

import random
import resource
import shutil
import sys

import pytest

from cosim.log import open_log
from tests.log.killed import Job, answer_of, check, killed_run, whole_run

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no signals that kill")


SIGNALS = ["SIGKILL", "SIGKILL", "SIGTERM", "SIGHUP"]


BEYOND = 5 * 10**9  # bytes


MOST_MEMORY = 150 * 2**20  # bytes, beyond what the imports take


def counts(slow, campaign):
    """Return the counts of a test's longer forms."""
    return [
        pytest.param(slow, marks=pytest.mark.slow),
        pytest.param(campaign, marks=pytest.mark.campaign),
    ]


@pytest.mark.parametrize("count", [3, *counts(40, 400)])
def test_a_kill_at_any_time_keeps_what_was_flushed(tmp_path, count):
    """Of a log that grows and is closed, by flushes of a chunk and of a few rows."""
    durations = [whole_run(Job(tmp_path / "a.mcap", seed))[0] for seed in range(3)]
    chance = random.Random(count)
    killed = 0  # before their logs were closed: at least half as many as runs are asked for
    for number in range(4 * count):
        if number >= count and killed > count / 2:
            break
        job = Job(tmp_path / f"{number}.mcap", number)
        delay = chance.uniform(0, durations[number % 3])
        reported, is_closed = killed_run(job, delay, SIGNALS[number % len(SIGNALS)])
        assert check(job, reported) >= reported
        killed += not is_closed
        job.path.unlink()
    assert killed > count / 2


@pytest.mark.parametrize("count", counts(40, 400))
def test_a_kill_within_any_write_keeps_what_was_flushed(tmp_path, count):
    """Also where the write is done by half."""
    writes = [whole_run(Job(tmp_path / "a.mcap", seed))[1] for seed in range(3)]
    chance = random.Random(count)
    for number in range(count):
        cut = (chance.randrange(10, writes[number % 3]), chance.random())
        job = Job(tmp_path / f"{number}.mcap", number % 3, cut=cut)
        reported, is_closed = killed_run(job)
        assert not is_closed
        assert check(job, reported) >= reported
        job.path.unlink()


@pytest.mark.parametrize("count", counts(20, 180))
def test_a_kill_of_a_run_leaves_a_whole_log_or_a_hidden_file(tmp_path, count):
    """The recorder's thread flushes while the run goes on; before the first row there is no log.

    A kill while the log gets its name may leave it with both.
    """
    duration, _ = whole_run(Job(tmp_path / "a.mcap", 2, kind="recorder"))
    chance = random.Random(count)
    for number in range(count):
        folder = tmp_path / str(number)
        folder.mkdir()
        job = Job(folder / "a.mcap", 2, kind="recorder")
        reported, _ = killed_run(job, chance.uniform(0, duration))
        *hidden, file = sorted(folder.iterdir())
        assert all(file.samefile(name) for name in hidden)
        if file.name.startswith("."):
            assert not reported
        else:
            assert check(job, reported) >= reported
        shutil.rmtree(folder)


def _measure(pipe, function, *arguments):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    function(*arguments)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 1024
    pipe.send((after - before) * unit)


def read_whole(path):
    """Open a log and read all of its rows."""
    log = open_log(path)
    log.load()
    for name in log.channels:
        log.rows(name)


@pytest.mark.campaign
def test_a_large_log_of_a_killed_run_is_opened_in_little_memory(tmp_path, subtests):
    """Of more than 5 GB, most of them holes on the disk."""
    for number in range(20):
        path = tmp_path / f"{number}.mcap"
        chance = random.Random(number)
        job = Job(path, number, filled=BEYOND)
        reported, _ = killed_run(job, chance.uniform(0, 0.1))
        with subtests.test(case=number):
            assert path.stat().st_size > BEYOND
            assert answer_of(_measure, read_whole, path) < MOST_MEMORY
            assert check(job, reported) >= reported
        path.unlink()
