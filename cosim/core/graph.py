"""Components by name, the connections between their signals, and the order in which they advance.

Components that influence each other in a circle form a loop; every other component is a cascade, which advances a whole block in
one call. Feedthrough orders only the inside of loops and the start.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Component, Design, Plan
from cosim.core.coupling import Cascade, Loop, Member, Stage, Wire, order_loop
from cosim.core.signals import Channel, Layout, Signal, Variability
from cosim.errors import GraphError, nearest
from cosim.units import same_unit

Coupling = Literal["gauss-seidel", "jacobi"]
Hold = Literal["line", "start"]
COUPLINGS: tuple[str, ...] = ("gauss-seidel", "jacobi")


@dataclass(frozen=True, slots=True, eq=False)
class Connection:
    """``to = gain from + offset``.

    Parameters
    ----------
    source : str
        ``component.output``, or one element of it: ``component.output[1]``.
    gain : float or matrix of shape (size of to, size of from)
    offset : float
    unit : str or None
        Unit after gain and offset; None: that of the source.
    """

    source: str
    gain: float | ArrayLike = 1.0
    offset: float = 0.0
    unit: str | None = None

    def __post_init__(self) -> None:
        try:
            gain = np.array(self.gain, np.float64)
        except ValueError as error:
            raise GraphError(f"{self.source!r}: gain has rows of different lengths; needed a number or a matrix") from error
        if gain.ndim not in (0, 2) or not np.isfinite(gain).all() or not np.isfinite(self.offset):
            raise GraphError(
                f"{self.source!r}: found gain {self.gain} and offset {self.offset}; needed finite numbers or a matrix"
            )
        object.__setattr__(self, "gain", gain)


class Graph:
    """A checked, ordered and then immutable network of components.

    Parameters
    ----------
    components : mapping of name to Component
    connections : mapping of ``component.input`` to ``component.output`` or Connection
    coupling : {"gauss-seidel", "jacobi"}
        How the components of a loop advance.
    hold : {"line", "start"}
        "line": continuous signals are straight lines inside a step. "start": every input holds its value from the start of
        the step, as most masters do; first order only.
    periods : mapping of component name to int
        Communication steps between the rows that a component's log channel keeps; 1 where not named.

    Raises
    ------
    GraphError
        All problems together: unknown names, unconnected inputs, sizes, units.
    AlgebraicLoopError
        If outputs feed through to each other in a circle.
    """

    def __init__(
        self,
        components: Mapping[str, Component],
        connections: Mapping[str, str | Connection],
        *,
        coupling: Coupling = "gauss-seidel",
        hold: Hold = "line",
        periods: Mapping[str, int] | None = None,
    ) -> None:
        if not components:
            raise GraphError("the graph has no components; needed at least one")
        dotted = [name for name in components if "." in name or not name]
        if dotted:
            raise GraphError(f"component {dotted[0]!r}: a component's name must not be empty and has no dot")
        if coupling not in COUPLINGS:
            raise GraphError(f"coupling: found {coupling!r}; {nearest(coupling, COUPLINGS)}")
        if hold not in ("line", "start"):
            raise GraphError(f"hold: found {hold!r}; {nearest(hold, ('line', 'start'))}")
        for name, period in (periods or {}).items():
            if name not in components:
                raise GraphError(f"periods: there is no component {name!r}; {nearest(name, components)}")
            if period < 1:
                raise GraphError(f"periods: found {period} steps for {name!r}, needed at least 1")
        self.components = dict(components)
        self.connections = {to: c if isinstance(c, Connection) else Connection(c) for to, c in connections.items()}
        self.coupling, self.hold, self.periods = coupling, hold, dict(periods or {})
        self.layout = layout_of(self.components, self.periods)
        self._ports = _Ports(self.layout)
        problems = check_connections(self.layout, self.connections)
        if problems:
            raise GraphError("\n".join(problems.values()))
        self._members = {name: self._member(name) for name in self.components}
        self.stages = self._order()
        self.held = {name: self._held(name) for stage in self.stages for name in stage.names}  # which inputs keep their value

    def prepare(self, step_ns: int, recorded: Mapping[str, Design] | None = None) -> Plan:
        """Let every component compute its design for the communication step; say what was decided."""
        h = step_ns / 1e9
        designs = {
            name: component.prepare(h, self.held[name], (recorded or {}).get(name, {}))
            for name, component in self.components.items()
        }
        return Plan(self.layout, step_ns, designs, self.held, tuple(stage.description for stage in self.stages))

    def initialize(self, t: float, row: Vector) -> None:
        """Fill the first row: initialise every component with its inputs, again until no input changes.

        Raises
        ------
        GraphError
            If initial values chase each other in a circle and do not settle.
        """
        names = [name for stage in self.stages for name in stage.names]
        rows = row[np.newaxis]
        for _ in range(len(names) + 2):  # the longest chain, once more where it closes, and once to see that nothing moves
            before = row.copy()
            for name in names:
                member = self._members[name]
                member.gather(rows, slice(0, 1))
                row[member.outputs] = member.component.initialize(t, row[member.inputs].copy())
            if np.array_equal(before, row, equal_nan=True):
                return
        moving = [label for label, a, b in zip(self.labels(), before, row, strict=True) if a != b and not np.isnan(b)]
        raise GraphError(
            f"initial values do not settle: {', '.join(moving)} still change after {len(names) + 2} rounds; "
            "give a lag or a delay among them a start value of its own"
        )

    def first_non_finite(self, stage: Stage, rows: Matrix) -> NonFinite | None:
        """Find, among the columns of a stage, the first value that is not finite: by row, then by component and signal."""
        found: NonFinite | None = None
        for name in stage.names:
            channel = self.layout[name]
            if np.isfinite(rows[:, channel.columns]).all():
                continue
            for signal, columns in channel.signal_columns():
                values = rows[: None if found is None else found.row, columns]
                bad = ~np.isfinite(values) & ~(np.isnan(values) & signal.optional)
                if bad.any():
                    row, element = np.unravel_index(int(np.argmax(bad)), bad.shape)
                    found = NonFinite(int(row), f"{name}.{signal.elements[element]}", float(values[row, element]))
        return found

    def labels(self) -> list[str]:
        """Name every column: ``component.signal`` or ``component.signal[i]``."""
        return [f"{c.name}.{element}" for c in self.layout.channels for signal in c.signals for element in signal.elements]

    # --- structure ---

    def _member(self, name: str) -> Member:
        channel = self.layout[name]
        wires = []
        for signal, columns in channel.signal_columns():
            connection = self.connections.get(f"{name}.{signal.name}")
            if connection is not None:
                _, _, source = self._ports.source(connection.source)
                wires.append(Wire.of(columns, source, np.asarray(connection.gain), connection.offset))
        return Member(name, self.components[name], channel.inputs, channel.outputs, tuple(wires))

    def _drivers(self, name: str) -> set[str]:
        return {
            self._ports.source(self.connections[f"{name}.{signal.name}"].source)[0].name
            for signal in self.layout[name].interface.inputs
        }

    def _order(self) -> tuple[Stage, ...]:
        names = list(self.components)
        number = {name: i for i, name in enumerate(names)}
        reach = np.eye(len(names), dtype=np.bool_)
        for name in names:
            for driver in self._drivers(name):
                reach[number[driver], number[name]] = True
        for _ in range(len(names).bit_length()):  # paths of twice the length each time
            reach = reach @ reach
        together = reach & reach.T
        group = [int(np.argmax(together[i])) for i in range(len(names))]
        sorter: TopologicalSorter[int] = TopologicalSorter({g: set() for g in dict.fromkeys(group)})
        for name in names:
            for driver in self._drivers(name):
                if group[number[driver]] != group[number[name]]:
                    sorter.add(group[number[name]], group[number[driver]])
        return tuple(self._stage([n for n in names if group[number[n]] == g]) for g in sorter.static_order())

    def _stage(self, names: list[str]) -> Stage:
        if len(names) == 1 and names[0] not in self._drivers(names[0]):
            return Cascade(self._members[names[0]])
        inputs = {name: {s.name: self._source_port(name, s) for s in self.layout[name].interface.inputs} for name in names}
        interfaces = {name: self.layout[name].interface for name in names}
        operations, late = order_loop(interfaces, inputs, jacobi=self.coupling == "jacobi")
        plan = tuple((kind, self._members[name]) for kind, name in operations)
        return Loop(self.coupling, tuple(self._members[name] for name in names), plan, late)

    def _source_port(self, name: str, signal: Signal) -> tuple[str, str]:
        channel, source, _ = self._ports.source(self.connections[f"{name}.{signal.name}"].source)
        return channel.name, source.name

    def _held(self, name: str) -> Mask:
        late = next(stage.late.get(name, frozenset()) for stage in self.stages if name in stage.names)
        held = []
        for signal in self.layout[name].interface.inputs:
            discrete = signal.variability == "discrete" or self._variability(*self._source_port(name, signal)) == "discrete"
            held += [self.hold == "start" or discrete or signal.name in late] * signal.size
        return np.array(held, dtype=np.bool_)

    def _variability(self, name: str, output: str, seen: frozenset[str] = frozenset()) -> Variability:
        """Resolve an inherited variability: discrete where every input behind it is."""
        _, signal = self._ports.find(f"{name}.{output}", "output")
        if signal.variability != "inherited":
            return signal.variability
        if name in seen:
            return "discrete"
        behind = [self._source_port(name, s) for s in self.layout[name].interface.inputs]
        found = {self._variability(*port, seen | {name}) for port in behind}
        return "discrete" if found == {"discrete"} else "continuous"


class _Ports:
    """Look up ports by their written names."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.channels = {channel.name: channel for channel in layout.channels}

    def find(self, port: str, causality: Literal["input", "output"]) -> tuple[Channel, Signal]:
        name, _, wanted = port.partition(".")
        if name not in self.channels:
            raise GraphError(f"{port!r}: there is no component {name!r}; {nearest(name, self.channels)}")
        channel = self.channels[name]
        signals = channel.interface.inputs if causality == "input" else channel.interface.outputs
        for signal in signals:
            if signal.name == wanted:
                return channel, signal
        other = "input" if causality == "output" else "output"
        if wanted in (signal.name for signal in channel.signals):
            raise GraphError(f"{port!r} is an {other} of {name!r}; needed an {causality}. There is: {_names(signals)}")
        raise GraphError(f"{port!r}: {name!r} has no {causality} {wanted!r}; {nearest(wanted, [s.name for s in signals])}")

    def has(self, port: str) -> bool:
        name, _, wanted = port.partition(".")
        return name in self.channels and any(s.name == wanted for s in self.channels[name].interface.outputs)

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
            raise GraphError(f"{port!r}: '{channel.name}.{signal.name}' has {signal.size} elements, numbered from 0")
        return channel, signal, slice(columns.start + index, columns.start + index + 1)


def check_connections(layout: Layout, connections: Mapping[str, Connection], missing: Collection[str] = ()) -> dict[str, str]:
    """Find every problem of the connections, by the input it belongs to.

    ``missing`` names components that are meant to be there but could not be built: what touches them is not judged.
    """
    ports, problems = _Ports(layout), {}
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


def _check_connection(ports: _Ports, to: str, connection: Connection) -> Iterable[str]:
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
        problems.append(f"{found}: size {size}{_unit(source)} cannot drive size {target.size}{_unit(target)}")
    unit = connection.unit or source.unit
    if not same_unit(unit, target.unit):
        way = f"convert with {{ from = {connection.source!r}, gain = ..., unit = {target.unit!r} }}"
        problems.append(f"{found}: unit {unit!r} cannot drive unit {target.unit!r}; {way}")
    plain = not shape and connection.gain == 1.0 and connection.offset == 0.0
    if plain and not same_unit(source.unit, connection.unit):
        problems.append(f"{found}: the source has unit {source.unit!r}; unit = {connection.unit!r} needs its gain")
    if source.optional and not target.optional:
        problems.append(f"{found}: the source may carry no value (NaN), the input needs one at every step")
    return problems


def _names(signals: Iterable[Signal]) -> str:
    return ", ".join(signal.name for signal in signals) or "none"


def _unit(signal: Signal) -> str:
    return "" if signal.unit is None else f" [{signal.unit}]"


def layout_of(components: Mapping[str, Component], periods: Mapping[str, int] | None = None) -> Layout:
    """Give every component its columns."""
    channels: list[Channel] = []
    for name, component in components.items():
        start = channels[-1].columns.stop if channels else 0
        channels.append(Channel(name, component.interface, start, (periods or {}).get(name, 1)))
    return Layout(tuple(channels))


@dataclass(frozen=True, slots=True)
class NonFinite:
    """A value that is infinite, or NaN where that does not mean "no value yet": ``label`` names its column."""

    row: int
    label: str
    value: float
