"""The terminal of the command line: its streams, its progress, and the signals that it sends."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from time import perf_counter
from types import FrameType
from typing import TYPE_CHECKING, Final, Protocol, TextIO

from cosim.interrupts import INTERRUPTED, REASONS

if TYPE_CHECKING:
    from typing_extensions import Buffer

    from cosim.scenario.recordings.recording import Progress

READER_GONE: Final = 141  # 128 + SIGPIPE: the exit code where the reader of stdout is gone


@contextmanager
def show_progress(hidden: bool) -> Iterator[Progress | None]:
    """Show simulated time, speed relative to real time and remaining time on stderr.

    Nothing is shown where stderr is no terminal.
    """
    if hidden or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.fields[clock]}"),
        BarColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None, clock="", speed="")
        began = perf_counter()
        first: float | None = None

        def update(time: float, end: float) -> None:
            nonlocal first
            if first is None:
                first = time  # after one step, or a fixed block
            elapsed = max(perf_counter() - began, 1e-9)
            clock = f"t = {time:.2f} of {end:g} s"
            speed = f"{(time - first) / elapsed:.3g} x real time"
            bar.update(task, completed=time - first, total=end - first, clock=clock, speed=speed)

        yield update


@contextmanager
def show_count(hidden: bool, what: str) -> Iterator[Callable[[int], None] | None]:
    """Show on stderr how many of something are done, and for how long it has been going on.

    Nothing is shown where stderr is no terminal.
    """
    if hidden or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(f"{what}: 0", total=None)

        def update(count: int) -> None:
            bar.update(task, description=f"{what}: {count}")

        yield update


class ShownMembers(Protocol):
    """Shows how many members of a study are done, or how many of something else of it."""

    def __call__(self, done: int, total: int, failed: int, *, what: str = "members") -> None:
        """Show how many are done, of how many, and how many of them failed."""
        ...


@contextmanager
def show_members(hidden: bool) -> Iterator[ShownMembers | None]:
    """Show on stderr how many members of a study are done, their rate, and the time left.

    What is yielded is called with how many are done, of how many, and how many of them failed;
    then perhaps of something else, which begins a count of its own.
    Nothing is shown where stderr is no terminal.
    """
    if hidden or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.fields[members]}"),
        BarColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None, members="", rate="")
        shown = ""
        began = 0.0
        first = 0

        def update(done: int, total: int, failed: int, *, what: str = "members") -> None:
            nonlocal shown, began, first
            if shown != what:
                bar.reset(task)
                shown = what
                began = perf_counter()
                first = done  # those of an earlier call of the study took no time in this one
            elapsed = max(perf_counter() - began, 1e-9)
            failures = f", {failed} failed" if failed else ""
            members = f"{done} of {total} {what}{failures}"
            rate = f"{(done - first) / elapsed:.3g} a second"
            bar.update(
                task, completed=done - first, total=total - first, members=members, rate=rate
            )

        yield update


def open_standard_streams() -> None:
    """Open those of the descriptors 0 to 2 that are closed, on nothing.

    Else the next file that is opened, such as a log, would be stdout to all C code, and Python has
    no stream where there is no descriptor.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the smallest number that is free
    if sys.stdout is None:
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115  until the end
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115  until the end


def keep_stdout() -> TextIO | None:
    """Keep stdout for data: from here on, what C code prints to descriptor 1 goes to stderr.

    Returns
    -------
    TextIO or None
        The stream that is stdout now; None where Python's stdout is not descriptor 1, or stdout or
        stderr is closed.
    """
    try:
        if sys.stdout.fileno() != 1:
            return None
        sys.stdout.flush()
        data = os.dup(1)
        os.dup2(sys.stderr.fileno(), 1)
    except (AttributeError, OSError, ValueError):  # no stream, no descriptor, or a closed one
        return None
    raw = _Data(data, "w", closefd=False)
    sys.stdout = io.TextIOWrapper(
        io.BufferedWriter(raw), sys.stdout.encoding, sys.stdout.errors, line_buffering=raw.isatty()
    )
    return sys.stdout


class _Data(io.FileIO):
    """Data to a reader; where that has enough, as ``head`` has, the program ends without a word.

    It ends as one that the signal for this ends, so that no code that means something else is seen.
    """

    def write(self, data: Buffer) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            # what is still in buffers would be written at the end of the program
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, self.fileno())
            os.close(nothing)
            raise SystemExit(READER_GONE) from None


@contextmanager
def ended_by_interrupt(*, quietly: bool) -> Iterator[None]:
    """Let Ctrl-C end the program, without a word where that is its ordinary end."""
    try:
        yield
    except KeyboardInterrupt:
        if not quietly:
            raise
        sys.exit(INTERRUPTED)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Turn a request to terminate and a closed terminal into what Ctrl-C does.

    What it has begun is so cleaned up, such as temporary folders. In a run they end that.
    """
    received: list[int] = []

    def receive(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt

    numbers: list[int] = []
    if threading.current_thread() is threading.main_thread():
        numbers += [number for number in REASONS if signal.getsignal(number) == signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, receive)
    try:
        yield
    except SystemExit as end:
        if received and end.code == INTERRUPTED:
            sys.exit(128 + received[0])
        raise
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


class _StandardError(io.TextIOWrapper):
    """Messages to a terminal or a pipe, which may be closed before the end: then they are lost."""

    def write(self, text: str) -> int:
        with suppress(OSError):
            super().write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            super().flush()


def outlive_terminal() -> None:
    """Ignore messages that find the terminal or the pipe closed."""
    stderr = sys.stderr
    if type(stderr) is io.TextIOWrapper:  # what tests have in its place keeps all
        encoding = stderr.encoding
        errors = stderr.errors
        sys.stderr = _StandardError(stderr.detach(), encoding, errors, line_buffering=True)
