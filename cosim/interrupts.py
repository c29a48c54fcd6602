"""Ctrl-C and other signals that end a program: Ctrl-C, a request to terminate, a closed terminal.

They are deferred where a file and its bookkeeping change together.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeAlias, final

REASONS: dict[int, str] = {
    signal.SIGINT: "interrupted by the user",
    signal.SIGTERM: "terminated from outside",
}
if sys.platform != "win32":
    REASONS[signal.SIGHUP] = "its terminal was closed"
SIGNALS = tuple(REASONS)
INTERRUPTED = 128 + signal.SIGINT  # exit code after Ctrl-C, as a shell gives it
Handler: TypeAlias = Callable[[int, FrameType | None], Any]


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Defer the signals until the block has ended, however it ends.

    Only the main thread runs Python's handlers, and only those can raise within the block;
    elsewhere, and where a signal is ignored or kills, nothing is changed.
    """
    handlers = _python_handlers()
    if threading.current_thread() is not threading.main_thread() or not handlers:
        yield
        return
    deferred = _Deferred()
    for number in handlers:
        signal.signal(number, deferred)
    try:
        yield
    finally:
        # All handlers first: the first deferred signal usually raises, and ends this loop.
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number, frame in deferred.signals:
            handlers[number](number, frame)


def is_deferred(number: int) -> bool:
    """Return whether a signal has to wait for the end of such a block; any thread may ask."""
    return isinstance(signal.getsignal(number), _Deferred)


@final
class _Deferred:
    """A handler that keeps the signals."""

    def __init__(self) -> None:
        self.signals: list[tuple[int, FrameType | None]] = []

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.signals.append((number, frame))


def _python_handlers() -> dict[int, Handler]:
    """Return the handlers that are Python functions; not those that ignore the signal, or kill."""
    handlers: dict[int, Handler] = {}
    for number in SIGNALS:
        handler = signal.getsignal(number)
        if callable(handler):
            handlers[number] = handler
    return handlers
