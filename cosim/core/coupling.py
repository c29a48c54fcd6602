"""How the components of one stage advance over a block.

A cascade is one component: one call. The components of a loop advance step by step. At each step a component's input from a
component that has not reached the end of the step yet is *late*: it keeps its value from the start of the step (first order), and
outputs that feed through from it are evaluated again as soon as it is known. Which inputs are late is fixed before the run:

* Gauss-Seidel: components advance one after the other, those whose feedthrough inputs are known first.
* Jacobi: all inputs from inside the loop are late.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block, Component, Stopped
from cosim.core.signals import Interface
from cosim.errors import AlgebraicLoopError

Port = tuple[str, str]  # component, signal
Operation = tuple[Literal["advance", "refresh"], str]


@dataclass(frozen=True, slots=True)
class Wire:
    """Copies source columns into input columns, through a gain and an offset where there are any."""

    to: slice
    source: slice
    gain: Matrix | None
    offset: float

    @staticmethod
    def of(to: slice, source: slice, gain: float | tuple[tuple[float, ...], ...], offset: float) -> Wire:
        """Build a wire; a plain copy where the gain is 1 and the offset 0."""
        if isinstance(gain, tuple):
            return Wire(to, source, np.array(gain, np.float64), offset)
        plain = gain == 1.0 and offset == 0.0
        return Wire(to, source, None if plain else gain * np.eye(to.stop - to.start), offset)

    def copy(self, signals: Matrix, rows: slice) -> None:
        """Fill the input columns of some rows; sums run in a fixed order, without BLAS."""
        if self.gain is None:
            signals[rows, self.to] = signals[rows, self.source]
            return
        source = signals[rows, self.source]
        for i, gains in enumerate(self.gain):
            total = np.full(len(source), self.offset)
            for j, gain in enumerate(gains):
                if gain != 0.0:
                    total += gain * source[:, j]
            signals[rows, self.to.start + i] = total


@dataclass(frozen=True, slots=True)
class Member:
    """A component with its columns and the wires that feed it."""

    name: str
    component: Component
    inputs: slice
    outputs: slice
    wires: tuple[Wire, ...]

    def gather(self, signals: Matrix, rows: slice) -> None:
        """Bring the inputs of some rows up to date."""
        for wire in self.wires:
            wire.copy(signals, rows)

    def perform(self, kind: Literal["advance", "refresh"], time: Vector, h: float, rows: Matrix) -> None:
        """Carry out one operation of a loop over one step, from row 0 to row 1."""
        if kind == "advance":
            rows[1:, self.outputs] = self.component.advance(time, h, rows[:, self.inputs])
        else:
            rows[1, self.outputs] = self.component.outputs(float(time[1]), rows[1, self.inputs])


class Stage(Protocol):
    """Advances its components over a block."""

    @property
    def names(self) -> tuple[str, ...]:
        """The components of the stage."""
        ...

    @property
    def late(self) -> Mapping[str, frozenset[str]]:
        """Inputs by component that are known only after the component has advanced."""
        ...

    @property
    def description(self) -> str:
        """For the log."""
        ...

    def advance(self, block: Block, signals: Matrix) -> None:
        """Fill rows 1 to K of its columns. Raises Stopped with the number of rows that are filled."""
        ...


@dataclass(frozen=True, slots=True)
class Cascade:
    """One component outside every loop."""

    member: Member
    late: Mapping[str, frozenset[str]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The component."""
        return (self.member.name,)

    @property
    def description(self) -> str:
        """For the log."""
        return f"cascade {self.member.name}"

    def advance(self, block: Block, signals: Matrix) -> None:
        """Advance the whole block in one call."""
        member = self.member
        member.gather(signals, slice(1, None))
        try:
            signals[1:, member.outputs] = member.component.advance(block.time, block.h, signals[:, member.inputs])
        except Stopped as stop:
            signals[1 : stop.steps + 1, member.outputs] = stop.outputs
            raise stop.at(member.name, float(block.time[stop.steps])) from stop


@dataclass(frozen=True, slots=True)
class Loop:
    """Components that influence each other in a circle, advanced step by step in a fixed order of operations."""

    coupling: str
    members: tuple[Member, ...]
    operations: tuple[Operation, ...]
    late: Mapping[str, frozenset[str]]

    @property
    def names(self) -> tuple[str, ...]:
        """The components, in the order they advance."""
        return tuple(name for operation, name in self.operations if operation == "advance")

    @property
    def description(self) -> str:
        """For the log."""
        return f"{self.coupling} {' '.join(f'{name}' if kind == 'advance' else f'({name})' for kind, name in self.operations)}"

    def advance(self, block: Block, signals: Matrix) -> None:
        """Advance step by step."""
        members = {member.name: member for member in self.members}
        plan = [(kind, members[name]) for kind, name in self.operations]
        end = slice(1, 2)
        for k in range(block.steps):
            rows, time = signals[k : k + 2], block.time[k : k + 2]
            for member in self.members:
                rows[1, member.outputs] = rows[0, member.outputs]
            for kind, member in plan:
                member.gather(rows, end)
                try:
                    member.perform(kind, time, block.h, rows)
                except Stopped as stop:
                    raise Stopped(np.empty((k, 0)), str(stop), failed=stop.failed).at(member.name, float(time[0])) from stop
            for member in self.members:
                member.gather(rows, end)


def order_loop(
    interfaces: Mapping[str, Interface], sources: Mapping[str, Mapping[str, Port]], *, jacobi: bool
) -> tuple[tuple[Operation, ...], dict[str, frozenset[str]]]:
    """Fix the order of operations in a loop, and which inputs are late.

    Parameters
    ----------
    interfaces : mapping of component name to Interface
        The components of the loop.
    sources : mapping of component name to mapping of input to Port
        What drives each input; ports of components outside the loop are known from the start.
    jacobi : bool
        Treat every input from inside the loop as late.

    Raises
    ------
    AlgebraicLoopError
        If outputs feed through to each other in a circle; every port of it is named.
    """
    circle = _algebraic_loop(interfaces, sources)
    if circle:
        raise AlgebraicLoopError(
            f"{' -> '.join(circle)}: every output here feeds through; put a component with a state of its own between, "
            "such as a lag or a delay"
        )
    known: set[Port] = set()
    operations: list[Operation] = []
    late: dict[str, frozenset[str]] = {}
    waiting = list(interfaces)

    def is_known(name: str, signal: str) -> bool:
        source = sources[name][signal]
        return source[0] not in interfaces or source in known

    def unknown_feedthrough(name: str) -> int:
        feeding = {i for output in interfaces[name].outputs for i in interfaces[name].feeds(output.name)}
        return sum(not is_known(name, signal) for signal in feeding)

    def settle(name: str) -> bool:
        ports = {
            (name, o.name) for o in interfaces[name].outputs if all(is_known(name, i) for i in interfaces[name].feeds(o.name))
        }
        news = bool(ports - known)
        known.update(ports)
        return news

    def refresh() -> None:
        progress = True
        while progress:
            progress = False
            for name in [n for kind, n in operations if kind == "advance"]:
                if settle(name):
                    operations.append(("refresh", name))
                    progress = True

    while waiting:
        name = waiting.pop(0) if jacobi else waiting.pop(min(range(len(waiting)), key=lambda i: unknown_feedthrough(waiting[i])))
        inside = {i for i, source in sources[name].items() if source[0] in interfaces}
        late[name] = frozenset(i for i in inside if jacobi or not is_known(name, i))
        operations.append(("advance", name))
        if not jacobi:
            settle(name)
            refresh()
    if jacobi:
        for name in interfaces:  # outputs that no late input reaches are right already
            known.update((name, o.name) for o in interfaces[name].outputs if not set(interfaces[name].feeds(o.name)) & late[name])
        refresh()
    return tuple(operations), late


def _algebraic_loop(interfaces: Mapping[str, Interface], sources: Mapping[str, Mapping[str, Port]]) -> list[str]:
    """Find a circle of ports along feedthrough and connections; give it as text, closed, or nothing."""
    behind: dict[Port, list[Port]] = {}
    for name, interface in interfaces.items():
        for signal, source in sources[name].items():
            behind[name, signal] = [source] if source[0] in interfaces else []
        for output in interface.outputs:
            behind[name, output.name] = [(name, signal) for signal in interface.feeds(output.name)]
    done: set[Port] = set()
    for start in behind:
        path: list[Port] = []

        def visit(port: Port, path: list[Port] = path) -> list[Port]:
            if port in path:
                return [*path[path.index(port) :], port]
            if port in done:
                return []
            path.append(port)
            for other in behind[port]:
                circle = visit(other)
                if circle:
                    return circle
            done.add(path.pop())
            return []

        circle = visit(start)
        if circle:
            return [".".join(port) for port in reversed(circle)]
    return []
