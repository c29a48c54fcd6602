"""A log stands at its path from its first row on; before that, what stood there is untouched."""

from __future__ import annotations

import errno
import os
import shutil
import time
from contextlib import suppress
from itertools import product

import numpy as np
import pytest

import cosim
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import (
    CosimError,
    GraphError,
    Interrupted,
    LogError,
    LogWriteError,
    NonFiniteError,
)
from cosim.log import McapRecorder, files, open_log, places, recorder
from tests.log.disks import FullDisk
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


@pytest.fixture(params=[False, True], ids=["new", "force"])
def force(request):
    """Write to a free path, or in place of an old log."""
    return request.param


@pytest.fixture
def path(tmp_path, force):
    """Name the log; with ``force`` an old one of 10 steps stands there."""
    if force:
        record(tmp_path / "a.mcap", steps=10)
    return tmp_path / "a.mcap"


def untouched(path, force):
    """Return whether nothing is left but the old log, if there was one."""
    files = list(path.parent.iterdir())
    if not force:
        return not files
    return files == [path] and open_log(path).steps == 10


def attempt(path, force, *, error=None, rows=0):
    """Begin a run, write some rows and end it with an error."""
    run = list(blocks(table(layout(), 100), 10))
    with McapRecorder(path, force=force) as recorder:
        recorder.begin(plan())
        for block, signals in run[:rows]:
            recorder.write(block, signals)
        if error is not None:
            raise error


def test_a_run_refused_before_its_first_row_leaves_no_trace(path, force, subtests):
    """Whatever stood there stays, and no other file."""
    for error in (GraphError("no"), LogError("no"), ValueError("bug"), KeyboardInterrupt()):
        with subtests.test(case=error):
            with pytest.raises(type(error)):
                attempt(path, force, error=error)
            assert untouched(path, force)


def test_a_run_without_rows_leaves_a_log(tmp_path, path, force, subtests):
    """Of no time, or failed at its start; then with the stop reason."""
    for error, status in [
        (None, "complete"),
        (NonFiniteError("y became nan"), "failed"),
        (LogWriteError("negative"), "failed"),
        (Interrupted("Ctrl-C"), "interrupted"),
    ]:
        with subtests.test(case=error):
            with suppress(NonFiniteError, LogWriteError, Interrupted):
                attempt(path, force, error=error)
            assert list(tmp_path.iterdir()) == [path]
            log = open_log(path)
            assert (log.status, log.steps, len(log.rows("plant"))) == (status, 0, 0)
            assert log.results["reason"] == str(error or "")
        path.unlink()
        if force:
            record(path, steps=10)


def test_the_log_stands_at_its_path_from_the_first_row_on(path, force):
    """The same file under a hidden name before, and under no other after."""
    with McapRecorder(path, force=force) as recorder:
        recorder.begin(plan())
        (hidden,) = set(path.parent.iterdir()) - {path}
        assert hidden.name.startswith(".a.mcap.")
        assert path.exists() == force
        assert not force or open_log(path).steps == 10
        growing = hidden.stat().st_ino
        block, signals = next(blocks(table(layout(), 100), 10))
        recorder.write(block, signals)
        assert list(path.parent.iterdir()) == [path]
        assert path.stat().st_ino == growing
    assert path.stat().st_ino == growing


@pytest.mark.parametrize("linked", [True, False])
def test_a_file_that_came_meanwhile_is_not_replaced(tmp_path, monkeypatch, linked):
    """With and without hard links, at the first row and at the end of a run without any."""
    path = tmp_path / "a.mcap"
    if not linked:
        monkeypatch.setattr(files.os, "link", no_links)

    def fail(rows):
        with McapRecorder(path) as recorder:
            recorder.begin(plan())
            path.write_text("mine")
            for block, signals in list(blocks(table(layout(), 10), 10))[:rows]:
                recorder.write(block, signals)

    for rows in (0, 1):
        with pytest.raises(LogError, match=r"a\.mcap .*force=True"):
            fail(rows)
        assert path.read_text() == "mine"
        assert list(tmp_path.iterdir()) == [path]
        path.unlink()
    record(path, steps=20)
    assert open_log(path).steps == 20
    assert list(tmp_path.iterdir()) == [path]


def no_links(source, target):
    """Fail as on a file system without hard links."""
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))


def test_a_folder_lost_before_the_first_row_is_an_error(tmp_path):
    """There is nowhere to put the log."""

    def fail():
        with McapRecorder(tmp_path / "logs" / "a.mcap") as recorder:
            recorder.begin(plan())
            (hidden,) = (tmp_path / "logs").iterdir()
            hidden.unlink()
            (tmp_path / "logs").rmdir()
            recorder.write(*next(blocks(table(layout(), 10), 10)))

    with pytest.raises(LogError, match=r"a\.mcap cannot be created: No such file or directory"):
        fail()
    assert not list(tmp_path.iterdir())


def test_an_interrupt_in_begin_leaves_no_trace(path, force, monkeypatch, subtests):
    """Wherever it comes."""
    functions = ("begin_file", "LogStore", "BackgroundWriter")
    for function, error in product(functions, (KeyboardInterrupt(), MemoryError())):

        def interrupt(*args, error=error, **kwargs):
            raise error

        with monkeypatch.context() as patch, subtests.test(case=(function, error)):
            patch.setattr(recorder, function, interrupt)
            with pytest.raises(type(error)):
                attempt(path, force)
            assert untouched(path, force)


def test_a_disk_full_from_the_start_leaves_the_old_log(path, force, monkeypatch):
    """What cannot even begin replaces nothing."""
    monkeypatch.setattr(files, "create", lambda path: FullDisk(path, 1))
    with pytest.raises(LogError, match=r"a\.mcap cannot be written: No space left"):
        attempt(path, force)
    assert untouched(path, force)


def test_a_path_that_takes_no_log_is_refused(tmp_path):
    """A folder, a folder that cannot be made, and an existing log, unless it is to be replaced."""
    (tmp_path / "text").write_text("")
    for force in (False, True):
        with pytest.raises(LogError, match=r"is a folder; .*/run\.mcap"):
            attempt(tmp_path, force)
        with pytest.raises(LogError, match=r"text/a\.mcap cannot be created"):
            attempt(tmp_path / "text" / "a.mcap", force)
    assert list(tmp_path.iterdir()) == [tmp_path / "text"]
    path = tmp_path / "new" / "a.mcap"
    record(path, steps=10)
    with pytest.raises(LogError, match=r"a\.mcap exists; .*force=True"):
        record(path)
    old = open_log(path)
    record(path, steps=20, force=True)
    assert len(open_log(path).rows("plant")) == 21
    with pytest.raises(LogError, match="has changed since it was opened"):
        old.rows("plant")


def test_a_long_name_leaves_room_for_the_hidden_one(tmp_path):
    """A file's name may have 255 bytes."""
    path = tmp_path / ("ü" * 125 + ".mcap")
    record(path, steps=5)
    assert open_log(path).steps == 5


def test_the_next_run_removes_what_a_killed_one_left(tmp_path):
    """Its hidden file, but not that of another log, nor of a run that goes on."""
    left = []
    for name in ("a.mcap", "b.mcap"):
        (folder := tmp_path / "other").mkdir(exist_ok=True)
        with suppress(KeyboardInterrupt), McapRecorder(folder / name) as recorder:
            recorder.begin(plan())
            (hidden,) = folder.glob(f".{name}.*.part")
            left.append(hidden.rename(tmp_path / hidden.name))  # out of its reach
            raise KeyboardInterrupt
    folder.rmdir()
    with McapRecorder(tmp_path / "a.mcap", numbered=True) as recorder:
        recorder.begin(plan())
        assert not left[0].exists()
        assert left[1].exists()
        with McapRecorder(tmp_path / "a.mcap", numbered=True) as second:
            second.begin(plan())
            assert len(list(tmp_path.glob(".a.mcap.*.part"))) == 2
    assert {path.name for path in tmp_path.iterdir()} == {"a.mcap", "a-2.mcap", left[1].name}


def test_a_log_that_is_written_is_not_replaced(tmp_path):
    """A second run with ``force`` is refused, and the first goes on."""
    path = tmp_path / "a.mcap"
    run = list(blocks(table(layout(), 20), 10))

    def replace_it():
        with McapRecorder(path, force=True) as second:
            second.begin(plan())
            second.write(*run[0])

    with McapRecorder(path) as recorder:
        recorder.begin(plan())
        recorder.write(*run[0])
        with pytest.raises(LogError, match=r"a\.mcap is being written by another run"):
            replace_it()
        recorder.write(*run[1])
    assert open_log(path).steps == 20
    assert list(tmp_path.iterdir()) == [path]
    replace_it()
    assert open_log(path).steps == 10


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (lambda path: path.rename(path.with_name("b.mcap")), "removed"),
        (lambda path: path.parent.rename(path.parent.with_name("moved")), "its folder"),
        (lambda path: os.replace(copied(path), path), "another file"),
    ],
    ids=["renamed", "folder moved", "replaced"],
)
def test_a_log_that_is_lost_is_an_error_at_the_write(tmp_path, harm, reason):
    """What was written stays valid, wherever it is."""
    path = tmp_path / "logs" / "a.mcap"
    run = list(blocks(table(layout(), 3000), 10))

    def go_on():
        with McapRecorder(path, flush=0.0) as recorder:
            recorder.begin(plan())
            recorder.write(*run[0])
            harm(path)
            deadline = time.monotonic() + 60.0
            for block, signals in run[1:]:
                recorder.write(block, signals)
            while time.monotonic() < deadline:
                recorder.message(0, "info", "run", "still here")

    message = rf"a\.mcap cannot be written further: .*{reason}[^;]*$"
    with pytest.raises(LogWriteError, match=message):
        go_on()
    for log in tmp_path.rglob("*.mcap"):
        assert open_log(log).status in {"failed", "unfinished"}


def copied(path):
    """Return the path of a copy."""
    return shutil.copy(path, path.with_name("copy.mcap"))


def test_a_log_that_is_written_can_be_read(tmp_path):
    """What a reader has opened stays readable; where rows have moved it is to be opened again."""
    path = tmp_path / "a.mcap"
    rows = table(layout(), 1500)
    texts = set()
    with McapRecorder(path, flush=1e-3) as recorder:
        recorder.begin(plan())
        for block, signals in blocks(rows, 10):
            recorder.write(block, signals)
            log = open_log(path)
            try:
                found = log.rows("plant")
            except LogError as error:
                texts.add(str(error))
            else:
                assert same_bits(found, rows[: len(found), :5])
    assert texts <= {f"{path} has changed since it was opened; open it again"}
    assert open_log(path).steps == 1500


def test_a_summary_that_is_replaced_while_it_is_read_is_read_again(tmp_path, monkeypatch):
    """The file is not taken for one without a summary, which any further row would have changed."""
    path = tmp_path / "a.mcap"
    run = list(blocks(table(layout(), 100), 10))
    looks = []

    def replaced(path, stream):
        looks.append(path)
        if len(looks) > 1:
            return find_indexed(path, stream)
        os.utime(path, ns=(0, 0))  # as a flush changes it
        return None

    find_indexed = places.indexed
    with McapRecorder(path, flush=1e-3) as recorder:
        recorder.begin(plan())
        recorder.write(*run[0])
        wait_for_step(path, 10)
        monkeypatch.setattr(places, "indexed", replaced)
        log = open_log(path)
        assert (len(looks), log.status, log.steps) == (2, "unfinished", 10)


def test_the_steps_of_a_log_that_is_written_are_those_when_it_was_opened(tmp_path):
    """Also where a message is ahead of the rows, and these are written anew meanwhile."""
    path = tmp_path / "a.mcap"
    run = list(blocks(table(layout(), 100), 10))
    with McapRecorder(path, flush=1e-3, metadata={"cosim.run": {"start_time": "0.0"}}) as recorder:
        recorder.begin(plan())
        recorder.message(500 * STEP_NS, "info", "run", "ahead")
        recorder.write(*run[0])
        wait_for_step(path, 10)
        log = open_log(path)
        for number, block in enumerate(run[1:], start=2):
            recorder.write(*block)
            wait_for_step(path, 10 * number)
        with pytest.raises(LogError, match="has changed since it was opened"):
            log.rows("plant")
        assert (log.steps, log.end_ns) == (10, 10 * STEP_NS)


def test_the_last_step_of_a_log_that_is_written_is_that_of_its_last_row(tmp_path):
    """Also where no component has a row at every step: of five rows every fifth step, step 20."""
    path = tmp_path / "a.mcap"
    lay = Layout((Channel("slow", Interface((), (Signal("y"),)), 0, 5),))
    rows = np.arange(21.0)[:, np.newaxis]
    with McapRecorder(path, flush=0.0) as recorder:
        recorder.begin(plan(lay))
        for number, (block, signals) in enumerate(blocks(rows, 5), start=1):
            recorder.write(block, signals)
            wait_for_rows(path, number + 1)
            log = open_log(path)
            assert (log.status, log.steps) == ("unfinished", 5 * number)
            assert log.end_ns == 5 * number * STEP_NS


def wait_for_step(path, step):
    """Wait until a log that is written has the rows of a step."""
    deadline = time.monotonic() + 60.0
    last_step = 0
    while last_step < step:
        assert time.monotonic() < deadline
        with suppress(LogError):  # its rows have moved since it was opened
            last_step = open_log(path).steps


def test_wrong_paths_are_refused_by_all_that_takes_one(short_log, subtests):
    """A name too long, one with a NUL, no text, and half a character: before anything is done."""
    for bad in ["x" * 260 + ".mcap", "a\0b.mcap", 3, None, b"\xff.mcap", "\udcff\ud800.mcap"]:
        calls = {
            "open_log": lambda bad=bad: open_log(bad),
            "McapRecorder": lambda bad=bad: McapRecorder(bad),
            "replay": lambda bad=bad: cosim.replay(bad),
            "diff": lambda bad=bad: cosim.diff(open_log(short_log), bad),
        }
        if bad is not None:
            calls["run"] = lambda bad=bad: cosim.run("academic", out=bad)
        if isinstance(bad, str):
            calls["load"] = lambda bad=bad: cosim.load(bad)
        for name, call in calls.items():
            with subtests.test(case=(name, bad)), pytest.raises(CosimError):
                call()
