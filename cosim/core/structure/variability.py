"""How signals vary between communication points, and which inputs have a zero-order hold.

A continuous signal is interpolated linearly through a step, a discrete one holds its value from the
start of the step. An output that inherits its variability is discrete where everything behind it
is. An input is held by itself, or where everything that drives it is discrete. What drives an input
may jump and be interpolated all the same: by its left limits, where these are known
(:mod:`cosim.core.structure.jumping`); else the jump becomes a ramp over one step, which is warned
of.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Final

import numpy as np

from cosim.arrays import Mask
from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.core.signals import Channel, Signal, Variability
from cosim.core.structure.cycles import reached_from, strongly_connected
from cosim.core.structure.feedthrough import Edge, Sources
from cosim.core.structure.ports import Ports

BECOMES_A_RAMP: Final = (
    "the jump becomes a ramp over the step before it: an error of first order in the step"
)


class Variabilities:
    """The variability of every output of a graph, and what follows from it for the inputs.

    Parameters
    ----------
    ports : Ports
    connections : mapping of Port to Connection
        By input, or elements of it; checked.
    parts : mapping of Port to sequence of Port
        The connected inputs, or elements of them, of every input.
    sources : mapping of component name to mapping of input to tuple of Port
        The outputs that drive each input.
    zero_order : bool
        Whether every input has a zero-order hold, whatever drives it.
    means : frozenset of str
        Components whose inputs that have one value over a step get the mean, whatever drives them.
    """

    def __init__(
        self,
        ports: Ports,
        connections: Mapping[Port, Connection],
        parts: Mapping[Port, Sequence[Port]],
        sources: Sources,
        *,
        zero_order: bool,
        means: frozenset[str],
    ) -> None:
        self._ports = ports
        self._channels = ports.channels
        self._connections = connections
        self._parts = parts
        self._sources = sources
        self._zero_order = zero_order
        self._means = means
        self._stepped: frozenset[Port] = frozenset()
        self._by_output = self._variabilities()

    def of(self, output: Port) -> Variability:
        """Return the variability of an output; inherited where nothing behind it changes."""
        return self._by_output[self._ports.output(output).port]

    def jumps(self, output: Port) -> list[Port]:
        """Return the discrete outputs whose jumps are known to be in an output, itself first."""
        discrete: list[Port] = []
        reached = [self._ports.output(output).port]
        for port in reached:  # grows on the way
            if self.of(port) == "discrete":
                discrete.append(port)
                continue
            fed = dict.fromkeys(self.fed_to(port))
            reached += [source for source in fed if source not in reached]
        return discrete

    def held_connections(self, names: list[str]) -> set[tuple[Port, Port]]:
        """Return the connections of components, as input and source, with a zero-order hold."""
        held: set[tuple[Port, Port]] = set()
        for name in names:
            for signal in self._channels[name].interface.inputs:
                to = Port(name, signal.name)
                # An output that drives some elements continuously is no held source.
                open_ports: set[Port] = set()
                for part in self._parts[to]:
                    open_ports |= self._open_sources(signal, self._connections[part])
                held.update((to, port) for port in self._sources[name][signal.name])
                held.difference_update((to, port) for port in open_ports)
        return held

    def _open_sources(self, signal: Signal, connection: Connection) -> set[Port]:
        """Return the outputs that drive elements of an input without a zero-order hold."""
        ports = self._driving(connection)
        if connection.matrix.ndim == 2:  # every element may be a sum of all sources
            return set() if self._is_held(signal, *ports) else set(ports)
        return {port for port in ports if not self._is_held(signal, port)}

    def _driving(self, connection: Connection) -> list[Port]:
        """Return the whole outputs behind a connection."""
        return [self._ports.output(port).port for port in connection.sources]

    def _is_held(self, signal: Signal, *sources: Port) -> bool:
        """Return whether an input has a zero-order hold, by itself or by what drives it."""
        if self._zero_order or signal.variability == "discrete":
            return True
        return self._combined(sources) == "discrete"

    def held(
        self,
        channel: Channel,
        extrapolated: frozenset[str],
        loop: frozenset[str],
        torn: Collection[Edge] = (),
    ) -> Mask:
        """Return which input elements of a component have a zero-order hold.

        Parameters
        ----------
        channel : Channel
        extrapolated : frozenset of str
            Its inputs that are known only after it has advanced.
        loop : frozenset of str
            The components of its loop.
        torn : collection of (input Port, source Port)
            The connections that the loop is solved for.
        """
        held: list[bool] = []
        for signal in channel.interface.inputs:
            if self._is_held(signal):
                held += [True] * signal.size
            else:
                # Of an extrapolated input only what comes from inside the loop is extrapolated.
                to = Port(channel.name, signal.name)
                inside = loop if signal.name in extrapolated else frozenset[str]()
                solved = frozenset(source for port, source in torn if port == to)
                held += self._held_elements(to, signal.size, inside, solved)
        mask = np.array(held, dtype=np.bool_)
        mask.setflags(write=False)
        return mask

    def latest(self, channel: Channel, held: Mask) -> Mask:
        """Return which input elements, where they have one value over a step, have that at its end.

        What drives them may jump inside of a step, so that the mean may be no value of it: a
        co-simulation FMU, a component in Python, a switch, what follows one of these directly.
        Those of ``held``, shape (n_u,), do not move.
        """
        stepped = frozenset[Port]() if channel.name in self._means else self._stepped
        mask = self.driven_by(channel, stepped) & ~held
        mask.setflags(write=False)
        return mask

    def driven_by(
        self, channel: Channel, outputs: Collection[Port], *, alone: bool = False
    ) -> Mask:
        """Return which input elements of a component some outputs drive, with others or alone."""
        mask = np.zeros(channel.interface.n_u, np.bool_)
        for signal in channel.interface.inputs if outputs else ():
            for part in self._parts[Port(channel.name, signal.name)]:
                end = self._ports.input(part)
                first = end.columns.start - channel.inputs.start
                sources = [self._ports.output(port) for port in self._connections[part].sources]
                driven = [source.port in outputs for source in sources]
                elements = np.repeat(driven, [source.size for source in sources])
                if self._connections[part].matrix.ndim == 2:  # each may be a sum of all sources
                    elements = np.full(end.size, all(driven) if alone else any(driven))
                mask[first : first + end.size] = elements
        mask.setflags(write=False)
        return mask

    def moving_in(self, loop: frozenset[str]) -> frozenset[Port]:
        """Return the outputs that components drive each other with; none where one is discrete."""
        driving: set[Port] = set()
        for name in loop:
            driving.update(chain.from_iterable(self._sources[name].values()))
        inside = frozenset(port for port in driving if port.component in loop)
        is_held = any(self.of(port) == "discrete" for port in inside)
        return frozenset() if is_held else inside

    def takes_latest(self, channel: Channel) -> bool:
        """Return whether a component has such inputs with one value, unless extrapolated."""
        latest = self.latest(channel, self.held(channel, frozenset(), frozenset()))
        columns = channel.interface.input_columns()
        return any(latest[columns[name]].any() for name in channel.interface.one_value)

    def _held_elements(
        self, to: Port, size: int, loop: frozenset[str], solved: frozenset[Port]
    ) -> list[bool]:
        """Return which elements of an input are driven by discrete signals, or from a loop."""
        held = [False] * size  # where nothing drives it: constant
        for part in self._parts[to]:
            end = self._ports.input(part)
            held[end.elements] = self._held_by(self._connections[part], end.size, loop, solved)
        return held

    def _held_by(
        self, connection: Connection, size: int, loop: frozenset[str], solved: frozenset[Port]
    ) -> list[bool]:
        """Return which elements of what a connection drives have a zero-order hold."""
        sources = [self._ports.output(port) for port in connection.sources]
        ports = [source.port for source in sources]
        inside = [port.component in loop and port not in solved for port in ports]
        if connection.matrix.ndim == 2:  # every element may be a sum of all sources
            together = self._combined(ports)
            is_extrapolated = any(inside) and solved.isdisjoint(ports)
            return [is_extrapolated or together == "discrete"] * size
        discrete = [self.of(source.port) == "discrete" for source in sources]
        elements: list[bool] = []
        for source, from_loop, is_discrete in zip(sources, inside, discrete, strict=True):
            elements += [from_loop or is_discrete] * source.size
        return elements

    def _combined(self, outputs: Iterable[Port]) -> Variability:
        """Return the variability of what follows several outputs."""
        variabilities = {self.of(port) for port in outputs} - {"inherited"}
        if not variabilities:
            return "inherited"
        return "discrete" if variabilities == {"discrete"} else "continuous"

    def warnings(self) -> Iterator[tuple[str, str]]:
        """Yield (component, text) where jumps are interpolated with what is continuous."""
        if self._zero_order:
            return
        for name, sources in self._sources.items():
            outputs = self._channels[name].interface.outputs
            if any(signal.variability == "inherited" for signal in outputs):
                for text in self._ramps_of(chain.from_iterable(sources.values())):
                    yield name, text
        for to, connection in self._connections.items():
            if connection.matrix.ndim == 2:
                for text in self._ramps_of(self._driving(connection)):
                    yield to.component, text
        yield from self._jumps_of_continuous()

    def _ramps_of(self, ports: Iterable[Port]) -> Iterator[str]:
        """Yield what becomes of the jumps in a signal that follows several outputs."""
        by_variability: dict[Variability, list[Port]] = {"discrete": [], "continuous": []}
        for port in dict.fromkeys(ports):
            by_variability.setdefault(self.of(port), []).append(port)
        if by_variability["discrete"] and by_variability["continuous"]:
            jumping = ", ".join(map(str, by_variability["discrete"]))
            yield (
                f"{jumping}: interpolated linearly together with "
                f"{', '.join(map(str, by_variability['continuous']))}, so that a jump becomes a "
                "ramp over the step before it: an error of first order in the step"
            )

    def _jumps_of_continuous(self) -> Iterator[tuple[str, str]]:
        """Yield (component, text) of outputs that jump to what arrives, and are interpolated."""
        for output in self.interpolated():
            if self._starts_apart(output):
                yield (
                    output.component,
                    f"{output} begins with a value of its own and jumps where the first of its "
                    f"input arrives, unless both are equal; {BECOMES_A_RAMP}",
                )

    def interpolated(self) -> list[Port]:
        """Return the continuous outputs that drive inputs which are followed through a step."""
        outputs: dict[Port, None] = {}
        for name in self._sources:
            outputs |= dict.fromkeys(self.followed_by(name))
        return list(outputs)

    def followed_by(self, name: str) -> Iterator[Port]:
        """Yield the continuous outputs that a component follows through a step."""
        if self._zero_order:
            return
        interface = self._channels[name].interface
        inputs = self._sources[name]
        for signal in interface.inputs:
            is_followed = signal.variability != "discrete" and signal.name not in interface.delayed
            if is_followed and signal.name in inputs:
                for output in inputs[signal.name]:
                    if self.of(output) == "continuous":
                        yield output

    def jumps_fed_to(self, output: Port) -> list[Port]:
        """Return the discrete signals that are known to feed through to an output.

        What inherits its variability is left out: there they meet continuous ones, which is said.
        """
        declared = self._channels[output.component].interface.by_name[output.signal]
        if declared.variability == "inherited":
            return []
        ports = dict.fromkeys(self.fed_to(output))
        return [port for port in ports if self.of(port) == "discrete"]

    def fed_to(self, output: Port) -> Iterator[Port]:
        """Yield the outputs that are known to feed through to an output."""
        interface = self._channels[output.component].interface
        if not interface.knows(output.signal):
            return
        inputs = self._sources[output.component]
        for name in interface.feeds(output.signal):
            yield from inputs.get(name, ())

    def _starts_apart(self, output: Port) -> bool:
        """Return whether an output follows a delayed input, and does not begin with its value."""
        interface = self._channels[output.component].interface
        delays = bool(interface.delayed) and not interface.feeds_initially(output.signal)
        return delays and interface.by_name[output.signal].variability == "inherited"

    def _variabilities(self) -> dict[Port, Variability]:
        """Return the variability of every output: what inherits it follows what is behind it.

        A cycle of components that inherit theirs is discrete, unless something continuous enters;
        and so is what begins with another value than the constant that arrives later.
        """
        variabilities: dict[Port, Variability] = {}
        inheriting: dict[str, list[Port]] = {}
        for channel in self._channels.values():
            for signal in channel.interface.outputs:
                port = Port(channel.name, signal.name)
                variabilities[port] = signal.variability
                if signal.variability == "inherited":
                    inheriting.setdefault(channel.name, []).append(port)
        followers: dict[Port, list[Port]] = {}
        drivers: dict[str, list[str]] = {}
        for name, outputs in inheriting.items():
            ports = dict.fromkeys(chain.from_iterable(self._sources[name].values()))
            for port in ports:
                followers.setdefault(port, []).extend(outputs)
            drivers[name] = [port.component for port in _with(variabilities, "inherited", ports)]
        discrete = _with(variabilities, "discrete", variabilities)
        continuous = _with(variabilities, "continuous", variabilities)
        for name in _on_cycles(drivers):
            discrete += inheriting[name]
        inherited = _with(variabilities, "inherited", variabilities)
        discrete += [port for port in inherited if self._starts_apart(port)]
        for port in reached_from(discrete, followers):
            variabilities[port] = "discrete"
        # Last, as one continuous signal is enough.
        for port in reached_from(continuous, followers):
            variabilities[port] = "continuous"
        self._stepped = self._stepped_outputs(discrete, followers, variabilities)
        return variabilities

    def _stepped_outputs(
        self,
        discrete: list[Port],
        followers: Mapping[Port, list[Port]],
        variabilities: Mapping[Port, Variability],
    ) -> frozenset[Port]:
        """Return the outputs that are discrete, or may jump where nobody knows of it.

        What integrates passes on what feeds through; of discrete signals that is known, by left
        limits.
        """
        stepped = list(discrete)
        fed = {port: list(outputs) for port, outputs in followers.items()}
        for channel in self._channels.values():
            interface = channel.interface
            for signal in interface.outputs:
                port = Port(channel.name, signal.name)
                if signal.name in interface.jumping:
                    stepped.append(port)
                if signal.variability != "continuous":
                    continue
                if not interface.continuous:
                    stepped.append(port)
                    continue
                inputs = self._sources[channel.name]
                for name in interface.feeds(signal.name):
                    for source in inputs.get(name, ()):
                        if variabilities[source] != "discrete":
                            fed.setdefault(source, []).append(port)
        return frozenset(reached_from(stepped, fed))


def _with(
    variabilities: Mapping[Port, Variability], wanted: Variability, ports: Iterable[Port]
) -> list[Port]:
    """Return those of the ports that have a variability."""
    return [port for port in ports if variabilities[port] == wanted]


def _on_cycles(drivers: Mapping[str, list[str]]) -> list[str]:
    """Return the components that drive themselves, by others or directly."""
    group_of = strongly_connected(drivers)
    sizes = Counter(group_of.values())
    return [name for name in drivers if sizes[group_of[name]] > 1 or name in drivers[name]]
