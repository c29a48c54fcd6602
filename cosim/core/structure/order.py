"""The order in which the components of a loop advance, from names and declarations alone.

Which inputs are extrapolated (:mod:`cosim.core.stages.coupling`) is fixed before the run:

* Gauss-Seidel: components advance one after the other, in the order that breaks the fewest
  connections. A connection is *broken* where the component behind it advances first, though its
  state follows the input through the step: first order. It is not where that input is delayed
  (:class:`cosim.core.signals.Interface`) or has a zero-order hold, so a delay or a sampled
  controller goes first.
* Jacobi: all inputs from inside the loop are extrapolated, whatever the order of the components.
* Newton: the same order as Gauss-Seidel. A connection that would be broken is *torn* instead: what
  it has at the end of the step is an unknown, which is solved for. The same holds for the others
  where they take a step several times.

The connections of an algebraic loop feed through and reach each other within the same instant: one
of them at least is torn. Where nothing solves for it, its input is extrapolated, and the outputs
that follow it stay as they are: they belong to the value that was extrapolated.

To break the fewest connections is to find a minimum feedback arc set, which is NP-hard. A component
that breaks none may always advance next: what is known at the end of the step only grows, so it
costs nothing now and helps the others. Where every component breaks one, a uniform-cost search over
the sets of components that have advanced finds the least. Beyond ``SEARCH`` the greedy heuristic of
P. Eades, X. Lin and W. Smyth (Inf. Process. Lett. 47, 1993) takes its place: next is the component
that breaks the fewest connections less those that it completes. Among equals, fewer outputs are
evaluated again; then names decide. Nothing depends on the order in which components are given.
Where what is broken is solved for, an output that jumps is broken last: there the jump would become
a ramp.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Final, Literal, NamedTuple, TypeAlias

from cosim.core.port import Port
from cosim.core.signals import Interface
from cosim.core.structure.feedthrough import (
    Edge,
    Feedthrough,
    LoopFeedthrough,
    Sources,
    UnknownFeedthrough,
    find_feedthrough,
)

Coupling: TypeAlias = Literal["gauss-seidel", "jacobi", "newton"]
OperationKind: TypeAlias = Literal["advance", "refresh"]
Operation: TypeAlias = tuple[OperationKind, str]

SEARCH: Final = 30_000  # connections followed, until the heuristic takes over: about 0.2 s


@dataclass(frozen=True, slots=True)
class LoopOrder:
    """How a loop is advanced.

    Parameters
    ----------
    operations : tuple of Operation
    extrapolated : mapping of component name to frozenset of str
        Inputs that are known only after the component has advanced.
    broken : int
        Connections that are extrapolated though the state behind them follows them, or an output
        that nothing evaluates again.
    torn : tuple of (input Port, source Port)
        The connections whose values at the end of a step are unknowns, sorted.
    kept : tuple of (input Port, source Port)
        With Jacobi, where nothing solves for them: the connections of algebraic loops, sorted.
        Their inputs stay what they were before the step until all outputs of it are known.
    algebraic : tuple of Port
        An algebraic loop, closed; empty: there is none.
    unknown : tuple of UnknownFeedthrough
    """

    operations: tuple[Operation, ...]
    extrapolated: Mapping[str, frozenset[str]]
    broken: int
    torn: tuple[Edge, ...]
    kept: tuple[Edge, ...]
    algebraic: tuple[Port, ...]
    unknown: tuple[UnknownFeedthrough, ...]


class Cost(NamedTuple):
    """What it costs to let a component advance: broken connections, then outputs that wait.

    ``jumping`` counts those of the broken connections whose sources jump, where they are solved
    for; ``waiting`` the inputs that feed through and are not known yet.
    """

    broken: int
    jumping: int
    waiting: int

    def plus(self, other: Cost) -> Cost:
        """Return what both cost."""
        return Cost(
            self.broken + other.broken,
            self.jumping + other.jumping,
            self.waiting + other.waiting,
        )


FREE: Final = Cost(0, 0, 0)


def order_loop(
    interfaces: Mapping[str, Interface],
    sources: Sources,
    *,
    coupling: Coupling,
    iterates: bool | None = None,
    held: Collection[Edge] = (),
    jumping: Collection[Port] = (),
) -> LoopOrder:
    """Return the order of operations in a loop, and which inputs are extrapolated.

    Parameters
    ----------
    interfaces : mapping of component name to Interface
        The components of the loop.
    sources : mapping of component name to mapping of input to tuple of Port
        What drives each input; ports of components outside the loop are known from the start.
    coupling : {"gauss-seidel", "jacobi", "newton"}
    iterates : bool, optional
        Whether a step is taken several times; left out: with "newton".
    held : collection of (input Port, source Port)
        Connections with a zero-order hold: their value at the end of a step reaches no state.
    jumping : collection of Port
        Outputs that may jump at communication points.

    Raises
    ------
    AlgebraicLoopError
        If a discrete signal is in an algebraic loop; every port of it is named.
    """
    by_name = {name: interfaces[name] for name in sorted(interfaces)}
    if iterates is None:
        iterates = coupling == "newton"
    feedthrough = find_feedthrough(by_name, sources, iterates=iterates)
    network = _Network(by_name, feedthrough, sources, held, iterates=iterates, jumping=jumping)
    if coupling == "jacobi":
        progress = _Progress(network)
        progress.advance_together()
    else:
        progress = _search(network) or _choose_greedily(network)
    torn = tuple(sorted(progress.torn))
    return LoopOrder(
        tuple(progress.operations),
        progress.extrapolated,
        0 if iterates else progress.cost.broken,
        torn if iterates else (),
        torn if coupling == "jacobi" and not iterates else (),
        feedthrough.path,
        feedthrough.unknown,
    )


class _Network:
    """The connections inside a loop and what feeds through to what; never changes.

    Attributes
    ----------
    names : tuple of str
        The components, sorted.
    inputs : dict of component name to list of Port
        The inputs with sources inside the loop.
    outputs : dict of component name to list of Port
    inside : dict of input Port to tuple of Port
        Its sources inside the loop.
    driven : dict of output Port to list of Port
        The inputs inside the loop that it drives.
    fed : dict of input Port to list of Port
        The outputs that it feeds through to.
    reactive : set of (input Port, source Port)
        The connections that would be broken.
    tearable : set of (input Port, source Port)
        Those of them that would be torn.
    iterates : bool
        Whether what is torn is solved for.
    jumping : set of (input Port, source Port)
        Those of the connections that would be torn whose sources jump.
    size : int
        Number of components and connections.
    """

    def __init__(
        self,
        interfaces: Mapping[str, Interface],
        feedthrough: LoopFeedthrough,
        sources: Sources,
        held: Collection[Edge],
        *,
        iterates: bool,
        jumping: Collection[Port],
    ) -> None:
        self.names = tuple(interfaces)
        self.inputs: dict[str, list[Port]] = {}
        self.outputs: dict[str, list[Port]] = {}
        self.inside: dict[Port, tuple[Port, ...]] = {}
        self.driven: dict[Port, list[Port]] = {}
        self.fed: dict[Port, list[Port]] = {}
        self.reactive: set[Edge] = set(feedthrough.algebraic)
        self.iterates = iterates
        for name, interface in interfaces.items():
            self.outputs[name] = [Port(name, signal.name) for signal in interface.outputs]
            for output in self.outputs[name]:
                self.driven[output] = []
        for name, interface in interfaces.items():
            self._connect(name, interface, sources[name], held)
            self._feed(name, feedthrough.by_component[name])
        self.tearable = self.reactive if iterates else set(feedthrough.algebraic)
        self.jumping = {edge for edge in self.reactive if iterates and edge[1] in jumping}
        self.size = len(self.names) + sum(map(len, self.inside.values()))

    def _connect(
        self,
        name: str,
        interface: Interface,
        sources: Mapping[str, tuple[Port, ...]],
        held: Collection[Edge],
    ) -> None:
        self.inputs[name] = []
        for signal, ports in sources.items():
            to = Port(name, signal)
            inside = tuple(port for port in ports if port in self.driven)
            if not inside:
                continue
            self.inputs[name].append(to)
            self.inside[to] = inside
            self.fed[to] = []
            for port in inside:
                self.driven[port].append(to)
                if signal not in interface.delayed and (to, port) not in held:
                    self.reactive.add((to, port))

    def _feed(self, name: str, feedthrough: Feedthrough) -> None:
        for output, signals in feedthrough.items():
            for signal in signals:
                to = Port(name, signal)
                if to in self.inside:
                    self.fed[to].append(Port(name, output))


class _Progress:
    """Which components have advanced over a step, and what is known at the end of it.

    Attributes
    ----------
    operations : list of Operation
    extrapolated : dict of component name to frozenset of str
    cost : Cost
        Of all components that have advanced.
    waiting : set of str
        The components that have not advanced.
    torn : set of (input Port, source Port)
    """

    def __init__(self, network: _Network) -> None:
        self.network = network
        self.operations: list[Operation] = []
        self.extrapolated: dict[str, frozenset[str]] = {}
        self.cost = FREE
        self.waiting = set(network.names)
        self.torn: set[Edge] = set()
        self._missing_sources = {to: len(ports) for to, ports in network.inside.items()}
        self._missing_inputs: dict[Port, int] = {port: 0 for port in network.driven}
        self._broken = dict.fromkeys(network.names, 0)
        self._jumping = dict.fromkeys(network.names, 0)
        self._unknown_feeding = dict.fromkeys(network.names, 0)
        for to, outputs in network.fed.items():
            self._unknown_feeding[to.component] += bool(outputs)
            for output in outputs:
                self._missing_inputs[output] += 1
        for to, _ in network.reactive:
            self._broken[to.component] += 1
        for to, _ in network.jumping:
            self._jumping[to.component] += 1
        self._final: set[Port] = set()
        self._free = [name for name in network.names if self.cost_of(name) == FREE]

    def cost_of(self, name: str) -> Cost:
        """Return what it costs to let a component advance now."""
        return Cost(self._broken[name], self._jumping[name], self._unknown_feeding[name])

    def gain_of(self, name: str) -> int:
        """Return how many connections would no longer be broken if a component advanced now."""
        count = 0
        for output in self._computable(name):
            for to in self.network.driven[output]:
                count += to.component in self.waiting and (to, output) in self.network.reactive
        return count

    def advance_free(self) -> None:
        """Advance every component that costs nothing, by name, also those that come to that."""
        while self._free:
            name = heappop(self._free)
            if name in self.waiting:
                self.advance(name)

    def advance(self, name: str) -> None:
        """Advance a component, then evaluate again what waited for its outputs."""
        self.cost = self.cost.plus(self.cost_of(name))
        unknown = self._unknown_inputs(name)
        self._tear(name)
        self._start(name, self._unknown_inputs(name) if self.network.iterates else unknown)
        # No refresh for these outputs: advance has just computed them with these inputs.
        self._spread(self._computable(name))

    def advance_together(self) -> None:
        """Advance all components with the values from before the step (Jacobi)."""
        outputs: list[Port] = []
        for name in self.network.names:
            self._tear(name)
            if self.network.iterates:  # what is torn is tried at the end of the step, too
                extrapolated = self._unknown_inputs(name)
            else:
                extrapolated = [to.signal for to in self.network.inputs[name]]
            self._start(name, extrapolated)
            # Outputs that no extrapolated input reaches are final already.
            outputs += self._computable(name)
        self.cost = Cost(len(self.network.reactive), 0, 0)
        self._spread(outputs)

    def _unknown_inputs(self, name: str) -> list[str]:
        """Return the inputs of a component that are not known at the end of the step."""
        return [to.signal for to in self.network.inputs[name] if self._missing_sources[to]]

    def _tear(self, name: str) -> None:
        """Tear the connections to a component whose sources are not known, where they may be."""
        for to in self.network.inputs[name]:
            for port in self.network.inside[to]:
                edge = (to, port)
                if edge in self.network.tearable and port not in self._final:
                    self.torn.add(edge)
                    self._complete(edge)

    def _start(self, name: str, extrapolated: Iterable[str]) -> None:
        self.waiting.remove(name)
        self.extrapolated[name] = frozenset(extrapolated)
        self.operations.append(("advance", name))

    def _computable(self, name: str) -> list[Port]:
        """Return the outputs that would be final, and are not."""
        ports = self.network.outputs[name]
        return [
            port for port in ports if not self._missing_inputs[port] and port not in self._final
        ]

    def _spread(self, outputs: Iterable[Port]) -> None:
        """Make outputs final; evaluate others again where inputs become known, until none is."""
        final = deque(outputs)
        self._final.update(final)
        stale: deque[str] = deque()  # components that have advanced, with outputs to evaluate
        while final or stale:
            if final:
                stale += self._reach(final.popleft())
                continue
            name = stale.popleft()
            refreshed = self._computable(name)
            if refreshed:
                self.operations.append(("refresh", name))
                self._final.update(refreshed)
                final += refreshed

    def _reach(self, output: Port) -> list[str]:
        """Make an output known to what it drives; return who can now be evaluated again."""
        stale = []
        for to in self.network.driven[output]:
            if (to, output) in self.torn:
                continue
            name = to.component
            is_fed = self._complete((to, output))
            if is_fed and name not in self.waiting:
                stale.append(name)
            if name in self.waiting and self.cost_of(name) == FREE:
                heappush(self._free, name)
        return stale

    def _complete(self, edge: Edge) -> bool:
        """Make the source of an input known; return whether outputs wait for it no longer."""
        to = edge[0]
        self._broken[to.component] -= edge in self.network.reactive
        self._jumping[to.component] -= edge in self.network.jumping
        self._missing_sources[to] -= 1
        if self._missing_sources[to]:
            return False
        fed = self.network.fed[to]
        self._unknown_feeding[to.component] -= bool(fed)
        for port in fed:
            self._missing_inputs[port] -= 1
        return bool(fed)


def _search(network: _Network) -> _Progress | None:
    """Return the cheapest order; None: it was not found within ``SEARCH``."""
    candidates: list[tuple[Cost, tuple[str, ...]]] = [(FREE, ())]
    visited: set[frozenset[str]] = set()
    work = 0
    while candidates and work < SEARCH:
        _, choices = heappop(candidates)
        progress = _replayed(network, choices)
        work += network.size
        waiting = frozenset(progress.waiting)
        if not waiting:
            return progress
        if waiting in visited:
            continue
        visited.add(waiting)
        for name in waiting:
            total = progress.cost.plus(progress.cost_of(name))
            heappush(candidates, (total, (*choices, name)))
    return None


def _replayed(network: _Network, choices: Iterable[str]) -> _Progress:
    """Return the progress after some choices; between them advances what costs nothing."""
    progress = _Progress(network)
    progress.advance_free()
    for name in choices:
        progress.advance(name)
        progress.advance_free()
    return progress


def _choose_greedily(network: _Network) -> _Progress:
    """Return a good order: next is who breaks the fewest connections less those it completes."""
    progress = _Progress(network)

    def rank(name: str) -> tuple[int, int, int, str]:
        cost = progress.cost_of(name)
        return cost.broken - progress.gain_of(name), cost.jumping, cost.waiting, name

    progress.advance_free()
    while progress.waiting:
        progress.advance(min(progress.waiting, key=rank))
        progress.advance_free()
    return progress
