"""The order in which the components of a loop advance, derived from what feeds through.

Which inputs are extrapolated (:mod:`cosim.core.coupling`) is fixed before the run:

* Gauss-Seidel: components advance one after the other, those whose feedthrough inputs are known
  first.
* Jacobi: all inputs from inside the loop are extrapolated.

An algebraic loop, that is a cycle of outputs that are known to feed through to each other, is
refused. Unknown feedthrough counts as there, except where it would close a cycle: there it is taken
as not there (:class:`UnknownFeedthrough`). If it is there after all, its output was computed with
the extrapolated input, the value from the start of the step.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from typing import Literal, TypeAlias, TypeVar

from cosim.core.port import Port
from cosim.core.signals import Interface
from cosim.errors import AlgebraicLoopError

PortDependencies: TypeAlias = Mapping[Port, Collection[Port]]  # what each port depends on directly
Feedthrough: TypeAlias = dict[str, tuple[str, ...]]  # the inputs that feed through to each output
Sources: TypeAlias = Mapping[str, Mapping[str, tuple[Port, ...]]]  # of each input, by component
Node = TypeVar("Node", bound=Hashable)
OperationKind: TypeAlias = Literal["advance", "refresh"]
Operation: TypeAlias = tuple[OperationKind, str]


@dataclass(frozen=True, slots=True)
class UnknownFeedthrough:
    """Unknown feedthrough of a component, taken as not there because it would close a cycle."""

    component: str
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]

    def __str__(self) -> str:
        outputs = _first_names(self.component, self.outputs)
        inputs = _first_names(self.component, self.inputs)
        return (
            f"{outputs} may depend directly on {inputs} (the FMU does not say): taken as not "
            "feeding through; if it does, the loop is solved with the value of the step before"
        )


@dataclass(frozen=True, slots=True)
class LoopOrder:
    """How a loop is advanced.

    Parameters
    ----------
    operations : tuple of Operation
    extrapolated : mapping of component name to frozenset of str
        Inputs that are known only after the component has advanced.
    unknown : tuple of UnknownFeedthrough
    """

    operations: tuple[Operation, ...]
    extrapolated: Mapping[str, frozenset[str]]
    unknown: tuple[UnknownFeedthrough, ...]


def order_loop(interfaces: Mapping[str, Interface], sources: Sources, *, jacobi: bool) -> LoopOrder:
    """Return the order of operations in a loop, and which inputs are extrapolated.

    Parameters
    ----------
    interfaces : mapping of component name to Interface
        The components of the loop.
    sources : mapping of component name to mapping of input to tuple of Port
        What drives each input; ports of components outside the loop are known from the start.
    jacobi : bool
        Extrapolate every input from inside the loop.

    Raises
    ------
    AlgebraicLoopError
        If outputs are known to feed through to each other in a cycle; every port of it is named.
    """
    feedthrough, unknown = _feedthrough(interfaces, sources)
    order = _Order(feedthrough, sources)
    if jacobi:
        order.advance_together()
    else:
        order.advance_in_turn()
    return LoopOrder(tuple(order.operations), order.extrapolated, unknown)


class _Order:
    """The order of operations of a loop while it is built.

    Attributes
    ----------
    final : set of Port
        The outputs that have their value at the end of the step.
    """

    def __init__(self, feedthrough: Mapping[str, Feedthrough], sources: Sources) -> None:
        self.feedthrough = feedthrough
        self.sources = sources
        self.final: set[Port] = set()
        self.operations: list[Operation] = []
        self.extrapolated: dict[str, frozenset[str]] = {}

    def advance_together(self) -> None:
        """Advance all components with the values of the step before (Jacobi)."""
        for name in self.feedthrough:
            self._advance(name, extrapolated=self._inputs_from_inside(name))
        # Outputs that no extrapolated input reaches are final already.
        for name, feedthrough in self.feedthrough.items():
            for output, inputs in feedthrough.items():
                if not self.extrapolated[name].intersection(inputs):
                    self.final.add(Port(name, output))
        self._refresh()

    def advance_in_turn(self) -> None:
        """Advance the components one after the other (Gauss-Seidel)."""
        waiting = list(self.feedthrough)
        while waiting:
            # Of equals the first in the file: min keeps the order of the list.
            name = min(waiting, key=self._count_unknown_feedthrough)
            waiting.remove(name)
            inside = self._inputs_from_inside(name)
            unknown = frozenset(signal for signal in inside if not self._is_known(name, signal))
            self._advance(name, extrapolated=unknown)
            # No refresh for these outputs: advance has just computed them with these inputs.
            self._mark_final(name)
            self._refresh()

    def _inputs_from_inside(self, name: str) -> frozenset[str]:
        inside = set()
        for signal, ports in self.sources[name].items():
            if any(port.component in self.feedthrough for port in ports):
                inside.add(signal)
        return frozenset(inside)

    def _is_known(self, name: str, signal: str) -> bool:
        ports = self.sources[name][signal]
        inside = [port for port in ports if port.component in self.feedthrough]
        return self.final.issuperset(inside)

    def _count_unknown_feedthrough(self, name: str) -> int:
        feeding: set[str] = set()
        for inputs in self.feedthrough[name].values():
            feeding.update(inputs)
        return sum(not self._is_known(name, signal) for signal in feeding)

    def _advance(self, name: str, *, extrapolated: frozenset[str]) -> None:
        self.extrapolated[name] = extrapolated
        self.operations.append(("advance", name))

    def _mark_final(self, name: str) -> bool:
        """Mark the outputs whose feedthrough inputs are known; return whether any is new."""
        before = len(self.final)
        for output, inputs in self.feedthrough[name].items():
            if all(self._is_known(name, signal) for signal in inputs):
                self.final.add(Port(name, output))
        return len(self.final) > before

    def _refresh(self) -> None:
        """Evaluate outputs again where extrapolated inputs became known, until nothing is new."""
        progress = True
        while progress:
            progress = False
            for name in self.extrapolated:
                if self._mark_final(name):
                    self.operations.append(("refresh", name))
                    progress = True


def _feedthrough(
    interfaces: Mapping[str, Interface], sources: Sources
) -> tuple[dict[str, Feedthrough], tuple[UnknownFeedthrough, ...]]:
    """Return what feeds through to each output; where that is unknown, what closes no cycle.

    Raises
    ------
    AlgebraicLoopError
        If what is known to feed through closes a cycle.
    """
    known: dict[str, Feedthrough] = {}
    possible: dict[str, Feedthrough] = {}
    for name, interface in interfaces.items():
        possible[name] = {output.name: interface.feeds(output.name) for output in interface.outputs}
        known[name] = {
            output: inputs if interface.knows(output) else ()
            for output, inputs in possible[name].items()
        }
    cycle = find_cycle(_dependencies(known, sources))
    if cycle:
        raise AlgebraicLoopError(
            f"{' -> '.join(map(str, cycle))}: every output here feeds through; put a component "
            "with a state of its own between, such as a lag or a delay"
        )
    unknown = []
    dependencies = _dependencies(possible, sources)
    while cycle := find_cycle(dependencies):
        name = _unknown_component(cycle, dependencies, interfaces)
        # Cuts ``possible[name]``: the next cycle is looked for without it.
        unknown.append(_cut_unknown(name, possible[name], interfaces[name], dependencies))
        dependencies = _dependencies(possible, sources)
    return possible, tuple(unknown)


def _unknown_component(
    cycle: list[Port], dependencies: PortDependencies, interfaces: Mapping[str, Interface]
) -> str:
    """Return the first component on a cycle that the cycle passes by unknown feedthrough."""
    for first, second in pairwise(cycle):
        inside = first.component == second.component and first in dependencies[second]
        if inside and not interfaces[first.component].knows(second.signal):
            return first.component
    raise AssertionError("a cycle of known feedthrough was refused before")


def _cut_unknown(
    name: str, feedthrough: Feedthrough, interface: Interface, dependencies: PortDependencies
) -> UnknownFeedthrough:
    """Remove and return the unknown feedthrough of a component that lies on a cycle."""
    cycle_of = strongly_connected(dependencies)
    cut_outputs: dict[str, None] = {}
    cut_inputs: dict[str, None] = {}
    for output, inputs in feedthrough.items():
        if interface.knows(output):
            continue
        cycle = cycle_of[Port(name, output)]
        closing = [signal for signal in inputs if cycle_of[Port(name, signal)] == cycle]
        feedthrough[output] = tuple(signal for signal in inputs if signal not in closing)
        if closing:
            cut_outputs[output] = None
            cut_inputs.update(dict.fromkeys(closing))
    return UnknownFeedthrough(name, tuple(cut_outputs), tuple(cut_inputs))


def _dependencies(feedthrough: Mapping[str, Feedthrough], sources: Sources) -> PortDependencies:
    """Return what the ports of a loop depend on directly: by connections, and inside components."""
    dependencies: dict[Port, list[Port]] = {}
    for name, outputs in feedthrough.items():
        for signal, ports in sources[name].items():
            inside = [port for port in ports if port.component in feedthrough]
            dependencies[Port(name, signal)] = inside
        for output, inputs in outputs.items():
            dependencies[Port(name, output)] = [Port(name, signal) for signal in inputs]
    return dependencies


def find_cycle(dependencies: PortDependencies) -> list[Port]:
    """Return a cycle of ports, closed, in the direction of the signals; empty: there is none."""
    try:
        TopologicalSorter(dependencies).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def strongly_connected(dependencies: Mapping[Node, Collection[Node]]) -> dict[Node, Node]:
    """Return for every node the one that stands for its strongly connected component.

    R. Tarjan, Depth-first search and linear graph algorithms, SIAM J. Comput. 1 (1972), without
    recursion: ``path`` is the stack of calls, ``least`` the low link. One function, as the
    algorithm is one loop.
    """
    number: dict[Node, int] = {}
    least: dict[Node, int] = {}
    representative: dict[Node, Node] = {}
    open_nodes: list[Node] = []
    for root in dependencies:
        if root in number:
            continue
        path = [(root, iter(dependencies[root]))]
        while path:
            node, edges = path[-1]
            if node not in number:
                number[node] = least[node] = len(number)
                open_nodes.append(node)
            for other in edges:
                if other not in number:
                    path.append((other, iter(dependencies[other])))
                    break
                if other not in representative:
                    least[node] = min(least[node], number[other])
            else:
                path.pop()
                if path:
                    caller = path[-1][0]
                    least[caller] = min(least[caller], least[node])
                while least[node] == number[node] and node not in representative:
                    representative[open_nodes.pop()] = node
    return representative


def _first_names(component: str, signals: Collection[str], most: int = 6) -> str:
    """Return the first ports in words, and how many more there are."""
    names = [f"{component}.{signal}" for signal in signals]
    shown = ", ".join(names[:most])
    more = len(names) - most
    return shown if more <= 0 else f"{shown} and {more} more"
