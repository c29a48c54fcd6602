"""A loop in which some components take substeps, and others keep to communication steps.

::

    for every communication step:
        the early components advance
        every stage of those between advances, in substeps where it is a loop
        the late components advance; outputs that follow them at once are evaluated again

Of a component that has steps of its own - a delay, a sampled controller, an estimator - nothing
happens inside a communication step. It is *early* where what it reads at the end of a step reaches
none of its outputs there; it is *late* where its outputs hold their values over the step, or only
such components read them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import final

from cosim.arrays import Matrix, read_only
from cosim.core.contracts import Block, Stopped
from cosim.core.port import Port
from cosim.core.signals import Interface, Variability
from cosim.core.stages.coupling import (
    Advancing,
    Cut,
    NestedStages,
    OperationName,
    call,
    check_finite,
    keep_limits,
    with_limits,
)
from cosim.core.stages.member import END, Member
from cosim.core.structure.feedthrough import Sources
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
        if kind == "right":
            if not member.reads_jumps(rows):
                return None
            member.gather(rows, END)
        else:
            member.gather_left(rows)
        ended: Cut | None = None
        try:
            u = member.inputs_over(read_only(rows))
            rows[1, member.outputs] = call(kind, member, step.time, step.h, u)
        except Stopped as stop:
            ended = Cut(stop.steps, stop, member.name)
            if not stop.steps:
                raise ended from stop
            rows[1, member.outputs] = stop.outputs[0]
        failure = keep_limits(kind, member, step.time, rows)
        if failure is not None:
            raise Cut(0, failure, member.name)
        return ended


@dataclass(frozen=True, slots=True)
class SubstepRoles:
    """The components of a loop by what they do in its substeps.

    Parameters
    ----------
    taking : tuple of str
        They take substeps.
    early, late : tuple of str
        They advance over whole communication steps, before and behind the substeps.
    unfit : tuple of str
        They can do neither.
    """

    taking: tuple[str, ...]
    early: tuple[str, ...]
    late: tuple[str, ...]
    unfit: tuple[str, ...]


def substep_roles(
    interfaces: Mapping[str, Interface],
    sources: Sources,
    variability: Callable[[Port], Variability],
) -> SubstepRoles:
    """Return what the components of a loop do in its substeps.

    Parameters
    ----------
    interfaces : mapping of component name to Interface
        The components of the loop.
    sources : mapping of component name to mapping of input to tuple of Port
        What drives each input.
    variability : callable
        Of an output.
    """
    taking = [name for name, own in interfaces.items() if own.substeps and own.rollback]
    others = [name for name in interfaces if name not in taking]
    early = [name for name in others if _is_early(interfaces[name])]
    late = [name for name in others if name not in early]
    unfit: list[str] = []
    while True:
        read = _read_continuously(taking + unfit, sources, variability)
        followed = [name for name in late if name in read]
        if not followed:
            break
        unfit += followed
        late = [name for name in late if name not in read]
    return SubstepRoles(tuple(taking), tuple(early), tuple(late), tuple(unfit))


def _is_early(interface: Interface) -> bool:
    """Return whether no output at the end of a step depends on an input there."""
    delayed = interface.input_names <= frozenset(interface.delayed)
    return delayed and not any(interface.feeds(signal.name) for signal in interface.outputs)


def _read_continuously(
    readers: list[str], sources: Sources, variability: Callable[[Port], Variability]
) -> set[str]:
    """Return the components that drive some others with outputs that are not discrete."""
    read: set[str] = set()
    for reader in readers:
        for ports in sources[reader].values():
            read.update(port.component for port in ports if variability(port) != "discrete")
    return read
