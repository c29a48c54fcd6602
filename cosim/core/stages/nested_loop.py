"""A loop in which some components take substeps, and others keep to communication steps.

::

    for every communication step:
        the early components advance
        every stage of those between advances, in substeps where it is a loop
        the late components advance; outputs that follow them at once are evaluated again

Which components are early or late: :mod:`cosim.core.structure.substeps`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

from cosim.arrays import Matrix, read_only
from cosim.core.contracts import Block
from cosim.core.stages.coupling import (
    Advancing,
    Cut,
    NestedStages,
    OperationName,
    check_finite,
    gather,
    perform,
    with_limits,
)
from cosim.core.stages.member import END, Member
from cosim.core.structure.order import OperationKind


@final
class NestedLoop:
    """Advances a loop with stages of its own.

    Parameters
    ----------
    members : sequence of Member
        The components of the loop.
    order : sequence of (OperationKind, str)
        The operations of a step.
    nested : NestedStages
    stages : sequence of Advancing
        Advance its stages.
    """

    def __init__(
        self,
        members: Sequence[Member],
        order: Sequence[tuple[OperationKind, str]],
        nested: NestedStages,
        stages: Sequence[Advancing],
    ) -> None:
        by_name = {member.name: member for member in members}
        self._members = members
        self._late = [member for member in members if member.name in nested.late]
        self._stages = stages
        self._early: list[tuple[OperationName, Member]] = []
        self._behind: list[tuple[OperationName, Member]] = []
        for kind, name in order:
            member = by_name[name]
            operations = [(operation, member) for operation in with_limits(kind, member)]
            if kind == "refresh" or name in nested.late:
                self._behind += operations
            elif name in nested.early:
                self._early += operations
            else:
                self._behind += operations[1:]  # it has advanced

    def advance(self, block: Block, signals: Matrix) -> None:
        """Fill rows 1 to K of its columns; see :class:`cosim.core.stages.coupling.Advancing`."""
        for k in range(block.steps):
            step = block.part(k, k + 1)
            try:
                self._advance(step, signals[k : k + 2])
                check_finite(self._members, step, signals[k : k + 2])
            except Cut as cut:
                raise Cut(k + cut.steps, cut.error, cut.component) from cut

    def _advance(self, step: Block, rows: Matrix) -> None:
        for member in self._late:  # they hold their outputs until they advance
            member.keep_outputs(rows)
        ended: Cut | None = None
        for kind, member in self._early:
            ended = self._perform(kind, member, step, rows) or ended
        for stage in self._stages:
            try:
                stage.advance(step, rows)
            except Cut as cut:
                if not cut.steps:
                    raise
                ended = cut
        for kind, member in self._behind:
            ended = self._perform(kind, member, step, rows) or ended
        # What is recorded as applied at the end of the step is what the sources gave there at last.
        for member in self._members:
            member.gather(rows, END)
        if ended is not None:
            raise ended

    def _perform(
        self, kind: OperationName, member: Member, step: Block, rows: Matrix
    ) -> Cut | None:
        """Advance a component, or evaluate its outputs; return what ends the run with this step.

        Raises
        ------
        Cut
            If it does not complete the step.
        """
        if kind == "right" and not member.reads_jumps(rows):
            return None
        gather(kind, member, rows)
        _, stop = perform(kind, member, step.time, step.h, rows, read_only(rows))
        if stop is None:
            return None
        cut = Cut(stop.steps, stop, member.name)
        if not stop.steps:
            raise cut from stop
        return cut
