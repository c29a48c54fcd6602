"""Ctrl-C at any instant leaves every row once, or the tail cut."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from pathlib import Path

import pytest

import cosim.log
from cosim.interrupts import uninterrupted
from cosim.log import McapRecorder, background, files, open_log
from tests.log.recordings import STEP_NS, blocks, layout, make_chunks_small, plan, same_bits, table

BY_BYTECODE = {module.__file__ for module in (background, files)}
TRACED = {str(path) for path in Path(cosim.log.__file__).parent.rglob("*.py")}
TRACED.add(contextlib.__file__)
SWITCH = {"write", "append", "_room", "_hand_over", "uninterrupted"}


@pytest.fixture(autouse=True)
def listening():
    """Let Ctrl-C interrupt, also in tests started in the background, where it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Press:
    """Press Ctrl-C at the n-th instant of some functions, or all, of the log.

    An instant is a bytecode of the writer, a line of the rest.
    """

    def __init__(self, instant, functions):
        self.left = instant
        self._functions = functions

    def __call__(self, frame, event, arg):
        code = frame.f_code
        if code.co_filename not in TRACED:
            return None
        if self._functions and code.co_name not in self._functions:
            return None
        frame.f_trace_opcodes = code.co_filename in BY_BYTECODE
        self.left -= 1
        if self.left == 0:
            signal.raise_signal(signal.SIGINT)
        return self


def run(path, rows, instant=0, functions=None):
    """Record rows and messages, with Ctrl-C at an instant; return whether that came."""
    press = Press(instant, functions)
    before = sys.gettrace()
    try:
        with McapRecorder(path, compression="none") as recorder:
            sys.settrace(press if instant else before)
            recorder.begin(plan())
            for number, (block, signals) in enumerate(blocks(rows, 4)):
                recorder.message(int(block.time_ns[0]), "info", "run", f"block {number}")
                recorder.write(block, signals)
            sys.settrace(before)
    finally:
        sys.settrace(before)
    return press.left <= 0


def assert_whole(path, rows, instant):
    """Check that a log has each row once up to its end, with their hash, and each message once."""
    log = open_log(path)
    count = len(log.rows("plant"))
    last_step = max(count - 1, 0)
    texts = [message.text for message in log.messages()]
    assert same_bits(log.rows("plant"), rows[:count, :5]), instant
    assert same_bits(log.rows("identifier"), rows[:count:5, 5:]), instant
    assert (log.steps, log.end_ns) == (last_step, last_step * STEP_NS), instant
    assert log.content_hash() == log.results["content_hash"], instant
    assert texts == [f"block {number}" for number in range(len(texts))], instant


@pytest.mark.fast("None-71-15")
@pytest.mark.parametrize(
    ("functions", "stride", "least"),
    [
        (SWITCH, 17, 15),
        (None, 71, 15),
        (SWITCH, 3, 50),
        (None, 17, 50),
        pytest.param(SWITCH, 1, 50, marks=pytest.mark.campaign),
    ],
)
def test_an_interrupt_at_any_instant_keeps_every_row_once(
    tmp_path, monkeypatch, functions, stride, least
):
    """The file is whole or does not exist, and no other is left.

    Ctrl-C comes at some of the instants around the writing of a chunk, and at some of all others.
    """
    make_chunks_small(monkeypatch, 700)
    rows = table(layout(), 12)
    path = tmp_path / "a.mcap"
    instant = 1
    pressed = True
    kept = 0
    while pressed:
        with contextlib.suppress(KeyboardInterrupt):
            pressed = run(path, rows, instant, functions)
        assert set(tmp_path.iterdir()) <= {path}, instant
        if path.exists():
            assert_whole(path, rows, instant)
            kept += 1
            path.unlink()
        instant += stride
    assert kept > least


def test_an_interrupt_within_is_handed_on_at_the_end():
    """Every press of it, to the handler from before."""
    pressed = []
    before = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    try:
        with uninterrupted():
            with uninterrupted():
                signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            assert not pressed
        assert pressed == [signal.SIGINT] * 2
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_block_ends_before_the_interrupt():
    """Also where it ends with an error."""
    done = []

    def fail():
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            done.append(True)
            raise ValueError

    with pytest.raises(KeyboardInterrupt) as raised:
        fail()
    assert done
    assert isinstance(raised.value.__context__, ValueError)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_handler_that_cannot_raise_is_left_alone():
    """Ignored stays ignored, and what kills still kills."""
    before = signal.getsignal(signal.SIGINT)
    try:
        for handler in (signal.SIG_IGN, signal.SIG_DFL):
            signal.signal(signal.SIGINT, handler)
            with uninterrupted():
                assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_write_logs_too(tmp_path):
    """They get no interrupts, and may set no handlers."""
    thread = threading.Thread(target=run, args=(tmp_path / "a.mcap", table(layout(), 12)))
    thread.start()
    thread.join()
    assert open_log(tmp_path / "a.mcap").steps == 12
