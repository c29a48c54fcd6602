"""Rows of a log as a run writes it."""

import subprocess
import sys
import threading
from contextlib import ExitStack
from itertools import count

import numpy as np
import pytest

from cosim.errors import LogError
from cosim.log import McapRecorder, open_log
from cosim.log.files import Rotation, UnfinishedLog
from cosim.log.following import FollowedLog
from cosim.log.text import choose, csv_text
from tests.log.recordings import STEP_NS, blocks, layout, plan, record, same_bits, table

STEPS = 600
WRITER = f"""
import sys
from cosim.log import McapRecorder, open_log
from tests.log.recordings import blocks, layout, plan, table

rows = table(layout(), {STEPS})
with McapRecorder(sys.argv[1], flush=1e-3) as recorder:
    recorder.begin(plan())
    for block, signals in blocks(rows, 20):
        recorder.write(block, signals)
        print("written", flush=True)
        if not sys.stdin.readline():
            break
"""


@pytest.fixture
def writer(tmp_path):
    """Start a process that writes 20 rows whenever it is told to, to its log."""
    path = tmp_path / "a.mcap"
    command = [sys.executable, "-c", WRITER, str(path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout.readline() == "written\n"
        yield process, path
        process.kill()


def goes_on(process):
    """Return what lets the writer write more, until it ends: at most as often as it has blocks."""
    numbers = count()

    def wait():
        assert next(numbers) < 10_000
        if process.poll() is None:
            try:
                process.stdin.write("\n")
                process.stdin.flush()
            except BrokenPipeError:
                return
            process.stdout.readline()

    return wait


def joined(parts):
    """Return times and values of a table."""
    parts = list(parts)
    return np.concatenate([part.time_ns for part in parts]), np.concatenate(
        [part.values for part in parts]
    )


@pytest.mark.slow
def test_every_row_comes_once_bit_for_bit(writer):
    """Of components with two rates, while another process writes to the log."""
    process, path = writer
    followed = FollowedLog(path, None, wait=goes_on(process))
    parts = list(followed.joined())
    assert len(parts) > 1  # or nothing was followed
    time_ns, values = joined(parts)
    assert np.array_equal(time_ns, np.arange(STEPS + 1) * 1_000_000)
    whole = choose(open_log(path), None, None, None)
    assert same_bits(values, joined(whole.joined())[1])


@pytest.mark.slow
def test_the_log_of_a_run_that_was_killed_ends(writer):
    """With all rows that were flushed."""
    process, path = writer
    go_on = goes_on(process)
    parts = []

    def kill():
        if not parts:
            go_on()
        else:
            process.kill()
            process.wait(60)

    for part in FollowedLog(path, ["plant.*"], wait=kill).joined():
        parts.append(part)
    time_ns, values = joined(parts)
    whole = choose(open_log(path), ["plant.*"], None, None)
    assert whole.run.status == "unfinished"
    assert same_bits(values, joined(whole.joined())[1])
    assert len(time_ns) >= 1


@pytest.mark.slow
def test_a_window_of_time_ends_when_it_is_there(writer):
    """The run goes on."""
    process, path = writer
    followed = FollowedLog(path, ["plant.u"], 0.05, 0.1, wait=goes_on(process))
    time_ns, _ = joined(followed.joined())
    assert np.array_equal(time_ns, np.arange(50, 101) * 1_000_000)
    assert process.poll() is None


def test_a_closed_log_is_printed_as_ever(tmp_path):
    """There is nothing to wait for."""
    path = tmp_path / "a.mcap"
    record(path, steps=50)
    text = "".join(csv_text(FollowedLog(path, None, wait=pytest.fail)))
    assert text == "".join(csv_text(choose(open_log(path), None, None, None)))


def test_a_damaged_log_is_an_error_after_some_attempts(tmp_path):
    """It might have been changed by its run."""
    path = tmp_path / "a.mcap"
    record(path, steps=50, compression="none")
    data = bytearray(path.read_bytes())
    data[data.index(b"\x05", len(data) // 2)] ^= 1
    followed = FollowedLog(path, None, wait=lambda: None)
    path.write_bytes(data)
    with pytest.raises(LogError):
        list(followed.joined())


def test_a_log_that_is_not_there_is_not_waited_for(tmp_path):
    """A name may be wrong."""
    with pytest.raises(LogError, match=r"a\.mcap cannot be read: No such file"):
        FollowedLog(tmp_path / "a.mcap", None)


def test_a_log_that_is_rotated_is_followed_from_file_to_file(tmp_path):
    """While it is written, and from a later file on."""
    path = tmp_path / "a.mcap"
    rows = table(layout(), 100)
    run = blocks(rows, 10)
    rotation = Rotation(None, 30 * STEP_NS, "30ms")
    with ExitStack() as stack:
        recorder = stack.enter_context(McapRecorder(path, rotation=rotation, flush=1e-3))
        recorder.begin(plan())
        recorder.write(*next(run))
        numbers = count()

        def wait():
            assert next(numbers) < 10_000
            block = next(run, None)
            if block is not None:
                recorder.write(*block)
            else:
                stack.close()

        time_ns, values = joined(FollowedLog(path, ["plant.*"], wait=wait).joined())
    assert np.array_equal(time_ns, np.arange(101) * STEP_NS)
    assert same_bits(values, rows[:, :5])
    later = FollowedLog(tmp_path / "a.part2.mcap", ["plant.u"], wait=pytest.fail)
    assert np.array_equal(joined(later.joined())[0], np.arange(30, 101) * STEP_NS)


def test_a_next_file_is_waited_for_as_long_as_it_is_begun(tmp_path, monkeypatch):
    """However long a slow disk takes to close the file before, and to name the next one."""
    path = tmp_path / "a.mcap"
    looks = []
    is_slow = threading.Event()
    is_seen = threading.Event()
    publish = UnfinishedLog.publish

    def publish_late(self):
        if self.path != path:
            is_slow.set()
            assert is_seen.wait(60.0)
        publish(self)

    def look():
        assert is_slow.wait(60.0)
        looks.append(1)
        if len(looks) == 50:
            is_seen.set()
            stack.close()

    monkeypatch.setattr(UnfinishedLog, "publish", publish_late)
    with ExitStack() as stack:
        recorder = stack.enter_context(
            McapRecorder(path, rotation=Rotation(None, 60 * STEP_NS, "60ms"), flush=1e-3)
        )
        recorder.begin(plan())
        for block in blocks(table(layout(), 100), 10):
            recorder.write(*block)
        assert is_slow.wait(60.0)
        time_ns, _ = joined(FollowedLog(path, None, wait=look).joined())
    assert np.array_equal(time_ns, np.arange(101) * STEP_NS)
    assert len(looks) == 50


def test_a_next_file_that_never_comes_is_not_waited_for(tmp_path):
    """Its run was killed, or the file was moved away."""
    path = tmp_path / "a.mcap"
    record(path, steps=100, rotation=Rotation(None, 60 * STEP_NS, "60ms"))
    (tmp_path / "a.part2.mcap").unlink()
    looks = []
    time_ns, _ = joined(FollowedLog(path, None, wait=lambda: looks.append(1)).joined())
    assert len(time_ns) == 60
    assert len(looks) == 5
