"""Checks of a graph: jumps, held inputs, truths, and connections as in the run of a replay."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from itertools import islice
from typing import Any, Final

import numpy as np

from cosim.core.clock import Clock, nanoseconds
from cosim.core.connections import AS_IS, Connection
from cosim.core.contracts import Component
from cosim.core.graph import Graph
from cosim.core.port import Port, named_ports
from cosim.core.recorded.partial import declared_channels
from cosim.core.recording import Recording
from cosim.core.signals import Interface
from cosim.core.stages.substep_control import SubstepTolerance
from cosim.core.structure.connection_checks import unknown_units
from cosim.errors import (
    GraphError,
    LogError,
    nearest,
    quoted,
)
from cosim.instants import step_seconds
from cosim.log.metadata import json_table
from cosim.scenario.document.places import Problem
from cosim.scenario.document.schema import File, Settings
from cosim.scenario.kinds.base import Scenario
from cosim.units import Unit, conversion

_HELD_IN_LOOP: Final = (
    "{source} depends on what it drives, so that '{to}' takes it with a zero-order hold, on the "
    "mean {delay:g} s late: an error of first order in the step, which no identifier has in its "
    "model; needed a small step"
)


def substep_tolerance(settings: Settings) -> SubstepTolerance | None:
    """Return the tolerance of substeps; None: there are none.

    Raises
    ------
    ClockError, GraphError
        If a value of the table is refused, or a step cannot be divided.
    """
    table = settings.substeps
    if table is None:
        return None
    tolerance = SubstepTolerance(table.rtol, table.atol, nanoseconds(table.min))
    tolerance.finest_level(Clock.step_of(settings.step))
    return tolerance


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
            if not jumping:
                continue
            jumps = "is discrete and jumps"
            if source.whole not in jumping:
                jumps = f"jumps with {', '.join(map(str, jumping))} (direct feedthrough)"
            text = (
                f"{to.signal} '{source}' {jumps}; linear interpolation would turn the jump into a "
                f"ramp over one step; {way_out}"
            )
            problems.append((("components", to.component), text))
    return problems


def held_disturbances(scenario: Scenario, graph: Graph) -> Iterator[tuple[str, str]]:
    """Yield (component, text) where a disturbance is in a loop, by signals among its alphas."""
    if graph.input_interpolation not in (None, "linear"):
        return
    delay = 0.5 * step_seconds(Clock.step_of(scenario.file.scenario.step))
    for stage in graph.stages:
        loop = {member.name for member in stage.members}
        for to, connection in graph.connections.items():
            if to.component not in loop:
                continue
            end = graph.ports.input(to)
            first = end.columns.start - end.channel.inputs.start
            if not graph.held[to.component][first : first + end.size].any():
                continue
            for source in connection.sources:
                name = source.component
                if name not in loop:
                    continue
                inputs = graph.components[name].interface.input_names
                if not inputs.isdisjoint(scenario.specs[name].continuous_inputs):
                    yield name, _HELD_IN_LOOP.format(source=source, to=to, delay=delay)


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
    signals = {name: component.interface.by_name for name, component in components.items()}
    for estimate, truth in file.truth.items():
        try:
            ports = [Port.parse(text) for text in (estimate, *named_ports(truth))]
            if not missing.isdisjoint(port.component for port in ports):
                continue
            found = {port: port.find(signals.get(port.component, {})) for port in ports}
            absent = [port for port in ports if found[port] is None]
            swapped = [port for port in absent if port.component in file.swap]
            if swapped:
                text = f"has no {str(swapped[0])!r}: the report leaves out {estimate!r}"
                warn(swapped[0].component, text)
                continue
            if absent:
                names: list[str] = []
                for name, own in signals.items():
                    names += [f"{name}.{signal}" for signal in own]
                text = str(absent[0])
                raise GraphError(f"unknown signal {text!r}; {nearest(text, names)}")
            matches = filter(None, map(found.get, ports))
            units = [signal.measures_of(elements) for signal, elements in matches]
            _check_units(ports, units, truth, warn)
            kept[estimate] = truth
        except GraphError as error:
            problems.append((("truth", estimate), str(error)))
    return kept, problems


def _check_units(
    ports: Sequence[Port],
    units: Sequence[Sequence[Unit]],
    truth: Any,
    warn: Callable[[str, str], None],
) -> None:
    """Check that an estimate has the size of its truth, and units that this can be converted to.

    Warn where nobody can say.

    Parameters
    ----------
    ports : sequence of Port
        The estimate, and the signals of its truth; none: that is numbers.
    units : sequence of sequence of Unit
        Of their elements.
    truth : number, str or tuple
    warn : callable

    Raises
    ------
    GraphError
        If it has not.
    """
    estimate, *true_ports = ports
    estimated, *true_units = units
    true_size = sum(map(len, true_units)) if true_ports else len(np.atleast_1d(truth))
    if len(estimated) != true_size:
        shown_truth = list(truth) if isinstance(truth, tuple) else truth
        raise GraphError(
            f"'{estimate}' has size {len(estimated)}, its true value {shown_truth!r} has size "
            f"{true_size}"
        )
    beside = iter(estimated)
    for port, own in zip(true_ports, true_units, strict=True):
        for unit, true_unit in dict.fromkeys(zip(islice(beside, len(own)), own, strict=True)):
            if conversion(true_unit, unit) is None:
                raise GraphError(
                    f"'{estimate}' has unit {unit.name!r}, its true value '{port}' has unit "
                    f"{true_unit.name!r}; expected compatible units"
                )
            if unknown := unknown_units(true_unit, unit):
                warn(
                    estimate.component,
                    f"{estimate}, its truth {port}: {unknown}, so values in {true_unit.name!r} "
                    f"are taken as {unit.name!r}, as they are",
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
    channels = declared_channels(recording.channels)
    before = {name: channel.interface for name, channel in channels.items()}
    again = {name: component.interface for name, component in components.items()}
    recorded = recording.metadata.get("cosim.connections", {})
    found = dict(connections)
    for to, connection in connections.items():
        units = _units(to, connection, before)
        is_converted = len({unit for unit in units if unit is not None}) > 1
        if not is_converted or connection.unit is not None or str(to) not in recorded:
            continue
        if units != _units(to, connection, again):
            continue
        try:
            values = json_table(recorded[str(to)])
        except ValueError as error:
            text = f"recorded connection to {quoted(str(to))}: {error}"
            raise LogError(f"{recording.label}: {text}") from error
        if "conversions" not in values and values.get("from") == connection.label:
            found[to] = replace(connection, source=connection.sources, unit=AS_IS)
    return found


def _units(
    to: Port, connection: Connection, interfaces: Mapping[str, Interface]
) -> list[str | tuple[str, ...] | None]:
    """Return the units of an input and of what drives it, as they are declared."""
    units = []
    for port in (to, *connection.sources):
        interface = interfaces.get(port.component)
        signal = None if interface is None else interface.by_name.get(port.signal)
        units.append(None if signal is None else signal.unit)
    return units
