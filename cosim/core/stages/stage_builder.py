"""Stages out of components: which of them form loops, and how each loop advances."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Literal, TypeAlias, final

import numpy as np

from cosim.core.port import Port
from cosim.core.stages.coupling import Cascade, Loop, NestedStages, Stage
from cosim.core.stages.divided_step import OutsideColumns
from cosim.core.stages.member import Member
from cosim.core.stages.substep_control import SubstepControl, SubstepTolerance
from cosim.core.stages.torn_inputs import KeptInputs, TornInputs
from cosim.core.structure.checked_connections import CheckedConnections
from cosim.core.structure.cycles import groups_in_order
from cosim.core.structure.feedthrough import Edge, extrapolation_text
from cosim.core.structure.order import Coupling, order_loop
from cosim.core.structure.substeps import driving_outputs, estimated_outputs, substep_roles
from cosim.core.structure.variability import Variabilities
from cosim.errors import RollbackError, listing

InputInterpolation: TypeAlias = Literal["linear", "zero-order", "latest"]


@dataclass(frozen=True, slots=True)
class LoopMethod:
    """How loops advance; see :class:`cosim.core.Graph`.

    Parameters
    ----------
    coupling : Coupling
    input_interpolation : InputInterpolation
    iterations : int
    substeps : SubstepTolerance or None
    """

    coupling: Coupling
    input_interpolation: InputInterpolation
    iterations: int
    substeps: SubstepTolerance | None


@final
class StageBuilder:
    """Orders components into stages.

    Parameters
    ----------
    members : mapping of component name to Member
    connections : CheckedConnections
    variabilities : Variabilities
    method : LoopMethod
    jumping : collection of Port
        Outputs that may jump at communication points.
    left_limits : mapping of int to int
        The columns of their left limits, by their own.

    Attributes
    ----------
    torn : list of (input Port, source Port)
        The connections that the loops are solved for.
    early_events : list of str
        Components whose outputs are evaluated again behind an event that they keep.
    """

    def __init__(
        self,
        members: Mapping[str, Member],
        connections: CheckedConnections,
        variabilities: Variabilities,
        method: LoopMethod,
        *,
        jumping: Collection[Port],
        left_limits: Mapping[int, int],
    ) -> None:
        self.torn: list[Edge] = []
        self.early_events: list[str] = []
        self._members = members
        self._connections = connections.by_port
        self._parts = connections.parts
        self._sources = connections.sources
        self._ports = connections.ports
        self._variabilities = variabilities
        self._method = method
        self._jumping = jumping
        self._left_limits = left_limits

    def stages(self, components: Iterable[str]) -> tuple[Stage, ...]:
        """Return the strongly connected ones of some components, as stages in topological order.

        What drives them from elsewhere does not matter.

        Raises
        ------
        RollbackError
            If the components of a loop cannot be coupled so.
        AlgebraicLoopError
            If there is a discrete signal in a cycle of outputs that feed through to each other.
        """
        drivers = {name: self._drivers(name) for name in components}
        for name, own in drivers.items():
            drivers[name] = own & drivers.keys()
        stages: list[Stage] = []
        for names in groups_in_order(drivers):
            first = names[0]
            if len(names) == 1 and first not in drivers[first]:
                stages.append(Cascade(self._members[first]))
            else:
                stages.append(self._loop(names))
        return tuple(stages)

    def _drivers(self, name: str) -> set[str]:
        """Return the components that drive an input of this one."""
        drivers: set[str] = set()
        for ports in self._sources[name].values():
            drivers.update(port.component for port in ports)
        return drivers

    def _loop_note(self, name: str, loop: Sequence[str]) -> str:
        """Return which loop a component is in, and by which connections."""
        names = frozenset(loop)
        driving = []
        for signal in self._members[name].channel.interface.inputs:
            for part in self._parts[Port(name, signal.name)]:
                sources = self._connections[part].sources
                inside = [str(port) for port in sources if port.component in names]
                if inside:
                    driving.append(f"{', '.join(inside)} -> {part}")
        return (
            f"it is in the loop of {listing(loop)}, by {'; '.join(driving)}, coupled by "
            f"'{self._method.coupling}'"
        )

    def _loop(self, names: list[str]) -> Loop:
        """Return the components of a cycle as a loop."""
        interfaces = {name: self._members[name].channel.interface for name in names}
        sources = {name: self._sources[name] for name in names}
        held: set[Edge] = set()
        if self._method.input_interpolation != "latest":
            held = self._variabilities.held_connections(names)
        iterates = self._method.coupling == "newton" or self._method.iterations > 1
        order = order_loop(
            interfaces,
            sources,
            coupling=self._method.coupling,
            iterates=iterates,
            held=held,
            jumping=self._jumping,
        )
        members = [self._members[name] for name in names]
        operations = [(kind, self._members[name]) for kind, name in order.operations]
        warnings = [(unknown.component, str(unknown)) for unknown in order.unknown]
        if order.algebraic and not order.torn:
            warnings.append((order.algebraic[0].component, extrapolation_text(order.algebraic)))
        torn: TornInputs | None = None
        if order.torn:
            iterations = 0 if self._method.coupling == "newton" else self._method.iterations
            torn = TornInputs(order.torn, members, self._ports, iterations)
        kept = None
        if self._method.coupling == "jacobi" and torn is None:
            kept = KeptInputs(order.kept, members, self._ports)
        for member in members:
            member.note = self._loop_note(member.name, names)
        loop = Loop(
            self._method.coupling,
            tuple(members),
            tuple(operations),
            order.extrapolated,
            order.broken,
            tuple(warnings),
            torn,
            kept,
            self._lags(members),
        )
        if self._method.substeps is not None:
            loop = self._with_substeps(loop, self._method.substeps)
        if loop.nested is not None:
            return loop
        if order.torn:
            _check_rollback(members)
            self.torn += order.torn
        refreshed = dict.fromkeys(name for kind, name in order.operations if kind == "refresh")
        self.early_events += [name for name in refreshed if interfaces[name].keeps_events]
        return loop

    def _with_substeps(self, loop: Loop, tolerance: SubstepTolerance) -> Loop:
        """Return a loop that takes substeps, as far as its components can.

        Raises
        ------
        RollbackError
            If some neither can nor need not.
        """
        interfaces = {member.name: member.channel.interface for member in loop.members}
        sources = {name: self._sources[name] for name in interfaces}
        roles = substep_roles(interfaces, sources, self._variabilities.of)
        if not (roles.early or roles.late):
            return replace(loop, controls=(self._substep_control(tolerance, loop),))
        stages = self.stages(roles.taking)
        extrapolated: dict[str, frozenset[str]] = {}
        warnings: list[tuple[str, str]] = []
        controls: list[SubstepControl] = []
        for stage in stages:
            extrapolated.update(stage.extrapolated)
            warnings += stage.warnings
            controls += stage.controls
        return replace(
            loop,
            extrapolated=extrapolated,
            warnings=tuple(warnings),
            controls=tuple(controls),
            nested=NestedStages(frozenset(roles.early), frozenset(roles.late), stages),
        )

    def _substep_control(self, tolerance: SubstepTolerance, loop: Loop) -> SubstepControl:
        interfaces = {member.name: member.channel.interface for member in loop.members}
        compared: list[int] = []
        nominal: list[float] = []
        estimated = estimated_outputs(interfaces, self._sources, self._variabilities.of)
        for port, signal in estimated.items():
            columns = _numbers(self._ports.output(port).columns)
            compared += [self._left_limits.get(column, column) for column in columns]
            nominal += signal.nominal_values
        driving = driving_outputs(interfaces, self._sources)
        from_outside = [port for port in driving if port.component not in interfaces]
        return SubstepControl(
            tuple(interfaces),
            tolerance,
            1 if loop.is_first_order else 2,
            outside=self._outside_columns(sorted(from_outside, key=str)),
            compared=np.array(compared, np.intp),
            nominal=np.array(nominal),
        )

    def _outside_columns(self, driving: Sequence[Port]) -> OutsideColumns:
        columns: dict[str, list[int]] = {"linear": [], "start": [], "end": []}
        for port in driving:
            how = "linear"
            if self._method.input_interpolation == "zero-order":
                how = "start"
            elif self._variabilities.of(port) == "discrete":
                how = "end" if self._method.input_interpolation == "latest" else "start"
            columns[how] += _numbers(self._ports.output(port).columns)
        linear, start, end = (np.array(numbers, np.intp) for numbers in columns.values())
        limits = self._left_limits
        jumping = [column for column in chain(*columns.values()) if column in limits]
        places = [limits[column] for column in jumping]
        return OutsideColumns(
            linear, start, end, np.array(jumping, np.intp), np.array(places, np.intp)
        )

    def _lags(self, members: Sequence[Member]) -> bool:
        """Return whether something in a loop belongs to the start of a step, or to inside it."""
        if self._method.input_interpolation != "linear":
            return True
        lagging: set[Port] = set()
        for member in members:
            if self._variabilities.takes_latest(member.channel):
                return True
            lagging.update(Port(member.name, name) for name in member.channel.interface.lagging)
        driving = driving_outputs([member.name for member in members], self._sources)
        return not lagging.isdisjoint(driving)


def _check_rollback(members: Sequence[Member]) -> None:
    """Check that the components of a loop that iterates can go back to the start of a step.

    Raises
    ------
    RollbackError
        If some cannot.
    """
    names = [member.name for member in members if not member.channel.interface.rollback]
    if names:
        raise RollbackError(
            "coupling: expected 'gauss-seidel' or 'jacobi' with 1 iteration, got 'newton' or "
            f"several iterations, which repeat steps; {listing(names)} in this loop cannot go "
            "back to the start of a step (rollback is not declared; of an FMU: "
            "canGetAndSetFMUstate)"
        )


def _numbers(columns: slice) -> list[int]:
    return list(range(columns.start, columns.stop))
