"""A loop that repeats recorded substeps, with the recorded inputs at both ends of each."""

from __future__ import annotations

from typing import final

import numpy as np

from cosim.arrays import Matrix, Vector, read_only
from cosim.core.contracts import Block, Stopped
from cosim.core.stages.coupling import Cut, OperationName, Stage, call, keep_limits
from cosim.core.stages.divided_step import DividedStep, kept_columns, limit_columns
from cosim.core.stages.member import END, Member
from cosim.core.stages.substep_control import RecordedSubsteps, SubstepControl


@final
class FollowedLoop:
    """Advances a loop in recorded substeps.

    Parameters
    ----------
    loop : Stage
    control : SubstepControl
    """

    def __init__(self, loop: Stage, control: SubstepControl) -> None:
        members = loop.members
        self._loop = loop
        self._control = control
        self._members = members
        self._refreshed = {name for kind, name in loop.order if kind == "refresh"}
        by_name = {member.name: member for member in members}
        self._in_order = [by_name[name] for kind, name in loop.order if kind == "advance"]
        self._extrapolated = {member.name: _extrapolated(loop, member) for member in members}
        self._gives_others = loop.kept is not None or any(self._extrapolated.values())
        self._columns = kept_columns(members)
        self._limits = limit_columns(members)

    def advance(self, step: DividedStep, recorded: RecordedSubsteps) -> None:
        """Take recorded substeps, each with the recorded inputs at both of its ends.

        They are kept with the outputs that are computed now.
        """
        row = step.signals[0]
        computed = step.signals
        for substep in recorded.between(step.begin, step.end):
            if not substep.accepted:
                self._control.add(substep)
                continue
            block, rows = step.rows(substep.begin, substep.end, row, self._control.outside)
            rows[1, self._columns] = substep.values
            computed = rows.copy()
            given = self._given(rows)
            for member in recorded.live:
                self._advance_alone(member, block, rows, given, computed)
            values = tuple(computed[1, self._columns].tolist())
            self._control.add(substep._replace(values=values))
            row = rows[1]
        for member in recorded.live:
            step.signals[1, member.outputs] = computed[1, member.outputs]
        for member in recorded.copied:
            step.signals[1, member.outputs] = self._call(
                "advance", member, step.block, step.signals
            )
        for member in self._members:
            step.signals[1, member.inputs] = row[member.inputs]
        step.signals[1, self._limits] = computed[1, self._limits]

    def _given(self, rows: Matrix) -> Matrix:
        """Return rows of which the second has the inputs that components advanced with.

        Those that are extrapolated had outputs from the begin of the substep.
        """
        if not self._gives_others:
            return rows
        given = rows.copy()
        for member in self._members:
            member.keep_outputs(given)
        for member in self._in_order:
            member.gather_left(given)
            if self._loop.kept is None:
                given[1, member.outputs] = rows[1, member.outputs]
        return given

    def _advance_alone(
        self, member: Member, block: Block, rows: Matrix, given: Matrix, computed: Matrix
    ) -> None:
        """Advance a component over a substep of which all signals are known.

        Parameters
        ----------
        member : Member
        block : Block
        rows : Matrix, shape (2, width)
            All signals at both ends.
        given : Matrix, shape (2, width)
            The same with the inputs that it advanced with.
        computed : Matrix, shape (2, width)
            Takes its outputs, and the left limits of those that jump.
        """
        if self._loop.kept is not None:
            kept, _ = self._loop.kept.inputs_of(member)
            rows = rows.copy()
            rows[1, kept] = given[1, kept]
        jumps = member.reads_jumps(rows)
        taken = self._with_left_inputs(member, rows) if jumps else rows
        extrapolated = self._extrapolated[member.name]
        if extrapolated:
            taken = taken.copy()
            taken[1, extrapolated] = given[1, extrapolated]
        computed[1, member.outputs] = self._call("advance", member, block, taken)
        failure = keep_limits("advance", member, block.time, computed)
        if failure is not None:
            raise Cut(0, failure, member.name)
        if jumps or (extrapolated and member.name in self._refreshed):
            computed[1, member.outputs] = self._call("right", member, block, rows)

    def _with_left_inputs(self, member: Member, rows: Matrix) -> Matrix:
        """Return rows of which the second has left limits in its inputs, where these jump."""
        taken = rows.copy()
        member.gather(taken, END)
        right = taken[1, member.inputs].copy()
        member.gather_left(taken)
        left = taken[1, member.inputs]
        # What does not jump is taken as it was recorded: a loop may have solved for it.
        taken[1, member.inputs] = np.where(left == right, rows[1, member.inputs], left)
        return taken

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


def _extrapolated(loop: Stage, member: Member) -> list[int]:
    """Return the columns of inputs that a component advances with, but that end otherwise."""
    columns: list[int] = []
    if member.takes_latest:
        for name in loop.extrapolated.get(member.name, ()):
            places = member.channel.signal_columns[name]
            columns += range(places.start, places.stop)
    return columns
