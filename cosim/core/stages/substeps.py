"""Substeps: a loop divides its communication steps where the estimated error asks for it.

::

    interval <- the communication step, or the part of it that the last step ended with
    until the end of the communication step:
        coarse <- the loop takes the interval at once, and goes back
        fine   <- the loop takes it in two halves
        where fine differs from coarse by more than is tolerated, and the halves can be halved:
            the loop goes back; interval <- the first half, which is known to be its coarse
        else:
            row <- fine; interval <- the next one, twice as long where the error is small

Between communication points what drives the loop from outside is interpolated linearly, or holds.

The difference of one step and two halves estimates the error of the latter by Richardson's
extrapolation (E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
section II.4): ``(fine - coarse) / (2**p - 1)`` for a loop of order p, of all continuous outputs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, final

import numpy as np

from cosim.arrays import Matrix, Vector, read_only
from cosim.core.contracts import Block, Stopped
from cosim.core.recording import Substep
from cosim.core.stages.coupling import Advancing, Cut, OperationName, call
from cosim.core.stages.member import END, Member
from cosim.core.stages.substep_control import (
    OutsideColumns,
    RecordedSubsteps,
    Subinterval,
    SubstepControl,
)


@final
class _Step:
    """A communication step: a block of one step, and its rows, of which the second is filled."""

    def __init__(self, block: Block, signals: Matrix) -> None:
        self.block = block
        self.signals = signals
        self.begin_ns = int(block.time_ns[0])
        self.step_ns = int(block.time_ns[1]) - self.begin_ns

    def rows(
        self, begin: int, end: int, row: Vector, outside: OutsideColumns
    ) -> tuple[Block, Matrix]:
        """Return a part of the step, between two times in it [ns], as a block with its rows.

        The first one is ``row``; the second has what drives the loop from outside.
        """
        time_ns = np.array([self.begin_ns + begin, self.begin_ns + end])
        block = Block(self.block.index, time_ns, time_ns / 1e9, (end - begin) / 1e9)
        rows = np.array([row, row])
        self._drive(rows[1], end, outside)
        return block, rows

    def _drive(self, row: Vector, end: int, outside: OutsideColumns) -> None:
        first, last = self.signals
        if end == self.step_ns:
            for columns in (outside.linear, outside.start, outside.end, outside.limits):
                row[columns] = last[columns]
            return
        left = last.copy()
        left[outside.jumping] = last[outside.limits]
        linear = outside.linear
        fraction = end / self.step_ns
        row[linear] = first[linear] + fraction * (left[linear] - first[linear])
        row[outside.start] = first[outside.start]
        row[outside.end] = left[outside.end]
        row[outside.limits] = row[outside.jumping]


@final
class SubsteppedLoop:
    """Advances a loop in substeps.

    Parameters
    ----------
    members : sequence of Member
        The components of the loop.
    control : SubstepControl
    advancing : Advancing
        Advances them over communication steps, and so over parts of one.
    """

    def __init__(
        self, members: Sequence[Member], control: SubstepControl, advancing: Advancing
    ) -> None:
        self._control = control
        self._members = members
        self._advancing = advancing
        columns = [np.arange(m.columns.start, m.columns.stop) for m in members]
        limits = [m.jumps.own_limits for m in members if m.jumps is not None]
        self._columns = np.concatenate([*columns, *limits])
        self._limits = np.concatenate([np.empty(0, np.intp), *limits])
        self._cut: Cut | None = None

    def advance(self, block: Block, signals: Matrix) -> None:
        """Fill rows 1 to K of its columns; see :class:`cosim.core.stages.coupling.Advancing`."""
        for k in range(block.steps):
            step = _Step(block.part(k, k + 1), signals[k : k + 2])
            try:
                if self._control.recorded is None:
                    self._advance(step)
                else:
                    self._follow(step, self._control.recorded)
            except Cut as cut:
                raise Cut(k, cut.error, cut.component) from cut

    def _advance(self, step: _Step) -> None:
        control = self._control
        part: Subinterval | None = control.first()
        row = step.signals[0].copy()
        coarse: Vector | None = None
        is_known = False
        while part is not None:
            states = self._save()
            if not is_known:
                coarse = self._take(step, part, row)
                self._restore(states)
            first, second = part.halves
            middle = self._take(step, first, row)
            fine = None if middle is None else self._take(step, second, middle)
            error = self._error(row, coarse, fine)
            if error > 1.0 and control.can_refine(part, step.step_ns):
                self._add(step, part, error)
                self._restore(states)
                part = first
                coarse = middle
                is_known = True
                continue
            if middle is None or fine is None:
                assert self._cut is not None
                raise self._cut
            self._add(step, first, error, middle)
            self._add(step, second, error, fine)
            row = fine
            part = control.next(part, error)
            is_known = False
        step.signals[1, self._columns] = row[self._columns]

    def _follow(self, step: _Step, recorded: RecordedSubsteps) -> None:
        """Take recorded substeps, each with the recorded inputs at both of its ends.

        They are kept with the outputs that are computed now.
        """
        end_ns = step.begin_ns + step.step_ns
        row = step.signals[0]
        for substep in recorded.between(step.begin_ns, end_ns):
            if not substep.accepted:
                self._control.add(substep)
                continue
            begin = substep.begin_ns - step.begin_ns
            block, rows = step.rows(begin, begin + substep.length_ns, row, self._control.outside)
            rows[1, self._columns] = substep.values
            computed = rows[1].copy()
            for member in recorded.live:
                computed[member.outputs] = self._advance_alone(member, block, rows)
                step.signals[1, member.outputs] = computed[member.outputs]
            values = tuple(computed[self._columns].tolist())
            self._control.add(substep._replace(values=values))
            row = rows[1]
        for member in recorded.copied:
            step.signals[1, member.outputs] = self._call(
                "advance", member, step.block, step.signals
            )
        for member in self._members:
            step.signals[1, member.inputs] = row[member.inputs]
        step.signals[1, self._limits] = row[self._limits]

    def _advance_alone(self, member: Member, block: Block, rows: Matrix) -> Vector:
        """Advance a component over a substep of which all signals are known; return its outputs."""
        if not member.reads_jumps(rows):
            return self._call("advance", member, block, rows)
        taken = rows.copy()
        member.gather(taken, END)
        right = taken[1, member.inputs].copy()
        member.gather_left(taken)
        left = taken[1, member.inputs]
        # What does not jump is taken as it was recorded: a loop may have solved for it.
        taken[1, member.inputs] = np.where(left == right, rows[1, member.inputs], left)
        self._call("advance", member, block, taken)
        return self._call("right", member, block, rows)

    def _call(self, kind: OperationName, member: Member, block: Block, rows: Matrix) -> Vector:
        """Advance a component over one step, or evaluate its outputs at the end.

        Raises
        ------
        Cut
            If it stops there, also at its end.
        """
        try:
            return call(kind, member, block.time, block.h, member.inputs_over(read_only(rows)))
        except Stopped as stop:
            raise Cut(0, stop, member.name) from stop

    def _take(self, step: _Step, part: Subinterval, row: Vector) -> Vector | None:
        """Advance the loop over a part; return the row at its end, None where it cannot."""
        begin = part.begin_ns(step.step_ns)
        end = part.end_ns(step.step_ns)
        block, rows = step.rows(begin, end, row, self._control.outside)
        try:
            self._advancing.advance(block, rows)
        except Cut as cut:
            self._cut = cut
            return None
        reached: Vector = rows[1]
        return reached

    def _error(self, row: Vector, coarse: Vector | None, fine: Vector | None) -> float:
        """Return the error that is estimated of the two halves, in units of what is tolerated."""
        if coarse is None or fine is None:
            return math.inf
        compared = self._control.compared
        size = np.fmax(np.abs(row[compared]), np.abs(fine[compared]))
        tolerated = self._control.tolerated(size)
        difference = np.abs(fine[compared] - coarse[compared])
        difference[np.isnan(fine[compared]) & np.isnan(coarse[compared])] = 0.0
        differs = difference != 0.0
        ratios = difference[differs] / tolerated[differs]
        worst = float(ratios.max(initial=0.0))
        if math.isnan(worst):
            return math.inf
        return worst / (2.0**self._control.order - 1.0)

    def _add(self, step: _Step, part: Subinterval, error: float, row: Vector | None = None) -> None:
        """Keep a part that was taken; one without a row was rejected."""
        begin = part.begin_ns(step.step_ns)
        end = part.end_ns(step.step_ns)
        values = () if row is None else tuple(row[self._columns].tolist())
        loop = self._members[0].name
        self._control.add(
            Substep(step.begin_ns + begin, end - begin, loop, error, row is not None, values)
        )

    def _save(self) -> list[Any]:
        return [member.component.save() for member in self._members]

    def _restore(self, states: Sequence[Any]) -> None:
        for member, state in zip(self._members, states, strict=True):
            member.component.restore(state)
