"""Some rows of a run, and the jumps between them, in memory that does not grow without bound."""

from __future__ import annotations

from typing import Final

import numpy as np

from cosim.arrays import Mask, Matrix, Nanoseconds, Vector
from cosim.core.contracts import Block
from cosim.core.recording import SignalEvent

JUMP: Final = 4.0  # times as much as the steps before and after it: what changes at once
SIGNIFICANT_JUMP: Final = 1e-6  # of the range of a signal
SEVERAL: Final = 8  # jumps in the last quarter of a step by chance: one in 65536
ABOUT: Final = 0.1  # of the largest one
QUARTERS: Final = 4  # steps of the finest run in one of the run that is certified


class ThinnedRows:
    """Keeps every n-th row of a run, and the last one that its clock has.

    Parameters
    ----------
    every : int
        Communication steps between two rows that are kept.
    steps : int
        Communication steps of the run.

    Attributes
    ----------
    end_ns : int
        The last instant of the run [ns], kept or not.
    """

    def __init__(self, every: int, steps: int) -> None:
        self._every = every
        self._steps = steps
        self._rows: list[Matrix] = []
        self._times: list[Nanoseconds] = []
        self.end_ns = 0

    def take(self, block: Block, signals: Matrix) -> None:
        """Keep the rows that are due."""
        self.end_ns = int(block.time_ns[-1])
        first = 0 if block.index == 0 and not self._rows else 1
        rows = np.arange(first, block.steps + 1)
        numbers = block.index + rows
        due = rows[(numbers % self._every == 0) | (numbers == self._steps)]
        self._rows.append(signals[due])
        self._times.append(block.time_ns[due])

    @property
    def rows(self) -> Matrix:
        """The rows that were kept, shape (N, width)."""
        return np.concatenate(self._rows)

    @property
    def time_ns(self) -> Nanoseconds:
        """Their instants [ns], shape (N,)."""
        return np.concatenate(self._times)


class JumpWatch:
    """Finds what changes within one step of a run as it does in none beside it.

    A signal whose steps are small enough changes in each about as much as in those before and after
    it. Where it changes more than ``JUMP`` times as much as in any of the ``QUARTERS`` steps before
    and after, it jumps, or the step does not resolve what happens. So many, as a change of noise,
    which comes with every step of the run that is certified, may be small once.

    Parameters
    ----------
    watched : Mask, shape (width,)
        Columns of a row.
    may_jump : Mask, shape (width,)
        Which of them may jump at ends of steps of the run that is certified.

    Attributes
    ----------
    expected_ns : set of int
        Instants [ns] at which signals jump by actions. The row there has the values before, so that
        the jump is in the step that follows; at a communication point of the run that is certified
        it is none that such a run could miss.
    """

    def __init__(self, watched: Mask, may_jump: Mask) -> None:
        self.expected_ns: set[int] = set()
        self._columns = np.flatnonzero(watched)
        self._may_jump = may_jump[watched]
        width = len(self._columns)
        # The largest jumps, and when: within a step of the run that is certified, and in the last
        # quarter of one, as a jump at its end is; of the latter several, the smallest first.
        self._within = np.zeros(width)
        self._within_ns = np.zeros(width, np.int64)
        self._at_ends = np.zeros((SEVERAL, width))
        self._at_ends_ns = np.zeros(width, np.int64)
        self._smallest = np.full(width, np.inf)
        self._largest = np.full(width, -np.inf)
        # of the steps before the next block
        self._changes = np.zeros((2 * QUARTERS, width))
        self._times = np.zeros(2 * QUARTERS, np.int64)
        self._numbers = np.ones(2 * QUARTERS, np.int64)

    def unexpected(self) -> dict[int, tuple[int, bool]]:
        """Return by column when it jumps elsewhere than it may [ns], and whether within a step.

        Of several jumps at ends of about one size all are there: were their instants any, a part of
        them would be within.
        """
        with np.errstate(over="ignore"):
            significant = SIGNIFICANT_JUMP * np.maximum(self._largest - self._smallest, 0.0)
        are_regular = self._at_ends[0] > ABOUT * self._at_ends[-1]
        within = self._within > significant
        at_ends = (self._at_ends[-1] > significant) & ~(self._may_jump | are_regular)
        times_ns = np.where(within, self._within_ns, self._at_ends_ns)
        found = np.flatnonzero(within | at_ends)
        return {int(self._columns[i]): (int(times_ns[i]), bool(within[i])) for i in found}

    def expect(self, event: SignalEvent) -> None:
        """Note the instant of an event: signals jump there as they should, behind the row."""
        if event.cause != "jump":
            self.expected_ns.add(event.time_ns)

    def take(self, block: Block, signals: Matrix) -> None:
        """Look at the next rows."""
        signals = signals[:, self._columns]
        self._smallest = np.fmin(self._smallest, np.fmin.reduce(signals))
        self._largest = np.fmax(self._largest, np.fmax.reduce(signals))
        with np.errstate(over="ignore", invalid="ignore"):  # of a run that leaves all bounds
            changes = np.nan_to_num(np.abs(np.diff(signals, axis=0)))
        changes = np.vstack([self._changes, changes])
        times = np.concatenate([self._times, block.time_ns[1:]])
        numbers = np.concatenate([self._numbers, block.index + np.arange(1, block.steps + 1)])
        self._changes = changes[-2 * QUARTERS :]
        self._times = times[-2 * QUARTERS :]
        self._numbers = numbers[-2 * QUARTERS :]
        inner = slice(QUARTERS, -QUARTERS)
        jumps = _isolated(changes)
        if self.expected_ns:
            starts = times[QUARTERS - 1 : -QUARTERS - 1]
            is_expected = np.isin(starts, list(self.expected_ns))
            jumps[is_expected & (numbers[inner] % QUARTERS == 1)] = 0.0
        is_end = numbers[inner] % QUARTERS == 0
        _keep(jumps[~is_end], times[inner][~is_end], self._within, self._within_ns)
        _keep(jumps[is_end], times[inner][is_end], self._at_ends[-1].copy(), self._at_ends_ns)
        self._at_ends = np.sort(np.vstack([self._at_ends, jumps[is_end]]), axis=0)[-SEVERAL:]


def _isolated(changes: Matrix) -> Matrix:
    """Return those changes that are larger than all around them, 0 for the others.

    Of the first and the last, around which not all are known, there is nothing.
    """
    inner = changes[QUARTERS:-QUARTERS]
    largest = np.zeros_like(inner)
    for shift in range(2 * QUARTERS + 1):
        if shift != QUARTERS:
            np.maximum(largest, changes[shift : shift + len(inner)], out=largest)
    isolated: Matrix = np.where(inner / JUMP > largest, inner, 0.0)
    return isolated


def _keep(jumps: Matrix, times: Nanoseconds, largest: Vector, instants: Nanoseconds) -> None:
    """Keep the largest jump of each column, and its instant."""
    if len(jumps):
        rows = jumps.argmax(axis=0)
        candidates = jumps.max(axis=0)
        larger = candidates > largest
        largest[larger] = candidates[larger]
        instants[larger] = times[rows][larger]
