"""Signals during a run: the first ends it cleanly, the second at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TypeAlias

from cosim.errors import Interrupted
from cosim.interrupts import REASONS

Check: TypeAlias = Callable[[], None]


@contextmanager
def interruptible() -> Iterator[Check]:
    """Yield a check that raises where the run was interrupted, called after every block.

    Ctrl-C, a request to terminate and a closed terminal so end the run cleanly; a second one does
    what it did before: as a rule it ends the program at once. What is ignored stays ignored, as in
    a program that ``nohup`` started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    received: list[int] = []
    handlers: dict[int, Callable[[int, FrameType | None], object] | int] = {}

    def receive(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) == 1:
            return
        before = handlers[number]
        if callable(before):
            with suppress(KeyboardInterrupt):  # it has no reason
                before(number, frame)
        raise KeyboardInterrupt(REASONS[number])

    def check() -> None:
        if received:
            raise Interrupted(REASONS[received[0]], received[0])

    for number in REASONS:
        before = signal.getsignal(number)
        if before not in (signal.SIG_IGN, None):  # None: not from Python, so not ours to replace
            handlers[number] = before
            signal.signal(number, receive)
    try:
        yield check
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
