"""Write a span of time of a log to a new log."""

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
from cosim.log.editing.pieces import LogPieces, read_pieces
from cosim.log.mcap_file.unfinished import UnfinishedLog
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
    """Write the rows in ``start <= t <= stop`` to a log, with their messages; return it.

    A message between two communication points goes with the rows after it, as the substeps do that
    lead there. Only chunks that have any of that time are read.

    Parameters
    ----------
    path : Path
    start, stop : float or None
        [s]. None: from the first row on, up to the last one.
    out : Path
    names : tuple of str
        What the times are called in messages.
    force : bool
        Replace an existing file.

    Raises
    ------
    UsageError
        If ``start`` is after ``stop``.
    LogError
        If the log cannot be read, has no row in that time, or ``out`` cannot be written or is that
        log.
    """
    first_ns, last_ns = span_ns(start, stop, names)
    target = UnfinishedLog(out, force=force)
    target.check_not_read([path])
    log = open_log(path)
    pieces = read_pieces(log.path)
    messages = _message_span(pieces, first_ns, last_ns)
    span = _Span((first_ns, last_ns), messages)

    def end(_: str) -> PartEnd:
        if span.first_row is None:
            raise LogError(f"{RecordedWindow(log, first_ns, last_ns).label}: no rows in this span")
        steps = pieces.steps_to(span.last_row)
        return PartEnd(
            PARTIAL_STATUS, part_text(span.first_row, span.last_row), steps, span.last_row
        )

    blocks = Container(log.path).blocks(first_ns=messages[0], last_ns=last_ns)
    batches = gathered(blocks, pieces.dtypes, span.has)
    return write_log(target, pieces, batches, end)


def _message_span(
    pieces: LogPieces, first_ns: int | None, last_ns: int | None
) -> tuple[int | None, int | None]:
    """Return from when to when messages go with the rows of a span [ns]."""
    first_message = None
    last_message = None
    if first_ns is not None:
        first_message = pieces.point_before(first_ns - 1) + 1
    if last_ns is not None:
        last_message = pieces.point_before(last_ns)
    return first_message, last_message


@final
class _Span:
    """Says which messages are in a span of time, and keeps which rows of it there are.

    Parameters
    ----------
    rows_ns, messages_ns : (int or None, int or None)
        The first and the last instant of rows, and of other messages [ns]; None: of all.
    """

    def __init__(
        self, rows_ns: tuple[int | None, int | None], messages_ns: tuple[int | None, int | None]
    ) -> None:
        self._rows_ns = rows_ns
        self._messages_ns = messages_ns
        self.first_row: int | None = None
        self.last_row = 0

    def has(self, number: int, time_ns: Nanoseconds, contents: list[bytes] | None) -> Mask:
        """Return which of some messages are in it."""
        first_ns, last_ns = self._rows_ns if contents is None else self._messages_ns
        inside = np.ones(len(time_ns), np.bool_)
        if first_ns is not None:
            inside &= time_ns >= first_ns
        if last_ns is not None:
            inside &= time_ns <= last_ns
        if contents is None and inside.any():
            own = time_ns[inside]
            first = int(own.min())
            self.first_row = first if self.first_row is None else min(first, self.first_row)
            self.last_row = max(int(own.max()), self.last_row)
        return inside


def part_text(first_ns: int, last_ns: int) -> str:
    """Return which part of a run some rows are, in words."""
    return f"the part {span_text(first_ns, last_ns)}"
