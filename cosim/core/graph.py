"""Components by name, the connections between their signals, and the order in which they advance.

Components on a cycle of the graph form a loop; every other component is a cascade, which advances a
whole block in one call. Feedthrough orders only the inside of loops and the initialization.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from itertools import chain
from typing import Literal

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.connections import (
    Connection,
    Ports,
    SourceText,
    check_connections,
    conversions_of,
    layout_of,
    unit_warnings,
)
from cosim.core.contracts import Component, Design, Plan, prepare
from cosim.core.coupling import Cascade, Loop, Member, Stage, Wire, constant_wires, wires_of
from cosim.core.initial_values import InitialValues
from cosim.core.order import order_loop, strongly_connected
from cosim.core.port import Port
from cosim.core.signals import Channel, Variability
from cosim.errors import GraphError, NonFiniteError, nearest
from cosim.units import Conversion

Coupling = Literal["gauss-seidel", "jacobi"]
InputInterpolation = Literal["linear", "zero-order"]
COUPLINGS: tuple[str, ...] = ("gauss-seidel", "jacobi")
INTERPOLATIONS: tuple[str, ...] = ("linear", "zero-order")


class Graph:
    """A checked, ordered and then immutable network of components.

    Parameters
    ----------
    components : mapping of name to Component
    connections : mapping of ``component.input`` to Connection, or to what it takes as its source
    coupling : {"gauss-seidel", "jacobi"}
        How the components of a loop advance.
    input_interpolation : {"linear", "zero-order"}
        "linear": continuous signals are interpolated linearly inside a step. "zero-order": every
        input holds its value from the start of the step, as in most masters; first order only.
    periods : mapping of component name to int
        Communication steps between the rows that a component's log channel keeps; 1 where not
        named.

    Attributes
    ----------
    connections : dict of Port to Connection
    conversions : dict of Port to tuple of Conversion
        Where a connection converts units: its conversion for each source.
    unconnected : dict of Port to tuple of float
        The inputs that nothing drives, and the value that each keeps.
    held : dict of component name to Mask, shape (n_u,)
        Which input elements have a zero-order hold.
    initializations : int
        How often the components were initialized.

    Raises
    ------
    GraphError
        All problems together: unknown names, unconnected inputs, sizes, units.
    AlgebraicLoopError
        If outputs are known to feed through to each other in a cycle.
    """

    def __init__(
        self,
        components: Mapping[str, Component],
        connections: Mapping[str, SourceText | Connection] | Mapping[Port, Connection],
        *,
        coupling: Coupling = "gauss-seidel",
        input_interpolation: InputInterpolation = "linear",
        periods: Mapping[str, int] | None = None,
    ) -> None:
        _check_names(components)
        _check_choice("coupling", coupling, COUPLINGS)
        _check_choice("input_interpolation", input_interpolation, INTERPOLATIONS)
        self.periods = dict(periods or {})
        _check_periods(self.periods, components)
        self.components = dict(components)
        self.coupling = coupling
        self.input_interpolation = input_interpolation
        self.layout = layout_of(self.components, self.periods)
        self._ports = Ports(self.layout)
        self.connections = self._checked(connections)
        self.conversions = self._conversions()
        self.unconnected = self._find_unconnected()
        self._sources = {
            channel.name: self._sources_of(channel) for channel in self.layout.channels
        }
        wires: dict[Port, tuple[Wire, ...]] = {}
        self._members: dict[str, Member] = {}
        for name in self.components:
            wires_of_inputs = self._wires_of(name)
            wires.update(wires_of_inputs)
            self._members[name] = self._member(name, wires_of_inputs)
        self.stages = self._order()
        self.initializations = 0
        self._initial_values = InitialValues(self.layout, self._members, self._sources, wires)
        self.held: dict[str, Mask] = {}
        for stage in self.stages:
            for name in stage.names:
                self.held[name] = self._held(name, stage)

    def prepare(self, step_ns: int, recorded: Mapping[str, Design] | None = None) -> Plan:
        """Prepare every component for the communication step; return what is fixed by that."""
        h = step_ns / 1e9
        designs: dict[str, Design] = {}
        for name, component in self.components.items():
            design = {} if recorded is None else recorded.get(name, {})
            designs[name] = prepare(component, h, self.held[name], design)
        schedule = tuple(stage.description for stage in self.stages)
        return Plan(self.layout, step_ns, designs, self.held, schedule)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # the check below names them
    def initialize(self, t: float, row: Vector) -> None:
        """Initialize all components together; see :mod:`cosim.core.initial_values`.

        Parameters
        ----------
        t : float
            Start time [s].
        row : Vector, shape (width,)
            Is filled.

        Raises
        ------
        GraphError
            If initial values depend on each other and no solution was found.
        NonFiniteError
            If an initial value is not finite.
        """
        self.initializations += 1
        self._initial_values.find(t, row)
        for stage in self.stages:
            bad = self.first_non_finite(stage, row[np.newaxis])
            if bad is not None:
                raise bad.error(t)

    def first_non_finite(self, stage: Stage, rows: Matrix) -> NonFinite | None:
        """Return the first value of a stage that is not finite: by row, component and signal."""
        first: NonFinite | None = None
        for name in stage.names:
            channel = self.layout[name]
            if np.isfinite(rows[:, channel.columns]).all():
                continue
            for signal, columns in channel.signal_columns():
                # Only rows before the one found already: the earliest row wins.
                end = None if first is None else first.row
                values = rows[:end, columns]
                no_value = np.isnan(values) & signal.optional
                bad = ~np.isfinite(values) & ~no_value
                if bad.any():
                    row, element = np.unravel_index(int(np.argmax(bad)), bad.shape)
                    label = f"{name}.{signal.elements[element]}"
                    first = NonFinite(int(row), label, float(values[row, element]))
        return first

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """What was assumed, and where the interpolation of inputs errs, as (component, text)."""
        warnings = list(unit_warnings(self.layout, self.connections))
        warnings += self._ramps()
        for stage in self.stages:
            warnings += stage.warnings
        return warnings

    def labels(self) -> list[str]:
        """Return the name of every column: ``component.signal`` or ``component.signal[i]``."""
        labels = []
        for channel in self.layout.channels:
            for signal in channel.signals:
                labels += [f"{channel.name}.{element}" for element in signal.elements]
        return labels

    # --- structure ---

    def _checked(
        self, connections: Mapping[str, SourceText | Connection] | Mapping[Port, Connection]
    ) -> dict[Port, Connection]:
        """Return the connections by the port of the input, after a check of them all."""
        parsed: dict[Port, Connection] = {}
        for to, given in connections.items():
            port = to if isinstance(to, Port) else Port.parse(to)
            parsed[port] = given if isinstance(given, Connection) else Connection(given)
        problems = check_connections(self.layout, parsed)
        if problems:
            raise GraphError("\n".join(problems.values()))
        by_input = {}
        for port, connection in parsed.items():
            channel, signal = self._ports.input(port)
            by_input[Port(channel.name, signal.name)] = connection
        return by_input

    def _conversions(self) -> dict[Port, tuple[Conversion, ...]]:
        conversions = {}
        for to, connection in self.connections.items():
            by_source = conversions_of(self._ports, to, connection)
            if not all(conversion.copies for conversion in by_source):
                conversions[to] = by_source
        return conversions

    def _find_unconnected(self) -> dict[Port, tuple[float, ...]]:
        unconnected = {}
        for channel in self.layout.channels:
            for signal in channel.interface.inputs:
                port = Port(channel.name, signal.name)
                if port not in self.connections:
                    unconnected[port] = signal.initial_values
        return unconnected

    def _sources_of(self, channel: Channel) -> dict[str, tuple[Port, ...]]:
        """Return the outputs that drive each input."""
        sources = {}
        for signal in channel.interface.inputs:
            connection = self.connections.get(Port(channel.name, signal.name))
            driving = () if connection is None else connection.sources
            ports = [self._ports.source(port).port for port in driving]
            sources[signal.name] = tuple(dict.fromkeys(ports))
        return sources

    def _wires_of(self, name: str) -> dict[Port, tuple[Wire, ...]]:
        """Return the wires that feed each input of a component."""
        wires = {}
        channel = self.layout[name]
        for signal, columns in channel.signal_columns():
            port = Port(name, signal.name)
            connection = self.connections.get(port)
            if connection is None:
                if port in self.unconnected:
                    wires[port] = constant_wires(columns, signal.initial_values)
                continue  # else an output
            sources = [self._ports.source(source) for source in connection.sources]
            copies = (Conversion(),) * len(sources)
            conversions = self.conversions.get(port, copies)
            wires[port] = wires_of(columns, connection, sources, conversions)
        return wires

    def _member(self, name: str, wires: Mapping[Port, tuple[Wire, ...]]) -> Member:
        channel = self.layout[name]
        flat = chain.from_iterable(wires.values())
        component = self.components[name]
        return Member(name, component, channel.inputs, channel.outputs, tuple(flat))

    def _drivers(self, name: str) -> set[str]:
        """Return the components that drive an input of this one."""
        drivers: set[str] = set()
        for ports in self._sources[name].values():
            drivers.update(port.component for port in ports)
        return drivers

    def _order(self) -> tuple[Stage, ...]:
        """Return the strongly connected components of the graph, as stages in topological order."""
        names = list(self.components)
        group_of = strongly_connected({name: self._drivers(name) for name in names})
        sorter: TopologicalSorter[str] = TopologicalSorter()
        for name in names:
            sorter.add(group_of[name])
        for name in names:
            for driver in self._drivers(name):
                if group_of[driver] != group_of[name]:
                    sorter.add(group_of[name], group_of[driver])
        stages = []
        for group in sorter.static_order():
            members = [name for name in names if group_of[name] == group]
            stages.append(self._stage(members))
        return tuple(stages)

    def _stage(self, names: list[str]) -> Stage:
        if len(names) == 1 and names[0] not in self._drivers(names[0]):
            return Cascade(self._members[names[0]])
        interfaces = {name: self.layout[name].interface for name in names}
        sources = {name: self._sources[name] for name in names}
        order = order_loop(interfaces, sources, jacobi=self.coupling == "jacobi")
        members = [self._members[name] for name in names]
        operations = [(kind, self._members[name]) for kind, name in order.operations]
        warnings = [(unknown.component, str(unknown)) for unknown in order.unknown]
        return Loop(
            self.coupling, tuple(members), tuple(operations), order.extrapolated, tuple(warnings)
        )

    def _held(self, name: str, stage: Stage) -> Mask:
        """Return which input elements of a component have a zero-order hold."""
        extrapolated = stage.extrapolated.get(name, frozenset())
        held: list[bool] = []
        for signal in self.layout[name].interface.inputs:
            zero_order = (
                self.input_interpolation == "zero-order" or signal.variability == "discrete"
            )
            if zero_order:
                held += [True] * signal.size
            else:
                # Of an extrapolated input only what comes from inside the loop is extrapolated.
                loop = stage.names if signal.name in extrapolated else ()
                held += self._held_elements(Port(name, signal.name), signal.size, loop)
        return np.array(held, dtype=np.bool_)

    def _held_elements(self, to: Port, size: int, loop: tuple[str, ...]) -> list[bool]:
        """Return which elements of an input are driven by discrete signals, or from a loop."""
        connection = self.connections.get(to)
        if connection is None:  # constant
            return [False] * size
        sources = [self._ports.source(port) for port in connection.sources]
        inside = [source.port.component in loop for source in sources]
        if connection.matrix.ndim == 2:  # every element may be a sum of all sources
            together = self._combined([source.port for source in sources])
            return [any(inside) or together == "discrete"] * size
        discrete = [self.variability(source.port) == "discrete" for source in sources]
        elements: list[bool] = []
        for source, from_loop, is_discrete in zip(sources, inside, discrete, strict=True):
            elements += [from_loop or is_discrete] * source.size
        return elements

    def variability(self, output: Port, visited: frozenset[str] = frozenset()) -> Variability:
        """Return the variability of an output.

        An inherited one is discrete where every input of its component is. It stays inherited where
        nothing is behind it that changes: constants hold and are interpolated alike.
        """
        name = output.component
        signal = self._ports.source(output).signal
        if signal.variability != "inherited":
            return signal.variability
        if name in visited:
            return "discrete"
        ports = chain.from_iterable(self._sources[name].values())
        return self._combined(ports, visited | {name})

    def _combined(
        self, outputs: Iterable[Port], visited: frozenset[str] = frozenset()
    ) -> Variability:
        """Return the variability of what follows several outputs."""
        found = {self.variability(port, visited) for port in outputs} - {"inherited"}
        if not found:
            return "inherited"
        return "discrete" if found == {"discrete"} else "continuous"

    def _ramps(self) -> Iterator[tuple[str, str]]:
        """Yield (component, text) where jumps are interpolated with what is continuous."""
        if self.input_interpolation == "zero-order":
            return
        for name, sources in self._sources.items():
            outputs = self.layout[name].interface.outputs
            if any(signal.variability == "inherited" for signal in outputs):
                for text in self._ramps_of(chain.from_iterable(sources.values())):
                    yield name, text
        for to, connection in self.connections.items():
            if connection.matrix.ndim == 2:
                for text in self._ramps_of(self._sources[to.component][to.signal]):
                    yield to.component, text

    def _ramps_of(self, ports: Iterable[Port]) -> Iterator[str]:
        """Yield what becomes of the jumps in a signal that follows several outputs."""
        by_variability: dict[Variability, list[Port]] = {"discrete": [], "continuous": []}
        for port in dict.fromkeys(ports):
            by_variability.setdefault(self.variability(port), []).append(port)
        if by_variability["discrete"] and by_variability["continuous"]:
            jumping = ", ".join(map(str, by_variability["discrete"]))
            yield (
                f"{jumping}: interpolated linearly together with "
                f"{', '.join(map(str, by_variability['continuous']))}, so that a jump becomes a "
                "ramp over the step before it: an error of first order in the step"
            )


def _check_names(components: Mapping[str, Component]) -> None:
    if not components:
        raise GraphError("the graph has no components; needed at least one")
    for name in components:
        if "." in name or not name:
            raise GraphError(
                f"component {name!r}: a component's name must not be empty and has no dot"
            )


def _check_choice(key: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise GraphError(f"{key}: found {value!r}; {nearest(value, choices)}")


def _check_periods(periods: Mapping[str, int], components: Mapping[str, Component]) -> None:
    for name, period in periods.items():
        if name not in components:
            suggestion = nearest(name, components)
            raise GraphError(f"periods: there is no component {name!r}; {suggestion}")
        if period < 1:
            raise GraphError(f"periods: found {period} steps for {name!r}, needed at least 1")


@dataclass(frozen=True, slots=True)
class NonFinite:
    """A value that is infinite, or NaN where NaN does not mean "no value yet".

    ``label`` names its column, ``row`` is counted from the first row searched.
    """

    row: int
    label: str
    value: float

    def error(self, t: float) -> NonFiniteError:
        """Return the error that names it, at time ``t`` [s]."""
        return NonFiniteError(
            f"{self.label!r} became {self.value} at t = {t} s; the log keeps everything before"
        )
