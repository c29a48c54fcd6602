"""What feeds through in a loop: known and unknown direct feedthrough, and algebraic loops.

An algebraic loop, that is a cycle of outputs that are known to feed through to each other, is
refused. Unknown feedthrough counts as there, except where it would close a cycle: there it is taken
as not there (:class:`UnknownFeedthrough`). If it is there after all, its output was computed with
the extrapolated input, the value from the start of the step.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
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


def find_feedthrough(
    interfaces: Mapping[str, Interface], sources: Sources
) -> tuple[dict[str, Feedthrough], tuple[UnknownFeedthrough, ...]]:
    """Return what feeds through to each output; where that is unknown, what closes no cycle.

    Parameters
    ----------
    interfaces : mapping of component name to Interface
        The components of a loop; which unknown feedthrough is taken as not there follows their
        order.
    sources : mapping of component name to mapping of input to tuple of Port

    Raises
    ------
    AlgebraicLoopError
        If what is known to feed through closes a cycle.
    """
    known: dict[str, Feedthrough] = {}
    possible: dict[str, Feedthrough] = {}
    for name, interface in interfaces.items():
        possible[name] = {output.name: interface.feeds(output.name) for output in interface.outputs}
        known[name] = _known_feedthrough(interface, possible[name])
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
