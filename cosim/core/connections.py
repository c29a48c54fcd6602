"""Which output drives which input: the connections of a graph, checked against its ports and their units."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from cosim.core.contracts import Component
from cosim.core.signals import Channel, Layout, Signal
from cosim.errors import GraphError, nearest
from cosim.units import BASE, Conversion, Unit, conversion


@dataclass(frozen=True, slots=True, eq=False)
class Connection:
    """``to = gain from + offset``, then from the unit reached to the unit of ``to`` (:mod:`cosim.units`).

    Parameters
    ----------
    source : str
        ``component.output``, or one element of it: ``component.output[1]``.
    gain : float or matrix of shape (size of to, size of from)
    offset : float
        In the unit reached.
    unit : str or None
        Unit reached by gain and offset; None: that of the source.
    """

    source: str
    gain: float | ArrayLike = 1.0
    offset: float = 0.0
    unit: str | None = None

    def __post_init__(self) -> None:
        try:
            gain = np.array(self.gain, np.float64)
        except ValueError as error:
            raise GraphError(
                f"{self.source!r}: gain has rows of different lengths; needed a number or a matrix"
            ) from error
        if gain.ndim not in (0, 2) or not np.isfinite(gain).all() or not np.isfinite(self.offset):
            raise GraphError(
                f"{self.source!r}: found gain {self.gain} and offset {self.offset}; needed finite numbers or a matrix"
            )
        object.__setattr__(self, "gain", gain)


class Ports:
    """Ports by their written names."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.channels = {channel.name: channel for channel in layout.channels}

    def find(self, port: str, causality: Literal["input", "output"]) -> tuple[Channel, Signal]:
        """Find a port of one kind."""
        name, _, wanted = port.partition(".")
        if name not in self.channels:
            raise GraphError(
                f"{port!r}: there is no component {name!r}; {nearest(name, self.channels)}"
            )
        channel = self.channels[name]
        signals = channel.interface.inputs if causality == "input" else channel.interface.outputs
        for signal in signals:
            if signal.name == wanted:
                return channel, signal
        other = "input" if causality == "output" else "output"
        if wanted in (signal.name for signal in channel.signals):
            raise GraphError(
                f"{port!r} is an {other} of {name!r}; needed an {causality}. There is: {_names(signals)}"
            )
        raise GraphError(
            f"{port!r}: {name!r} has no {causality} {wanted!r}; {nearest(wanted, [s.name for s in signals])}"
        )

    def has(self, port: str) -> bool:
        """Say whether an output has just this name."""
        name, _, wanted = port.partition(".")
        return name in self.channels and any(
            s.name == wanted for s in self.channels[name].interface.outputs
        )

    def source(self, port: str) -> tuple[Channel, Signal, slice]:
        """Find an output, or one element of it, and its columns in the row."""
        element = re.fullmatch(r"(.*)\[(\d+)\]", port)
        if element is not None and self.has(port):  # a name of its own that looks like an element
            element = None
        channel, signal = self.find(element[1] if element else port, "output")
        columns = next(columns for s, columns in channel.signal_columns() if s is signal)
        if element is None:
            return channel, signal, columns
        index = int(element[2])
        if index >= signal.size:
            raise GraphError(
                f"{port!r}: '{channel.name}.{signal.name}' has {signal.size} elements, numbered from 0"
            )
        return channel, signal, slice(columns.start + index, columns.start + index + 1)


def check_connections(
    layout: Layout, connections: Mapping[str, Connection], missing: Collection[str] = ()
) -> dict[str, str]:
    """Find every problem of the connections, by the input it belongs to.

    ``missing`` names components that are meant to be there but could not be built: what touches them is not judged.
    """
    ports, problems = Ports(layout), {}
    known = [*ports.channels, *missing]
    for to, connection in connections.items():
        ends = {port: port.partition(".")[0] for port in (to, connection.source)}
        lost = [
            f"{port!r}: there is no component {name!r}; {nearest(name, known)}"
            for port, name in ends.items()
            if name not in known
        ]
        judged = not lost and not set(ends.values()) & set(missing)
        found = "; ".join(_check_connection(ports, to, connection) if judged else lost)
        if found:
            problems[to] = found
    for channel in layout.channels:
        for signal in channel.interface.inputs:
            to = f"{channel.name}.{signal.name}"
            if to not in connections:
                problems[to] = f"'{to}' is not connected; give it a source in [connections]"
    return problems


def _check_connection(ports: Ports, to: str, connection: Connection) -> Iterable[str]:
    found = f"{connection.source} -> {to}"
    try:
        _, target = ports.find(to, "input")
        _, source, columns = ports.source(connection.source)
    except GraphError as error:
        return [str(error)]
    size, problems = columns.stop - columns.start, []
    shape = np.shape(connection.gain)
    if shape:
        if shape != (target.size, size):
            problems.append(f"{found}: gain has shape {shape}, needed ({target.size}, {size})")
    elif size != target.size:
        problems.append(
            f"{found}: size {size}{_unit(source)} cannot drive size {target.size}{_unit(target)}"
        )
    reached = unit_reached(connection, source, target)
    if conversion(reached, target.measure) is None:
        way = f"convert with {{ from = {connection.source!r}, gain = ..., unit = {target.unit!r} }}"
        unknown = [repr(unit.name) for unit in (reached, target.measure) if unit.si is None]
        if unknown:
            way = f"unknown unit {' and '.join(unknown)}; {way}, and offset = ... where it has one, or define it in its FMU"
        problems.append(
            f"{found}: unit {_shown(reached)} cannot drive unit {_shown(target.measure)}; {way}"
        )
    plain = not shape and connection.gain == 1.0 and connection.offset == 0.0
    if plain and not _same(source.measure, reached):
        way = "needs its gain; without it the unit is converted"
        problems.append(
            f"{found}: the source has unit {source.unit!r}; unit = {connection.unit!r} {way}"
        )
    if source.optional and not target.optional:
        problems.append(
            f"{found}: the source may carry no value (NaN), the input needs one at every step"
        )
    return problems


def unit_reached(connection: Connection, source: Signal, target: Signal) -> Unit:
    """Give the unit after gain and offset; a name that either port uses means what it means there."""
    if connection.unit is None:
        return source.measure
    return next(
        (s.measure for s in (source, target) if s.unit == connection.unit), Unit(connection.unit)
    )


def converted(ports: Ports, to: str, connection: Connection) -> Conversion:
    """Give the conversion at the end of a connection that was checked."""
    (_, target), (_, source, _) = ports.find(to, "input"), ports.source(connection.source)
    found = conversion(unit_reached(connection, source, target), target.measure)
    assert found is not None
    return found


def _same(one: Unit, other: Unit) -> bool:
    found = conversion(one, other)
    return found is not None and found.copies


def _shown(unit: Unit) -> str:
    """Name a unit, with what it is where a definition says so."""
    if unit.base is None:
        return repr(unit.name)
    powers = ".".join(
        name if n == 1 else f"{name}{n}"
        for name, n in zip(BASE, unit.base.exponents, strict=True)
        if n
    )
    return f"{unit.name!r} ({powers or '1'})"


def _names(signals: Iterable[Signal]) -> str:
    return ", ".join(signal.name for signal in signals) or "none"


def _unit(signal: Signal) -> str:
    return "" if signal.unit is None else f" [{signal.unit}]"


def layout_of(
    components: Mapping[str, Component], periods: Mapping[str, int] | None = None
) -> Layout:
    """Give every component its columns."""
    channels: list[Channel] = []
    for name, component in components.items():
        start = channels[-1].columns.stop if channels else 0
        channels.append(Channel(name, component.interface, start, (periods or {}).get(name, 1)))
    return Layout(tuple(channels))
