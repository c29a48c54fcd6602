"""The inputs and outputs of a layout by their names, and where they stand in the row."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import Causality, Channel, Interface, Layout, Signal
from cosim.errors import GraphError, nearest
from cosim.units import Unit


@dataclass(frozen=True, slots=True)
class ConnectionEnd:
    """An input or an output, or elements of it, and their columns in the row."""

    channel: Channel
    signal: Signal
    columns: slice
    elements: slice

    @property
    def port(self) -> Port:
        """The whole input or output."""
        return Port(self.channel.name, self.signal.name)

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(self.columns.stop - self.columns.start)

    @property
    def measures(self) -> tuple[Unit, ...]:
        """The units of its elements."""
        return self.signal.measures_of(self.elements)


class Ports:
    """The ports of a layout by their names."""

    def __init__(self, layout: Layout) -> None:
        self.channels = {channel.name: channel for channel in layout.channels}
        self._signals: dict[tuple[str, Causality], dict[str, Signal]] = {}
        self._ends: dict[tuple[Port, Causality], ConnectionEnd] = {}
        for channel in layout.channels:
            name = channel.name
            interface = channel.interface
            self._signals[name, "input"] = {signal.name: signal for signal in interface.inputs}
            self._signals[name, "output"] = {signal.name: signal for signal in interface.outputs}

    def input(self, port: Port) -> ConnectionEnd:
        """Return an input, or elements of it.

        Raises
        ------
        GraphError
            If there is no such input or element; names the nearest.
        """
        return self._end(port, "input")

    def output(self, port: Port) -> ConnectionEnd:
        """Return an output, or elements of it.

        Raises
        ------
        GraphError
            If there is no such output or element; names the nearest.
        """
        return self._end(port, "output")

    def _end(self, port: Port, causality: Causality) -> ConnectionEnd:
        key = (port, causality)
        if key not in self._ends:
            self._ends[key] = self._find(port, causality)
        return self._ends[key]

    def _find(self, port: Port, causality: Causality) -> ConnectionEnd:
        if port.component not in self.channels:
            raise unknown_component(port, self.channels)
        channel = self.channels[port.component]
        match = port.find(self._signals[channel.name, causality])
        if match is None:
            raise unknown_port(port, channel.interface, causality)
        signal, elements = match
        columns = self.columns(Port(channel.name, signal.name), elements)
        return ConnectionEnd(channel, signal, columns, elements)

    def columns(self, port: Port, elements: slice) -> slice:
        """Return the columns of some elements of a whole signal."""
        start = self.channels[port.component].signal_columns[port.signal].start
        return slice(start + elements.start, start + elements.stop)


def layout_of(
    components: Mapping[str, Component], periods: Mapping[str, int] | None = None
) -> Layout:
    """Return the layout that gives every component its columns."""
    channels: list[Channel] = []
    start = 0
    for name, component in components.items():
        period = 1 if periods is None else periods.get(name, 1)
        channel = Channel(name, component.interface, start, period)
        channels.append(channel)
        start = channel.columns.stop
    return Layout(tuple(channels))


def unknown_component(port: Port, known: Iterable[str]) -> GraphError:
    """Return the error of a port whose component is not there."""
    name = port.component
    return GraphError(f"'{port}': there is no component {name!r}; {nearest(name, known)}")


def unknown_port(port: Port, interface: Interface, causality: Causality) -> GraphError:
    """Return the error of a port that its component, with this interface, does not have."""
    signals = interface.inputs if causality == "input" else interface.outputs
    names = [signal.name for signal in signals]
    own_names = [signal.name for signal in interface.signals]
    if port.name in own_names or port.signal in own_names:
        other = "input" if causality == "output" else "output"
        return GraphError(
            f"'{port}': expected an {causality} of {port.component!r}, got an {other}; available: "
            f"{', '.join(names) or 'none'}"
        )
    suggestion = nearest(port.signal, names)
    if "[" in port.signal:
        suggestion = f"{suggestion} (elements are [i] or [i:j], numbered from 0)"
    return GraphError(
        f"'{port}': {port.component!r} has no {causality} {port.signal!r}; {suggestion}"
    )


def undriven_parts(port: Port, signal: Signal, ends: Iterable[ConnectionEnd]) -> list[Port]:
    """Return the parts of an input that nothing drives: all of it, or runs of its elements."""
    driven: set[int] = set()
    for end in ends:
        driven.update(range(end.elements.start, end.elements.stop))
    if not driven:
        return [port]
    parts = []
    start = 0
    for stop in (*sorted(driven), signal.size):
        if stop - start == 1:
            parts.append(Port(port.component, port.signal, start))
        elif stop > start:
            parts.append(Port(port.component, port.signal, range(start, stop)))
        start = stop + 1
    return parts
