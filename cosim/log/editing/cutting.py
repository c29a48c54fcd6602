"""A span of time of a log, as a log of its own."""

from __future__ import annotations

from pathlib import Path
from typing import final

import numpy as np

from cosim.arrays import Mask, Nanoseconds
from cosim.core.recorded.run import RecordedWindow, span_ns
from cosim.errors import LogError
from cosim.log.contents.result import PARTIAL_STATUS, span_text
from cosim.log.editing.batches import gathered
from cosim.log.editing.copying import PartEnd, write_log
from cosim.log.editing.pieces import read_pieces
from cosim.log.reading.container import Container
from cosim.log.reading.reader import Log, open_log


def cut(
    path: Path,
    start: float | None,
    stop: float | None,
    out: Path,
    *,
    names: tuple[str, str] = ("start", "stop"),
    force: bool = False,
) -> Log:
    """Write the rows and messages in ``start <= t <= stop`` to a log; return it.

    Only chunks that have any of that time are read.

    Parameters
    ----------
    path : Path
    start, stop : float or None
        [s]. None: from the first row on, up to the last one.
    out : Path
    names : tuple of str
        What the times are called in messages.
    force : bool
        Replace a file that stands there.

    Raises
    ------
    UsageError
        If the times are no span.
    LogError
        If the log cannot be read, has no row in that time, or ``out`` cannot be written.
    """
    first_ns, last_ns = span_ns(start, stop, names)
    log = open_log(path)
    pieces = read_pieces(log.path)
    span = _Span(first_ns, last_ns)

    def end(_: str) -> PartEnd:
        if span.first_row is None:
            raise LogError(f"{RecordedWindow(log, first_ns, last_ns).label}: there is no row there")
        steps = pieces.steps_to(span.last_row)
        return PartEnd(
            PARTIAL_STATUS, part_text(span.first_row, span.last_row), steps, span.last_row
        )

    blocks = Container(log.path).blocks(first_ns=first_ns, last_ns=last_ns)
    batches = gathered(blocks, pieces.dtypes, span.has)
    return write_log(out, pieces, batches, end, force=force)


@final
class _Span:
    """Says which messages are in a span of time, and keeps which rows of it there are."""

    def __init__(self, first_ns: int | None, last_ns: int | None) -> None:
        self._first_ns = first_ns
        self._last_ns = last_ns
        self.first_row: int | None = None
        self.last_row = 0

    def has(self, number: int, time_ns: Nanoseconds, contents: list[bytes] | None) -> Mask:
        """Return which of some messages are in it."""
        inside = np.ones(len(time_ns), np.bool_)
        if self._first_ns is not None:
            inside &= time_ns >= self._first_ns
        if self._last_ns is not None:
            inside &= time_ns <= self._last_ns
        if contents is None and inside.any():
            own = time_ns[inside]
            first = int(own.min())
            self.first_row = first if self.first_row is None else min(first, self.first_row)
            self.last_row = max(int(own.max()), self.last_row)
        return inside


def part_text(first_ns: int, last_ns: int) -> str:
    """Return which part of a run some rows are, in words."""
    return f"the part {span_text(first_ns, last_ns)}"
