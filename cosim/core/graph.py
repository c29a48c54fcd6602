"""Components by name, the connections between their signals, and the order in which they advance.

Components that influence each other in a circle form a loop; every other component is a cascade, which advances a whole block in
one call. Feedthrough orders only the inside of loops and the start.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from typing import Literal

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.connections import Connection, Ports, check_connections, converted, layout_of
from cosim.core.contracts import Component, Design, Plan
from cosim.core.coupling import Cascade, Loop, Member, Stage, Wire
from cosim.core.initial_values import InitialValues
from cosim.core.order import Port, order_loop
from cosim.core.signals import Channel, Variability
from cosim.errors import GraphError, nearest
from cosim.units import Conversion

Coupling = Literal["gauss-seidel", "jacobi"]
InputInterpolation = Literal["linear", "zero-order"]
COUPLINGS: tuple[str, ...] = ("gauss-seidel", "jacobi")


class Graph:
    """A checked, ordered and then immutable network of components.

    Parameters
    ----------
    components : mapping of name to Component
    connections : mapping of ``component.input`` to ``component.output`` or Connection
    coupling : {"gauss-seidel", "jacobi"}
        How the components of a loop advance.
    input_interpolation : {"linear", "zero-order"}
        "linear": continuous signals are interpolated linearly inside a step. "zero-order": every input holds its value from the start of
        the step, as most masters do; first order only.
    periods : mapping of component name to int
        Communication steps between the rows that a component's log channel keeps; 1 where not named.

    Raises
    ------
    GraphError
        All problems together: unknown names, unconnected inputs, sizes, units.
    AlgebraicLoopError
        If outputs are known to feed through to each other in a circle.
    """

    def __init__(
        self,
        components: Mapping[str, Component],
        connections: Mapping[str, str | Connection],
        *,
        coupling: Coupling = "gauss-seidel",
        input_interpolation: InputInterpolation = "linear",
        periods: Mapping[str, int] | None = None,
    ) -> None:
        if not components:
            raise GraphError("the graph has no components; needed at least one")
        dotted = [name for name in components if "." in name or not name]
        if dotted:
            raise GraphError(
                f"component {dotted[0]!r}: a component's name must not be empty and has no dot"
            )
        if coupling not in COUPLINGS:
            raise GraphError(f"coupling: found {coupling!r}; {nearest(coupling, COUPLINGS)}")
        if input_interpolation not in ("linear", "zero-order"):
            raise GraphError(
                f"input_interpolation: found {input_interpolation!r}; {nearest(input_interpolation, ('linear', 'zero-order'))}"
            )
        for name, period in (periods or {}).items():
            if name not in components:
                raise GraphError(
                    f"periods: there is no component {name!r}; {nearest(name, components)}"
                )
            if period < 1:
                raise GraphError(f"periods: found {period} steps for {name!r}, needed at least 1")
        self.components = dict(components)
        self.connections = {
            to: c if isinstance(c, Connection) else Connection(c) for to, c in connections.items()
        }
        self.coupling, self.input_interpolation, self.periods = (
            coupling,
            input_interpolation,
            dict(periods or {}),
        )
        self.layout = layout_of(self.components, self.periods)
        self._ports = Ports(self.layout)
        problems = check_connections(self.layout, self.connections)
        if problems:
            raise GraphError("\n".join(problems.values()))
        found = {
            to: converted(self._ports, to, connection)
            for to, connection in self.connections.items()
        }
        self.conversions = {
            to: conversion for to, conversion in found.items() if not conversion.copies
        }
        self._sources = {
            channel.name: self._sources_of(channel) for channel in self.layout.channels
        }
        self._members = {name: self._member(name) for name in self.components}
        self.stages = self._order()
        self._start = InitialValues(self.layout, self._members, self._sources)
        self.held = {
            name: self._held(name) for stage in self.stages for name in stage.names
        }  # which inputs keep their value

    def prepare(self, step_ns: int, recorded: Mapping[str, Design] | None = None) -> Plan:
        """Let every component compute its design for the communication step; say what was decided."""
        h = step_ns / 1e9
        designs = {
            name: component.prepare(h, self.held[name], (recorded or {}).get(name, {}))
            for name, component in self.components.items()
        }
        return Plan(
            self.layout,
            step_ns,
            designs,
            self.held,
            tuple(stage.description for stage in self.stages),
        )

    def initialize(self, t: float, row: Vector) -> None:
        """Fill the first row: initialize all components together; see :mod:`cosim.core.initial_values`.

        Raises
        ------
        GraphError
            If initial values depend on each other in a circle that has no solution, or none that was found.
        """
        self._start.find(t, row)

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
                    found = NonFinite(
                        int(row), f"{name}.{signal.elements[element]}", float(values[row, element])
                    )
        return found

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """What is right only if something unknown is as it was taken, as (component, text)."""
        return [warning for stage in self.stages for warning in stage.warnings]

    def labels(self) -> list[str]:
        """Name every column: ``component.signal`` or ``component.signal[i]``."""
        return [
            f"{c.name}.{element}"
            for c in self.layout.channels
            for signal in c.signals
            for element in signal.elements
        ]

    # --- structure ---

    def _member(self, name: str) -> Member:
        channel = self.layout[name]
        wires = []
        for signal, columns in channel.signal_columns():
            port = f"{name}.{signal.name}"
            connection = self.connections.get(port)
            if connection is not None:
                _, _, source = self._ports.source(connection.source)
                gain, conversion = (
                    np.asarray(connection.gain),
                    self.conversions.get(port, Conversion()),
                )
                wires.append(Wire.of(columns, source, gain, connection.offset, conversion))
        return Member(name, self.components[name], channel.inputs, channel.outputs, tuple(wires))

    def _sources_of(self, channel: Channel) -> dict[str, Port]:
        """Give the output that drives each input."""
        found = {
            s.name: self._ports.source(self.connections[f"{channel.name}.{s.name}"].source)
            for s in channel.interface.inputs
        }
        return {name: (source.name, output.name) for name, (source, output, _) in found.items()}

    def _drivers(self, name: str) -> set[str]:
        return {driver for driver, _ in self._sources[name].values()}

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
        return tuple(
            self._stage([n for n in names if group[number[n]] == g]) for g in sorter.static_order()
        )

    def _stage(self, names: list[str]) -> Stage:
        if len(names) == 1 and names[0] not in self._drivers(names[0]):
            return Cascade(self._members[names[0]])
        interfaces = {name: self.layout[name].interface for name in names}
        sources = {name: self._sources[name] for name in names}
        order = order_loop(interfaces, sources, jacobi=self.coupling == "jacobi")
        plan = tuple((kind, self._members[name]) for kind, name in order.operations)
        warnings = tuple((doubt.component, str(doubt)) for doubt in order.doubts)
        return Loop(
            self.coupling, tuple(self._members[name] for name in names), plan, order.late, warnings
        )

    def _held(self, name: str) -> Mask:
        late = next(
            stage.late.get(name, frozenset()) for stage in self.stages if name in stage.names
        )
        held = []
        for signal in self.layout[name].interface.inputs:
            discrete = (
                signal.variability == "discrete"
                or self.variability(*self._sources[name][signal.name]) == "discrete"
            )
            held += [
                self.input_interpolation == "zero-order" or discrete or signal.name in late
            ] * signal.size
        return np.array(held, dtype=np.bool_)

    def variability(
        self, name: str, output: str, seen: frozenset[str] = frozenset()
    ) -> Variability:
        """Give the variability of an output; an inherited one is discrete where every input behind it is."""
        _, signal = self._ports.find(f"{name}.{output}", "output")
        if signal.variability != "inherited":
            return signal.variability
        if name in seen:
            return "discrete"
        found = {self.variability(*port, seen | {name}) for port in self._sources[name].values()}
        return "discrete" if found == {"discrete"} else "continuous"


@dataclass(frozen=True, slots=True)
class NonFinite:
    """A value that is infinite, or NaN where that does not mean "no value yet": ``label`` names its column."""

    row: int
    label: str
    value: float
