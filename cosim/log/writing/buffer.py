"""Rows and messages of a run that wait to be written.

A block costs one copy here, however short it is; the message records are made once per flush.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.contracts import Block


class WaitingMessage(NamedTuple):
    """A message that is not a row."""

    channel_id: int
    time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class RunRows:
    """Consecutive rows of a run."""

    steps: Nanoseconds  # (n,), numbers of the communication steps
    time_ns: Nanoseconds  # (n,)
    values: Matrix  # (n, width)

    def part(self, rows: slice) -> RunRows:
        """Return some of the rows."""
        return RunRows(self.steps[rows], self.time_ns[rows], self.values[rows])


@dataclass(frozen=True, slots=True)
class RunContent:
    """Rows, and messages beside them."""

    rows: RunRows
    messages: Sequence[WaitingMessage] = ()

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to write."""
        return not len(self.rows.steps) and not self.messages

    def reaches(self, time_ns: int) -> bool:
        """Return whether there is a row at a time [ns] or behind."""
        return len(self.rows.steps) > 0 and int(self.rows.time_ns[-1]) >= time_ns

    def pieces(self, rows: int) -> Iterator[RunContent]:
        """Yield it in pieces of so many rows."""
        content = self
        while len(content.rows.steps) > rows:
            piece, content = content.split(int(content.rows.time_ns[rows]))
            yield piece
        yield content

    def split(self, time_ns: int) -> tuple[RunContent, RunContent]:
        """Return what is before a time [ns], and what is at it or behind."""
        row = int(np.searchsorted(self.rows.time_ns, time_ns))
        early: list[WaitingMessage] = []
        late: list[WaitingMessage] = []
        for message in self.messages:
            (early if message.time_ns < time_ns else late).append(message)
        return (
            RunContent(self.rows.part(slice(row)), early),
            RunContent(self.rows.part(slice(row, None)), late),
        )


def joined(contents: Sequence[RunContent]) -> RunContent:
    """Return contents one behind the other."""
    steps = np.concatenate([content.rows.steps for content in contents])
    time_ns = np.concatenate([content.rows.time_ns for content in contents])
    values = np.concatenate([content.rows.values for content in contents])
    messages: list[WaitingMessage] = []
    for content in contents:
        messages += content.messages
    return RunContent(RunRows(steps, time_ns, values), messages)


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
        rows = RunRows(self._steps[taken], self._time_ns[taken], self._values[taken])
        messages = self.messages[self._taken_messages :]
        self._taken_rows = count
        self._taken_messages += len(messages)
        return RunContent(rows, messages)

    def clear_rows(self) -> None:
        """Forget the rows: there is room again."""
        self._count = 0
        self._taken_rows = 0

    def clear(self) -> None:
        """Forget everything."""
        self.clear_rows()
        self.messages = []
        self._taken_messages = 0
