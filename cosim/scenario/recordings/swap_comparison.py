"""Before a run: build a scenario with its swaps and without them, and compare the components.

The scenario is built without its swaps, as far as it can be, and with them. Both are initialized,
the components that are compared are linearized where they can be, and those that were replaced are
freed again. The swapped scenario is the very one that then runs: it is initialized once more. It is
built anew only if its FMUs do not come back from that as they were.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cosim.arrays import Vector
from cosim.core.contracts import prepare
from cosim.core.port import Port, named_ports
from cosim.core.recorded.partial import declared_channels
from cosim.core.recording import CompleteRecording, Plan
from cosim.core.signals import Causality, Interface
from cosim.errors import CosimError, GraphError, ScenarioError
from cosim.fmi.description import INTERFACE_TYPE_NAMES, Description, InterfaceType
from cosim.log.contents.metadata import json_table
from cosim.scenario.building.build import Builder, parse
from cosim.scenario.building.coupling import with_loop_gains
from cosim.scenario.building.experiment import Experiment, warnings_among
from cosim.scenario.building.parsing import Scenario, read
from cosim.scenario.document.swaps import ports_in
from cosim.scenario.kinds import Kind
from cosim.scenario.kinds.base import LinearNearStart
from cosim.scenario.kinds.build_record import Origins
from cosim.scenario.kinds.capabilities import HasDescription
from cosim.scenario.record import component_metadata, component_record
from cosim.scenario.recordings.port_comparison import (
    ComparedComponent,
    ComponentCapabilities,
    LinearBehavior,
    compare_components,
    propose,
)
from cosim.scenario.recordings.swap_report import SwapReport, SwapReports

if TYPE_CHECKING:
    from cosim.fmi.binary.messages import Message
    from cosim.fmi.unpacked import UnpackedFmus
    from cosim.fmi.variable import Variable


def compare_swaps(scenario: Scenario, unpacked: UnpackedFmus | None = None) -> SwapReports:
    """Compare every swapped component with the one it replaces; nothing runs or stays open.

    Raises
    ------
    ScenarioError
        If nothing of the scenario can be built.
    """
    with ExitStack() as resources:
        return _SwapComparison(scenario, resources, None, unpacked).reports


def dry_run(scenario: Scenario) -> SwapReports:
    """Do what a run does before its first step: swaps are compared, and the coupling is checked.

    Raises
    ------
    ScenarioError
        If nothing of the scenario can be built.
    """
    with ExitStack() as resources:
        comparison = _SwapComparison(scenario, resources, None)
        reports = comparison.reports
        if reports.refusals:
            return reports
        try:
            experiment = with_loop_gains(comparison.experiment(), comparison.rebuilt)
        except ScenarioError as error:
            return replace(reports, problems=tuple(str(error).splitlines()))
        warnings = dict.fromkeys([*reports.of_run, *experiment.warnings])
        return replace(reports, of_run=tuple(warnings))


def build_swapped(
    scenario: Scenario,
    resources: ExitStack,
    block: int | None,
    unpacked: UnpackedFmus | None = None,
) -> tuple[Experiment, SwapReports]:
    """Build a scenario with swaps, and the reports of these; parameters as of ``Builder``.

    Raises
    ------
    ScenarioError
        With every problem of the scenario, and the ports that may have been meant.
    """
    comparison = _SwapComparison(scenario, resources, block, unpacked)
    comparison.reports.check()
    return comparison.experiment(), comparison.reports


@dataclass(frozen=True)
class _InitialSignals:
    """Inputs and outputs of a component at initialization, by port."""

    inputs: Mapping[str, Vector]
    outputs: Mapping[str, Vector]

    @staticmethod
    def of(interface: Interface, u: Vector, y: Vector) -> _InitialSignals:
        inputs = interface.input_columns()
        outputs = interface.output_columns()
        u_by_input = {name: u[columns] for name, columns in inputs.items()}
        y_by_output = {name: y[columns] for name, columns in outputs.items()}
        return _InitialSignals(u_by_input, y_by_output)


@dataclass(frozen=True)
class _ReplacedComponent:
    """A replaced component, and its initial signals where it could be initialized."""

    component: ComparedComponent
    initial: _InitialSignals | None


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

    def signals(self, component: str) -> _InitialSignals | None:
        """Return the initial signals of a component; None: the scenario was not initialized."""
        if self.experiment is None or self.failure:
            return None
        channel = self.experiment.graph.layout[component]
        u = self._row[channel.inputs]
        y = self._row[channel.outputs]
        return _InitialSignals.of(channel.interface, u, y)

    def repeats(self) -> bool:
        """Return whether the scenario can be initialized again, to the same bits."""
        if self.experiment is None or self.failure:
            return False
        row = np.zeros_like(self._row)
        try:
            self.experiment.graph.initialize(self.experiment.clock.start_time, row)
        except CosimError:
            return False
        return row.tobytes() == self._row.tobytes()


class _SwapComparison:
    """A swapped scenario that was built, initialized and compared with the one before."""

    def __init__(
        self,
        scenario: Scenario,
        resources: ExitStack,
        block: int | None,
        unpacked: UnpackedFmus | None = None,
    ) -> None:
        self._scenario = scenario
        self._resources = resources
        self._block = block
        self._unpacked = unpacked
        before, unbuilt = _replaced_components(scenario, unpacked)
        self._interfaces = {name: part.component.interface for name, part in before.items()}
        builder = self._builder()
        fmus = builder.context.fmus
        # The messages of FMUs from when they are loaded belong to the run, those of the comparison
        # do not.
        self._messages: dict[str, Sequence[Message]] = {}
        for name, fmu in fmus.items():
            self._messages[name] = fmu.drain()
        self._initial = _InitialState(builder)
        of_run = warnings_among(self._messages)
        of_run += warnings_among({name: fmu.drain() for name, fmu in fmus.items()})
        reports = {}
        for name, part in before.items():
            if name in builder.components:
                reports[name] = self._compare(builder, name, part)
        problems = tuple(self._initial.problems)
        imported = {}
        for name, metadata in builder.context.metadata.items():
            if "code" in metadata:
                imported[name] = str(metadata["code"]["class"])
        warnings = tuple(dict.fromkeys([*builder.context.warnings, *of_run]))
        failure = self._initial.failure
        self.reports = SwapReports(reports, problems, failure, imported, warnings, unbuilt)
        self._repeats = self._initial.repeats()
        for fmu in fmus.values():
            fmu.discard()

    def _builder(self) -> Builder:
        return Builder(
            self._scenario,
            self._resources,
            Origins(unpacked=self._unpacked),
            block=self._block,
            replaced=self._interfaces,
        )

    def _compare(self, builder: Builder, name: str, before: _ReplacedComponent) -> SwapReport:
        initial = self._initial.signals(name)
        if initial is None and before.initial is not None:
            initial = _initialize_alone(builder, name, before.initial)
        after = _compared_component(builder, name, initial)
        return _report(builder, name, before.component, after)

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


def compare_with_recorded(builder: Builder, source: CompleteRecording, name: str) -> SwapReport:
    """Compare a component of a replay with the recorded one that it replaces, by what they declare.

    Neither is initialized or linearized for that: the replay is to begin with what was loaded.
    """
    interface_type = component_record(source, name).interface_type
    kind = str(json_table(component_metadata(source, name).get("table", "{}")).get("kind"))
    if interface_type is not None:
        kind = INTERFACE_TYPE_NAMES[interface_type]
    declared = declared_channels(source.channels)[name].interface
    before = ComparedComponent(declared, ComponentCapabilities(kind))
    return _report(builder, name, before, _declared_component(builder, name))


def _report(
    builder: Builder, name: str, before: ComparedComponent, after: ComparedComponent
) -> SwapReport:
    names = builder.port_maps[name].names if name in builder.port_maps else {}
    connected = _connected_ports(builder.scenario, name)
    refused = _refused_ports(builder, name)
    rows = compare_components(before, after, names=names, connected=connected, refused=refused)
    missing = []
    for port in before.ports:
        if port in connected and after.port(port) is None:
            missing.append(port)
    proposals = propose(before, after, missing)
    return SwapReport(name, rows, proposals, _unconverted_ports(builder, name))


def _replaced_components(
    scenario: Scenario, unpacked: UnpackedFmus | None
) -> tuple[dict[str, _ReplacedComponent], dict[str, str]]:
    """Build the scenario without its swaps, as far as it can be.

    Of what is replaced and could not be built the first problem.
    """
    components: dict[str, _ReplacedComponent] = {}
    unbuilt: dict[str, str] = {}
    with ExitStack() as resources, suppress(CosimError):
        original, problems = read(scenario.document.unswapped(), parse)
        builder = Builder(original, resources, Origins(unpacked=unpacked), problems=problems)
        state = _InitialState(builder)
        for name in scenario.document.swapped_components():
            if name in builder.components:
                initial = state.signals(name)
                component = _compared_component(builder, name, initial)
                components[name] = _ReplacedComponent(component, initial)
                continue
            for key, text in builder.problems:
                if key[:2] == ("components", name):
                    unbuilt.setdefault(name, text)
    return components, unbuilt


def _initialize_alone(
    builder: Builder, name: str, before: _InitialSignals
) -> _InitialSignals | None:
    """Initialize a component whose scenario cannot be, with the inputs that the one before had.

    Inputs that it did not have are zero. None: it cannot be initialized.
    """
    component = builder.components[name]
    interface = component.interface
    u = np.zeros(interface.n_u)
    for port, columns in interface.input_columns().items():
        values = before.inputs.get(port)
        if values is not None and u[columns].shape == values.shape:
            u[columns] = values
    held = np.zeros(len(u), np.bool_)
    with suppress(CosimError):
        prepare(component, builder.clock.h, held, {})
        component.initialize(builder.clock.start_time, u)
        y = component.outputs(builder.clock.start_time, u)
        return _InitialSignals.of(interface, u, y)
    return None


# --- one component ---


def _compared_component(
    builder: Builder, name: str, initial: _InitialSignals | None
) -> ComparedComponent:
    """Return what is known of a component that was built."""
    compared = _declared_component(builder, name)
    compared = replace(compared, linear=_linear_behavior(builder, name))
    return compared if initial is None else replace(compared, initial=initial.outputs)


def _declared_component(builder: Builder, name: str) -> ComparedComponent:
    """Return what a component that was built declares."""
    spec = builder.scenario.specs[name]
    described = None
    if isinstance(spec, HasDescription):
        described = spec.description(name, builder.context)
    compared = ComparedComponent(builder.components[name].interface, _capabilities(spec, described))
    if described is not None:
        _, description = described
        start = _declared(builder, name, description, "input", _start)
        nominal = _declared(builder, name, description, "input", _nominal)
        nominal |= _declared(builder, name, description, "output", _nominal)
        compared = replace(compared, start=start, nominal=nominal)
    return compared


def _capabilities(
    spec: Kind, described: tuple[InterfaceType, Description] | None
) -> ComponentCapabilities:
    if described is None:
        return ComponentCapabilities(spec.kind)
    interface_type, description = described
    declared = description.capabilities[interface_type]
    capabilities = ComponentCapabilities(
        INTERFACE_TYPE_NAMES[interface_type],
        rollback=declared.saves_state,
        variable_step=declared.variable_step,
        interpolation=declared.interpolates_inputs,
        directional_derivatives=declared.directional_derivatives,
    )
    if interface_type == "me":  # our solver takes any step and interpolates its inputs
        return replace(capabilities, variable_step=True, interpolation=True)
    return capabilities


def _declared(
    builder: Builder,
    name: str,
    description: Description,
    causality: Causality,
    values_of: Callable[[Variable], Vector],
) -> dict[str, Vector]:
    """Return what an FMU declares of its inputs or outputs, by port; not where that is NaN."""
    parts = [np.zeros(0)]
    for _, variables in description.ports(causality):
        parts += [values_of(variable) for variable in variables]
    values = np.concatenate(parts)
    interface = builder.components[name].interface
    columns_of = interface.input_columns() if causality == "input" else interface.output_columns()
    if name in builder.port_maps:
        ports = builder.port_maps[name]
        is_input = causality == "input"
        values = ports.shown_inputs(values) if is_input else ports.shown_outputs(values)
    declared = {}
    for port, columns in columns_of.items():
        if not np.isnan(values[columns]).any():
            declared[port] = values[columns]
    return declared


def _start(variable: Variable) -> Vector:
    if variable.start is None:
        return np.full(variable.size, np.nan)
    return np.array(variable.start, np.float64).reshape(-1)


def _nominal(variable: Variable) -> Vector:
    nominal = np.nan if variable.nominal is None else variable.nominal
    return np.full(variable.size, nominal)


def _linear_behavior(builder: Builder, name: str) -> LinearBehavior | None:
    """Return a component near its initial state; None: it cannot be linearized."""
    spec = builder.scenario.specs[name]
    if not isinstance(spec, LinearNearStart):
        return None
    try:
        system = spec.linear_system(name, builder.context)
    except (CosimError, ValueError):
        return None
    if system is None:
        return None
    ports = builder.port_maps.get(name)
    interface = builder.components[name].interface if ports is None else ports.component
    if system.D.shape != (interface.n_y, interface.n_u):
        return LinearBehavior(system, has_ports=False)  # some are not continuous
    if ports is None:
        return LinearBehavior(system)
    B, C, D = ports.shown_matrices(system.B, system.C, system.D)
    return LinearBehavior(replace(system, B=B, C=C, D=D))


# --- ports that the scenario names ---


def _connected_ports(scenario: Scenario, name: str) -> set[str]:
    """Return the ports of a component that the scenario names."""
    ports = list(scenario.connections)
    for connection in scenario.connections.values():
        ports += connection.sources
    for estimate, truth in scenario.file.truth.items():
        ports += ports_in([estimate, *named_ports(truth)])
    return _names_of(ports, name)


def _refused_ports(builder: Builder, name: str) -> set[str]:
    """Return the ports of a component at connections, or in truths, that stop the run."""
    connections = builder.scenario.connections
    truths = builder.scenario.file.truth
    ports: list[Port] = []
    for key, _ in builder.problems:
        if key[:1] == ("connections",):
            for to in ports_in(key[1:]):
                ports.append(to)
                if to in connections:
                    ports += connections[to].sources
        elif key[:1] == ("truth",):
            estimate = str(key[-1])
            ports += ports_in([estimate, *named_ports(truths.get(estimate))])
    return _names_of(ports, name)


def _unconverted_ports(builder: Builder, name: str) -> frozenset[str]:
    """Return the ports of a component that are connected to one without a unit."""
    ports: list[Port] = []
    for to, connection in builder.scenario.connections.items():
        if not _has_unit(builder, to):
            ports += connection.sources
        if connection.unit is None and not all(
            _has_unit(builder, source) for source in connection.sources
        ):
            ports.append(to)
    return frozenset(_names_of(ports, name))


def _has_unit(builder: Builder, port: Port) -> bool:
    """Return whether a port that there is declares its unit."""
    if port.component not in builder.components:
        return False
    try:
        match = port.find(builder.components[port.component].interface.by_name)
    except GraphError:  # no such element: that of its connection
        return False
    return match is not None and match[0].unit is not None


def _names_of(ports: Iterable[Port], component: str) -> set[str]:
    """Return the names of the ports of a component; of an element that of the signal too."""
    names: set[str] = set()
    for port in ports:
        if port.component == component:
            names |= {port.name, port.signal}
    return names
