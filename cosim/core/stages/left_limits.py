"""Left limits at the ends of steps, where what a component reads jumps.

The row at a communication point has the right limits. Behind the channels it has the left limits of
those continuous outputs that jump and are followed; that of a discrete output is what it had in the
row before. A component takes left limits at the end of a step. Where one of them is no right limit,
its outputs are evaluated again for the right ones. A recorder gets left limits as events.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Block
from cosim.core.recording import Recorder, SignalEvent
from cosim.core.signals import Layout

ColumnNumbers = NDArray[np.intp]
NO_LIMITS: Final[Mapping[int, Vector]] = {}


class JumpColumns:
    """What of a component jumps, by columns of the row.

    Parameters
    ----------
    layout : Layout
    sources : iterable of slice
        Outputs, of whatever component, whose left limits it takes.
    outputs : slice
        Its own.

    Attributes
    ----------
    held : array of int
        Those of its sources that are discrete.
    followed, limits : array of int
        Those that are continuous, and where their left limits stand.
    own, own_limits : array of int
        Those of its own outputs that jump, and where their left limits stand.
    own_places : array of int
        Where they are among all of its outputs.
    """

    def __init__(self, layout: Layout, sources: Iterable[slice], outputs: slice) -> None:
        limits = layout.left_limits
        columns: list[int] = []
        for source in sources:
            columns += range(source.start, source.stop)
        followed = [column for column in columns if column in limits]
        own = [column for column in limits if outputs.start <= column < outputs.stop]
        self.held = _numbers(column for column in columns if column not in limits)
        self.followed = _numbers(followed)
        self.limits = _numbers(limits[column] for column in followed)
        self.own = _numbers(own)
        self.own_limits = _numbers(limits[column] for column in own)
        self.own_places = self.own - outputs.start

    @property
    def has_sources(self) -> bool:
        """Whether it takes left limits."""
        return bool(len(self.held) or len(self.followed))

    def put(self, rows: Matrix) -> Vector:
        """Put left limits into row 1 of two, in the place of right ones; return those."""
        row = rows[1]
        right = np.concatenate([row[self.held], row[self.followed]])
        row[self.held] = rows[0, self.held]
        row[self.followed] = row[self.limits]
        return right

    def put_back(self, rows: Matrix, right: Vector) -> None:
        """Put right limits back."""
        n = len(self.held)
        rows[1, self.held] = right[:n]
        rows[1, self.followed] = right[n:]

    def jumps(self, signals: Matrix) -> Mask:
        """Return at which rows, from row 1 on, a left limit is no right limit; shape (K,)."""
        before = _bits(signals[:-1], self.held)
        after = _bits(signals[1:], self.held)
        left = _bits(signals[1:], self.limits)
        right = _bits(signals[1:], self.followed)
        jumps: Mask = (before != after).any(axis=1) | (left != right).any(axis=1)
        return jumps

    def keep(self, signals: Matrix, left_outputs: Mapping[int, Vector] = NO_LIMITS) -> None:
        """Take outputs as left limits, from row 1 on.

        Parameters
        ----------
        signals : Matrix
        left_outputs : mapping of int to Vector
            The outputs before jumps of its own, to be taken in the place of those of a row, by the
            number of the row counted from row 1.
        """
        signals[1:, self.own_limits] = signals[1:, self.own]
        for place, y in left_outputs.items():
            signals[1 + place, self.own_limits] = y[self.own_places]


def record(recorder: Recorder, layout: Layout, block: Block, rows: Matrix) -> None:
    """Record rows, shape (K+1, row_width), and where continuous outputs jump in them."""
    if not layout.jumping:
        recorder.write(block, rows)
        return
    recorder.write(block, rows[:, : layout.width])
    for event in jumps_in(layout, block, rows):
        recorder.event(event)


def jumps_in(layout: Layout, block: Block, rows: Matrix) -> list[SignalEvent]:
    """Return the jumps of continuous outputs in rows, in the order of time: their left limits."""
    limits = layout.left_limits
    events = []
    for channel in layout.channels:
        for signal in channel.interface.outputs:
            own = channel.signal_columns[signal.name]
            if own.start not in limits:
                continue
            first = limits[own.start]
            left = slice(first, first + signal.size)
            jumps = (_bits(rows[1:], left) != _bits(rows[1:], own)).any(axis=1)
            for row in np.flatnonzero(jumps).tolist():
                time_ns = int(block.time_ns[row + 1])
                values = tuple(rows[row + 1, left].tolist())
                events.append(SignalEvent(time_ns, "jump", f"{channel.name}.{signal.name}", values))
    return sorted(events, key=lambda event: event.time_ns)


def _numbers(columns: Iterable[int]) -> ColumnNumbers:
    return np.array(list(columns), np.intp)


def _bits(rows: Matrix, columns: ColumnNumbers | slice) -> NDArray[np.int64]:
    """Return values by their bits, by which NaN is NaN."""
    return np.ascontiguousarray(rows[:, columns]).view(np.int64)
