"""The order in which the components of a loop advance, found from what feeds through.

Which inputs are late (:mod:`cosim.core.coupling`) is fixed before the run:

* Gauss-Seidel: components advance one after the other, those whose feedthrough inputs are known first.
* Jacobi: all inputs from inside the loop are late.

A circle of outputs that are known to feed through to each other is refused. Feedthrough that is unknown counts as there, except
where it would close a circle: there it is taken as not there (:class:`UnknownFeedthrough`). If it is there after all, its output has been
computed with the late input's value from the start of the step.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from typing import Literal, TypeAlias

from cosim.core.signals import Interface
from cosim.errors import AlgebraicLoopError

Port: TypeAlias = tuple[str, str]  # component, signal
Behind: TypeAlias = Mapping[Port, Collection[Port]]  # the ports that each port depends on directly
Feeds: TypeAlias = dict[str, tuple[str, ...]]  # the inputs that feed through to each output
OperationKind: TypeAlias = Literal["advance", "refresh"]
Operation: TypeAlias = tuple[OperationKind, str]


@dataclass(frozen=True, slots=True)
class UnknownFeedthrough:
    """Feedthrough of a component that is unknown, and was taken as not there because it would close a circle."""

    component: str
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]

    def __str__(self) -> str:
        outputs, inputs = (
            _some([f"{self.component}.{name}" for name in names])
            for names in (self.outputs, self.inputs)
        )
        return (
            f"{outputs} may depend directly on {inputs} (the FMU does not say): taken as not feeding through; if it does, the "
            "loop is solved with the value of the step before"
        )


@dataclass(frozen=True, slots=True)
class LoopOrder:
    """How a loop is advanced.

    Parameters
    ----------
    operations : tuple of Operation
    late : mapping of component name to frozenset of str
        Inputs that are known only after the component has advanced.
    doubts : tuple of UnknownFeedthrough
    """

    operations: tuple[Operation, ...]
    late: Mapping[str, frozenset[str]]
    doubts: tuple[UnknownFeedthrough, ...]


def order_loop(
    interfaces: Mapping[str, Interface], sources: Mapping[str, Mapping[str, Port]], *, jacobi: bool
) -> LoopOrder:
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
            order.known.update(
                (name, o)
                for o, inputs in feeds[name].items()
                if not order.late[name].intersection(inputs)
            )
        order.refresh()
    else:
        waiting = list(interfaces)
        while waiting:
            name = min(waiting, key=order.unknown_feedthrough)
            waiting.remove(name)
            order.advance(
                name, late=frozenset(i for i in order.inside(name) if not order.is_known(name, i))
            )
            order.settle(name)
            order.refresh()
    return LoopOrder(tuple(order.operations), order.late, doubts)


class _Order:
    """The order of operations of a loop while it is found; ``known``: the outputs at the end of the step that are final."""

    def __init__(
        self, feeds: Mapping[str, Feeds], sources: Mapping[str, Mapping[str, Port]]
    ) -> None:
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
        ports = {
            (name, o)
            for o, inputs in self.feeds[name].items()
            if all(self.is_known(name, i) for i in inputs)
        }
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
) -> tuple[dict[str, Feeds], tuple[UnknownFeedthrough, ...]]:
    """Say what feeds through to each output of each component; where that is unknown, all that closes no circle."""
    known = {
        n: {o.name: face.feeds(o.name) if face.knows(o.name) else () for o in face.outputs}
        for n, face in interfaces.items()
    }
    circle = find_cycle(_behind(known, sources))
    if circle:
        raise AlgebraicLoopError(
            f"{' -> '.join('.'.join(port) for port in circle)}: every output here feeds through; put a component with a state of "
            "its own between, such as a lag or a delay"
        )
    feeds = {
        name: {o.name: face.feeds(o.name) for o in face.outputs}
        for name, face in interfaces.items()
    }
    doubts = []
    while circle := find_cycle(behind := _behind(feeds, sources)):
        name = next(
            a[0]
            for a, b in pairwise(circle)
            if a in behind[b] and a[0] == b[0] and not interfaces[a[0]].knows(b[1])
        )
        cycle_of, outputs = (
            cycles(behind),
            [o for o in feeds[name] if not interfaces[name].knows(o)],
        )
        closing = [
            (o, i)
            for o in outputs
            for i in feeds[name][o]
            if cycle_of[name, i] == cycle_of[name, o]
        ]
        for output in outputs:
            feeds[name][output] = tuple(
                i for i in feeds[name][output] if (output, i) not in closing
            )
        doubts.append(
            UnknownFeedthrough(
                name,
                tuple(dict.fromkeys(o for o, _ in closing)),
                tuple(dict.fromkeys(i for _, i in closing)),
            )
        )
    return feeds, tuple(doubts)


def _behind(
    feeds: Mapping[str, Feeds], sources: Mapping[str, Mapping[str, Port]]
) -> dict[Port, list[Port]]:
    """Give the ports of a loop that each of them follows at once: along connections, and through components."""
    behind: dict[Port, list[Port]] = {}
    for name, outputs in feeds.items():
        behind |= {
            (name, signal): [source] if source[0] in feeds else []
            for signal, source in sources[name].items()
        }
        behind |= {
            (name, output): [(name, signal) for signal in inputs]
            for output, inputs in outputs.items()
        }
    return behind


def find_cycle(behind: Behind) -> list[Port]:
    """Find a circle among ports, each with those it depends on; give it closed, in the direction of the signals, or nothing."""
    try:
        TopologicalSorter(behind).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def cycles(behind: Behind) -> dict[Port, Port]:
    """Give for every port one that stands for all those it depends on and that depend on it (Tarjan, 1972)."""
    number: dict[Port, int] = {}
    least: dict[Port, int] = {}
    found: dict[Port, Port] = {}
    open_ports: list[Port] = []
    for root in behind:
        path = [] if root in number else [(root, iter(behind[root]))]
        while path:
            port, edges = path[-1]
            if port not in number:
                number[port] = least[port] = len(number)
                open_ports.append(port)
            for other in edges:
                if other not in number:
                    path.append((other, iter(behind[other])))
                    break
                if other not in found:
                    least[port] = min(least[port], number[other])
            else:
                path.pop()
                if path:
                    least[path[-1][0]] = min(least[path[-1][0]], least[port])
                while least[port] == number[port] and port not in found:
                    found[open_ports.pop()] = port
    return found


def _some(names: list[str], most: int = 6) -> str:
    """List the first names, and how many more there are."""
    more = len(names) - most
    return ", ".join(names) if more <= 0 else f"{', '.join(names[:most])} and {more} more"
