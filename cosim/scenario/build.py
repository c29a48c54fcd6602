"""From a scenario to a graph and a clock, with every problem of the file in one report."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.blocks.declared import with_units
from cosim.blocks.port_map import PortMap
from cosim.blocks.renamed import Renamed
from cosim.blocks.renaming import resolve
from cosim.blocks.replay import Replay
from cosim.core.clock import Clock, start_nanoseconds
from cosim.core.connections import Connection, check_connections, layout_of
from cosim.core.contracts import Component, Plan, Recording
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.signals import Interface
from cosim.errors import CosimError
from cosim.scenario.context import DependsOnInvalidComponent, MessageSource, ScenarioBuildContext
from cosim.scenario.document import Document
from cosim.scenario.kinds import BuildContext, Kind
from cosim.scenario.parsing import Scenario, read
from cosim.scenario.problems import Problem
from cosim.scenario.recorded import ReplayOrigin
from cosim.scenario.swap import MapEntry, unknown_ports
from cosim.scenario.truth import check_truth

if TYPE_CHECKING:
    from cosim.fmi.binary.messages import Message


@dataclass(frozen=True)
class Experiment:
    """A scenario ready to run.

    Parameters
    ----------
    scenario : Scenario
    graph : Graph
    clock : Clock
    truth : mapping of estimate to its truth
        What the report compares.
    metadata : mapping of component name to plain values
        What the log keeps of a component.
    warnings : tuple of (component, text)
    reads : mapping of component name to names of tables
        That were read to build the component, beside its own.
    attachments : mapping of file name to text
        For the log: modelDescription.xml of each FMU.
    fmus : mapping of component name to MessageSource
        What was opened for this run and may have messages.
    files : frozenset of Path
        What is read beside the scenario.
    plan : Plan or None
        Of the graph, where it was prepared already.
    messages : mapping of component name to list of Message
        What was drained from ``fmus`` already.
    origin : ReplayOrigin or None
        Of a replay: the log it is made from.
    """

    scenario: Scenario
    graph: Graph
    clock: Clock
    truth: Mapping[str, Any]
    metadata: Mapping[str, Mapping[str, Any]]
    warnings: tuple[tuple[str, str], ...]
    reads: Mapping[str, frozenset[str]]
    attachments: Mapping[str, str]
    fmus: Mapping[str, MessageSource]
    files: frozenset[Path]
    plan: Plan | None = None
    messages: Mapping[str, Sequence[Message]] = field(default_factory=dict)
    origin: ReplayOrigin | None = None


class Builder:
    """Builds what can be built of a scenario, and collects the problems of the rest.

    Parameters
    ----------
    scenario : Scenario
    resources : ExitStack
        Closes what was opened, FMUs above all, when the run is over.
    problems : iterable of Problem
        Of the scenario, as far as they are known.
    recording : Recording, optional
        Take from it every component that cannot be computed again from the log: plants, FMUs,
        files.
    named_files : collection of str, optional
        With a recording: the files that may be opened all the same.
    block : int, optional
        Fixed number of communication steps in a block.
    replaced : mapping of component name to Interface, optional
        Of the components that swaps replaced, where they are known.
    describes : bool
        Read of FMUs their descriptions only: what is built shows what there is, and cannot run.

    Attributes
    ----------
    problems : list of Problem
    components : mapping of name to Component
        Those that could be built.
    port_maps : mapping of component name to PortMap
        Of those of them whose ports are renamed.

    Raises
    ------
    ScenarioError
        If nothing can be built.
    """

    def __init__(
        self,
        scenario: Scenario,
        resources: ExitStack,
        *,
        problems: Iterable[Problem] = (),
        recording: Recording | None = None,
        named_files: Collection[str] = (),
        block: int | None = None,
        replaced: Mapping[str, Interface] | None = None,
        describes: bool = False,
    ) -> None:
        self.scenario = scenario
        self.problems = list(problems)
        self.clock = self._clock(block)
        self.context = ScenarioBuildContext(
            scenario, self.clock, resources, recording, named_files, describes=describes
        )
        self.components: dict[str, Component] = {}
        self.port_maps: dict[str, PortMap] = {}
        self._recording = recording
        self._replaced = replaced or {}
        self._periods: dict[str, int] = {}
        self._invalid: set[str] = set()  # components whose connections are not checked
        self._check_models()
        for name, interface in self._replaced.items():
            entries = scenario.maps.get(name, [])
            self.problems += unknown_ports(scenario.tree, entries, interface)
        for name, spec in scenario.specs.items():
            self._build(name, spec)
        names = set(scenario.file.components)
        self._invalid |= names - self.components.keys()
        self._check_connections()
        self._truth, truth_problems = check_truth(
            scenario.file, self.components, self._invalid, self.context.warn
        )
        self.problems += truth_problems

    def _clock(self, block: int | None) -> Clock:
        """Return the clock; without one nothing else can be checked."""
        settings = self.scenario.file.scenario
        key = "step"
        try:
            Clock(settings.step, settings.step)
            key = "start_time"
            start_nanoseconds(settings.start_time)
            key = "stop"
            return _clock_of(self.scenario, block)
        except CosimError as error:
            self.problems.append((("scenario", key), str(error)))
            raise self.scenario.document.report(self.problems) from error

    # --- components ---

    def _check_models(self) -> None:
        for name in self.scenario.file.models:
            try:
                self.context.model(name)
            except (CosimError, ValueError) as error:
                self.problems.append((("models", name), str(error)))

    def _build(self, name: str, spec: Kind) -> None:
        """Build a component, or add the problem of that."""
        self.context.begin(name)
        try:
            component = self._component(name, spec)
            period = spec.period_steps(name, self.clock.step_ns)
            self.components[name] = spec.with_period(component, period)
            self._periods[name] = period
        except DependsOnInvalidComponent:
            pass
        except (CosimError, ValueError) as error:
            self.problems.append((("components", name), str(error)))

    def _component(self, name: str, spec: Kind) -> Component:
        if self._recording is not None and not spec.computable:
            for model in spec.models:
                self.context.model(model)  # what it was made of: a replay cannot change that
            return Replay(self._recording, name)  # recorded under the scenario's names
        component = spec.build(name, self.context)
        entries = self.scenario.maps.get(name)
        if entries:
            component = self._renamed(name, component, entries)
        return with_units(component, spec.units)

    def _renamed(self, name: str, component: Component, entries: Sequence[MapEntry]) -> Component:
        """Show a swapped component under the scenario's names; add the problems of its map."""
        renamings = [entry.renaming for entry in entries]
        replaced = self._replaced.get(name)
        self.port_maps[name], problems = resolve(component.interface, renamings, replaced)
        for entry in entries:
            port = entry.renaming.port
            text = problems.pop(port, None) or problems.pop(port.whole, None)
            if text is not None:
                self.problems.append((entry.key, text))
                self._invalid.add(name)
        return Renamed(component, self.port_maps[name])

    # --- connections ---

    def _check_connections(self) -> None:
        components = dict(self.components)
        for name in self._invalid & components.keys():
            del components[name]
        if not components:
            return
        layout = layout_of(components)
        problems = check_connections(layout, self.scenario.connections, self._invalid)
        reported = {key for key, _ in self.problems}
        for to, text in problems.items():
            key = ("connections", str(to))
            if key not in reported:
                self.problems.append((key, text))

    def check(self) -> None:
        """Check that everything could be built.

        Raises
        ------
        ScenarioError
            With every problem of the file.
        """
        if self.problems:
            raise self.scenario.document.report(self.problems)

    def experiment(self) -> Experiment:
        """Return the experiment.

        Raises
        ------
        ScenarioError
            With every problem of the file.
        """
        self.check()
        context = self.context
        graph = self._graph(self.components, self.scenario.connections)
        self._warn(graph)
        return Experiment(
            self.scenario,
            graph,
            self.clock,
            truth=self._truth,
            metadata=context.metadata,
            warnings=tuple(context.warnings),
            reads=context.reads,
            attachments=context.attachments,
            fmus=context.fmus,
            files=frozenset(context.files),
        )

    def _warn(self, graph: Graph) -> None:
        """Record the warnings of the components, knowing what drives them, and of the graph."""
        h = self.clock.step_ns / 1e9
        for name, spec in self.scenario.specs.items():
            held = {}
            mask = graph.held[name]
            inputs = self.components[name].interface.input_columns()
            for signal, columns in inputs.items():
                held[signal] = bool(mask[columns].any())
            for text in spec.advice(held, h):
                self.context.warn(name, text)
        for name, text in graph.warnings:
            self.context.warn(name, text)

    def upstream(self, component: str) -> Graph:
        """Return the graph of a component and of all that it depends on.

        What is wrong with other components does not matter.

        Raises
        ------
        ScenarioError
            With every problem of the file, if one of these cannot be built or connected.
        """
        connections: dict[Port, Connection] = {}
        needed: set[str] = set()
        waiting = {component}
        while waiting:
            name = waiting.pop()
            needed.add(name)
            for to, connection in self.scenario.connections.items():
                if to.component == name:
                    connections[to] = connection
                    waiting |= {port.component for port in connection.sources} - needed
        if not needed <= self.components.keys() - self._invalid:
            raise self.scenario.document.report(self.problems)
        components = {}
        for name, part in self.components.items():
            if name in needed:
                components[name] = part
        return self._graph(components, connections)

    def _graph(
        self, components: Mapping[str, Component], connections: Mapping[Port, Connection]
    ) -> Graph:
        settings = self.scenario.file.scenario
        periods = {name: self._periods[name] for name in components}
        try:
            return Graph(
                components,
                connections,
                coupling=settings.coupling,
                input_interpolation=settings.input_interpolation,
                periods=periods,
            )
        except CosimError as error:
            problem = (("connections",), str(error))
            raise self.scenario.document.report([problem]) from error


def parse(document: Document) -> Scenario:
    """Read and validate a document.

    Raises
    ------
    ScenarioError
        With every problem that shows without building the components; if there is one, with every
        problem of the file.
    """
    scenario, problems = read(document, parse)
    if problems:
        with ExitStack() as resources:
            Builder(scenario, resources, problems=problems).check()
    return scenario


def describe(document: Document) -> Experiment:
    """Read, validate and build a document without running anything of an FMU.

    What is built shows what there is, and cannot run.

    Raises
    ------
    ScenarioError
        With every problem of the file.
    """
    scenario, problems = read(document, parse)
    with ExitStack() as resources:
        return Builder(scenario, resources, problems=problems, describes=True).experiment()


def build_context(scenario: Scenario, resources: ExitStack) -> BuildContext:
    """Return what a single kind needs to build its component, outside a run."""
    return ScenarioBuildContext(scenario, _clock_of(scenario), resources, None)


def _clock_of(scenario: Scenario, block: int | None = None) -> Clock:
    settings = scenario.file.scenario
    return Clock(settings.stop, settings.step, block, settings.start_time)


def fingerprint(scenario: Scenario, name: str, reads: frozenset[str]) -> str:
    """Hash everything that the design of a component rests on.

    This is its table, the tables that it read, communication step, input interpolation and
    coupling.
    """
    settings = scenario.file.scenario
    names = sorted({f"components.{name}", *reads})
    tables = {dotted: _table(scenario.tree, dotted) for dotted in names}
    values = [tables, settings.step, settings.input_interpolation, settings.coupling]
    text = json.dumps(values, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _table(tree: Mapping[str, Any], dotted: str) -> Any:
    table, _, name = dotted.partition(".")
    return tree.get(table, {}).get(name)
