"""Initial values of all inputs and outputs of a graph (FMI 2.0.4 section 2.2.8, InitialUnknowns).

At initialization an output may depend on more inputs than later, because the state may follow them
(:meth:`cosim.core.signals.Interface.feeds_initially`). The ports are taken in the order of these
dependencies: an input when the outputs that drive it are known, an output when the inputs that it
depends on are. A component is initialized again whenever inputs of it have become known; until then
they have their start values.

Ports that depend on each other form an algebraic loop. It is torn at some of its inputs, v; one
sweep along the rest of it gives them back as w(v), and w(v) = v is solved
(:mod:`cosim.core.initialization.fixed_point`):

1. by fixed-point iteration, with as many sweeps as the loop has ports. That is enough where there
   is no loop in truth: unknown dependencies count as there. Where a signal is discrete, sweeps are
   all that is tried;
2. else by Newton's method from the start values, until the residual no longer falls;
3. the residual is compared with the values, and 1 - w' must be regular: else the initial values are
   not determined.

Then each component shows the outputs with which it starts: ``outputs`` at its inputs. An FMU may
show others there than in its initialization (exit_initialization_mode, and the event that follows).
Such a component is initialized and asked for its outputs in one from then on, and the ports are
taken again. No component is asked before those that drive it, so that outside loops none is
initialized again that has started.

At the end every input is what its connection gives, and every component was initialized with its
inputs and shows what it starts with. Only the outputs of a component at whose inputs a loop was
torn belong to v, which is as far from the recorded input as the residual.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from itertools import chain, pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Vector
from cosim.core.initialization.fixed_point import (
    Candidate,
    SingularError,
    iterate,
    measure,
    newton,
    newton_step,
)
from cosim.core.port import Port
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.core.stages.member import Member, NonFinite
from cosim.core.stages.wires import Wire
from cosim.core.structure.cycles import find_cycle, groups_in_order, strongly_connected
from cosim.core.structure.feedthrough import PortDependencies, Sources
from cosim.errors import GraphError, listing

SWEEPS: Final = 100  # of a loop with discrete signals, beyond one for each port
NO_OUTPUTS: Final = np.empty(0)


@dataclass(frozen=True, slots=True)
class AlgebraicLoop:
    """Ports that depend on each other at initialization.

    Parameters
    ----------
    order : tuple of Port
        In the order of a sweep; the torn inputs come last.
    torn : tuple of Port
        The torn inputs, named once for each of their elements.
    columns : integer array
        Of these elements, in the row.
    optional : bool array
        Which of them may have no value (NaN).
    discrete : bool
        A signal in it is not a continuous real number.
    path : str
        Every port of it, for messages.
    jumping : tuple of Port
        Outputs in it that may jump as their inputs change.
    """

    order: tuple[Port, ...]
    torn: tuple[Port, ...]
    columns: NDArray[np.intp]
    optional: Mask
    discrete: bool
    path: str
    jumping: tuple[Port, ...]


class InitialValues:
    """The order in which a graph is initialized, fixed by its structure.

    Parameters
    ----------
    layout : Layout
    members : mapping of component name to Member
    sources : mapping of component name to mapping of input to tuple of Port
        What drives each input.
    wires : mapping of Port to tuple of Wire
        What feeds each input.
    """

    def __init__(
        self,
        layout: Layout,
        members: Mapping[str, Member],
        sources: Sources,
        wires: Mapping[Port, tuple[Wire, ...]],
    ) -> None:
        self.layout = layout
        # By name: nothing may depend on the order of the components in a file.
        self.members = {name: members[name] for name in sorted(members)}
        channels = [member.channel for member in self.members.values()]
        self.columns: dict[Port, slice] = {}
        self._signals: dict[Port, Signal] = {}
        for channel in channels:
            for name, signal in channel.by_name.items():
                port = Port(channel.name, name)
                self.columns[port] = channel.signal_columns[name]
                self._signals[port] = signal
        self.wires = wires
        self.starting_order = _drivers_first(self.members, sources)
        self.order = self._ordered(_dependencies(channels, sources))
        self.outputs_outside_loops = self._outputs_outside_loops()

    def _ordered(self, dependencies: PortDependencies) -> list[Port | AlgebraicLoop]:
        """Return ports and algebraic loops in the order in which they can be computed."""
        group_of = strongly_connected(dependencies)
        groups: dict[Port, list[Port]] = {}
        for port, group in group_of.items():
            groups.setdefault(group, []).append(port)
        between: dict[Port, set[Port]] = {}
        for group, ports in groups.items():
            needed = set[Port]()
            for port in ports:
                needed.update(group_of[other] for other in dependencies[port])
            between[group] = needed - {group}
        order: list[Port | AlgebraicLoop] = []
        for group in _inputs_first(between, self.wires.keys()):
            ports = groups[group]
            if len(ports) == 1:
                order.append(group)
            else:
                order.append(self._algebraic_loop(sorted(ports), dependencies))
        return order

    def _outputs_outside_loops(self) -> list[Port]:
        """Return the outputs outside every loop: they are written again at the end of a round."""
        in_loops: set[Port] = set()
        for item in self.order:
            if isinstance(item, AlgebraicLoop):
                in_loops.update(item.order)
        return [port for port in self.columns if port not in self.wires and port not in in_loops]

    def _algebraic_loop(self, ports: list[Port], dependencies: PortDependencies) -> AlgebraicLoop:
        names = {port.component for port in ports}
        interfaces = {name: self.members[name].channel.interface for name in names}
        members = set(ports)
        inside = {port: sorted(members.intersection(dependencies[port])) for port in ports}
        path = find_cycle(inside)
        torn = _tear(inside, interfaces)
        sweep = [port for port in TopologicalSorter(inside).static_order() if port not in torn]
        sizes = [self._signals[port].size for port in torn]
        elements: list[Port] = []
        for port, size in zip(torn, sizes, strict=True):
            elements += [port] * size
        columns = _numbers([self.columns[port] for port in torn])
        optional = np.repeat([self._signals[port].optional for port in torn], sizes)
        discrete = any(_is_discrete(self._signals[port]) for port in ports)
        jumping = [port for port in ports if port.signal in interfaces[port.component].jumping]
        return AlgebraicLoop(
            (*sweep, *torn),
            tuple(elements),
            columns,
            optional,
            discrete,
            _path_text(path, ports),
            tuple(jumping),
        )

    def find(self, t: float, row: Vector) -> Mapping[str, NonFinite]:
        """Fill the first row, shape (width,).

        Returns
        -------
        mapping of component name to NonFinite
            The components that made a value of finite inputs that is not finite, the last one last.
            In a loop that value may have become the input, so that the row does not show it.

        Raises
        ------
        GraphError
            If an algebraic loop has no solution, more than one, or none that was found; if outputs
            depend on more than their components declare, and keep changing.
        """
        for channel in self.layout.channels:
            for signal in channel.interface.inputs:
                row[self.columns[Port(channel.name, signal.name)]] = signal.initial_values
        values = _InitialRow(self, t, row)
        self._iterate(values, row)
        while values.starts_differently():
            self._iterate(values, row)
        return values.origins

    def _iterate(self, values: _InitialRow, row: Vector) -> None:
        """Compute all ports until none changes."""
        # One round reaches what is declared. What is not may pass one component in each round more;
        # the last round only sees that nothing has changed.
        rounds = len(self.members) + 2
        for _ in range(rounds):
            before = row.copy()
            values.fill()
            if before.tobytes() == row.tobytes():
                return
        changing = []
        for port, columns in self.columns.items():
            if before[columns].tobytes() != row[columns].tobytes():
                changing.append(str(port))
        raise GraphError(
            f"initial values do not converge: {', '.join(changing)} still change after {rounds} "
            "rounds; an output there depends at initialization on an input that its component does "
            "not declare (FMI: InitialUnknowns); declare it, or none at all"
        )


class _InitialRow:
    """The first row while it is computed, and what each component was last initialized with."""

    def __init__(self, plan: InitialValues, t: float, row: Vector) -> None:
        self._plan = plan
        self._t = t
        self._row = row
        self._initialized: dict[str, tuple[bytes, Vector]] = {}
        self._started: dict[str, bytes] = {}  # the inputs with which each was asked for its outputs
        self._starting_differently: set[str] = set()
        self._solved: set[tuple[Port, ...]] = set()
        self.origins: dict[str, NonFinite] = {}

    def fill(self) -> None:
        """Compute every port once, in order; then no component has inputs that it was not given."""
        for item in self._plan.order:
            if isinstance(item, AlgebraicLoop):
                self._solve(item)
            else:
                self._update(item)
        # Again: these outputs were computed before inputs that come later in the order.
        for port in self._plan.outputs_outside_loops:
            self._update(port)
        # Last, so that every component was initialized with the inputs that the row shows.
        for name in self._plan.members:
            self._initialize(name)

    def starts_differently(self) -> bool:
        """Return whether a component starts with other outputs than it shows so far.

        The first one is enough: those that it drives are not asked before they have its outputs.
        """
        for name in self._plan.starting_order:
            inputs, y = self._initialized[name]
            if self._started.get(name) == inputs:
                continue
            outputs = self._start(name, inputs)
            if outputs.tobytes() != y.tobytes():
                self._starting_differently.add(name)
                self._initialized[name] = inputs, outputs
                return True
        return False

    def _start(self, name: str, inputs: bytes) -> Vector:
        """Return the outputs that a component starts with, initialized with the bits ``inputs``."""
        self._started[name] = inputs
        u = np.frombuffer(inputs)
        y = self._plan.members[name].component.initial_outputs(self._t, u)
        self._note_origin(name, u, y)
        return y

    def _note_origin(self, name: str, u: Vector, y: Vector) -> None:
        """Record a component whose outputs are not finite although its inputs are."""
        non_finite = self._plan.members[name].first_non_finite_output(y)
        if non_finite is not None and np.isfinite(u).all():
            self.origins.pop(name, None)
            self.origins[name] = non_finite  # behind those before it

    def _update(self, port: Port) -> None:
        """Bring an input or an output up to date."""
        if port in self._plan.wires:
            rows = self._row[np.newaxis]
            for wire in self._plan.wires[port]:
                wire.copy(rows, slice(0, 1))
            return
        columns = self._plan.columns[port]
        first = self._plan.members[port.component].outputs.start
        y = self._initialize(port.component)
        self._row[columns] = y[columns.start - first : columns.stop - first]

    def _initialize(self, name: str) -> Vector:
        """Return the outputs of a component, initialized with its inputs as they are now."""
        member = self._plan.members[name]
        u = self._row[member.inputs].copy()
        bits = u.tobytes()
        initialized_with, y = self._initialized.get(name, (None, NO_OUTPUTS))
        if bits != initialized_with:
            y = member.component.initialize(self._t, u)
            self._note_origin(name, u, y)
            if name in self._starting_differently:
                y = self._start(name, bits)
            self._initialized[name] = bits, y
        return y

    # --- algebraic loops ---

    def _solve(self, loop: AlgebraicLoop) -> None:
        """Solve a loop, unless what it depends on is as it was when it was solved."""

        def sweep(v: Vector) -> Vector:
            self._row[loop.columns] = v
            for port in loop.order:
                self._update(port)
            return self._row[loop.columns].copy()

        before = self._row.copy()
        v = self._row[loop.columns].copy()
        if loop.order in self._solved:
            sweep(v)
            if self._is_solved(loop, before):
                self._row[:] = before
                return
        self._solved.add(loop.order)
        limit = len(loop.order) + (SWEEPS if loop.discrete else 0)
        iterated = iterate(sweep, v, limit)
        try:
            if loop.discrete:
                solution = _need_fixed_point(loop, iterated)
            elif iterated is None or (np.isnan(iterated) & ~loop.optional).any():
                candidate = newton(sweep, v, lambda: self._largest(loop))
                solution = _need_small_residual(loop, candidate, self.origins)
            else:
                solution = iterated
                if np.isfinite(solution).all():
                    newton_step(sweep, solution, solution)  # only to see that 1 - w' is regular
        except SingularError as error:
            candidate = measure(v, sweep(v), self._largest(loop))
            reason = f"1 - w' is singular, with a {_residual_text(loop, candidate)}"
            if candidate.excess <= 1.0:
                reason = "1 - w' is singular, so that other values solve it as well"
            raise _unsolved(loop, reason) from error
        sweep(solution)

    def _largest(self, loop: AlgebraicLoop) -> float:
        """Return the largest value among the components of a loop."""
        names = {port.component for port in loop.order}
        parts = [self._row[self._plan.members[name].columns] for name in names]
        values = np.concatenate(parts)
        return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))

    def _is_solved(self, loop: AlgebraicLoop, before: Vector) -> bool:
        """Return whether a sweep gave the values of ``before`` again."""
        columns = _numbers([self._plan.columns[port] for port in loop.order])
        return measure(before[columns], self._row[columns], self._largest(loop)).excess <= 1.0


def _numbers(columns: Iterable[slice]) -> NDArray[np.intp]:
    """Return the numbers of columns, one after the other."""
    return np.concatenate([np.arange(part.start, part.stop) for part in columns])


def _need_fixed_point(loop: AlgebraicLoop, solution: Vector | None) -> Vector:
    if solution is None:
        sweeps = len(loop.order) + SWEEPS
        reason = f"with a discrete signal among them, and still changing after {sweeps} sweeps"
        raise _unsolved(loop, reason)
    return solution


def _need_small_residual(
    loop: AlgebraicLoop, candidate: Candidate, origins: Mapping[str, NonFinite]
) -> Vector:
    if not candidate.excess <= 1.0:
        reason = f"Newton's method ended with a {_residual_text(loop, candidate)}"
        names = {port.component for port in loop.order}
        inside = [origin for name, origin in origins.items() if name in names]
        if inside and not np.isfinite(candidate.residual):
            reason += f", as {inside[-1].label!r} became {inside[-1].value}"
        raise _unsolved(loop, reason)
    return candidate.v


def _dependencies(channels: Iterable[Channel], sources: Sources) -> PortDependencies:
    """Return the ports that each port depends on directly at initialization."""
    dependencies: dict[Port, tuple[Port, ...]] = {}
    for channel in channels:
        name = channel.name
        for signal, ports in sources[name].items():
            dependencies[Port(name, signal)] = ports
        for output in channel.interface.outputs:
            inputs = channel.interface.feeds_initially(output.name)
            dependencies[Port(name, output.name)] = tuple(Port(name, signal) for signal in inputs)
    return dependencies


def _drivers_first(members: Iterable[str], sources: Sources) -> list[str]:
    """Return the components, each behind those that drive it, as far as they are in no loop."""
    drivers: dict[str, set[str]] = {}
    for name in members:
        ports = chain.from_iterable(sources[name].values())
        drivers[name] = {port.component for port in ports}
    return list(chain.from_iterable(groups_in_order(drivers)))


def _inputs_first(dependencies: PortDependencies, inputs: Collection[Port]) -> Iterator[Port]:
    """Yield ports after what they depend on, inputs as early as possible.

    So components are initialized as seldom as possible: an output waits until all inputs that can
    be known before it are known.
    """
    sorter = TopologicalSorter(dependencies)
    waiting: list[Port] = []
    sorter.prepare()
    while sorter.is_active():
        ready = sorter.get_ready()
        batch = [port for port in ready if port in inputs]
        waiting += [port for port in ready if port not in inputs]
        if not batch:
            batch = waiting
            waiting = []
        yield from batch
        sorter.done(*batch)


def _tear(inside: dict[Port, list[Port]], interfaces: Mapping[str, Interface]) -> list[Port]:
    """Tear cycles at inputs until there is none; return these inputs. ``inside`` is cut there."""
    torn = []
    while cycle := find_cycle(inside):
        port = _weakest(cycle, interfaces)
        torn.append(port)
        inside[port] = []
    return sorted(torn)


def _weakest(cycle: list[Port], interfaces: Mapping[str, Interface]) -> Port:
    """Return the input at which a cycle is torn.

    Its feedthrough is unknown, else there at initialization only; among equals, the first by name.
    """
    ranked = []
    for port, following in pairwise(cycle):
        interface = interfaces[port.component]
        is_input = port.signal in interface.input_names
        if following.component == port.component and is_input:
            ranked.append((_strength(interface, port.signal, following.signal), port))
    return min(ranked)[1]


def _strength(interface: Interface, signal: str, output: str) -> int:
    """Rank how an output depends on an input: unknown, at initialization only, directly."""
    direct = interface.feedthrough.get(output, ())
    if interface.initial.get(output, direct) is None:
        return 0
    return 2 if signal in interface.feeds(output) else 1


def _is_discrete(signal: Signal) -> bool:
    return signal.type != "real" or signal.variability == "discrete"


def _path_text(path: list[Port], ports: list[Port]) -> str:
    """Return the ports of a loop as one cycle, or as a list where one cycle does not hold all."""
    if set(path) == set(ports):
        return " -> ".join(map(str, path))
    return ", ".join(map(str, ports))


def _residual_text(loop: AlgebraicLoop, candidate: Candidate) -> str:
    port = loop.torn[candidate.element]
    residual = f"residual of {candidate.residual:.3g} at '{port}'"
    return f"{residual}, expected at most {candidate.tolerance:.3g}"


def _unsolved(loop: AlgebraicLoop, reason: str) -> GraphError:
    if loop.jumping:
        names = listing([str(port) for port in loop.jumping])
        reason += f", and {names} may jump as inputs change, so that there may be no solution"
    return GraphError(
        f"no initial values for {loop.path}, which form an algebraic loop at initialization: "
        f"{reason}; give a component of the loop an initial value of its own (a lag or delay with "
        "initial), or other start values"
    )
