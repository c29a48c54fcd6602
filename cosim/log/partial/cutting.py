"""A span of time of a log, as a log of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cosim.arrays import Mask, Nanoseconds
from cosim.core.recorded_run import RecordedWindow, span_ns
from cosim.errors import LogError
from cosim.instants import NANOSECONDS
from cosim.log.container import Container
from cosim.log.partial.batches import gathered
from cosim.log.partial.copying import PartEnd, write_log
from cosim.log.partial.pieces import read_pieces
from cosim.log.reader import Log, open_log
from cosim.log.result import PARTIAL_STATUS


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
    window = RecordedWindow(log, first_ns, last_ns)
    first_row = _first_row(window)

    def is_inside(number: int, time_ns: Nanoseconds, contents: list[bytes] | None) -> Mask:
        inside = np.ones(len(time_ns), np.bool_)
        if first_ns is not None:
            inside &= time_ns >= first_ns
        if last_ns is not None:
            inside &= time_ns <= last_ns
        return inside

    blocks = Container(log.path).blocks(first_ns=first_ns, last_ns=last_ns)
    reason = f"the part from {first_row / NANOSECONDS} s to {window.end_ns / NANOSECONDS} s"
    end = PartEnd(PARTIAL_STATUS, reason, window.steps, window.end_ns)
    batches = gathered(blocks, pieces.dtypes, is_inside)
    return write_log(out, pieces, batches, lambda: end, force=force)


def _first_row(window: RecordedWindow) -> int:
    """Return the time of the first row [ns].

    Raises
    ------
    LogError
        If there is none.
    """
    firsts = []
    for name in window.channels:
        for time_ns, _ in window.blocks(name):
            if len(time_ns):
                firsts.append(int(time_ns[0]))
                break
    if not firsts:
        raise LogError(f"{window.label}: there is no row in this time")
    return min(firsts)
