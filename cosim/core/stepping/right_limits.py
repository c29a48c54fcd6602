"""Right limits: what follows at once where inputs jump at a communication point.

An input that is overridden or released jumps. Outputs that feed through from it jump with it, so do
the inputs that these drive, and so on; nothing else does. The ports that may follow are found once
for every set of inputs, in the order of their dependencies, which is that of the initialization.
Ports that depend on each other in a cycle are evaluated until none changes. That is enough where
feedthrough is unknown and not there in truth; else the algebraic loop is solved by Newton's method
(:mod:`cosim.core.initialization.fixed_point`), as at the start of a run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector, read_only
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.initialization.fixed_point import SingularError, iterate, newton
from cosim.core.port import Port
from cosim.core.stages.member import Member, first_non_finite
from cosim.core.structure.cycles import groups_in_order
from cosim.errors import RunError

END: Final = slice(0, 1)  # the only row

GivenOutputs: TypeAlias = Mapping[str, Sequence[tuple[slice, Vector]]]  # by component, with columns

NOTHING_GIVEN: Final[GivenOutputs] = {}


class _Update(NamedTuple):
    """Brings inputs of a member up to date, or some of its outputs; None: its inputs."""

    member: Member
    outputs: tuple[slice, ...] | None


class _Group(NamedTuple):
    """Updates in their order; ``inputs``: the columns of those that a cycle is solved for."""

    ports: tuple[Port, ...]
    updates: tuple[_Update, ...]
    is_cycle: bool
    inputs: NDArray[np.intp]


class _Limit(NamedTuple):
    """A row that becomes the right limit at ``t`` [s], with the outputs that are known of it."""

    t: float
    row: Vector
    given: GivenOutputs

    def perform_all(self, group: _Group) -> None:
        """Perform the updates of a group."""
        if group.is_cycle:
            self._solve(group)
            return
        for update in group.updates:
            self._perform(update)

    def _solve(self, group: _Group) -> None:
        """Solve for the inputs of a cycle: what each is, and what drives it then.

        Raises
        ------
        RunError
            If no solution is found.
        """
        columns = group.inputs
        row = self.row

        def sweep(v: Vector) -> Vector:
            row[columns] = v
            for update in reversed(group.updates):  # outputs, then the inputs that they drive
                self._perform(update)
            return row[columns].copy()

        ports = ", ".join(map(str, group.ports))
        v = row[columns].copy()
        solution = iterate(sweep, v, len(group.ports) + 1)
        if solution is None:
            try:
                candidate = newton(sweep, v, lambda: float(np.abs(row[columns]).max()))
            except SingularError as error:
                reason = "they have no solution, or more than one: 1 - dw/dv is singular"
                raise _unsolved(ports, self.t, reason) from error
            if not candidate.excess <= 1.0:
                reason = f"Newton's method ended with a residual of {candidate.residual:.3g}"
                raise _unsolved(ports, self.t, reason)
            solution = candidate.v
        sweep(solution)

    def _perform(self, update: _Update) -> None:
        row = self.row
        member = update.member
        if update.outputs is None:
            member.gather(row[np.newaxis], END)
            return
        known = self.given.get(member.name)
        if known is not None:
            for columns, values in known:
                row[columns] = values
            return
        try:
            y = member.component.outputs(self.t, read_only(row)[member.inputs])
        except RunError as error:
            raise Stopped(np.empty((0, 0)), str(error)).at(member.name, self.t) from error
        first = member.outputs.start
        for columns in update.outputs:
            row[columns] = y[columns.start - first : columns.stop - first]


class RightLimits:
    """Evaluates what follows the inputs that jump.

    Parameters
    ----------
    graph : Graph
    """

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._members = graph.members
        self._followers: dict[Port, list[Port]] = {}
        for channel in graph.layout.channels:
            for signal in channel.interface.inputs:
                to = Port(channel.name, signal.name)
                for source in graph.sources_of(to):
                    whole = graph.ports.output(source).port
                    self._followers.setdefault(whole, []).append(to)
        self._groups: dict[frozenset[Port], list[_Group]] = {}

    def reach_more(self, jumped: Port) -> bool:
        """Return whether anything else may jump where an input does."""
        return bool(self._ordered(frozenset([jumped])))

    def evaluate(self, t: float, row: Vector, jumped: frozenset[Port], given: GivenOutputs) -> None:
        """Bring a row up to date where inputs have jumped.

        Parameters
        ----------
        t : float
            Time [s].
        row : Vector, shape (width,)
            With the left limits, and the right ones of these inputs; is changed.
        jumped : frozenset of Port
            Whole inputs.
        given : mapping of component name to columns with their values
            Right limits that are known: of recorded components, which are not evaluated.

        Raises
        ------
        Stopped
            If a component cannot be evaluated.
        NonFiniteError
            If a value is not finite.
        RunError
            If values keep changing.
        """
        groups = self._groups.get(jumped)
        if groups is None:
            groups = self._groups[jumped] = self._ordered(jumped)
        if not groups:
            return
        # What is not finite is named by the check; numpy's warnings would say it without a name.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            limit = _Limit(t, row, given)
            for group in groups:
                limit.perform_all(group)
        members = [self._members[name] for name in self._names(groups)]
        bad = first_non_finite(members, row[np.newaxis])
        if bad is not None:
            raise bad.error(t)

    def _names(self, groups: Iterable[_Group]) -> dict[str, None]:
        """Return the components of groups, each once."""
        names: dict[str, None] = {}
        for group in groups:
            names.update(dict.fromkeys(port.component for port in group.ports))
        return names

    def _ordered(self, jumped: frozenset[Port]) -> list[_Group]:
        """Return the updates behind inputs, in the order of their dependencies; none of these."""
        dependencies: dict[Port, list[Port]] = {port: [] for port in jumped}
        waiting = sorted(jumped)
        while waiting:
            port = waiting.pop()
            for follower in self._following(port):
                if follower not in dependencies:
                    dependencies[follower] = []
                    waiting.append(follower)
                dependencies[follower].append(port)
        groups = []
        for ports in groups_in_order(dependencies):
            if not dependencies[ports[0]]:
                continue
            is_cycle = len(ports) > 1 or ports[0] in dependencies[ports[0]]
            inputs = self._input_columns(ports)
            groups.append(_Group(tuple(ports), self._updates(ports), is_cycle, inputs))
        return groups

    def _input_columns(self, ports: Iterable[Port]) -> NDArray[np.intp]:
        """Return the columns of those ports that are inputs."""
        columns: list[int] = []
        for port in ports:
            channel = self._graph.layout[port.component]
            if port.signal in channel.interface.input_names:
                own = channel.signal_columns[port.signal]
                columns += range(own.start, own.stop)
        return np.array(columns, np.intp)

    def _following(self, port: Port) -> list[Port]:
        """Return the ports that a port reaches directly."""
        interface = self._graph.layout[port.component].interface
        if port.signal not in interface.input_names:
            return self._followers.get(port, [])
        reached = []
        for output in interface.outputs:
            if port.signal in interface.feeds(output.name):
                reached.append(Port(port.component, output.name))
        return reached

    def _updates(self, ports: Sequence[Port]) -> tuple[_Update, ...]:
        """Return the updates of ports: of inputs first, of one member at once."""
        inputs: dict[str, None] = {}
        outputs: dict[str, list[slice]] = {}
        for port in ports:
            channel = self._graph.layout[port.component]
            if port.signal in channel.interface.input_names:
                inputs[port.component] = None
            else:
                columns = channel.signal_columns[port.signal]
                outputs.setdefault(port.component, []).append(columns)
        updates = [_Update(self._members[name], None) for name in inputs]
        for name, slices in outputs.items():
            updates.append(_Update(self._members[name], tuple(slices)))
        return tuple(updates)


def _unsolved(ports: str, t: float, reason: str) -> RunError:
    return RunError(
        f"after a jump at t = {t} s, {ports} form an algebraic loop that was not solved: "
        f"{reason}; break the loop with a component that has a state, such as a lag or a delay"
    )
