"""From a scenario to a graph and a clock, with every problem of the file in one report."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cached_property, partial
from typing import TYPE_CHECKING, Final

from cosim.blocks.declared import with_units
from cosim.blocks.replay import Replay
from cosim.core.clock import Clock, start_nanoseconds
from cosim.core.connections import Connection
from cosim.core.contracts import Component
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.selection import chosen_signals
from cosim.core.signals import SAMPLE_TIMES, Channel, Interface
from cosim.core.stages.looking_ahead import bound_to_steps
from cosim.core.stepping.actions import AT_CONDITION, Action, ConditionalAction, TimedAction
from cosim.core.structure.connection_checks import check_connections
from cosim.core.structure.feedthrough import find_feedthrough
from cosim.core.structure.ports import Ports, layout_of
from cosim.errors import (
    AlgebraicLoopError,
    CosimError,
    GraphError,
    RollbackError,
    ScenarioError,
    UsageError,
)
from cosim.scenario.building.actions import ActionChecker, check_condition
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.graph_checks import (
    as_in_run,
    check_truth,
    held_disturbances,
    jump_problems,
    substep_tolerance,
)
from cosim.scenario.building.parsing import read_tables
from cosim.scenario.document.document import Document
from cosim.scenario.document.places import Key, Problem
from cosim.scenario.document.problems import problems_in
from cosim.scenario.document.swaps import Map, ports_in, unknown_ports
from cosim.scenario.kinds import Kind
from cosim.scenario.kinds.base import BuildContext, PeriodicKind, Scenario
from cosim.scenario.kinds.build_record import (
    TABLES_ALONE,
    DependsOnInvalid,
    NotImported,
    Origins,
)
from cosim.scenario.kinds.capabilities import (
    Advising,
    GivenStates,
    HasGivenStates,
    HasSamples,
    RenamesMore,
)
from cosim.scenario.kinds.identified_plant import IdentifiedPlant
from cosim.scenario.kinds.plants import DescriptorKind
from cosim.scenario.record import component_record

if TYPE_CHECKING:
    from cosim.blocks.port_map import PortMap
    from cosim.blocks.renaming import Renaming


DESCRIBED: Final = Origins(describes=True)


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
        Of the tables, as :func:`read` returns them.
    replaced : mapping of component name to Interface, optional
        Of the components that swaps replaced, where they are known.
    beside : Scenario, optional
        The whole scenario, where only a part of it is built: what kinds ask of it.

    Attributes
    ----------
    problems : list of Problem
    context : BuildContext
        In which the components were built.
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
        replaced: Mapping[str, Interface] | None = None,
        beside: Scenario | None = None,
    ) -> None:
        self.scenario = scenario
        self.problems = list(problems)
        self._origins = origins
        self._replaced = replaced or {}
        invalid = self._check_times()
        self.context = BuildContext(beside or scenario, resources, origins, invalid)
        self.components: dict[str, Component] = {}
        self.port_maps: dict[str, PortMap] = {}
        self.given_states: dict[str, GivenStates] = {}
        self.unknown: set[str] = set()
        self.periods: dict[str, int] = {}
        self._dependent: list[Problem] = []  # components that rest on what is wrong with others
        self._cause: Exception | None = None  # of the first problem that was raised
        recording = origins.recording
        self._declared: Mapping[str, Channel] = {}  # all that a recorded run had
        if recording is not None:
            self._declared = declared_channels(recording.channels)
        self._check_models()
        self._wrong: set[str] = set()  # components with problems that do not stop their build
        for name, interface in self._replaced.items():
            own = scenario.maps.get(name)
            if own:
                self.problems += unknown_ports(scenario.tree, name, own, interface)
        for name, spec in scenario.specs.items():
            self._build(name, spec)
        if not self.problems:  # of what is not built here, which would have told itself
            self.problems += [(place, text) for place, text in self._dependent if text]
        # what is read from now on is told of the last one, in a part of a scenario as in the whole
        self.context.go_on(*list((beside or scenario).specs)[-1:])
        self._connections: Mapping[Port, Connection] = scenario.connections
        if recording is not None:  # with the conversions of its run
            self._connections = as_in_run(scenario.connections, recording, self.components)
        self._check_connections()
        self._truth, truth_problems = check_truth(
            scenario.file, self.components, self._invalid, self.context.warn
        )
        self.problems += truth_problems
        self._actions: Sequence[TimedAction] = ()
        self._reactions: Sequence[ConditionalAction] = ()
        with suppress(DependsOnInvalid):
            self._check_actions()
        self._check_until()
        self._check_record()

    # --- what is known beforehand ---

    def _check_times(self) -> set[Key]:
        """Add the problems of the times; return the settings that are then not known."""
        settings = self.scenario.file.scenario
        checks: dict[str, Callable[[], object]] = {
            "step": lambda: Clock(float(settings.step), settings.step),
            "start_time": lambda: start_nanoseconds(settings.start_time),
            "stop": lambda: settings.clock,
            "substeps": lambda: substep_tolerance(settings),
        }
        changes = self.scenario.document.changes
        is_of_step = "scenario.step" in changes and "scenario.stop" not in changes
        unknown: set[Key] = set()
        for name, check in checks.items():
            key = ("scenario", name)
            place, prefix = key, f"{name}: "
            if name == "stop" and is_of_step and settings.stop > settings.start_time:
                place, prefix = ("scenario", "step"), ""
            is_invalid = not self.scenario.invalid.isdisjoint({("scenario",), key})
            # what is checked on the grid of the steps needs it
            is_unchecked = name in ("stop", "substeps") and unknown
            if is_invalid or (not is_unchecked and self._is_refused(place, check, prefix)):
                unknown.add(key)
        return unknown

    def _is_refused(self, place: Key, check: Callable[[], object], prefix: str = "") -> bool:
        """Return whether a check refuses what stands at a place; add the problem of that.

        The place says what the prefix of its message does.
        """
        try:
            check()
        except DependsOnInvalid:
            pass
        except (CosimError, ValueError) as error:
            found = problems_in(error, place)
            self.problems += [(key, text.removeprefix(prefix)) for key, text in found]
            return True
        return False

    @property
    def clock(self) -> Clock:
        """The clock of the run, with blocks of any size.

        Raises
        ------
        ScenarioError
            If one of its times is wrong, with every problem of the file.
        """
        try:
            return self.context.clock
        except DependsOnInvalid as error:
            raise self.scenario.document.report(self.problems) from error

    def _check_models(self) -> None:
        for name in self.scenario.file.models:
            place: Key = ("models", name)
            if self._is_refused(place, partial(self.context.model, name)):
                self.context.invalid.add(place)

    @cached_property
    def _names(self) -> set[str]:
        """The names of all components that the file has, right or wrong."""
        names = set(self.scenario.file.components)
        for table, *entry in self.scenario.invalid:
            if table in ("components", "swap"):
                names |= set(map(str, entry))
        return names | {unicodedata.normalize("NFC", name) for name in names}

    @property
    def _invalid(self) -> set[str]:
        """The components whose signals are not known, or are not those of the run."""
        return self._wrong | (self._names - self.components.keys())

    @property
    def _right(self) -> dict[str, Component]:
        """The components that could be built, and of which nothing is wrong."""
        return {name: c for name, c in self.components.items() if name not in self._wrong}

    # --- components ---

    def _build(self, name: str, spec: Kind) -> None:
        """Build a component, or add the problem of that."""
        self.context.begin(name)
        place = ("components", name)
        try:
            component = self._component(name, spec)
            self.components[name] = self._with_period(name, spec, component)
            if isinstance(spec, HasGivenStates):
                given = spec.given_states(name, self.context)
                if given is not None:
                    self.given_states[name] = given
        except DependsOnInvalid as error:
            self._dependent.append((place, str(error)))
        except NotImported:
            self.unknown.add(name)
        except (CosimError, ValueError) as error:
            self._cause = self._cause or error
            self.problems += problems_in(error, place)
        except (ArithmeticError, MemoryError) as error:
            self.problems += problems_in(error, place)

    def _component(self, name: str, spec: Kind) -> Component:
        recording = self.context.replayed_from(spec)
        if recording is not None:
            if isinstance(spec, DescriptorKind):
                self.context.model(spec.model)  # what it was made of: a replay cannot change that
            record = component_record(recording, name)
            if record.lags:
                self.context.add_metadata(name, {"lags": record.lags})
            if record.code is not None:
                self.context.add_metadata(name, {"code": record.code.model_dump(by_alias=True)})
            return Replay(recording, name)  # recorded under the scenario's names
        component = spec.build(name, self.context)
        own = self.scenario.maps.get(name)
        if own:
            component = self._renamed(name, spec, component, own)
        return with_units(component, spec.units_of(component.interface))

    def _renamed(self, name: str, spec: Kind, component: Component, own: Map) -> Component:
        """Show a swapped component under the scenario's names; add the problems of its map."""
        from cosim.blocks.renamed import Renamed  # rarely needed
        from cosim.blocks.renaming import resolve

        renamings: Sequence[Renaming] = list(own.values())
        if isinstance(spec, RenamesMore):
            renamings = spec.renamings(component.interface, renamings)
        replaced = self._replaced.get(name)
        self.port_maps[name], problems = resolve(component.interface, renamings, replaced)
        for key, renaming in own.items():
            port = renaming.port
            text = problems.pop(port, None) or problems.pop(port.whole, None)
            if text is not None:
                self.problems.append((key, text))
                self._wrong.add(name)
        return Renamed(component, self.port_maps[name])

    def _with_period(self, name: str, spec: Kind, component: Component) -> Component:
        """Return a component with its sample period, or its recording if it is left out.

        It was built all the same: others may rest on what it is made of, and the log tells of it.

        Raises
        ------
        UsageError
            If it is left out, and the log lacks one of its outputs.
        """
        period = self.periods[name] = 1
        if isinstance(spec, PeriodicKind):
            period = spec.period_steps(name, self.context.step_ns)
            self.periods[name] = spec.recorded_period(period)
        if name in self._origins.left_out:
            recording = self._origins.recording
            assert recording is not None, "only a replay leaves components out"
            reader = self._reader_of_samples(name, spec, component)
            if reader is not None and self.periods[name] > 1:
                raise UsageError(
                    f"cannot be substituted from the log for '{reader}', as that has a row only "
                    f"every {self.periods[name]} communication steps and no marks of missing "
                    "samples; recompute it, too"
                )
            component = Replay(recording, name)
        if not isinstance(spec, PeriodicKind):
            return component
        sampled = spec.with_period(component, period)
        if isinstance(component, Replay):
            if sampled is component and self.periods[name] == 1:
                return component
            component.hold(sampled.interface)  # its rows were sampled in the run
            return component
        return sampled

    def _reader_of_samples(self, name: str, spec: Kind, component: Component) -> Port | None:
        """Return an input that has samples of a component, not only what it holds between them."""
        if not isinstance(spec, HasSamples):
            return None
        outputs = [signal.name for signal in component.interface.outputs]
        samples = {SAMPLE_TIMES, *map(spec.samples_of, outputs)}
        for to, connection in self.scenario.connections.items():
            for source in connection.sources:
                if source.component == name and source.signal in samples:
                    return to
        return None

    # --- what connects them, and what is said of their signals ---

    def _check_connections(self) -> None:
        invalid = self.scenario.invalid
        right = self._right
        if not right or not invalid.isdisjoint({("components",), ("connections",)}):
            return
        ports = Ports(layout_of(right))
        unread = ports_in(key[1] for key in invalid if key[0] == "connections")
        problems = check_connections(ports, self._connections, self._invalid, unread)
        for to, text in problems.items():
            origin = self.scenario.implied.get(to, to)
            key = ("connections", str(origin))
            if origin is None:
                where = "" if str(to) in text else f"'{to}': "
                self.problems.append((("components", to.component), where + text))
                self._wrong.add(to.component)
            elif origin == to and key not in invalid:
                self.problems.append((key, text))
            elif origin not in problems and key not in invalid:  # else told of that one
                text += f"; '{to}' has the source of '{origin}' by default"
                self.problems.append((key, text))

    def _check_actions(self) -> None:
        """Check the actions; a replay follows those that were recorded."""
        if not self.scenario.actions or self._origins.recording is not None:
            return
        checker = ActionChecker(
            self.scenario, self.context, self._right, self._names - self._right.keys()
        )
        self.problems += checker.problems
        self._actions = checker.timed
        self._reactions = checker.reactions

    def _check_until(self) -> None:
        """Add the problem of the condition that ends the run."""
        until = self.scenario.file.scenario.until
        right = self._right
        if until is not None and right:
            missing = self._names - right.keys()
            check = partial(check_condition, until, right, missing, self.context)
            self._is_refused(("scenario", "until"), check)

    def _check_record(self) -> None:
        """Add the problem of what is chosen to be recorded, where all components are known."""
        selection = self.scenario.file.record.selection
        if selection.signals is not None and self.components and not self._invalid:
            channels = {channel.name: channel for channel in layout_of(self.components).channels}
            check = partial(chosen_signals, channels, selection, beside=self._declared)
            self._is_refused(("record", "signals"), check, "the run: ")

    # --- the graph ---

    def check(self) -> None:
        """Check that everything could be built, and that it fits together.

        Raises
        ------
        ScenarioError
            With every problem of the file.
        """
        problems = [*self.problems, *self.graph_problems()]
        if problems:
            raise self._report(problems)

    def _report(self, problems: Iterable[Problem]) -> ScenarioError:
        error = self.scenario.document.report(problems)
        error.__cause__ = self._cause
        return error

    def graph_problems(self) -> list[Problem]:
        """Return the problems of the graph as a whole, where all that it is made of is right."""
        keys = [key for key, _ in self.problems]
        is_known = ("scenario", "substeps") in keys  # the graph would say the same of them
        is_unread = ("components",) in self.scenario.invalid
        is_unknown = is_unread or any(key[:1] == ("connections",) for key in keys)
        if self._invalid or is_known or is_unknown:
            return self._loop_problems()
        try:
            return jump_problems(self.scenario, self._graph)
        except CosimError as error:
            self._cause = self._cause or error
            return self._problems_of(error)

    def _loop_problems(self) -> list[Problem]:
        """Return the problems of algebraic loops among what is right, where not all of it is."""
        right = self._right
        interfaces = {name: component.interface for name, component in right.items()}
        sources: dict[str, dict[str, tuple[Port, ...]]] = {}
        for name, interface in interfaces.items():
            sources[name] = {signal.name: () for signal in interface.inputs}
        ports = Ports(layout_of(right))
        for to, connection in self._connections.items():
            with suppress(GraphError):  # which is told of the connection
                signal = ports.input(to).port.signal
                outputs = [ports.output(source).port for source in connection.sources]
                sources[to.component][signal] += tuple(outputs)
        try:
            find_feedthrough(interfaces, sources, iterates=True)
        except AlgebraicLoopError as error:
            return self._problems_of(error)
        return []

    def _problems_of(self, error: CosimError) -> list[Problem]:
        """Return what is wrong with a graph, and why FMUs cannot go back where that matters."""
        name, _, text = str(error).partition(": ")
        problems: list[Problem] = [(("connections",), str(error))]
        if name in ("coupling", "iterations", "substeps"):
            problems = [(("scenario", name), text)]
        if isinstance(error, RollbackError):
            for name, fmu in self.context.fmus.items():
                if fmu.unsaved:
                    problems.append((("components", name), fmu.unsaved))
        return problems

    @cached_property
    def _graph(self) -> Graph:
        return self.graph_of(self.components)

    def graph_of(self, names: Collection[str]) -> Graph:
        """Return the graph of some components and of what drives them, which is among them.

        Raises
        ------
        CosimError
            If they do not fit together.
        """
        settings = self.scenario.file.scenario
        again = self._origins.fmus_again
        components = {name: own for name, own in self.components.items() if name in names}
        means = []  # whose inputs with one value over a step get their mean, as in a run of old
        for name in components:
            spec = self.scenario.specs[name]
            if asks_for_means(spec) or (name in again and again[name].means):
                means.append(name)
        return Graph(
            components,
            {to: own for to, own in self._connections.items() if to.component in components},
            coupling=settings.coupling,
            iterations=settings.iterations,
            input_interpolation=settings.input_interpolation,
            means=means,
            periods={name: self.periods[name] for name in components},
            substeps=substep_tolerance(settings),
            threads=settings.threads,
        )

    def graph(self) -> Graph:
        """Return the graph of the components; what is wrong beside them does not matter.

        Raises
        ------
        ScenarioError
            If one of them cannot be built, with every problem of the file; or they do not fit
            together.
        """
        if not self.scenario.specs.keys() <= self._right.keys():
            raise self._report(self.problems)
        try:
            return self._graph
        except CosimError as error:
            raise self.scenario.document.report(self._problems_of(error)) from error

    def experiment(self) -> Experiment:
        """Return the experiment.

        Raises
        ------
        ScenarioError
            With every problem of the file.
        """
        self.check()
        graph = self._graph
        for name, text in self._warnings(graph):
            self.context.warn(name, text)
        left_out = self._origins.left_out
        recorded = tuple(
            name
            for name, spec in self.scenario.specs.items()
            if name in left_out or self.context.replayed_from(spec) is not None
        )
        clock = self.clock
        performed = [(clock.grid.stamp(timed.index), timed.action) for timed in self._actions]
        for reaction in self._reactions:
            performed += [(AT_CONDITION, action) for action in reaction.actions]
        settings: dict[tuple[int, str], Action] = {}
        for time_ns, action in performed:
            settings |= {(time_ns, name): action for name in action.variants}
        return Experiment(
            self.scenario,
            graph,
            clock,
            self.context,
            truth=self._truth,
            port_maps=self.port_maps,
            identified=self._judged(recorded),
            given_states=self.given_states,
            actions=tuple(self._actions),
            reactions=tuple(self._reactions),
            until=self.scenario.file.scenario.until,
            settings=settings,
            recorded=recorded,
            declared=self._declared,
        )

    def _judged(self, recorded: Sequence[str]) -> dict[str, IdentifiedPlant]:
        """Return what estimates are judged by, where all is here that this rests on.

        One that is copied may have less inputs than it had.
        """
        judged = {}
        for identifier, plant in self.context.identified.items():
            for name in (identifier, plant.observer, plant.regressor):
                if name not in self.components:
                    break
                inputs = self.components[name].interface.input_names
                declared = self._declared.get(name) if name in recorded else None
                if declared is not None and not declared.interface.input_names <= inputs:
                    break
            else:
                judged[identifier] = plant
        return judged

    def _warnings(self, graph: Graph) -> Iterator[tuple[str, str]]:
        """Yield the warnings of the components, knowing what drives them, and of the graph."""
        scenario = self.scenario
        for name, text in scenario.notes:
            if name in scenario.specs:  # not of another part
                yield name, text
        for name, spec in scenario.specs.items():
            for text in self.advice(name, spec, graph):
                yield name, text
        for name, fmu in self.context.fmus.items():
            if name in graph.components:  # not a plant that an action puts in its place later
                graph.wire(name)
            for text in fmu.component.notes:
                yield name, text
        yield from graph.warnings
        yield from held_disturbances(scenario, graph)
        keys = ["until"] if scenario.file.scenario.until is not None else []
        keys += ["when"] if self._reactions else []
        for name in bound_to_steps(graph) if keys else ():
            text = (
                f"cannot go back from behind the row where {' or '.join(map(repr, keys))} comes "
                "true, so that the run advances by single steps, which takes longer"
            )
            yield name, text
        if graph.substeps is not None and not graph.substep_controls:
            text = "there is no loop that takes any, so that they change nothing"
            yield "scenario.substeps", text

    def advice(self, name: str, spec: Kind, graph: Graph) -> list[str]:
        """Return the warnings of a component that knows what drives it.

        None of a copied one without some of its inputs; it is asked, as what it reads counts.
        """
        if not isinstance(spec, Advising):
            return []
        component = self.components[name]
        inputs = component.interface.input_columns()
        held = {signal: bool(graph.held[name][columns].any()) for signal, columns in inputs.items()}
        lacking: frozenset[str] = frozenset()
        if isinstance(component, Replay) and name in self._declared:
            lacking = frozenset(self._declared[name].interface.input_names - held.keys())
        held |= dict.fromkeys(lacking, False)
        texts = spec.advice(name, self.context, held)
        return [] if lacking else texts


def asks_for_means(spec: Kind) -> bool:
    """Return whether inputs with one value over a step get their mean, whatever drives them."""
    return getattr(spec, "input_interpolation", None) == "linear"


def read(document: Document) -> tuple[Scenario, list[Problem]]:
    """Read and validate a document; return what is right in it, and the problems of the rest.

    Raises
    ------
    ScenarioError
        If the text is no TOML.
    """
    return read_tables(document, parse)


def parse(document: Document) -> Scenario:
    """Read and validate a document; it may be a stranger's, so nothing of an FMU or a class runs.

    Raises
    ------
    ScenarioError
        With every problem that shows without building the components; if there is one, with every
        problem of the file that shows without its code.
    """
    scenario, problems = read(document)
    if problems:
        with ExitStack() as resources:
            Builder(scenario, resources, DESCRIBED, problems=problems).check()
    return scenario


def describe(document: Document) -> Builder:
    """Read, validate and build a document without running anything of an FMU or a user's class.

    What is built shows what there is, and cannot run. It has a graph where nothing is unknown.

    Raises
    ------
    ScenarioError
        With every problem of the file.
    """
    scenario, problems = read(document)
    with ExitStack() as resources:
        builder = Builder(scenario, resources, DESCRIBED, problems=problems)
        builder.check()
        if not builder.unknown:
            builder.experiment()
        return builder
