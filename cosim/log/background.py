"""Rows and messages written by a thread of their own, while the run goes on.

A run that is faster than the disk waits; nothing is dropped. What a run that pauses has recorded is
written after the flush interval all the same, and so is what it has computed of a block under way,
such as one in which an FMU hangs.

No lock is held while rows are copied, which an interrupt could leave locked: the run only appends
to the buffer that it fills, and the thread reads what has been appended. But for a block under way:
there the thread appends too, and interrupts wait for the copy. Full buffers go to the
thread through one queue, and come back through another.

A block costs one copy here, however short it is; the message records are made once per flush.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Final, NamedTuple, final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.contracts import Block
from cosim.core.recording import RowsUnderWay
from cosim.interrupts import uninterrupted


class WaitingMessage(NamedTuple):
    """A message that is not a row."""

    channel_id: int
    time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class RunContent:
    """Consecutive rows of a run, and messages beside them."""

    steps: Nanoseconds  # (n,), numbers of the communication steps
    time_ns: Nanoseconds  # (n,)
    values: Matrix  # (n, width)
    messages: Sequence[WaitingMessage] = ()

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to write."""
        return not len(self.steps) and not self.messages

    def pieces(self, rows: int) -> Iterator[RunContent]:
        """Yield it in pieces of so many rows."""
        content = self
        while len(content.steps) > rows:
            piece, content = content.split(int(content.time_ns[rows]))
            yield piece
        yield content

    def split(self, time_ns: int) -> tuple[RunContent, RunContent]:
        """Return what is before a time [ns], and what is at it or behind."""
        row = int(np.searchsorted(self.time_ns, time_ns))
        early = [message for message in self.messages if message.time_ns < time_ns]
        late = [message for message in self.messages if message.time_ns >= time_ns]
        return (
            RunContent(self.steps[:row], self.time_ns[:row], self.values[:row], early),
            RunContent(self.steps[row:], self.time_ns[row:], self.values[row:], late),
        )


def joined(contents: Sequence[RunContent]) -> RunContent:
    """Return contents one behind the other, in memory of their own."""
    return RunContent(
        np.concatenate([content.steps for content in contents]),
        np.concatenate([content.time_ns for content in contents]),
        np.concatenate([content.values for content in contents]),
        [message for content in contents for message in content.messages],
    )


@final
class RowBuffer:
    """Room for the rows of one flush, appended to by one thread and taken by another.

    Parameters
    ----------
    capacity : int
        Number of rows.
    width : int
        Of a row.

    Attributes
    ----------
    messages : list of WaitingMessage
        To be appended to.
    """

    def __init__(self, capacity: int, width: int) -> None:
        self._values = np.empty((capacity, width))
        self._time_ns = np.empty(capacity, dtype=np.int64)
        self._steps = np.empty(capacity, dtype=np.int64)
        self.messages: list[WaitingMessage] = []
        self._count = 0
        self._taken_rows = 0
        self._taken_messages = 0

    @property
    def is_full(self) -> bool:
        """Whether there is no room for another row."""
        return self._count == len(self._steps)

    def append(self, block: Block, signals: Matrix, start: int) -> int:
        """Copy the rows of a block from ``start`` on, as many as there is room for.

        Returns
        -------
        int
            The row of the block to go on at.
        """
        room = len(self._steps) - self._count
        stop = min(start + room, block.steps + 1)
        new_count = self._count + stop - start
        target = slice(self._count, new_count)
        self._values[target] = signals[start:stop]
        self._time_ns[target] = block.time_ns[start:stop]
        self._steps[target] = np.arange(block.index + start, block.index + stop)
        # Last: what is counted may be taken, and an interrupt before leaves the buffer as it was.
        self._count = new_count
        return stop

    def take(self) -> RunContent:
        """Return what has been appended since the last time: the buffer's own memory."""
        count = self._count
        taken = slice(self._taken_rows, count)
        messages = self.messages[self._taken_messages :]
        self._taken_rows = count
        self._taken_messages += len(messages)
        return RunContent(self._steps[taken], self._time_ns[taken], self._values[taken], messages)

    def clear(self) -> None:
        """Forget what was taken: there is room again."""
        self._count = 0
        self._taken_rows = 0
        del self.messages[: self._taken_messages]
        self._taken_messages = 0


FLUSH_INTERVAL: Final = 1.0  # s of wall time
_BUFFERS: Final = 3  # one that is filled, one that is written, one between them
_MOST_MESSAGES: Final = 10_000  # in a buffer
_PATIENCE: Final = 0.05  # s, for which an interrupt may have to wait
_SHORTEST: Final = 1e-3  # s between two looks at the buffer that is filled


@final
class BackgroundWriter:
    """Hands contents to a function, one after another, in a thread.

    Parameters
    ----------
    add : callable
        Writes a content; called in the thread.
    capacity, width : int
        Rows of a buffer, and their elements.
    interval : float
        The longest that a row waits for others to be written with it [s].
    """

    def __init__(
        self,
        add: Callable[[RunContent], None],
        *,
        capacity: int,
        width: int,
        interval: float,
    ) -> None:
        self._add = add
        self._capacity = capacity
        self._width = width
        self._interval = max(interval, _SHORTEST)
        self._filling: RowBuffer | None = RowBuffer(capacity, width)  # None: all are full
        self._made = 1
        self._free: SimpleQueue[RowBuffer] = SimpleQueue()
        self._full: SimpleQueue[RowBuffer | None] = SimpleQueue()  # None: no more will come
        self._error: BaseException | None = None
        self._thread: threading.Thread | None = None
        self._under_way: RowsUnderWay | None = None
        self._next = 0  # where rows are followed: the first one that is not in a buffer
        self._copying = threading.Lock()

    def follow(self, rows: RowsUnderWay) -> None:
        """Take what is computed of a block under way where it waits for the flush interval."""
        self._under_way = rows

    def write(self, block: Block, signals: Matrix, row: int) -> None:
        """Take the rows of a block from ``row`` on.

        Raises
        ------
        Exception
            What an earlier content could not be written for.
        """
        while row <= block.steps:
            buffer = self._room()
            if self._under_way is None:
                row = buffer.append(block, signals, row)
            else:
                with uninterrupted(), self._copying:
                    row = self._append(buffer, block, signals, row)
            if buffer.is_full:
                self._hand_over(buffer)

    def _append(self, buffer: RowBuffer, block: Block, signals: Matrix, row: int) -> int:
        """Copy the rows from ``row`` on that are in no buffer; return the row to go on at."""
        row = max(row, self._next - block.index)
        if row <= block.steps:
            row = buffer.append(block, signals, row)
            self._next = block.index + row
        return row

    def _append_under_way(self, buffer: RowBuffer, rows: RowsUnderWay) -> None:
        """Copy what is computed of the block under way, once there are rows before it.

        Not into a buffer that was handed over meanwhile: later rows may be in the next one.
        """
        with self._copying:
            if self._filling is not buffer:
                return
            found = rows()
            if found is not None and self._next > found[0].index:
                self._append(buffer, *found, 1)

    def message(self, message: WaitingMessage) -> None:
        """Take a message.

        Raises
        ------
        Exception
            What an earlier content could not be written for.
        """
        buffer = self._room()
        buffer.messages.append(message)
        if len(buffer.messages) >= _MOST_MESSAGES:
            self._hand_over(buffer)

    def close(self) -> RunContent | None:
        """Wait until everything that was handed over is written, and end the thread.

        Returns
        -------
        RunContent or None
            What has not been written.

        Raises
        ------
        Exception
            What a content could not be written for.
        """
        self.stop()
        if self._error is not None:
            raise self._error
        return None if self._filling is None else self._filling.take()

    def stop(self) -> None:
        """Wait until everything that was handed over is written, or failed; end the thread."""
        self._full.put(None)
        if self._thread is not None:
            self._thread.join()

    def _room(self) -> RowBuffer:
        """Return a buffer that is not full; wait until there is one."""
        if self._error is not None:
            raise self._error
        if self._thread is None:
            self._start()
        if self._filling is not None and self._filling.is_full:  # an interrupt came between
            self._hand_over(self._filling)
        while self._filling is None:
            with uninterrupted():
                self._fill_next()
            if self._error is not None:
                raise self._error
        return self._filling

    def _start(self) -> None:
        with uninterrupted():
            # A daemon: a process that ends without closing its log is not kept alive by it.
            thread = threading.Thread(target=self._run, name="cosim log", daemon=True)
            thread.start()
            self._thread = thread

    def _hand_over(self, buffer: RowBuffer) -> None:
        with uninterrupted(), self._copying:
            self._full.put(buffer)
            self._filling = None

    def _fill_next(self) -> None:
        """Fill a new buffer, or one that has been written; try again later where there is none."""
        try:
            self._filling = self._free.get(timeout=_PATIENCE if self._made == _BUFFERS else 0.0)
        except Empty:
            if self._made < _BUFFERS:
                self._filling = RowBuffer(self._capacity, self._width)
                self._made += 1

    def _run(self) -> None:
        try:
            self._write_until_closed()
        except BaseException as error:  # whatever it is, the run has to end with it
            self._error = error

    def _write_until_closed(self) -> None:
        due = time.monotonic() + self._interval
        while True:
            try:
                buffer = self._full.get(timeout=max(due - time.monotonic(), 0.0))
            except Empty:
                self._write_filling()
                due = time.monotonic() + self._interval
                continue
            if buffer is None:
                return
            self._write(buffer)
            buffer.clear()
            self._free.put(buffer)

    def _write_filling(self) -> None:
        with self._copying:  # a buffer is handed over as a whole
            buffer = self._filling
            if buffer is None or not self._full.empty():
                return  # what was full before it has to be written first
        while self._under_way is not None:
            self._append_under_way(buffer, self._under_way)
            if not buffer.is_full:
                break
            self._write(buffer)  # the run is not there to hand it over
            with self._copying:
                buffer.clear()
        self._write(buffer)

    def _write(self, buffer: RowBuffer) -> None:
        content = buffer.take()
        if not content.is_empty:
            self._add(content)
