"""Before a run: build a scenario with its swaps and without them, and compare the components.

The scenario is built without its swaps, as far as it can be, and with them. Both are initialized,
and the components that are compared are linearized where they can be. All of that is closed again:
the run begins with components of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.contracts import prepare
from cosim.core.port import Port, named_ports
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.run import RecordedRun
from cosim.core.signals import Interface
from cosim.errors import CosimError, ScenarioError
from cosim.fmi.description import INTERFACE_TYPE_NAMES
from cosim.log.metadata import json_table
from cosim.scenario.building.build import Builder, read
from cosim.scenario.building.coupling import with_loop_gains
from cosim.scenario.building.experiment import Experiment, warnings_among
from cosim.scenario.document.swaps import ports_in
from cosim.scenario.kinds.base import LinearNearStart, Scenario
from cosim.scenario.kinds.build_record import Resources
from cosim.scenario.kinds.capabilities import HasDescription
from cosim.scenario.kinds.values import LinearSystem
from cosim.scenario.record import component_metadata, component_record
from cosim.scenario.recordings.port_comparison import (
    CAPABILITIES,
    INITIAL,
    START,
    DescribedComponent,
    compare,
    describe,
    propose,
)
from cosim.scenario.recordings.swap_report import SwapReport, SwapReports

if TYPE_CHECKING:
    from cosim.fmi.unpacked import UnpackedFmus

_INITIAL_INPUT: Final = "initial input"


def compare_swaps(scenario: Scenario, unpacked: UnpackedFmus | None = None) -> SwapReports:
    """Compare every swapped component with the one it replaces; nothing runs or stays open.

    Parameters
    ----------
    scenario : Scenario
    unpacked : UnpackedFmus, optional
        Where FMUs are unpacked and loaded for all builds of a process.

    Raises
    ------
    ScenarioError
        If nothing of the scenario can be built.
    """
    before: dict[str, DescribedComponent] = {}
    replaced: dict[str, Interface] = {}
    unbuilt: dict[str, str] = {}
    with Resources(unpacked) as resources, suppress(CosimError):
        unswapped, problems = read(scenario.document.unswapped())
        builder = Builder(unswapped, resources, problems=problems)
        built = _Built(builder)
        for name in scenario.document.tables().replaced:
            if name in builder.components:
                before[name] = built.described(name)
                replaced[name] = builder.components[name].interface
                continue
            for key, text in builder.problems:
                if key[:2] == ("components", name):
                    unbuilt.setdefault(name, text)
    with Resources(unpacked) as resources:
        builder = Builder(scenario, resources, replaced=replaced)
        built = _Built(builder)
        warnings = list(builder.context.warnings)
        warnings += warnings_among({n: fmu.drain() for n, fmu in builder.context.fmus.items()})
        reports = {}
        for name, component in before.items():
            if name in builder.components:
                reports[name] = _report(builder, name, component, built.described(name, component))
        imported = {}
        for name, metadata in builder.context.metadata.items():
            if "code" in metadata:
                imported[name] = str(metadata["code"]["class"])
    return SwapReports(
        reports,
        tuple(built.problems),
        built.failure,
        imported,
        tuple(dict.fromkeys(warnings)),
        unbuilt,
        replaced,
    )


def dry_run(scenario: Scenario) -> SwapReports:
    """Do what a run does before its first step: swaps are compared, and the coupling is checked.

    Raises
    ------
    ScenarioError
        If nothing of the scenario can be built.
    """
    reports = compare_swaps(scenario)
    if reports.refusals:
        return reports
    with ExitStack() as resources:

        def build() -> Experiment:
            resources.close()
            return Builder(scenario, resources, replaced=reports.replaced).experiment()

        try:
            experiment = with_loop_gains(build(), build)
        except ScenarioError as error:
            return replace(reports, problems=tuple(str(error).splitlines()))
        warnings = dict.fromkeys([*reports.of_run, *experiment.built.warnings])
    return replace(reports, of_run=tuple(warnings))


def compare_with_recorded(builder: Builder, source: RecordedRun, name: str) -> SwapReport:
    """Compare a component of a replay with the recorded one that it replaces, by what they declare.

    Neither is initialized or linearized for that: the replay is to begin with what was loaded.
    """
    interface_type = component_record(source, name).interface_type
    kind = str(json_table(component_metadata(source, name).get("table", "{}")).get("kind"))
    if interface_type is not None:
        kind = INTERFACE_TYPE_NAMES[interface_type]
    declared = declared_channels(source.channels)[name].interface
    before = describe(declared, {"kind": kind})
    return _report(builder, name, before, _declared(builder, name, {}))


class _Built:
    """A scenario that was built, prepared and initialized as far as possible.

    Attributes
    ----------
    problems : list of str
        Why it could not be built.
    failure : str
        Why it could not be initialized; empty: it was.
    """

    def __init__(self, builder: Builder) -> None:
        self._builder = builder
        self._initial: dict[str, tuple[Vector, Vector]] = {}  # inputs and outputs
        self.problems: list[str] = []
        self.failure = ""
        try:
            graph = builder.experiment().graph
        except ScenarioError as error:
            self.problems = str(error).splitlines()
            return
        row = np.zeros(graph.layout.width)
        try:
            graph.prepare(builder.context.step_ns)
            graph.initialize(builder.clock.start_time, row)
        except CosimError as error:
            self.failure = str(error)
            return
        for channel in graph.layout.channels:
            self._initial[channel.name] = (row[channel.inputs], row[channel.outputs])

    def described(self, name: str, before: DescribedComponent | None = None) -> DescribedComponent:
        """Return what is known of a component that was built.

        Where the scenario could not be initialized, it may be alone, as the one before it was.
        """
        initial = self._initial.get(name)
        if initial is None and before is not None:
            initial = self._initialized_alone(name, before)
        interface = self._builder.components[name].interface
        numbers = {}
        if initial is not None:
            u, y = initial
            inputs = interface.input_columns().items()
            outputs = interface.output_columns().items()
            numbers[_INITIAL_INPUT] = {port: u[columns] for port, columns in inputs}
            numbers[INITIAL] = {port: y[columns] for port, columns in outputs}
        declared = _declared(self._builder, name, numbers)
        return replace(declared, system=_linear_system(self._builder, name))

    def _initialized_alone(
        self, name: str, before: DescribedComponent
    ) -> tuple[Vector, Vector] | None:
        """Initialize a component with the inputs that the one before had; others are zero."""
        component = self._builder.components[name]
        interface = component.interface
        u = np.zeros(interface.n_u)
        known = {port: own.numbers for port, own in before.ports.items()}
        if not any(INITIAL in numbers for numbers in known.values()):
            return None
        for port, columns in interface.input_columns().items():
            values = known.get(port, {}).get(_INITIAL_INPUT, [])
            if u[columns].shape == (len(values),):
                u[columns] = values
        clock = self._builder.clock
        with suppress(CosimError):
            prepare(component, clock.h, np.zeros(len(u), np.bool_), {})
            component.initialize(clock.start_time, u)
            return u, component.outputs(clock.start_time, u)
        return None


# --- one component ---


def _declared(
    builder: Builder, name: str, numbers: Mapping[str, Mapping[str, Vector]]
) -> DescribedComponent:
    """Return what a component that was built declares, beside ``numbers`` that are known of it."""
    spec = builder.scenario.specs[name]
    interface = builder.components[name].interface
    if not isinstance(spec, HasDescription):
        return describe(interface, {"kind": spec.kind}, numbers)
    interface_type, description = spec.description(name, builder.context)
    declared = description.capabilities[interface_type]
    steps = interface_type == "me"  # our solver takes any step and interpolates its inputs
    able = (
        declared.saves_state,
        steps or declared.variable_step,
        steps or declared.interpolates_inputs,
        declared.directional_derivatives,
    )
    capabilities: dict[str, Any] = {"kind": INTERFACE_TYPE_NAMES[interface_type]}
    capabilities |= zip(CAPABILITIES, able, strict=True)
    starts = {signal.name: np.array(signal.initial_values) for signal in interface.inputs}
    return describe(interface, capabilities, {START: starts, **numbers})


def _linear_system(builder: Builder, name: str) -> LinearSystem | None:
    """Return a component near its initial state; None: it cannot be linearized."""
    spec = builder.scenario.specs[name]
    if not isinstance(spec, LinearNearStart):
        return None
    try:
        system = spec.linear_system(name, builder.context)
    except (CosimError, ValueError):
        return None
    ports = builder.port_maps.get(name)
    if system is None or ports is None:
        return system
    if system.D.shape != (ports.component.n_y, ports.component.n_u):  # some are not continuous
        return replace(system, D=np.zeros((0, 0)))
    B, C, D = ports.shown_matrices(system.B, system.C, system.D)
    return replace(system, B=B, C=C, D=D)


def _report(
    builder: Builder, name: str, before: DescribedComponent, after: DescribedComponent
) -> SwapReport:
    """Compare a component with the one that it replaces, as far as the scenario names ports."""
    named: list[Port] = []
    refused: list[Port] = []
    unconverted: list[Port] = []
    with_unit = set()
    for other, component in builder.components.items():
        signals = component.interface.signals
        with_unit |= {f"{other}.{signal.name}" for signal in signals if signal.unit is not None}
    scenario = builder.scenario
    for to, connection in scenario.connections.items():
        ports = [to, *connection.sources]
        named += ports
        undeclared = [port for port in ports if with_unit.isdisjoint({str(port), str(port.whole)})]
        if to in undeclared:
            unconverted += connection.sources
        if connection.unit is None and undeclared not in ([], [to]):
            unconverted.append(to)
    for estimate, truth in scenario.file.truth.items():
        ports = ports_in([estimate, *named_ports(truth)])
        named += ports
    truths = scenario.file.truth
    for (table, *entry), _ in builder.problems:
        if table == "connections":
            for to in ports_in(entry):
                refused += [
                    to,
                    *(scenario.connections[to].sources if to in scenario.connections else ()),
                ]
        elif table == "truth" and entry:
            refused += ports_in([str(entry[-1]), *named_ports(truths.get(str(entry[-1])))])
    connected = _names_of(named, name)
    rows = compare(
        before,
        after,
        names=builder.port_maps[name].names if name in builder.port_maps else {},
        connected=connected,
        refused=_names_of(refused, name),
    )
    missing = [port for port in before.ports if port in connected and port not in after.ports]
    proposals = propose(before, after, missing)
    return SwapReport(name, rows, proposals, frozenset(_names_of(unconverted, name)))


def _names_of(ports: list[Port], component: str) -> set[str]:
    """Return the names of the ports of a component; of an element that of the signal too."""
    own = [port for port in ports if port.component == component]
    return {name for port in own for name in (port.name, port.signal)}
