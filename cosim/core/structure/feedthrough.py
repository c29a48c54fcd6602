"""What feeds through in a loop: known and unknown direct feedthrough, and algebraic loops.

An algebraic loop is a cycle of outputs that feed through to each other. Its connections are found
here; a coupling that iterates solves them, any other extrapolates one of them
(:mod:`cosim.core.structure.order`). A loop with a discrete signal in it is refused: neither is an
approximation of anything there.

Unknown feedthrough counts as there. Where nothing iterates, and it would close a cycle, it is taken
as not there (:class:`UnknownFeedthrough`). If it is there after all, its output was computed with
the extrapolated input, the value from the start of the step.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

from cosim.core.port import Port
from cosim.core.signals import Interface
from cosim.core.structure.cycles import find_cycle, strongly_connected
from cosim.errors import AlgebraicLoopError

PortDependencies: TypeAlias = Mapping[Port, Collection[Port]]  # what each port depends on directly
Feedthrough: TypeAlias = dict[str, tuple[str, ...]]  # the inputs that feed through to each output
Sources: TypeAlias = Mapping[str, Mapping[str, tuple[Port, ...]]]  # of each input, by component
Edge: TypeAlias = tuple[Port, Port]  # a connection: the input, and the output that drives it


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
class LoopFeedthrough:
    """What feeds through in a loop.

    Parameters
    ----------
    by_component : mapping of component name to Feedthrough
    algebraic : frozenset of (input Port, source Port)
        The connections of its algebraic loops.
    path : tuple of Port
        One algebraic loop, closed; empty: there is none.
    unknown : tuple of UnknownFeedthrough
    """

    by_component: Mapping[str, Feedthrough]
    algebraic: frozenset[Edge]
    path: tuple[Port, ...]
    unknown: tuple[UnknownFeedthrough, ...]


def find_feedthrough(
    interfaces: Mapping[str, Interface], sources: Sources, *, iterates: bool
) -> LoopFeedthrough:
    """Return what feeds through to each output, and the algebraic loops that it closes.

    Parameters
    ----------
    interfaces : mapping of component name to Interface
        The components of a loop; which unknown feedthrough is taken as not there follows their
        order.
    sources : mapping of component name to mapping of input to tuple of Port
    iterates : bool
        Whether the coupling iterates, so that unknown feedthrough may close a cycle.

    Raises
    ------
    AlgebraicLoopError
        If there is a discrete signal in an algebraic loop.
    """
    known: dict[str, Feedthrough] = {}
    possible: dict[str, Feedthrough] = {}
    for name, interface in interfaces.items():
        possible[name] = {output.name: interface.feeds(output.name) for output in interface.outputs}
        known[name] = _known_feedthrough(interface, possible[name])
    if iterates:
        dependencies = _dependencies(possible, sources)
        algebraic = _algebraic_connections(dependencies, sources)
        path = tuple(find_cycle(dependencies))
        _check_continuous(_dependencies(known, sources), interfaces)
        return LoopFeedthrough(possible, algebraic, path, ())
    dependencies = _dependencies(known, sources)
    algebraic = _algebraic_connections(dependencies, sources)
    path = tuple(find_cycle(dependencies))
    _check_continuous(dependencies, interfaces)
    unknown = []
    dependencies = _without(_dependencies(possible, sources), algebraic)
    while cycle := find_cycle(dependencies):
        name = _unknown_component(cycle, dependencies, interfaces)
        # Cuts ``possible[name]``: the next cycle is looked for without it.
        unknown.append(_cut_unknown(name, possible[name], interfaces[name], dependencies))
        dependencies = _without(_dependencies(possible, sources), algebraic)
    return LoopFeedthrough(possible, algebraic, path, tuple(unknown))


def early_event_text(name: str, coupling: str) -> str:
    """Return what happens to the events of a component whose outputs are evaluated again."""
    way_out = "an FMU that can save its state"
    if coupling == "jacobi":
        way_out = f"'gauss-seidel', or {way_out}"
    return (
        f"{name!r} cannot go back (rollback is not declared; of an FMU: canGetAndSetFMUstate), and "
        "its outputs are evaluated again for inputs that its loop knows later: an event of its own "
        "at a communication point has happened with the earlier ones, which is an error of first "
        f"order in the step; needed {way_out}"
    )


def extrapolation_text(path: Sequence[Port]) -> str:
    """Return what becomes of an algebraic loop where nothing iterates."""
    return (
        f"{' -> '.join(map(str, path))}: every output here feeds through; this algebraic loop is "
        "not solved within a step, but with a value of the step before (first order); coupling = "
        "'newton' solves it"
    )


def _algebraic_connections(dependencies: PortDependencies, sources: Sources) -> frozenset[Edge]:
    """Return the connections on cycles of ports, as input and source."""
    cycle_of = strongly_connected(dependencies)
    edges: set[Edge] = set()
    for name, inputs in sources.items():
        for signal in inputs:
            to = Port(name, signal)
            for port in dependencies[to]:
                if cycle_of[port] == cycle_of[to]:
                    edges.add((to, port))
    return frozenset(edges)


def _without(dependencies: PortDependencies, edges: Collection[Edge]) -> PortDependencies:
    """Return dependencies without some connections."""
    left: dict[Port, list[Port]] = {}
    for to, ports in dependencies.items():
        left[to] = [port for port in ports if (to, port) not in edges]
    return left


def _check_continuous(dependencies: PortDependencies, interfaces: Mapping[str, Interface]) -> None:
    """Check that no discrete signal is in an algebraic loop.

    Raises
    ------
    AlgebraicLoopError
        If one is; every port of the loop is named.
    """
    cycle_of = strongly_connected(dependencies)
    by_cycle: dict[Port, list[Port]] = {}
    for port, cycle in cycle_of.items():
        by_cycle.setdefault(cycle, []).append(port)
    for ports in by_cycle.values():
        if len(ports) == 1:  # a connection has two ends, so that a cycle has two ports
            continue
        for port in sorted(ports):
            signal = interfaces[port.component].by_name[port.signal]
            if signal.type != "real" or signal.variability == "discrete":
                inside = {port: [p for p in dependencies[port] if p in ports] for port in ports}
                path = " -> ".join(map(str, find_cycle(inside)))
                raise AlgebraicLoopError(
                    f"{path}: algebraic loop (every output has direct feedthrough), and '{port}' "
                    "is discrete, so that it cannot be solved by iteration; break the loop with a "
                    "component that has a state, such as a delay"
                )


def _known_feedthrough(interface: Interface, possible: Feedthrough) -> Feedthrough:
    """Return which inputs are known to feed through to each output."""
    known = {}
    for output, inputs in possible.items():
        known[output] = inputs if interface.knows(output) else ()
    return known


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


def _first_names(component: str, signals: Collection[str], most: int = 6) -> str:
    """Return the first ports in words, and how many more there are."""
    names = [f"{component}.{signal}" for signal in signals]
    shown = ", ".join(names[:most])
    more = len(names) - most
    return shown if more <= 0 else f"{shown} and {more} more"
