"""How the components of one stage advance over a block.

A cascade is one component: one call. The components of a loop advance step by step. At each step a component's input from a
component that has not reached the end of the step yet is *late*: it keeps its value from the start of the step (first order), and
outputs that feed through from it are evaluated again as soon as it is known. Which inputs are late is fixed before the run:

* Gauss-Seidel: components advance one after the other, those whose feedthrough inputs are known first.
* Jacobi: all inputs from inside the loop are late.

A circle of outputs that are known to feed through to each other is refused. Feedthrough that is unknown counts as there, except
where that would close a circle: there it is taken as not there, and said so (*doubts*). If it is there after all, its output has
been computed with the late input's value from the start of the step.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block, Component, Stopped
from cosim.core.signals import Interface
from cosim.errors import AlgebraicLoopError, RunError
from cosim.units import Conversion

Port = tuple[str, str]  # component, signal
Kind = Literal["advance", "refresh"]
Operation = tuple[Kind, str]
Feeds = dict[str, tuple[str, ...]]  # the inputs that feed through to each output


@dataclass(frozen=True, slots=True)
class Wire:
    """Copies source columns into input columns, through a gain and an offset where there are any, then from unit to unit."""

    to: slice
    source: slice
    gain: Matrix | None
    offset: float
    conversion: Conversion

    @staticmethod
    def of(to: slice, source: slice, gain: NDArray[np.float64], offset: float, conversion: Conversion) -> Wire:
        """Build a wire from a number or a matrix; no map where the gain is 1 and the offset 0."""
        if gain.ndim == 2:
            return Wire(to, source, gain, offset, conversion)
        plain = gain == 1.0 and offset == 0.0
        return Wire(to, source, None if plain else gain * np.eye(to.stop - to.start), offset, conversion)

    def copy(self, signals: Matrix, rows: slice) -> None:
        """Fill the input columns of some rows; sums run in a fixed order, without BLAS."""
        if self.gain is None:
            signals[rows, self.to] = self.conversion(signals[rows, self.source])
            return
        source = signals[rows, self.source]
        for i, gains in enumerate(self.gain):
            total = np.full(len(source), self.offset)
            for j, gain in enumerate(gains):
                if gain != 0.0:
                    total += gain * source[:, j]
            signals[rows, self.to.start + i] = self.conversion(total)


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

    def perform(self, kind: Kind, time: Vector, h: float, rows: Matrix) -> None:
        """Carry out one operation of a loop over one step, from row 0 to row 1."""
        if kind == "advance":
            rows[1:, self.outputs] = self.advance(time, h, rows)
        else:
            rows[1, self.outputs] = self.component.outputs(float(time[1]), rows[1, self.inputs])

    def advance(self, time: Vector, h: float, rows: Matrix) -> Matrix:
        """Let the component advance; its rows must have the shape that its interface promises."""
        y = self.component.advance(time, h, rows[:, self.inputs])
        needed = (len(time) - 1, self.outputs.stop - self.outputs.start)
        if np.shape(y) != needed:
            raise RunError(f"advance gave an array of shape {np.shape(y)}, its interface needs {needed}")
        return y


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
    def warnings(self) -> tuple[tuple[str, str], ...]:
        """What was taken to be so, as (component, text)."""
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
    warnings: tuple[tuple[str, str], ...] = ()

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
            signals[1:, member.outputs] = member.advance(block.time, block.h, signals)
        except RunError as error:
            stop = _stop(error)
            if stop.steps:
                signals[1 : stop.steps + 1, member.outputs] = stop.outputs
            raise stop.at(member.name, float(block.time[stop.steps])) from error


@dataclass(frozen=True, slots=True)
class Loop:
    """Components that influence each other in a circle, advanced step by step in a fixed order of operations."""

    coupling: str
    members: tuple[Member, ...]
    operations: tuple[tuple[Kind, Member], ...]
    late: Mapping[str, frozenset[str]]
    warnings: tuple[tuple[str, str], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The components, in the order they advance."""
        return tuple(member.name for kind, member in self.operations if kind == "advance")

    @property
    def description(self) -> str:
        """For the log."""
        return " ".join([self.coupling, *(m.name if kind == "advance" else f"({m.name})" for kind, m in self.operations)])

    def advance(self, block: Block, signals: Matrix) -> None:
        """Advance step by step."""
        for k in range(block.steps):
            ended = self._step(block.time[k : k + 2], block.h, signals[k : k + 2])
            if ended is not None:
                raise Stopped(np.empty((k + ended.steps, 0)), str(ended), failed=ended.failed)

    def _step(self, time: Vector, h: float, rows: Matrix) -> Stopped | None:
        """Fill row 1; give what ended the run there, with a row of outputs if the step was completed all the same."""
        end = slice(1, 2)
        ended: Stopped | None = None
        for member in self.members:
            rows[1, member.outputs] = rows[0, member.outputs]
        for kind, member in self.operations:
            member.gather(rows, end)
            try:
                member.perform(kind, time, h, rows)
            except RunError as error:
                stop = _stop(error)
                ended = stop.at(member.name, float(time[stop.steps]))
                if not ended.steps:
                    return ended
                rows[1, member.outputs] = ended.outputs[0]
        for member in self.members:
            member.gather(rows, end)
        return ended


def _stop(error: RunError) -> Stopped:
    """Take an error of a component that does not say how far it came as a stop before the first step."""
    return error if isinstance(error, Stopped) else Stopped(np.empty((0, 0)), str(error))


@dataclass(frozen=True, slots=True)
class LoopOrder:
    """How a loop is advanced.

    Parameters
    ----------
    operations : tuple of Operation
    late : mapping of component name to frozenset of str
        Inputs that are known only after the component has advanced.
    doubts : tuple of (component, output, input)
        Where feedthrough is unknown and was taken as not there.
    """

    operations: tuple[Operation, ...]
    late: Mapping[str, frozenset[str]]
    doubts: tuple[tuple[str, str, str], ...]


def order_loop(interfaces: Mapping[str, Interface], sources: Mapping[str, Mapping[str, Port]], *, jacobi: bool) -> LoopOrder:
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
        If outputs are known to feed through to each other in a circle; every port of it is named.
    """
    feeds, doubts = _feedthrough(interfaces, sources)
    order = _Order(feeds, sources)
    if jacobi:
        for name in interfaces:
            order.advance(name, late=order.inside(name))
        for name in interfaces:  # outputs that no late input reaches are right already
            order.known.update((name, o) for o, inputs in feeds[name].items() if not order.late[name].intersection(inputs))
        order.refresh()
    else:
        waiting = list(interfaces)
        while waiting:
            name = min(waiting, key=order.unknown_feedthrough)
            waiting.remove(name)
            order.advance(name, late=frozenset(i for i in order.inside(name) if not order.is_known(name, i)))
            order.settle(name)
            order.refresh()
    return LoopOrder(tuple(order.operations), order.late, doubts)


class _Order:
    """The order of operations of a loop while it is found; ``known``: the outputs at the end of the step that are final."""

    def __init__(self, feeds: Mapping[str, Feeds], sources: Mapping[str, Mapping[str, Port]]) -> None:
        self.feeds, self.sources = feeds, sources
        self.known: set[Port] = set()
        self.operations: list[Operation] = []
        self.late: dict[str, frozenset[str]] = {}

    def inside(self, name: str) -> frozenset[str]:
        return frozenset(i for i, source in self.sources[name].items() if source[0] in self.feeds)

    def is_known(self, name: str, signal: str) -> bool:
        source = self.sources[name][signal]
        return source[0] not in self.feeds or source in self.known

    def unknown_feedthrough(self, name: str) -> int:
        feeding = {i for inputs in self.feeds[name].values() for i in inputs}
        return sum(not self.is_known(name, signal) for signal in feeding)

    def advance(self, name: str, *, late: frozenset[str]) -> None:
        self.late[name] = late
        self.operations.append(("advance", name))

    def settle(self, name: str) -> bool:
        """Take the outputs as known whose feedthrough inputs are; say whether any is new."""
        ports = {(name, o) for o, inputs in self.feeds[name].items() if all(self.is_known(name, i) for i in inputs)}
        news = not ports <= self.known
        self.known |= ports
        return news

    def refresh(self) -> None:
        """Evaluate outputs again wherever late inputs have become known, until there is nothing new."""
        progress = True
        while progress:
            progress = False
            for name in self.late:
                if self.settle(name):
                    self.operations.append(("refresh", name))
                    progress = True


def _feedthrough(
    interfaces: Mapping[str, Interface], sources: Mapping[str, Mapping[str, Port]]
) -> tuple[dict[str, Feeds], tuple[tuple[str, str, str], ...]]:
    """Say what feeds through to each output of each component; where that is unknown, all that closes no circle."""
    known = {
        name: {o.name: face.feeds(o.name) if face.knows(o.name) else () for o in face.outputs}
        for name, face in interfaces.items()
    }
    circle = _circle(known, sources)
    if circle:
        raise AlgebraicLoopError(
            f"{' -> '.join('.'.join(port) for port in circle)}: every output here feeds through; put a component with a state of "
            "its own between, such as a lag or a delay"
        )
    feeds = {name: {o.name: face.feeds(o.name) for o in face.outputs} for name, face in interfaces.items()}
    doubts = []
    while circle := _circle(feeds, sources):
        name, signal, output = next(
            (name, a, b)
            for (name, a), (other, b) in pairwise(circle)
            if other == name and a in feeds[name].get(b, ()) and not interfaces[name].knows(b)
        )
        feeds[name][output] = tuple(i for i in feeds[name][output] if i != signal)
        doubts.append((name, output, signal))
    return feeds, tuple(doubts)


def _circle(feeds: Mapping[str, Feeds], sources: Mapping[str, Mapping[str, Port]]) -> list[Port]:
    """Find a circle of ports along feedthrough and connections; give it closed, in the direction of the signals, or nothing."""
    behind: dict[Port, list[Port]] = {}
    for name, outputs in feeds.items():
        behind |= {(name, signal): [source] if source[0] in feeds else [] for signal, source in sources[name].items()}
        behind |= {(name, output): [(name, signal) for signal in inputs] for output, inputs in outputs.items()}
    return find_circle(behind)


def find_circle(behind: Mapping[Port, Collection[Port]]) -> list[Port]:
    """Find a circle among ports, each with those it depends on; give it closed, in the direction of the signals, or nothing."""
    try:
        TopologicalSorter(behind).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []
