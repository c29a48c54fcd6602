"""A communication step that a loop takes in parts, with the values that drive it in each part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.clock import Standstill
from cosim.core.contracts import Block
from cosim.core.stages.member import Member
from cosim.core.stages.spans import Span
from cosim.instants import duration, last_nanosecond


@dataclass(frozen=True, slots=True)
class OutsideColumns:
    """The columns of a row that drive a loop from outside.

    Between communication points those of ``linear`` are interpolated, those of ``start`` keep their
    values from the start of the step, those of ``end`` have them from its end. Those of ``jumping``
    have left limits at its end, in ``limits``.
    """

    linear: NDArray[np.intp]
    start: NDArray[np.intp]
    end: NDArray[np.intp]
    jumping: NDArray[np.intp]
    limits: NDArray[np.intp]


@final
class DividedStep:
    """A communication step: a block of one step, and its rows, of which the second is filled."""

    def __init__(self, block: Block, signals: Matrix) -> None:
        self.block = block
        self.signals = signals
        self.begin, self.end = block.time.tolist()
        self.standstill = Standstill(self.begin)
        first_ns, last_ns = block.time_ns.tolist()
        self.span = Span(self.begin, self.end, first_ns, last_ns, is_step=True)

    def rows(
        self, begin: float, end: float, row: Vector, outside: OutsideColumns
    ) -> tuple[Block, Matrix]:
        """Return a part of the step, between two times in it [s], as a block with its rows.

        The first one is ``row``; the second has what drives the loop from outside.
        """
        time_ns = np.array([last_nanosecond(begin), last_nanosecond(end)])
        block = Block(self.block.index, time_ns, np.array([begin, end]), duration(begin, end))
        rows = np.array([row, row])
        self._drive(rows[1], end, outside)
        return block, rows

    def _drive(self, row: Vector, end: float, outside: OutsideColumns) -> None:
        first, last = self.signals
        if end == self.end:
            for columns in (outside.linear, outside.start, outside.end, outside.limits):
                row[columns] = last[columns]
            return
        left = last.copy()
        left[outside.jumping] = last[outside.limits]
        linear = outside.linear
        fraction = duration(self.begin, end) / self.block.h
        row[linear] = first[linear] + fraction * (left[linear] - first[linear])
        row[outside.start] = first[outside.start]
        row[outside.end] = left[outside.end]
        row[outside.limits] = row[outside.jumping]


def kept_columns(members: Sequence[Member]) -> NDArray[np.intp]:
    """Return the columns that are kept of a substep: of all components, then their left limits."""
    columns = [member.column_numbers for member in members]
    return np.concatenate([*columns, limit_columns(members)])


def limit_columns(members: Sequence[Member]) -> NDArray[np.intp]:
    """Return the columns of the left limits of outputs that jump."""
    limits = [member.jumps.own_limits for member in members if member.jumps is not None]
    return np.concatenate([np.empty(0, np.intp), *limits])
