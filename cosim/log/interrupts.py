"""Ctrl-C and requests to terminate, held off where a file and what is known of it must change together."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeAlias

SIGNALS = (signal.SIGINT, signal.SIGTERM)
Handler: TypeAlias = Callable[[int, FrameType | None], Any]


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hand SIGINT and SIGTERM on only when the block has ended, however it ends.

    Only the main thread runs Python's handlers, and only those can raise within the block; elsewhere, and where a signal is
    ignored or kills, nothing is changed.
    """
    found = {number: signal.getsignal(number) for number in SIGNALS}
    handlers: dict[int, Handler] = {
        number: handler for number, handler in found.items() if callable(handler)
    }
    if threading.current_thread() is not threading.main_thread() or not handlers:
        yield
        return
    pressed: list[tuple[int, FrameType | None]] = []
    for number in handlers:
        signal.signal(number, lambda number, frame: pressed.append((number, frame)))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number, frame in pressed:
            handlers[number](number, frame)
