"""Rows of a log as a run writes it."""

from __future__ import annotations

import shutil
import threading
from itertools import count

import numpy as np
import pytest

from cosim.errors import LogError
from cosim.log import McapRecorder, open_log
from cosim.log.files import Rotation, UnfinishedLog
from cosim.log.following import FollowedLog
from cosim.log.text import choose, csv_text
from tests.log.recordings import (
    STEP_NS,
    blocks,
    layout,
    plan,
    record,
    same_bits,
    table,
    wait_for_rows,
)

ROWS = table(layout(), 100)


class Writer:
    """A run that writes ten rows whenever it is waited for, to its end."""

    def __init__(self, path, **options):
        self._path = None if options else path
        self._blocks = blocks(ROWS, 10)
        self._recorder = McapRecorder(path, flush=1e-9, **options)
        self._recorder.begin(plan())
        self._looks = count(1)
        self.write()

    def write(self):
        number = next(self._looks)
        assert number < 1000
        block = next(self._blocks, None)
        if block is None:
            self.close()
        else:
            self._recorder.write(*block)
            if self._path is not None:  # else its rows are in several files
                wait_for_rows(self._path, 10 * number + 1)

    def close(self):
        self._recorder.__exit__(None, None, None)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.mcap"


@pytest.fixture
def writer(path):
    writing = Writer(path)
    yield writing
    writing.close()


def joined(parts):
    """Return times and values of a table."""
    parts = list(parts)
    return np.concatenate([part.time_ns for part in parts]), np.concatenate(
        [part.values for part in parts]
    )


def test_every_row_comes_once_bit_for_bit(path, writer):
    """Of components with two rates, while the log is written."""
    parts = list(FollowedLog(path, None, wait=writer.write).joined())
    assert len(parts) > 1  # or nothing was followed
    time_ns, values = joined(parts)
    assert np.array_equal(time_ns, np.arange(101) * STEP_NS)
    whole = choose(open_log(path), None, None, None)
    assert same_bits(values, joined(whole.joined())[1])


def test_the_log_of_a_run_that_was_killed_ends(path, writer):
    """With all rows that were flushed: nobody writes to this one, a copy."""
    killed = path.with_name("killed.mcap")
    shutil.copy(path, killed)
    time_ns, values = joined(FollowedLog(killed, ["plant.*"], wait=pytest.fail).joined())
    assert open_log(killed).status == "unfinished"
    assert same_bits(values, ROWS[: len(time_ns), :5])
    assert len(time_ns) == 11


def test_a_window_of_time_ends_when_it_is_there(path, writer):
    """The run goes on; and of a closed log there is nothing to wait for."""
    followed = FollowedLog(path, ["plant.u"], 0.02, 0.04, wait=writer.write)
    assert np.array_equal(joined(followed.joined())[0], np.arange(20, 41) * STEP_NS)
    assert open_log(path).status == "unfinished"
    writer.close()
    text = "".join(csv_text(FollowedLog(path, None, wait=pytest.fail)))
    assert text == "".join(csv_text(choose(open_log(path), None, None, None)))


def test_what_cannot_be_read_is_an_error(path):
    """A damaged log after some attempts, as a run might write it; a missing one at once."""
    with pytest.raises(LogError, match=r"a\.mcap cannot be read: No such file"):
        FollowedLog(path, None)
    record(path, steps=50, compression="none")
    data = bytearray(path.read_bytes())
    data[data.index(b"\x05", len(data) // 2)] ^= 1
    looks = []
    followed = FollowedLog(path, None, wait=lambda: looks.append(1))
    path.write_bytes(data)
    with pytest.raises(LogError):
        list(followed.joined())
    assert len(looks) == 4


def test_a_log_that_is_rotated_is_followed_from_file_to_file(path):
    """While it is written, and from a later file on."""
    writer = Writer(path, rotation=Rotation(None, 30 * STEP_NS, "30ms"))
    time_ns, values = joined(FollowedLog(path, ["plant.*"], wait=writer.write).joined())
    assert np.array_equal(time_ns, np.arange(101) * STEP_NS)
    assert same_bits(values, ROWS[:, :5])
    later = FollowedLog(path.with_name("a.part2.mcap"), ["plant.u"], wait=pytest.fail)
    assert np.array_equal(joined(later.joined())[0], np.arange(30, 101) * STEP_NS)


def test_a_next_file_is_waited_for_as_long_as_it_is_begun(path, monkeypatch):
    """However long a slow disk takes to close the file before, and to name the next one."""
    is_slow, is_seen = threading.Event(), threading.Event()
    publish = UnfinishedLog.publish
    looks = []

    def publish_late(self):
        if self.path != path:
            is_slow.set()
            assert is_seen.wait(60.0)
        publish(self)

    def look():
        looks.append(1)
        if len(looks) == 50:
            is_seen.set()
            writer.close()

    monkeypatch.setattr(UnfinishedLog, "publish", publish_late)
    writer = Writer(path, rotation=Rotation(None, 60 * STEP_NS, "60ms"))
    for _ in range(9):
        writer.write()
    assert is_slow.wait(60.0)
    time_ns, _ = joined(FollowedLog(path, None, wait=look).joined())
    assert np.array_equal(time_ns, np.arange(101) * STEP_NS)
    assert len(looks) == 50


def test_a_next_file_that_never_comes_is_not_waited_for(path):
    """Its run was killed, or the file was moved away."""
    record(path, steps=100, rotation=Rotation(None, 60 * STEP_NS, "60ms"))
    path.with_name("a.part2.mcap").unlink()
    looks = []
    time_ns, _ = joined(FollowedLog(path, None, wait=lambda: looks.append(1)).joined())
    assert (len(time_ns), len(looks)) == (60, 5)
