"""Before a run: build a scenario with its swaps and without them, and compare the components.

The scenario is built without its swaps, as far as it can be, and with them. Both are initialized,
the components that are compared are linearized where they can be, and those that were replaced are
freed again. The swapped scenario is the very one that then runs: it is initialized once more. It is
built anew only if its FMUs do not come back from that as they were.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from cosim.arrays import Vector
from cosim.core.contracts import prepare
from cosim.core.port import Port, named_ports
from cosim.core.recorded.partial import declared_channels
from cosim.core.recording import CompleteRecording, Plan
from cosim.core.signals import Causality, Interface
from cosim.errors import CosimError, GraphError, ScenarioError
from cosim.fmi.description import INTERFACE_TYPE_NAMES
from cosim.log.contents.metadata import json_table
from cosim.scenario.building.build import Builder, read
from cosim.scenario.building.coupling import with_loop_gains
from cosim.scenario.building.experiment import Experiment, warnings_among
from cosim.scenario.document.swaps import ports_in
from cosim.scenario.kinds.base import HasDescription, LinearNearStart, Scenario
from cosim.scenario.kinds.build_record import Resources, unpacked_in
from cosim.scenario.kinds.values import LinearSystem
from cosim.scenario.record import component_metadata, component_record
from cosim.scenario.recordings.port_comparison import (
    CAPABILITIES,
    INITIAL,
    NOMINAL,
    START,
    ComparedComponent,
    compare_components,
    propose,
)
from cosim.scenario.recordings.swap_report import SwapReport, SwapReports

if TYPE_CHECKING:
    from cosim.fmi.unpacked import UnpackedFmus
    from cosim.fmi.variable import Variable

_INITIAL_INPUT: Final = "initial input"
_PortValues: TypeAlias = dict[str, Mapping[str, Vector]]  # by aspect and port


def compare_swaps(scenario: Scenario, unpacked: UnpackedFmus | None = None) -> SwapReports:
    """Compare every swapped component with the one it replaces; nothing runs or stays open.

    Raises
    ------
    ScenarioError
        If nothing of the scenario can be built.
    """
    with Resources(unpacked) as resources:
        return _SwapComparison(scenario, resources).reports


def dry_run(scenario: Scenario) -> SwapReports:
    """Do what a run does before its first step: swaps are compared, and the coupling is checked.

    Raises
    ------
    ScenarioError
        If nothing of the scenario can be built.
    """
    with ExitStack() as resources:
        comparison = _SwapComparison(scenario, resources)
        reports = comparison.reports
        if reports.refusals:
            return reports
        try:
            experiment = with_loop_gains(comparison.experiment(), comparison.rebuilt)
        except ScenarioError as error:
            return replace(reports, problems=tuple(str(error).splitlines()))
        warnings = dict.fromkeys([*reports.of_run, *experiment.built.warnings])
        return replace(reports, of_run=tuple(warnings))


def build_swapped(scenario: Scenario, resources: ExitStack) -> tuple[Experiment, SwapReports]:
    """Build a scenario with swaps, and the reports of these; parameters as of ``Builder``.

    Raises
    ------
    ScenarioError
        With every problem of the scenario, and the ports that may have been meant.
    """
    comparison = _SwapComparison(scenario, resources)
    comparison.reports.check()
    return comparison.experiment(), comparison.reports


def compare_with_recorded(builder: Builder, source: CompleteRecording, name: str) -> SwapReport:
    """Compare a component of a replay with the recorded one that it replaces, by what they declare.

    Neither is initialized or linearized for that: the replay is to begin with what was loaded.
    """
    interface_type = component_record(source, name).interface_type
    kind = str(json_table(component_metadata(source, name).get("table", "{}")).get("kind"))
    if interface_type is not None:
        kind = INTERFACE_TYPE_NAMES[interface_type]
    declared = declared_channels(source.channels)[name].interface
    return _report(
        builder, name, ComparedComponent(declared, {"kind": kind}), _declared(builder, name)
    )


class _InitialState:
    """A built scenario, prepared and initialized as far as possible.

    Attributes
    ----------
    experiment : Experiment or None
        None: ``problems`` says why it could not be built.
    failure : str
        Why it could not be initialized; empty: it was.
    """

    def __init__(self, builder: Builder) -> None:
        self._builder = builder
        self.experiment: Experiment | None = None
        self.problems: list[str] = []
        self.failure = ""
        self.plan: Plan | None = None
        self._row = np.zeros(0)
        try:
            self.experiment = builder.experiment()
        except ScenarioError as error:
            self.problems = str(error).splitlines()
            return
        graph = self.experiment.graph
        self._row = np.zeros(graph.layout.width)
        try:
            self.plan = graph.prepare(self.experiment.clock.step_ns)
            graph.initialize(self.experiment.clock.start_time, self._row)
        except CosimError as error:
            self.failure = str(error)

    @property
    def repeats(self) -> bool:
        """Whether the scenario can be initialized again, to the same bits."""
        if self.experiment is None or self.failure:
            return False
        row = np.zeros_like(self._row)
        try:
            self.experiment.graph.initialize(self.experiment.clock.start_time, row)
        except CosimError:
            return False
        return row.tobytes() == self._row.tobytes()

    def component(self, name: str, before: ComparedComponent | None = None) -> ComparedComponent:
        """Return what is known of a component that was built.

        Where the scenario could not be initialized, it may be alone, as the one before it was.
        """
        values: _PortValues = {}
        if self.experiment is not None and not self.failure:
            channel = self.experiment.graph.layout[name]
            rows = (self._row[channel.inputs], self._row[channel.outputs])
            values = _initial_values(channel.interface, *rows)
        elif before is not None and _INITIAL_INPUT in before.values:
            values = self._initialized_alone(name, before.values[_INITIAL_INPUT])
        declared = _declared(self._builder, name)
        system = _linear_system(self._builder, name)
        return replace(declared, values={**declared.values, **values}, system=system)

    def _initialized_alone(self, name: str, inputs: Mapping[str, Vector]) -> _PortValues:
        """Initialize a component with the inputs that the one before had; others are zero."""
        component = self._builder.components[name]
        interface = component.interface
        u = np.zeros(interface.n_u)
        for port, columns in interface.input_columns().items():
            if port in inputs and u[columns].shape == inputs[port].shape:
                u[columns] = inputs[port]
        clock = self._builder.clock
        with suppress(CosimError):
            prepare(component, clock.h, np.zeros(len(u), np.bool_), {})
            component.initialize(clock.start_time, u)
            return _initial_values(interface, u, component.outputs(clock.start_time, u))
        return {}


def _initial_values(interface: Interface, u: Vector, y: Vector) -> _PortValues:
    """Return inputs and outputs at initialization, by port."""
    return {
        _INITIAL_INPUT: {name: u[own] for name, own in interface.input_columns().items()},
        INITIAL: {name: y[own] for name, own in interface.output_columns().items()},
    }


class _SwapComparison:
    """A swapped scenario that was built, initialized and compared with the one before."""

    def __init__(self, scenario: Scenario, resources: ExitStack) -> None:
        before, unbuilt = _replaced_components(scenario, unpacked_in(resources))
        replaced = {name: component.interface for name, component in before.items()}
        self._resources = resources
        self._builder = partial(Builder, scenario, resources, replaced=replaced)
        builder = self._builder()
        fmus = builder.context.fmus
        # The messages of FMUs from when they are loaded belong to the run, those of the comparison
        # do not.
        self._messages = {name: fmu.drain() for name, fmu in fmus.items()}
        self._initial = _InitialState(builder)
        of_run = warnings_among(self._messages)
        of_run += warnings_among({name: fmu.drain() for name, fmu in fmus.items()})
        reports = {}
        for name, component in before.items():
            if name in builder.components:
                after = self._initial.component(name, component)
                reports[name] = _report(builder, name, component, after)
        imported = {}
        for name, metadata in builder.context.metadata.items():
            if "code" in metadata:
                imported[name] = str(metadata["code"]["class"])
        self.reports = SwapReports(
            reports,
            tuple(self._initial.problems),
            self._initial.failure,
            imported,
            tuple(dict.fromkeys([*builder.context.warnings, *of_run])),
            unbuilt,
        )
        self._repeats = self._initial.repeats
        for fmu in fmus.values():
            fmu.discard()

    def experiment(self) -> Experiment:
        """Return the experiment; it is built again where the first one cannot run any more.

        Raises
        ------
        ScenarioError
            With every problem of the scenario.
        """
        experiment = self._initial.experiment
        if experiment is None or not self._repeats:
            return self.rebuilt()
        experiment.plan = self._initial.plan
        experiment.messages = self._messages
        return experiment

    def rebuilt(self) -> Experiment:
        """Return the experiment, built anew."""
        self._resources.close()
        return self._builder().experiment()


def _replaced_components(
    scenario: Scenario, unpacked: UnpackedFmus | None
) -> tuple[dict[str, ComparedComponent], dict[str, str]]:
    """Build the scenario without its swaps, as far as it can be.

    Of what is replaced and could not be built the first problem.
    """
    components: dict[str, ComparedComponent] = {}
    unbuilt: dict[str, str] = {}
    with Resources(unpacked) as resources, suppress(CosimError):
        builder = Builder(read(scenario.document.unswapped()), resources)
        state = _InitialState(builder)
        for name in scenario.document.tables().replaced:
            if name in builder.components:
                components[name] = state.component(name)
                continue
            for key, text in builder.problems:
                if key[:2] == ("components", name):
                    unbuilt.setdefault(name, text)
    return components, unbuilt


def _report(
    builder: Builder, name: str, before: ComparedComponent, after: ComparedComponent
) -> SwapReport:
    names = builder.port_maps[name].names if name in builder.port_maps else {}
    connected = _names_of(_named_ports(builder.scenario), name)
    refused = _names_of(_refused_ports(builder), name)
    rows = compare_components(before, after, names=names, connected=connected, refused=refused)
    missing = [port for port in before.ports if port in connected and after.port(port) is None]
    unconverted = frozenset(_names_of(_unconverted_ports(builder), name))
    return SwapReport(name, rows, propose(before, after, missing), unconverted)


# --- one component ---


def _declared(builder: Builder, name: str) -> ComparedComponent:
    """Return what a component that was built declares."""
    spec = builder.scenario.specs[name]
    interface = builder.components[name].interface
    if not isinstance(spec, HasDescription):
        return ComparedComponent(interface, {"kind": spec.kind})
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

    def values(causality: Causality, values_of: Callable[[Variable], Vector]) -> dict[str, Vector]:
        parts = [np.zeros(0)]
        for _, variables in description.ports(causality):
            parts += map(values_of, variables)
        of_all = np.concatenate(parts)
        columns = interface.input_columns() if causality == "input" else interface.output_columns()
        ports = builder.port_maps.get(name)
        if ports is not None:
            is_input = causality == "input"
            of_all = ports.shown_inputs(of_all) if is_input else ports.shown_outputs(of_all)
        return {
            port: of_all[own] for port, own in columns.items() if not np.isnan(of_all[own]).any()
        }

    nominal = values("input", _nominal) | values("output", _nominal)
    return ComparedComponent(
        interface, capabilities, {START: values("input", _start), NOMINAL: nominal}
    )


def _start(variable: Variable) -> Vector:
    if variable.start is None:
        return np.full(variable.size, np.nan)
    return np.array(variable.start, np.float64).reshape(-1)


def _nominal(variable: Variable) -> Vector:
    return np.full(variable.size, np.nan if variable.nominal is None else variable.nominal)


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


# --- ports that the scenario names ---


def _named_ports(scenario: Scenario) -> Iterable[Port]:
    """Yield the ports that the scenario names."""
    for to, connection in scenario.connections.items():
        yield from (to, *connection.sources)
    for estimate, truth in scenario.file.truth.items():
        yield from ports_in([estimate, *named_ports(truth)])


def _refused_ports(builder: Builder) -> Iterable[Port]:
    """Yield the ports at connections, or in truths, that stop the run."""
    connections = builder.scenario.connections
    truths = builder.scenario.file.truth
    for key, _ in builder.problems:
        if key[:1] == ("connections",):
            for to in ports_in(key[1:]):
                yield to
                yield from connections[to].sources if to in connections else ()
        elif key[:1] == ("truth",):
            estimate = str(key[-1])
            yield from ports_in([estimate, *named_ports(truths.get(estimate))])


def _unconverted_ports(builder: Builder) -> Iterable[Port]:
    """Yield the ports that are connected to one without a unit."""

    def has_unit(port: Port) -> bool:
        if port.component not in builder.components:
            return False
        try:
            match = port.find(builder.components[port.component].interface.by_name)
        except GraphError:  # no such element: that of its connection
            return False
        return match is not None and match[0].unit is not None

    for to, connection in builder.scenario.connections.items():
        if not has_unit(to):
            yield from connection.sources
        if connection.unit is None and not all(map(has_unit, connection.sources)):
            yield to


def _names_of(ports: Iterable[Port], component: str) -> set[str]:
    """Return the names of the ports of a component; of an element that of the signal too."""
    own = [port for port in ports if port.component == component]
    return {name for port in own for name in (port.name, port.signal)}
