"""The connections of a graph, checked: what drives every input, and what nothing drives."""

from __future__ import annotations

from collections.abc import Mapping

from cosim.core.arguments import check_type
from cosim.core.connections import ONE_SOURCE, Connection, SourceText, conversions_of
from cosim.core.port import Port
from cosim.core.signals import Channel, Signal
from cosim.core.structure.connection_checks import check_connections
from cosim.core.structure.ports import Ports, undriven_parts
from cosim.errors import GraphError
from cosim.units import Conversion


class CheckedConnections:
    """Connections by the inputs that they drive.

    Parameters
    ----------
    ports : Ports
    connections : mapping of input, or elements of one, to Connection, or to its source

    Attributes
    ----------
    ports : Ports
    by_port : dict of Port to Connection
        By input, or elements of it.
    parts : dict of Port to list of Port
        The connected ports of every input, in the order of its elements.
    sources : dict of component name to dict of input name to tuple of Port
        The outputs that drive each input.
    conversions : dict of Port to tuple of Conversion
        Where a connection converts units: its conversion for each element of the input.
    unconnected : dict of Port to tuple of float
        The inputs, or elements of them, that nothing drives, and the values that they keep.

    Raises
    ------
    GraphError
        All problems of the connections together.
    """

    def __init__(
        self,
        ports: Ports,
        connections: Mapping[str, SourceText | Connection] | Mapping[Port, Connection],
    ) -> None:
        self.ports = ports
        self.by_port = _checked(ports, connections)
        self.parts = self._parts_by_input()
        self.conversions = self._conversions()
        self.unconnected = self._find_unconnected()
        self.sources = {name: self._sources_of(channel) for name, channel in ports.channels.items()}

    def sources_of(self, port: Port) -> tuple[Port, ...]:
        """Return the outputs, or elements of them, that drive an input, in its order."""
        sources: list[Port] = []
        for part in self.parts[self.ports.input(port).port]:
            sources += self.by_port[part].sources
        return tuple(sources)

    def undriven(self, port: Port, signal: Signal) -> list[Port]:
        """Return the parts of an input that nothing drives."""
        ends = [self.ports.input(to) for to in self.parts[port]]
        return undriven_parts(port, signal, ends)

    def _parts_by_input(self) -> dict[Port, list[Port]]:
        parts: dict[Port, list[Port]] = {}
        for channel in self.ports.channels.values():
            for signal in channel.interface.inputs:
                parts[Port(channel.name, signal.name)] = []
        for to in self.by_port:
            parts[self.ports.input(to).port].append(to)
        for ports in parts.values():
            ports.sort(key=lambda to: self.ports.input(to).elements.start)
        return parts

    def _conversions(self) -> dict[Port, tuple[Conversion, ...]]:
        conversions = {}
        for to, connection in self.by_port.items():
            by_element = conversions_of(self.ports, to, connection)
            if not all(conversion.copies for conversion in by_element):
                conversions[to] = by_element
        return conversions

    def _find_unconnected(self) -> dict[Port, tuple[float, ...]]:
        unconnected = {}
        for channel in self.ports.channels.values():
            for signal in channel.interface.inputs:
                port = Port(channel.name, signal.name)
                for part in self.undriven(port, signal):
                    unconnected[part] = signal.initial_values[part.elements_of(signal)]
        return unconnected

    def _sources_of(self, channel: Channel) -> dict[str, tuple[Port, ...]]:
        """Return the outputs that drive each input of a component."""
        sources = {}
        for signal in channel.interface.inputs:
            driving = self.sources_of(Port(channel.name, signal.name))
            ports = [self.ports.output(port).port for port in driving]
            sources[signal.name] = tuple(dict.fromkeys(ports))
        return sources


def _checked(
    ports: Ports, connections: Mapping[str, SourceText | Connection] | Mapping[Port, Connection]
) -> dict[Port, Connection]:
    """Return the connections by the port of the input, after a check of them all."""
    check_type("connections", connections, Mapping, GraphError)
    parsed: dict[Port, Connection] = {}
    for to, given in connections.items():
        port = to if isinstance(to, Port) else Port.parse(to)
        if port in parsed:
            raise GraphError(f"'{port}' is given twice; {ONE_SOURCE}")
        parsed[port] = given if isinstance(given, Connection) else Connection(given)
    problems = check_connections(ports, parsed)
    if problems:
        raise GraphError("\n".join(problems.values()))
    by_input = {}
    for port, connection in parsed.items():
        whole = ports.input(port).port
        # a signal may have a name that looks like that of an element
        by_input[whole if port.name == whole.signal else port] = connection
    return by_input
