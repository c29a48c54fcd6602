"""Signals end the command line also where the main thread is in a call that does not return."""

import os
import signal
import subprocess
import sys
import threading

import pytest

import cosim
from cosim import unanswered
from cosim.interrupts import REASONS, uninterrupted
from cosim.unanswered import ended_if_unanswered
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, compiles for Linux")

SCENARIO = """
[scenario]
name = "x"
stop = 100.0
step = 0.001
[components]
plant = { kind = "fmu", path = "hangs.fmu" }
"""


@pytest.fixture(autouse=True)
def listening():
    """Let Ctrl-C interrupt, also in tests started in the background, where it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def open_files():
    return sorted(os.listdir("/proc/self/fd"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "again", "steps"),
    [(signal.SIGINT, True, 20000), (signal.SIGTERM, False, 20000), (signal.SIGTERM, True, 0)],
)
def test_a_signal_ends_a_step_that_does_not_return(tmp_path, number, again, steps):
    """After some seconds, or at once where it comes again: Ctrl-C, or what timeout(1) sends.

    The log is left as it was written: with all that was computed before, after the flush interval.
    Where that was nothing there is none, and none is spoken of.
    """
    defines = ("ROGUE=HANGS_LATER", f"AT={steps}")
    compile_fmu(tmp_path / "hangs.fmu", STATELESS, "rogue2.c", defines=defines)
    (tmp_path / "x.toml").write_text(SCENARIO)
    command = [sys.executable, "-m", "cosim", "run", "x.toml", "--out", "x.mcap", "--flush", "0.1"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr.readline() == "hangs\n"
            process.send_signal(number)
            said = process.stderr.readline()
            assert f"a call of plant, at t = {steps // 1000} s, does not return" in said
            assert process.poll() is None
            if again:
                process.send_signal(number)
            _, messages = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 128 + number
    assert messages.startswith(f"cosim: {REASONS[number]}: ended")
    assert ("x.mcap" in messages) == (steps > 0)
    if steps:
        log = cosim.open_log(tmp_path / "x.mcap")
        assert (log.status, log.steps) == ("unfinished", steps)
    else:
        assert not (tmp_path / "x.mcap").exists()


def test_signals_that_python_answers_are_left_to_its_handlers(capfd):
    """Any number of signals, however fast they come: nothing is said, and nothing ends."""
    received = []
    signal.signal(signal.SIGINT, lambda number, frame: received.append(number))
    with ended_if_unanswered():
        for _ in range(5):
            signal.raise_signal(signal.SIGINT)
    assert len(received) == 5
    assert capfd.readouterr().err == ""


def test_a_deferred_signal_ends_nothing(capfd, monkeypatch):
    """Such as the end of a log, however long a disk takes for it."""
    monkeypatch.setattr(unanswered, "PATIENCE", 0.01)
    received = []
    signal.signal(signal.SIGINT, lambda number, frame: received.append(number))
    with ended_if_unanswered():
        with uninterrupted():
            for _ in range(3):
                signal.raise_signal(signal.SIGINT)
                threading.Event().wait(0.1)  # one call, for much longer than the patience
            assert received == []
        assert len(received) == 3
    assert capfd.readouterr().err == ""


def test_nothing_is_left_of_listening():
    """No thread, no file, no descriptor for signals; in another thread there is none at all."""
    threads = threading.active_count()
    files = open_files()
    for _ in range(3):
        with ended_if_unanswered():
            assert threading.active_count() == threads + 1
            with ended_if_unanswered():  # the outer one listens already
                assert threading.active_count() == threads + 1
            counts = []
            thread = threading.Thread(target=lambda counts=counts: count_inside(counts))
            thread.start()
            thread.join()
            assert counts == [threads + 2]
    assert threading.active_count() == threads
    assert open_files() == files
    assert signal.set_wakeup_fd(-1) == -1


def count_inside(counts):
    with ended_if_unanswered():
        counts.append(threading.active_count())


def test_who_hears_of_the_signals_already_goes_on_so():
    """Such as an event loop that calls the command line."""
    signal.signal(signal.SIGINT, lambda number, frame: None)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer)
    try:
        with ended_if_unanswered():
            signal.raise_signal(signal.SIGINT)
        assert os.read(reader, 10) == bytes([signal.SIGINT])
    finally:
        assert signal.set_wakeup_fd(-1) == writer
        os.close(reader)
        os.close(writer)
