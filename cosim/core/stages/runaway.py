"""Loops whose values run away: the coupling multiplies an error, step by step, and hides the rest.

A loop runs away where its largest value has grown by a steady factor of at least ``GROWTH`` in
``WINDOW`` steps, and so in the ``WINDOW`` steps before, to more than ``LIMIT`` times what it began
with. A signal that jumps to a large value and stays there does not, nor does a ramp: their growth
slows down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block
from cosim.core.stages.coupling import Cut
from cosim.core.stages.member import Member
from cosim.errors import RunawayError

WINDOW: Final = 10  # steps, of which the largest value counts: it may oscillate
GROWTH: Final = 1.1  # in these steps
STEADY: Final = 0.95  # of the exponent of the growth in the steps before
LIMIT: Final = 1e12
HISTORY: Final = 3 * WINDOW  # steps that growth is seen in
TINY: Final = float(np.finfo(np.float64).tiny)


@final
class LoopWatch:
    """Looks at the rows of some loops when these have advanced: the last stage of a graph.

    Parameters
    ----------
    loops : sequence of sequence of Member
        The components of each.
    """

    def __init__(self, loops: Sequence[Sequence[Member]]) -> None:
        self._loops = [_WatchedLoop(members) for members in loops]

    def advance(self, block: Block, signals: Matrix) -> None:
        """Cut a block where a loop runs away.

        Raises
        ------
        Cut
            With a RunawayError; the row where it is found is not kept.
        """
        cuts = [loop.cut(block, signals) for loop in self._loops]
        found = [cut for cut in cuts if cut is not None]
        if found:
            raise min(found, key=lambda cut: cut.steps)


class _WatchedLoop:
    """A loop, and its largest values in the steps before.

    Parameters
    ----------
    members : sequence of Member
        Its components.
    """

    def __init__(self, members: Sequence[Member]) -> None:
        self._members = members
        self._columns = np.concatenate([member.column_numbers for member in members])
        nominal = [1.0]
        for member in members:
            for signal in member.channel.signals:
                nominal += signal.nominal_values
        self._scale = max(map(abs, nominal))
        self._peaks = np.empty(0)  # of the last block and HISTORY steps, to that before `_next`
        self._next = 0

    def cut(self, block: Block, signals: Matrix) -> Cut | None:
        """Return where a block ends before it; None: it does not run away there."""
        peaks = self._peaks_of(signals)
        history = np.concatenate([self._known(block.index), peaks])
        self._peaks = history
        self._next = block.index + len(signals)
        if block.index == 0:
            self._scale = max(self._scale, float(history[0]))
        if peaks.max() <= LIMIT * self._scale:
            return None
        growth = _growth(history)[-len(signals) :]
        runs_away = (peaks > LIMIT * self._scale) & (growth > 1.0)
        runs_away[0] = False  # the last row of the block before
        if not runs_away.any():
            return None
        row = int(runs_away.argmax())
        error = self._error(signals[row], float(block.time[row]), float(growth[row]))
        return Cut(row - 1, error, self._members[0].name)

    def _known(self, index: int) -> Vector:
        """Return the largest values of HISTORY steps up to one, as far as they are known.

        It may be taken again: a run goes back to a step, or a session to a state.
        """
        begin = self._next - len(self._peaks)
        if not begin <= index <= self._next:
            return np.empty(0)
        return self._peaks[: index - begin][-HISTORY:]

    def _peaks_of(self, signals: Matrix) -> Vector:
        """Return the largest value of every row; NaN is no value."""
        values = np.abs(signals[:, self._columns])
        peaks: Vector = np.fmax.reduce(values, axis=1, initial=0.0)
        return peaks

    def _error(self, row: Vector, t: float, growth: float) -> RunawayError:
        values = np.nan_to_num(np.abs(row[self._columns]))
        column = int(self._columns[values.argmax()])
        member = next(m for m in self._members if m.columns.start <= column < m.columns.stop)
        return RunawayError(
            f"{member.label(column - member.columns.start)!r} diverges: {row[column]:.3g} at t = "
            f"{t} s, after growth by a steady factor of {growth:.3f} per step to more than "
            f"{LIMIT:g} times the initial scale of its loop; everything before is kept; "
            f'{member.note}; use a smaller step or another coupling, or coupling_check = "warn" '
            "if the system itself is unstable"
        )


def _growth(history: Vector) -> Vector:
    """Return the factor by which values grow in a step, where that is steady; else 1.

    Parameters
    ----------
    history : Vector, shape (N,)

    Returns
    -------
    Vector, shape (N,)
    """
    growth = np.ones(len(history))
    if len(history) < HISTORY:
        return growth
    largest = sliding_window_view(history, WINDOW).max(axis=1)
    exponents = np.log(np.maximum(largest, TINY))
    in_window = exponents[2 * WINDOW :] - exponents[WINDOW:-WINDOW]
    before = exponents[WINDOW:-WINDOW] - exponents[: -2 * WINDOW]
    least = np.maximum(math.log(GROWTH), STEADY * before)
    is_steady = (before > 0.0) & (in_window >= least)
    growth[HISTORY - 1 :] = np.where(is_steady, np.exp(in_window / WINDOW), 1.0)
    return growth
