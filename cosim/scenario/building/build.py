"""From a scenario to a graph and a clock, with every problem of the file in one report."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from cosim.blocks.declared import with_units
from cosim.blocks.replay import Replay
from cosim.core.clock import Clock, start_nanoseconds
from cosim.core.connections import Connection
from cosim.core.contracts import Component
from cosim.core.graph import Graph
from cosim.core.partial_recorder import chosen_signals
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels
from cosim.core.signals import Channel, Interface
from cosim.core.stepping.actions import AT_CONDITION, Action, ConditionalAction, TimedAction
from cosim.core.structure.connection_checks import check_connections
from cosim.core.structure.feedthrough import find_feedthrough
from cosim.core.structure.ports import Ports, layout_of
from cosim.errors import AlgebraicLoopError, CosimError, GraphError, RollbackError, UsageError
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.graph_checks import (
    as_in_run,
    check_substeps,
    check_truth,
    held_disturbances,
    jump_problems,
    substep_tolerance,
)
from cosim.scenario.building.parsing import Scenario, read
from cosim.scenario.building.stopping import check_until, until_warnings
from cosim.scenario.document.document import Document
from cosim.scenario.document.places import Key, Problem
from cosim.scenario.document.problems import TableProblems
from cosim.scenario.document.swaps import MapEntry, ports_in, unknown_ports
from cosim.scenario.kinds import Kind
from cosim.scenario.kinds.base import BuildContext, PeriodicKind, clock_of
from cosim.scenario.kinds.build_record import (
    TABLES_ALONE,
    DependsOnInvalid,
    NotImported,
    Origins,
)
from cosim.scenario.kinds.capabilities import Advising, HasGivenStates, HasSamples, RenamesMore
from cosim.scenario.kinds.identified_plant import IdentifiedPlant
from cosim.scenario.kinds.initial_states import GivenStates
from cosim.scenario.kinds.models import form_problems
from cosim.scenario.kinds.plants import DescriptorKind
from cosim.scenario.record import component_record

if TYPE_CHECKING:
    from cosim.blocks.port_map import PortMap
    from cosim.blocks.renaming import Renaming


class Builder:
    """Builds what can be built of a scenario, and collects the problems of the rest.

    Parameters
    ----------
    scenario : Scenario
    resources : ExitStack
        Closes what was opened, FMUs above all, when the run is over.
    origins : Origins
        Where components come from, beside their tables.
    problems : iterable of Problem
        Of the scenario, as far as they are known.
    block : int, optional
        Fixed number of communication steps in a block.
    replaced : mapping of component name to Interface, optional
        Of the components that swaps replaced, where they are known.
    beside : Scenario, optional
        The whole scenario, where only a part of it is built: what kinds ask of it.

    Attributes
    ----------
    problems : list of Problem
    components : mapping of name to Component
        Those that could be built.
    port_maps : mapping of component name to PortMap
        Of those of them whose ports are renamed.
    given_states : mapping of component name to GivenStates
        Initial states that the run may have to change.
    periods : dict of component name to int
        Communication steps between the rows that their log channels keep.
    unknown : set of str
        Components of which nothing but the table is known, as nothing of their code runs here.

    Raises
    ------
    ScenarioError
        If nothing can be built.
    """

    def __init__(
        self,
        scenario: Scenario,
        resources: ExitStack,
        origins: Origins = TABLES_ALONE,
        *,
        problems: Iterable[Problem] = (),
        block: int | None = None,
        replaced: Mapping[str, Interface] | None = None,
        beside: Scenario | None = None,
    ) -> None:
        self.scenario = scenario
        self.problems = list(problems)
        self._origins = origins
        self._block = block
        invalid = self._check_times()
        self.context = BuildContext(beside or scenario, resources, origins, invalid)
        self.components: dict[str, Component] = {}
        self.port_maps: dict[str, PortMap] = {}
        self.given_states: dict[str, GivenStates] = {}
        self.unknown: set[str] = set()
        self._replaced = replaced or {}
        self.periods: dict[str, int] = {}
        self._invalid: set[str] = set()  # components whose connections are not checked
        self._cause: Exception | None = None  # what the first component raised that was not built
        self._check_models()
        for name, interface in self._replaced.items():
            entries = scenario.maps.get(name, [])
            self.problems += unknown_ports(scenario.tree, entries, interface)
        for name, spec in scenario.specs.items():
            self._build(name, spec)
        self._drop_repeated_problems()
        self._invalid |= self._names() - self.components.keys()
        self._connections: Mapping[Port, Connection] = scenario.connections
        if origins.recording is not None:  # with the conversions of its run
            self._connections = as_in_run(scenario.connections, origins.recording, self.components)
        self._check_connections()
        self._truth, truth_problems = check_truth(
            scenario.file, self.components, self._invalid, self.context.warn
        )
        self.problems += truth_problems
        self._actions: tuple[TimedAction, ...] = ()
        self._reactions: tuple[ConditionalAction, ...] = ()
        self._check_actions()
        self._check_until()
        self._check_record()

    def _check_times(self) -> set[Key]:
        """Add the problems of the times; return the settings that are then not known."""
        settings = self.scenario.file.scenario
        checks: dict[str, Callable[[], object]] = {
            "step": lambda: Clock(float(settings.step), settings.step),
            "start_time": lambda: start_nanoseconds(settings.start_time),
            "stop": lambda: clock_of(self.scenario.file.scenario),
            "substeps": lambda: check_substeps(settings),
        }
        unknown: set[Key] = set()
        for name, check in checks.items():
            key = ("scenario", name)
            if not self.scenario.invalid.isdisjoint({("scenario",), key}):
                unknown.add(key)
            # what is checked on the grid of the steps needs it
            elif name not in ("stop", "substeps") or not unknown:
                try:
                    check()
                except CosimError as error:
                    changes = self.scenario.document.changes
                    is_of_step = "scenario.step" in changes and "scenario.stop" not in changes
                    if name == "stop" and is_of_step and settings.stop > settings.start_time:
                        self.problems.append((("scenario", "step"), str(error)))
                    else:
                        self.problems.append((key, str(error).removeprefix(f"{name}: ")))
                    unknown.add(key)
        return unknown

    @property
    def clock(self) -> Clock:
        """The clock of the run.

        Raises
        ------
        ScenarioError
            If one of its times is wrong, with every problem of the file.
        """
        try:
            return replace(self.context.clock, block=self._block)
        except DependsOnInvalid as error:
            raise self.scenario.document.report(self.problems) from error

    def _names(self) -> set[str]:
        """Return the names of all components that the file has, right or wrong."""
        names = set(self.scenario.file.components)
        for table, *entry in self.scenario.invalid:
            if table in ("components", "swap"):
                names |= set(map(str, entry))
        return names | {unicodedata.normalize("NFC", name) for name in names}

    # --- components ---

    def _check_models(self) -> None:
        for name, table in self.scenario.file.models.items():
            problems: list[Problem] = []
            for key, text in form_problems(table):
                problems.append((("models", name, key) if key else ("models", name), text))
            if not problems:
                try:
                    self.context.model(name)
                except (CosimError, ValueError) as error:
                    problems = [(("models", name), str(error))]
            if problems:
                self.problems += problems
                self.context.invalid.add(("models", name))

    def _build(self, name: str, spec: Kind) -> None:
        """Build a component, or add the problem of that."""
        self.context.begin(name)
        try:
            component = self._component(name, spec)
            self.components[name] = self._with_period(name, spec, component)
            if isinstance(spec, HasGivenStates):
                given = spec.given_states(name, self.context)
                if given is not None:
                    self.given_states[name] = given
        except DependsOnInvalid:
            pass
        except NotImported:
            self.unknown.add(name)
        except TableProblems as error:
            self._cause = self._cause or error
            for key, text in error.problems:
                self.problems.append((("components", name, *key), text))
        except (CosimError, ValueError) as error:
            self._cause = self._cause or error
            self.problems.append((("components", name), str(error)))
        except (ArithmeticError, MemoryError) as error:  # of numbers near the largest or smallest
            self.problems.append((("components", name), out_of_range(error)))

    def _with_period(self, name: str, spec: Kind, component: Component) -> Component:
        """Return a component with its sample period, or its recording if it is left out."""
        period = self.periods[name] = 1
        if isinstance(spec, PeriodicKind):
            period = spec.period_steps(name, self.context.step_ns)
            self.periods[name] = spec.recorded_period(period)
        if name in self._origins.left_out:
            component = self._recording_of(name, spec, component, self.periods[name])
        return spec.with_period(component, period) if isinstance(spec, PeriodicKind) else component

    def _drop_repeated_problems(self) -> None:
        """Drop what a component says of another that it reads, which says that itself."""
        known = {(".".join(map(str, key)), text) for key, text in self.problems}
        read_by = self.context.reads
        kept = []
        for key, text in self.problems:
            others: set[str] = set()
            if key[:1] == ("components",) and len(key) > 1:
                others = {*read_by.get(str(key[1]), ())} - {f"components.{key[1]}"}
            if not any((table, text) in known for table in others):
                kept.append((key, text))
        self.problems = kept

    def _component(self, name: str, spec: Kind) -> Component:
        recording = self._origins.recording
        if recording is not None and not spec.computable:
            if isinstance(spec, DescriptorKind):
                self.context.model(spec.model)  # what it was made of: a replay cannot change that
            record = component_record(recording, name)
            if record.lags:
                self.context.add_metadata(name, {"lags": record.lags})
            if record.code is not None:
                self.context.add_metadata(name, {"code": record.code.model_dump(by_alias=True)})
            return Replay(recording, name)  # recorded under the scenario's names
        component = spec.build(name, self.context)
        entries = self.scenario.maps.get(name)
        if entries:
            component = self._renamed(name, spec, component, entries)
        return with_units(component, spec.units_of(component.interface))

    def _recording_of(self, name: str, spec: Kind, component: Component, period: int) -> Component:
        """Return the recording of a component that is left out.

        It was built all the same: others may rest on what it is made of, and the log tells of it.

        Raises
        ------
        UsageError
            If the log lacks one of its outputs.
        """
        recording = self._origins.recording
        assert recording is not None, "only a replay leaves components out"
        outputs = component.interface.outputs
        has_samples = isinstance(spec, HasSamples) and any(
            spec.samples_of(signal.name) for signal in outputs
        )
        if has_samples and period > 1:
            raise UsageError(
                f"cannot be substituted from the log, which has a row only every {period} "
                "communication steps and no marks of missing samples; recompute it, too"
            )
        return Replay(recording, name)

    def _renamed(
        self, name: str, spec: Kind, component: Component, entries: Sequence[MapEntry]
    ) -> Component:
        """Show a swapped component under the scenario's names; add the problems of its map."""
        from cosim.blocks.renamed import Renamed  # rarely needed
        from cosim.blocks.renaming import resolve

        given = [entry.renaming for entry in entries]
        renamings: Sequence[Renaming] = given
        if isinstance(spec, RenamesMore):
            renamings = spec.renamings(component.interface, given)
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
        invalid = self.scenario.invalid
        if not components or not invalid.isdisjoint({("components",), ("connections",)}):
            return
        ports = Ports(layout_of(components))
        unread = ports_in(key[1] for key in invalid if key[0] == "connections")
        problems = check_connections(ports, self._connections, self._invalid, unread)
        for to, text in problems.items():
            origin = self.scenario.implied.get(to, to)
            if origin is None:
                where = "" if str(to) in text else f"'{to}': "
                self.problems.append((("components", to.component), where + text))
                self._invalid.add(to.component)
            elif origin == to or origin not in problems:  # else told of what it follows from
                self._add_connection_problem(to, origin, text)

    def _add_connection_problem(self, to: Port, origin: Port, text: str) -> None:
        key = ("connections", str(origin))
        if key in self.scenario.invalid:
            return
        if origin != to:
            text += f"; '{to}' has the source of '{origin}' by default"
        self.problems.append((key, text))

    def _check_until(self) -> None:
        """Add the problem of the condition that ends the run."""
        until = self.scenario.file.scenario.until
        known = {name: c for name, c in self.components.items() if name not in self._invalid}
        if until is None or not known:
            return
        unknown = self._names() - known.keys()
        try:
            step_ns = self.context.step_ns
        except DependsOnInvalid:
            return
        self.problems += check_until(until, known, unknown, step_ns)

    def _check_record(self) -> None:
        """Add the problem of what is chosen to be recorded, where all components are known."""
        selection = self.scenario.file.record.selection
        key = ("record", "signals")
        if selection.signals is None or self._invalid or not self.components:
            return
        channels = {c.name: c for c in layout_of(self.components).channels}
        try:
            chosen_signals(channels, selection, beside=self._declared)
        except UsageError as error:
            self.problems.append((key, str(error).removeprefix("the run: ")))

    @property
    def _declared(self) -> Mapping[str, Channel]:
        return (
            {}
            if self._origins.recording is None
            else declared_channels(self._origins.recording.channels)
        )

    def _settings(self) -> dict[tuple[int, str], Action]:
        """Return what sets parameters, by time [ns] and component."""
        settings: dict[tuple[int, str], Action] = {}
        for timed in self._actions:
            time_ns = self.clock.grid.stamp(timed.index)
            for name in timed.action.variants:
                settings[time_ns, name] = timed.action
        for reaction in self._reactions:
            for action in reaction.actions:
                for name in action.variants:
                    settings[AT_CONDITION, name] = action
        return settings

    def _check_actions(self) -> None:
        """Check the actions; a replay follows those that were recorded."""
        if not self.scenario.actions or self._origins.recording is not None:
            return
        from cosim.scenario.building.acting import ActionChecker
        from cosim.scenario.building.settings import SettingBuilder
        from cosim.scenario.building.timed_swaps import SwapBuilder

        known = {name: c for name, c in self.components.items() if name not in self._invalid}
        try:
            clock = self.context.clock
        except DependsOnInvalid:
            return
        settings = None
        swaps = None
        if not self._origins.describes:
            swaps = SwapBuilder(self.scenario, self.context, known)
            settings = SettingBuilder(self.scenario, self.context, known)
        connections = self.scenario.connections
        unknown = self._names() - known.keys()
        checker = ActionChecker(
            known, connections, unknown, clock=clock, settings=settings, swaps=swaps
        )
        checker.check(self.scenario.actions)
        self.problems += checker.problems
        self._actions = tuple(checker.timed)
        self._reactions = tuple(checker.reactions)

    def check(self) -> None:
        """Check that everything could be built.

        Raises
        ------
        ScenarioError
            With every problem of the file.
        """
        if self.problems:
            problems = [*self.problems, *self.graph_problems()]
            raise self.scenario.document.report(problems) from self._cause

    def graph_problems(self) -> list[Problem]:
        """Return the problems of the graph as a whole, where all that it is made of is right."""
        keys = [key for key, _ in self.problems]
        is_known = ("scenario", "substeps") in keys  # the graph would say the same of them
        is_unread = ("components",) in self.scenario.invalid
        is_unknown = is_unread or any(key[:1] == ("connections",) for key in keys)
        if self._invalid or is_known or is_unknown:
            return self._loop_problems()
        try:
            graph = self._graph()
        except CosimError as error:
            return self._problems_of(error)
        return jump_problems(self.scenario, graph)

    def _loop_problems(self) -> list[Problem]:
        """Return the problems of algebraic loops among what is right, where not all of it is."""
        known = {n: c.interface for n, c in self.components.items() if n not in self._invalid}
        sources: dict[str, dict[str, tuple[Port, ...]]] = {}
        for name, interface in known.items():
            sources[name] = {signal.name: () for signal in interface.inputs}
        ports = Ports(layout_of({name: self.components[name] for name in known}))
        for to, connection in self._connections.items():
            with suppress(GraphError):  # which is told of the connection
                signal = ports.input(to).port.signal
                outputs = [ports.output(source).port for source in connection.sources]
                sources[to.component][signal] += tuple(outputs)
        try:
            find_feedthrough(known, sources, iterates=True)
        except AlgebraicLoopError as error:
            return [_problem_of(error)]
        return []

    def experiment(self) -> Experiment:
        """Return the experiment.

        Raises
        ------
        ScenarioError
            With every problem of the file.
        """
        self.check()
        graph = self.graph()
        jumps = jump_problems(self.scenario, graph)
        if jumps:
            raise self.scenario.document.report(jumps)
        self._warn(graph)
        return Experiment(
            self.scenario,
            graph,
            self.clock,
            self.context,
            truth=self._truth,
            port_maps=self.port_maps,
            identified=self._judged(graph),
            given_states=self.given_states,
            actions=self._actions,
            reactions=self._reactions,
            until=self.scenario.file.scenario.until,
            settings=self._settings(),
            recorded=self._recorded_names(),
            declared=self._declared,
        )

    def _judged(self, graph: Graph) -> dict[str, IdentifiedPlant]:
        """Return what estimates are judged by, where all is here that this rests on."""
        judged = {}
        for name, plant in self.context.identified.items():
            sources = (name, plant.observer, plant.regressor)
            here = [source for source in sources if source in graph.components]
            if len(here) == len(sources) and all(map(self._has_all_inputs, here)):
                judged[name] = plant
        return judged

    def _has_all_inputs(self, name: str) -> bool:
        """Return whether a component has all its inputs; one that is copied may have less."""
        declared = self._declared.get(name) if name in self._recorded_names() else None
        inputs = self.components[name].interface.input_names
        return declared is None or declared.interface.input_names <= inputs

    def _recorded_names(self) -> tuple[str, ...]:
        """Return the components that are taken from the recording."""
        specs = self.scenario.specs.items()
        return tuple(
            name for name, spec in specs if self._origins.copies(name, computable=spec.computable)
        )

    def _warn(self, graph: Graph) -> None:
        """Record the warnings of the components, knowing what drives them, and of the graph."""
        for name, left_out in self.scenario.unfollowed.items():
            self.context.warn(
                name,
                f"has no inputs: the connections to {', '.join(left_out)} are left out, and what "
                "[truth] compares with need not be true of the data",
            )
        for recorded in self.scenario.recorded_inputs:
            self.context.warn(recorded.port.component, recorded.text())
        for name, spec in self.scenario.specs.items():
            for text in self.advice(name, spec, graph):
                self.context.warn(name, text)
        for name, fmu in self.context.fmus.items():
            if name in graph.components:  # not a plant that an action puts in its place later
                graph.wire(name)
            for text in fmu.component.notes:
                self.context.warn(name, text)
        keys = ["until"] if self.scenario.file.scenario.until is not None else []
        keys += ["when"] if self._reactions else []
        held_inputs = held_disturbances(self.scenario, graph, self.clock.step_ns)
        others = [*held_inputs, *until_warnings(keys, graph)]
        if graph.substeps is not None and not graph.substep_controls:
            text = "there is no loop that takes any, so that they change nothing"
            others.append(("scenario.substeps", text))
        for name, text in (*graph.warnings, *others):
            self.context.warn(name, text)

    def advice(self, name: str, spec: Kind, graph: Graph) -> list[str]:
        """Return the warnings of a component that knows what drives it."""
        if not isinstance(spec, Advising):
            return []
        inputs = self.components[name].interface.input_columns()
        held = {signal: bool(graph.held[name][columns].any()) for signal, columns in inputs.items()}
        return spec.advice(name, self.context, held=held, h=self.clock.h)

    def graph(self) -> Graph:
        """Return the graph of the components; what is wrong beside them does not matter.

        Raises
        ------
        ScenarioError
            If one of them cannot be built, with every problem of the file; or they do not fit
            together.
        """
        if not self.scenario.specs.keys() <= self.components.keys() - self._invalid:
            raise self.scenario.document.report(self.problems) from self._cause
        try:
            return self._graph()
        except CosimError as error:
            raise self.scenario.document.report(self._problems_of(error)) from error

    def _problems_of(self, error: CosimError) -> list[Problem]:
        """Return what is wrong with a graph, and why FMUs cannot go back where that matters."""
        problems = [_problem_of(error)]
        if isinstance(error, RollbackError):
            for name, fmu in self.context.fmus.items():
                if fmu.unsaved:
                    problems.append((("components", name), fmu.unsaved))
        return problems

    def _graph(self) -> Graph:
        settings = self.scenario.file.scenario
        specs = self.scenario.specs
        return Graph(
            self.components,
            self._connections,
            coupling=settings.coupling,
            iterations=settings.iterations,
            input_interpolation=settings.input_interpolation,
            means=[name for name, spec in specs.items() if self._gets_means(name, spec)],
            periods=self.periods,
            substeps=substep_tolerance(settings),
            threads=settings.threads,
        )

    def _gets_means(self, name: str, spec: Kind) -> bool:
        """Return whether inputs with one value over a step get their mean, as in a run of old."""
        again = self._origins.fmus_again.get(name)
        return asks_for_means(spec) or (again is not None and again.means)


def asks_for_means(spec: Kind) -> bool:
    """Return whether inputs with one value over a step get their mean, whatever drives them."""
    return getattr(spec, "input_interpolation", None) == "linear"


def _problem_of(error: CosimError) -> Problem:
    """Return what is wrong with a graph as a problem of the key that it is about."""
    name, _, text = str(error).partition(": ")
    if name in ("coupling", "iterations", "substeps"):
        return ("scenario", name), text
    return ("connections",), str(error)


def out_of_range(error: Exception) -> str:
    """Return in words that a number has left the range of numbers."""
    return f"numeric overflow or underflow: {error}"


def parse(document: Document) -> Scenario:
    """Read and validate a document; it may be a stranger's, so nothing of an FMU or a class runs.

    Raises
    ------
    ScenarioError
        With every problem that shows without building the components; if there is one, with every
        problem of the file that shows without its code.
    """
    scenario, problems = read(document, parse)
    if problems:
        with ExitStack() as resources:
            Builder(scenario, resources, Origins(describes=True), problems=problems).check()
    return scenario


@dataclass(frozen=True)
class DescribedScenario:
    """What there is of a scenario, of which nothing runs.

    Parameters
    ----------
    scenario : Scenario
    clock : Clock
    components : mapping of name to Component
        Those whose ports are known.
    graph : Graph or None
        None: the ports of some components are not known.
    metadata : mapping of component name to plain values
    """

    scenario: Scenario
    clock: Clock
    components: Mapping[str, Component]
    graph: Graph | None
    metadata: Mapping[str, Mapping[str, Any]]


def describe(document: Document) -> DescribedScenario:
    """Read, validate and build a document without running anything of an FMU or a user's class.

    What is built shows what there is, and cannot run.

    Raises
    ------
    ScenarioError
        With every problem of the file.
    """
    scenario, problems = read(document, parse)
    with ExitStack() as resources:
        builder = Builder(scenario, resources, Origins(describes=True), problems=problems)
        builder.check()
        graph = None if builder.unknown else builder.experiment().graph
        metadata = builder.context.metadata
        return DescribedScenario(scenario, builder.clock, builder.components, graph, metadata)
