"""Checks of a graph: the tolerance of substeps, jumps, truths, and connections as in a run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from typing import Any, Final

import numpy as np

from cosim.core.clock import Clock, nanoseconds
from cosim.core.connections import AS_IS, Connection
from cosim.core.contracts import Component
from cosim.core.graph import Graph
from cosim.core.port import Port, named_ports
from cosim.core.recorded.partial import declared_channels
from cosim.core.recording import Recording
from cosim.core.signals import Interface, Signal
from cosim.core.stages.substep_control import SubstepTolerance
from cosim.core.structure.connection_checks import unknown_units
from cosim.errors import GraphError, LogError, nearest, quoted
from cosim.instants import StepNs, step_seconds
from cosim.log.contents.metadata import json_table
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.document.places import Problem
from cosim.scenario.document.schema import File, Settings
from cosim.units import Unit, conversion

_HELD_IN_LOOP: Final = (
    "{source} depends on what it drives, so that '{to}' takes it with a zero-order hold, on the "
    "mean {delay:g} s late: an error of first order in the step, which no identifier has in its "
    "model; needed a small step"
)


# --- substeps ---


def substep_tolerance(settings: Settings) -> SubstepTolerance | None:
    """Return the tolerance of substeps; None: there are none.

    Raises
    ------
    ClockError, GraphError
        If a value of the table is refused.
    """
    table = settings.substeps
    if table is None:
        return None
    return SubstepTolerance(table.rtol, table.atol, nanoseconds(table.min))


def check_substeps(settings: Settings) -> None:
    """Check the tolerance of substeps, and that a step can be divided.

    Raises
    ------
    ClockError, GraphError
        If a value of the table is refused, or a step cannot be divided.
    """
    tolerance = substep_tolerance(settings)
    if tolerance is not None:
        tolerance.finest_level(Clock.step_of(settings.step))


# --- signals between components ---


def jump_problems(scenario: Scenario, graph: Graph) -> list[Problem]:
    """Return the problems of inputs that must not jump."""
    problems: list[Problem] = []
    for to, connection in scenario.connections.items():
        way_out = scenario.specs[to.component].continuous_inputs.get(to.signal)
        if way_out is None:
            continue
        for source in connection.sources:
            jumping = graph.jumps(source)
            if jumping:
                text = f"{to.signal} '{source}' {_how(source, jumping)}; {way_out}"
                problems.append((("components", to.component), text))
    return problems


def _how(source: Port, jumping: Sequence[Port]) -> str:
    """Return how a signal jumps."""
    jumps = "is discrete and jumps"
    if source.whole not in jumping:
        jumps = f"jumps with {', '.join(map(str, jumping))} (direct feedthrough)"
    return f"{jumps}; linear interpolation would turn the jump into a ramp over one step"


def held_disturbances(
    scenario: Scenario, graph: Graph, step_ns: StepNs
) -> Iterator[tuple[str, str]]:
    """Yield (component, text) where a disturbance is in a loop, by signals among its alphas."""
    if graph.input_interpolation not in (None, "linear"):
        return
    delay = 0.5 * step_seconds(step_ns)
    for stage in graph.stages:
        loop = {member.name for member in stage.members}
        for to, connection in graph.connections.items():
            if to.component not in loop:
                continue
            end = graph.ports.input(to)
            first = end.columns.start - end.channel.inputs.start
            held = graph.held[to.component][first : first + end.size]
            for source in connection.sources:
                is_inside = source.component in loop
                if is_inside and held.any() and _is_modulated(scenario, graph, source.component):
                    text = _HELD_IN_LOOP.format(source=source, to=to, delay=delay)
                    yield source.component, text


def _is_modulated(scenario: Scenario, graph: Graph, name: str) -> bool:
    """Return whether a component has inputs that must not jump, such as alphas."""
    inputs = graph.components[name].interface.input_names
    return not inputs.isdisjoint(scenario.specs[name].continuous_inputs)


# --- truths ---


def check_truth(
    file: File,
    components: Mapping[str, Component],
    missing: Set[str],
    warn: Callable[[str, str], None],
) -> tuple[dict[str, Any], list[Problem]]:
    """Return the truths that can be compared, and the problems of the others.

    A swapped component need not have the signals that only the report asks for.

    Parameters
    ----------
    file : File
    components : mapping of name to Component
    missing : set of names
        Of components that are not right: truths with their signals are not checked.
    warn : callable
        Called with the truths that a swap leaves out, as (component, text).
    """
    kept: dict[str, Any] = {}
    problems: list[Problem] = []
    signals = _Signals(components)
    for estimate, truth in file.truth.items():
        texts = [estimate, *named_ports(truth)]
        try:
            ports = [Port.parse(text) for text in texts]
            if not missing.isdisjoint(port.component for port in ports):
                continue
            unknown = signals.unknown(ports)
            dropped = [port for port in unknown if port.component in file.swap]
            if dropped:
                text = f"has no {str(dropped[0])!r}: the report leaves out {estimate!r}"
                warn(dropped[0].component, text)
                continue
            estimated, *true_signals = [signals.units(port) for port in ports]
            _check_size(estimate, truth, estimated, true_signals)
            first = 0
            for port, true in zip(ports[1:], true_signals, strict=True):
                beside = estimated[first : first + len(true)]
                for pair in dict.fromkeys(zip(beside, true, strict=True)):
                    _check_unit(estimate, port, *pair, warn)
                first += len(true)
        except GraphError as error:
            problems.append((("truth", estimate), str(error)))
        else:
            kept[estimate] = truth
    return kept, problems


class _Signals:
    """The signals of components by port."""

    def __init__(self, components: Mapping[str, Component]) -> None:
        self._signals: dict[str, Mapping[str, Signal]] = {}
        self._names: list[str] = []
        for name, component in components.items():
            signals = component.interface.by_name
            self._signals[name] = signals
            self._names += [f"{name}.{signal}" for signal in signals]

    def unknown(self, ports: Sequence[Port]) -> list[Port]:
        """Return those of some ports that there are not."""
        return [port for port in ports if self._match(port) is None]

    def units(self, port: Port) -> tuple[Unit, ...]:
        """Return the units of the elements that a port names.

        Raises
        ------
        GraphError
            If there is no such signal or element.
        """
        match = self._match(port)
        if match is None:
            suggestion = nearest(str(port), self._names)
            raise GraphError(f"unknown signal {str(port)!r}; {suggestion}")
        signal, elements = match
        return signal.measures_of(elements)

    def _match(self, port: Port) -> tuple[Signal, slice] | None:
        return port.find(self._signals.get(port.component, {}))


def _check_size(
    estimate: str, truth: Any, estimated: Sequence[Unit], true_signals: Sequence[Sequence[Unit]]
) -> None:
    """Check that an estimate has as many elements as its truth: all signals of it, or numbers.

    Raises
    ------
    GraphError
        If it has not.
    """
    true_size = sum(map(len, true_signals))
    if not true_signals:
        true_size = len(np.atleast_1d(truth))
    if len(estimated) != true_size:
        shown_truth = list(truth) if isinstance(truth, tuple) else truth
        raise GraphError(
            f"{estimate!r} has size {len(estimated)}, "
            f"its true value {shown_truth!r} has size {true_size}"
        )


def _check_unit(
    estimate: str,
    port: Port,
    unit: Unit,
    true_unit: Unit,
    warn: Callable[[str, str], None],
) -> None:
    """Check that the unit of a true signal can be converted to that of the estimate.

    Warn where nobody can say.

    Raises
    ------
    GraphError
        If it cannot.
    """
    if conversion(true_unit, unit) is None:
        raise GraphError(
            f"{estimate!r} has unit {unit.name!r}, its true value {str(port)!r} has unit "
            f"{true_unit.name!r}; expected compatible units"
        )
    if unknown := unknown_units(true_unit, unit):
        warn(
            Port.parse(estimate).component,
            f"{estimate}, its truth {port}: {unknown}, so values in {true_unit.name!r} are taken "
            f"as {unit.name!r}, as they are",
        )


# --- replays ---


def as_in_run(
    connections: Mapping[Port, Connection],
    recording: Recording,
    components: Mapping[str, Component],
) -> dict[Port, Connection]:
    """Return the connections of a replay, ``unit = "as is"`` where the run converted nothing.

    An earlier version of cosim knew fewer units than this one, and took values in others as they
    are. Units and connections that are not as they were then are left as they stand.

    Parameters
    ----------
    connections : mapping of Port to Connection
        By input, as the scenario has them.
    recording : Recording
    components : mapping of component name to Component
        As they are built again.

    Raises
    ------
    LogError
        If a recorded connection cannot be understood.
    """
    declared = declared_channels(recording.channels)
    before = {name: channel.interface for name, channel in declared.items()}
    again = {name: component.interface for name, component in components.items()}
    recorded = recording.metadata.get("cosim.connections", {})
    found = {}
    for to, connection in connections.items():
        units = list(_units(to, connection, before))
        is_kept = units == list(_units(to, connection, again)) and connection.unit is None
        differ = len({unit for unit in units if unit is not None}) > 1
        if is_kept and differ and str(to) in recorded:
            try:
                values = json_table(recorded[str(to)])
            except ValueError as error:
                text = f"recorded connection to {quoted(str(to))}: {error}"
                raise LogError(f"{recording.label}: {text}") from error
            if "conversions" not in values and values.get("from") == connection.label:
                connection = replace(connection, source=connection.sources, unit=AS_IS)
        found[to] = connection
    return found


def _units(
    to: Port, connection: Connection, interfaces: Mapping[str, Interface]
) -> Iterator[str | tuple[str, ...] | None]:
    """Yield the units of an input and of what drives it, as they are declared."""
    for port in (to, *connection.sources):
        interface = interfaces.get(port.component)
        signal = None if interface is None else interface.by_name.get(port.signal)
        yield None if signal is None else signal.unit
