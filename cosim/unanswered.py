"""A signal while the main thread is in a call of C that does not return: it ends the process.

Python runs its handlers in the main thread, between two instructions, so that Ctrl-C waits as long
as an FMU hangs, and so does a request to terminate, as timeout(1), systemd and batch systems send
it. A thread of the command line hears of it at once, and asks whether the main thread still runs
Python. Where it does, all is left to its handlers. Where it does not, that is said, with the FMU
that is called, and if it still does not some seconds later, or when a signal comes again, the
process ends.

Only the command line does so: the process is its own. One that uses the package may hold more than
a run, such as the session of a notebook. A closed terminal may send its signal twice at once, which
is one: it never ends a process before those seconds are over.
"""

from __future__ import annotations

import math
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

from cosim.interrupts import REASONS, SIGNALS, is_deferred

PATIENCE: Final = 1.0  # s in which the main thread is to run an instruction of Python
GRACE: Final = 4.0  # s more, once that is said
_LOOK: Final = 0.05  # s between two looks at whether it does
_CALLS: Final = "cosim.native.fmi.process"  # imported where FMUs are called
_ENDS_AT_ONCE: Final = {signal.SIGINT, signal.SIGTERM}  # when it comes again
_ALL: Final = 4096  # bytes, more than there can be
_BELOW_PROGRESS: Final = "\x1b[?25h\n"  # and with a cursor, which that hides
_questions: list[Any] = []  # kept, as the main thread may come to them late


@contextmanager
def ended_if_unanswered() -> Iterator[None]:
    """End the process after a signal that the main thread cannot answer.

    Elsewhere than in the main thread, and where another hears of the signals already, such as an
    event loop, nothing is changed.
    """
    if sys.platform == "win32" or not _may_listen():
        yield
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    ended = threading.Event()
    thread = threading.Thread(target=_listen, args=(reader, ended), daemon=True)
    thread.start()
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(-1)
        ended.set()
        os.close(writer)  # the thread reads the end of the pipe
        thread.join()
        os.close(reader)


def _may_listen() -> bool:
    if threading.current_thread() is not threading.main_thread():
        return False
    listener = signal.set_wakeup_fd(-1)
    signal.set_wakeup_fd(listener)
    return listener == -1


def _listen(reader: int, ended: threading.Event) -> None:
    """Read the numbers of the signals that come, and act where the main thread does not."""
    while numbers := os.read(reader, _ALL):
        number = next((number for number in numbers if number in SIGNALS), None)
        if number is None:
            continue
        answered = _ask_main_thread()
        if ended.is_set() or answered.wait(PATIENCE) or is_deferred(number):
            continue
        _is_repeated(reader)  # taken before it is said what a second one does
        _write(
            f"{REASONS[number]}: {_current_call()} does not return: ended in {GRACE:g} s if it "
            "still does not, at once with Ctrl-C again, without a complete log"
        )
        end = time.monotonic() + GRACE
        while not (ended.is_set() or answered.wait(_LOOK) or is_deferred(number)):
            if time.monotonic() > end or _is_repeated(reader):
                _write(f"{REASONS[number]}: ended{_log_left()}")
                os._exit(128 + number)


def limit_calls(limit: float) -> None:
    """Let SIGALRM end the process where the main thread is in a call of C for longer [s].

    A signal, as a call may keep Python's lock, such as the one that loads a binary.
    """
    if sys.platform != "win32" and limit < math.inf:
        threading.Thread(target=_watch, args=(limit,), daemon=True).start()


def _watch(limit: float) -> None:
    while True:
        signal.setitimer(signal.ITIMER_REAL, limit)
        time.sleep(min(PATIENCE, limit / 4))
        _ask_main_thread().wait()


def _is_repeated(reader: int) -> bool:
    """Return whether Ctrl-C or a request to terminate has come again."""
    is_ready = bool(select.select([reader], [], [], 0.0)[0])
    return is_ready and not _ENDS_AT_ONCE.isdisjoint(os.read(reader, _ALL))


def _current_call() -> str:
    """Return what the main thread is in, as far as that is known."""
    calls = sys.modules.get(_CALLS)
    called: str = calls.running_text() if calls is not None else ""
    return f"a call of {called}," if called else "the current call (of an FMU, say)"


def _log_left() -> str:
    """Return what is left of the log of the run, if it has rows."""
    calls = sys.modules.get(_CALLS)
    path = calls.reported_log if calls is not None else None
    return f"; {path} was not closed: 'cosim info' shows up to where it is complete" if path else ""


def _ask_main_thread() -> threading.Event:
    """Return what the main thread sets as soon as it runs Python."""
    import ctypes  # here, as --help does without

    answered = threading.Event()

    def answer(_: int | None) -> int:
        answered.set()
        return 0

    question = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(answer)
    _questions.append(question)
    ctypes.pythonapi.Py_AddPendingCall(question, None)
    return answered


def _write(text: str) -> None:
    """Write a message, unless nobody takes it; sys.stderr may be locked by the main thread."""
    start = _BELOW_PROGRESS if os.isatty(2) else ""
    with suppress(OSError, ValueError):
        if select.select([], [2], [], 0.0)[1]:
            os.write(2, f"{start}cosim: {text}\n".encode())
