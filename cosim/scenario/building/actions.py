"""The actions of a scenario: checked against its components before the run, and made ready for it.

An input has one override or fault at a time. A later action takes the place of the earlier one;
two at one instant would contradict each other, and a release needs something to be released.

Where parameters are set the state stays, and what follows from them is computed anew, before the
run: a component of cosim's own is built and designed once more, with the new values, and takes over
the state. Its design is recorded, and a replay takes it from there. Those of an FMU are set in it.

A component is swapped for an FMU that goes on from its continuous states. Both are for model
exchange, where these have names, by which they are handed over. What else an FMU remembers, its
discrete states, begins anew, with an event.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Final, cast

import numpy as np
from pydantic import ValidationError

from cosim.blocks.declared import Declared, with_units
from cosim.core.clock import whole_steps
from cosim.core.conditions import Condition
from cosim.core.contracts import Component, Design, Stopped
from cosim.core.port import Port
from cosim.core.recording import Recording, SignalEvent
from cosim.core.signals import FaultKind, Interface
from cosim.core.stages.overrides import checked_values
from cosim.core.stepping.actions import (
    NO_VARIANTS,
    ActedOn,
    Action,
    ConditionalAction,
    Injection,
    Override,
    Release,
    Setting,
    Swap,
    TimedAction,
)
from cosim.core.stepping.fault_injection import faults_of
from cosim.core.stepping.jumps import ParameterValues
from cosim.core.structure.ports import ConnectionEnd, Ports, layout_of
from cosim.errors import (
    ClockError,
    CosimError,
    GraphError,
    LogError,
    RunError,
    UsageError,
    listing,
    nearest,
    quoted,
)
from cosim.log.metadata import decode_design
from cosim.native.numerics.expression import compile_condition
from cosim.scenario.document.places import Key, Problem
from cosim.scenario.document.problems import TableProblems, problems_in, problems_of
from cosim.scenario.document.schema import ActionTable
from cosim.scenario.document.swaps import component_table
from cosim.scenario.kinds import KINDS, Kind
from cosim.scenario.kinds.base import AnyKind, BuildContext, PeriodicKind, Scenario
from cosim.scenario.kinds.plants import FmuKind

if TYPE_CHECKING:
    from cosim.fmi.component import Fmu
    from cosim.fmi.driving.model_exchange import ModelExchange

SETTINGS: Final = "cosim.settings"  # record of the log: designs by time and component
RANDOM: Final = ("noise", "drop")  # effects that have a seed


class ActionChecker:
    """Checks the actions of a scenario, all of them, and makes those that are right.

    Parameters
    ----------
    scenario : Scenario
    context : BuildContext
        In which the components of the run were built. Where it describes, parameters that are set
        and components that are swapped are not looked at.
    components : mapping of name to Component
        Those that are right.
    unknown : set of str
        Components that are not: actions on them are not checked.

    Attributes
    ----------
    timed : list of TimedAction
    reactions : list of ConditionalAction
    problems : list of Problem
    """

    def __init__(
        self,
        scenario: Scenario,
        context: BuildContext,
        components: Mapping[str, Component],
        unknown: Set[str],
    ) -> None:
        self._scenario = scenario
        self._context = context
        self._components = components
        self._unknown = unknown
        self._clock = context.clock
        self._ports = Ports(layout_of(components))
        self._changes: dict[int, tuple[int, int]] = {}  # last action and point, by column
        self._overridden: set[int] = set()  # columns
        self._undecided: set[int] = set()  # columns that change at conditions
        self._at_conditions: dict[int, list[Action]] = {}  # by number
        self.timed: list[TimedAction] = []
        self.problems: list[Problem] = []
        self._points = self._find_points()
        if not context.origins.describes:
            self._change_components()
        self._change_inputs()
        self.reactions: list[ConditionalAction] = []
        for number, own in sorted(self._at_conditions.items()):
            when = scenario.actions[number].when or ""
            self.reactions.append(ConditionalAction(when, tuple(own)))

    @contextmanager
    def _at(self, number: int, *place: str) -> Iterator[None]:
        """Add what is raised inside as problems of an action.

        Those of a table have their keys in the action, others stand at the place, which says what
        the prefix of a message does.
        """
        key: Key = ("actions", number)
        try:
            yield
        except TableProblems as error:
            self.problems += problems_in(error, key)
        except (CosimError, ValueError) as error:
            self.problems.append(((*key, *place), str(error).removeprefix(f"{place[-1]}: ")))

    def _find_points(self) -> dict[int, int]:
        """Return the communication points of actions by their numbers.

        At a condition: a negative number, the same one for equal conditions.
        """
        points = {}
        conditions: dict[str, int] = {}
        for number, action in self._scenario.actions.items():
            if action.at is not None:
                with self._at(number, "at"):
                    points[number] = self._point(action.at)
            if action.when is not None:
                with self._at(number, "when"):
                    check_condition(action.when, self._components, self._unknown, self._context)
                    points[number] = conditions.setdefault(action.when, -1 - number)
        return points

    def _point(self, at: float) -> int:
        """Return the communication point of an instant [s].

        Raises
        ------
        ClockError
            If it is none, or none of the run before its end.
        """
        clock = self._clock
        index = clock.steps_until(at, "at")
        expected = ""
        if index < 0:
            expected = f">= {clock.start_time} s (start of the run)"
        elif index >= clock.steps:
            expected = f"< {clock.stop} s (end of the run; the last step begins before)"
        if expected:
            raise ClockError(f"expected a time {expected}, got {at} s")
        return index

    def _take(self, number: int, action: Action) -> None:
        """Take an action that is right."""
        index = self._points[number]
        if index < 0:
            self._at_conditions.setdefault(number, []).append(action)
        else:
            self.timed.append(TimedAction(index, action))

    # --- components ---

    def _change_components(self) -> None:
        """Make what sets parameters of components, or swaps them, in the order of time."""
        changes = list(self._changes_of_components())
        builder = SettingBuilder(self._scenario, self._context, self._components)
        # at one instant parameters are set first
        for change in sorted(changes, key=lambda one: (one.values is None, one.index)):
            name = change.name
            if name in self._unknown:
                continue
            place = ("swap", name) if change.values is None else _place_of(name, change.values)
            with self._at(change.number, *place):
                if name not in self._components:
                    known = nearest(name, self._components)
                    raise GraphError(f"there is no component {name!r}; {known}")
                self._check_alone(change, changes, is_fmu=builder.is_fmu(name))
                if change.values is None:
                    self._take(change.number, self._swap(change))
                else:
                    self._take(change.number, builder.action(name, change.values))

    def _changes_of_components(self) -> Iterator[_Change]:
        """Yield what the actions do to components, in the order of the file."""
        for number, index in self._points.items():
            action = self._scenario.actions[number]
            values: dict[str, dict[str, Any]] = {}
            for text, value in (action.set or {}).items():
                name, _, parameter = text.partition(".")
                values.setdefault(name, {})[parameter] = value
            for name in (*values, *(action.swap or {})):
                yield _Change(index, number, name, values.get(name))

    def _check_alone(self, change: _Change, others: Sequence[_Change], *, is_fmu: bool) -> None:
        """Check that no action before it in the file changes the same component.

        Parameters are set at several fixed times; those of an FMU, which are set in it, whenever.

        Raises
        ------
        GraphError
            If one does.
        """
        for other in others:
            if other.name != change.name or other.number >= change.number:
                continue
            if change.values is None or other.values is None:
                found = "; expected one action"
            elif other.index == change.index:
                found = " at the same instant; set all in one action, or choose another time"
            elif min(other.index, change.index) < 0 and not is_fmu:
                found = (
                    ", in an order that depends on a condition; set it in one action, or at fixed "
                    "times"
                )
            else:
                continue
            raise GraphError(f"{change.name!r} is also changed by actions[{other.number}]{found}")

    def _swap(self, change: _Change) -> Swap:
        """Return what swaps a component.

        Raises
        ------
        UsageError
            If states cannot be handed over, or the FMU does not fit into its place.
        CosimError
            If the FMU cannot be opened.
        """
        name = change.name
        path = (self._scenario.actions[change.number].swap or {})[name]
        begin = f"the state of {name!r} cannot be transferred"
        source = self._context.model_exchange.get(name)
        if source is None or not source.state_names:
            raise UsageError(
                f"{begin}: it has no named continuous states; expected a plant, or a model "
                "exchange FMU (FMI 2 or 3)"
            )
        table = component_table(name, path)
        specs = {**self._scenario.specs, name: KINDS[table["kind"]].model_validate(table)}
        context = self._context.beside(replace(self._scenario, specs=specs), name)
        component = specs[name].build(name, context)
        target = context.model_exchange.get(name)
        if target is None:
            raise UsageError(
                f"{begin} to {path}, which has no named continuous states; expected a model "
                "exchange FMU"
            )
        if sorted(source.state_names) != sorted(target.state_names):
            raise UsageError(
                f"{begin} to {path}: expected the states {listing(source.state_names)}, got "
                f"{listing(target.state_names) or 'none'}"
            )
        place = self._components[name].interface
        _check_place(name, path, place, component.interface)
        self._context.fmus[f"{name} ({path})"] = context.fmus[name]
        return Swap(name, Declared(component, place), path, StateTransfer(source, target))

    # --- inputs ---

    def _change_inputs(self) -> None:
        """Make what happens to inputs, in the order of time.

        Those at conditions first: what they may have done decides what others may release.
        """
        for number in sorted(self._points, key=lambda number: (self._points[number], number)):
            table = self._scenario.actions[number]
            for text in table.signals:
                with self._at(number, "signal"):
                    self._change_input(number, table, text)

    def _change_input(self, number: int, table: ActionTable, text: str) -> None:
        """Make what an action does to one signal.

        Raises
        ------
        GraphError
            If there is no such input, another action has changed it at the same instant, or there
            is nothing to release.
        TableProblems
            If the values of the table do not fit the input.
        """
        port = Port.parse(text)
        if port.component in self._unknown:
            return
        end = self._input(port)
        index = self._points[number]
        action = self._action_on(end, table, text)
        columns = range(end.columns.start, end.columns.stop)
        for column in columns:
            other, point = self._changes.get(column, (number, None))
            if point == index and other == number:
                raise GraphError(f"'{end.port}' is listed twice")
            if point == index:
                raise GraphError(
                    f"'{end.port}' is also changed by actions[{other}] at the same instant; "
                    "remove one of the two, or choose another time"
                )
        if index < 0:
            self._undecided.update(columns)
        is_undecided = not self._undecided.isdisjoint(columns)
        self._changes |= dict.fromkeys(columns, (number, index))
        if not isinstance(action, Release):
            self._overridden.update(columns)
        elif is_undecided:
            action = Release(text, is_needed=False)
        elif not self._overridden.issuperset(columns):
            raise GraphError(
                f"'{end.port}' is not overridden as a whole at that time; override it in an "
                "earlier action, or remove the release"
            )
        if isinstance(action, Release):
            self._overridden.difference_update(columns)
        self._take(number, action)

    def _input(self, port: Port) -> ConnectionEnd:
        """Return an input, or elements of it.

        Raises
        ------
        GraphError
            If there is none; of an output, with the inputs that it drives.
        """
        try:
            return self._ports.input(port)
        except GraphError as error:
            driven = []
            for to, connection in self._scenario.connections.items():
                if any(source.whole == port.whole for source in connection.sources):
                    driven.append(str(to))
            if not driven:
                raise
            raise GraphError(f"{error}; '{port.whole}' drives {listing(driven)}") from error

    def _action_on(self, end: ConnectionEnd, table: ActionTable, to: str) -> Action:
        """Return what happens to an input.

        Raises
        ------
        TableProblems
            If the values of the table do not fit the input.
        """
        effect = table.effects[0]
        if effect == "release":
            return Release(to)
        value: Any = getattr(table, effect)
        try:
            if effect == "drop" and value is True:
                value = 1.0
            elif effect == "delay":
                value = float(self._late_steps(value))
            values = list(value) if isinstance(value, tuple) else [value] * end.size
            if effect == "override":
                return Override(to, tuple(checked_values(to, values, end)))
            if len(values) != end.size:
                raise GraphError(
                    f"expected {end.size} values (one per element) or a single one, got "
                    f"{len(values)}"
                )
            seed = [float(table.seed or 0)] if effect in RANDOM else []
            parameters: list[float] = []
            for element in [] if effect == "freeze" else values:
                parameters += [element, *seed]
            kind = cast(FaultKind, effect)
            faults_of(end, kind, parameters)
        except CosimError as error:
            problem = str(error).removeprefix(f"{effect}: ")
            raise TableProblems([((effect,), problem)]) from error
        return Injection(to, kind, tuple(parameters))

    def _late_steps(self, delay: float) -> int:
        """Return a delay [s] in communication steps.

        Raises
        ------
        CosimError
            If it is no whole number of them, from 1 on.
        """
        if delay < self._clock.h:
            raise UsageError(
                f"expected at least one communication step ({self._clock.step} s), got {delay} s"
            )
        return whole_steps(delay, self._clock.step_ns, "delay")


# --- components that are changed ---


@dataclass(frozen=True, slots=True)
class _Change:
    """What an action does to a component.

    Parameters
    ----------
    index : int
        Its communication point; negative: at a condition.
    number : int
        Of the action.
    name : str
        Of the component.
    values : dict of parameter to value, or None
        None: it is swapped.
    """

    index: int
    number: int
    name: str
    values: dict[str, Any] | None


def _place_of(name: str, values: Mapping[str, Any], key: Key = ()) -> tuple[str, str]:
    """Return where an action sets what a key of a component's table is of, or else the first."""
    parameter = next((part for part in map(str, key) if part in values), next(iter(values)))
    return "set", f"{name}.{parameter}" if parameter else name


@dataclass(frozen=True, slots=True)
class FmuSetting:
    """Tunable parameters of an FMU are set.

    Parameters
    ----------
    name : str
        Of its component.
    fmu : Fmu
    settings : mapping of parameter to values
    """

    name: str
    fmu: Fmu
    settings: ParameterValues
    variants: ClassVar[Mapping[str, Component]] = NO_VARIANTS
    transfers: ClassVar[bool] = False

    def perform(self, simulation: ActedOn) -> None:
        """Set them; the outputs follow."""
        try:
            self.fmu.tune(simulation.t, self.settings)
        except RunError as error:
            raise Stopped(np.empty((0, 0)), str(error)).at(self.name, simulation.t) from error
        simulation.change(self.name, self.settings)


class SettingBuilder:
    """Makes actions of the parameters that are set, in the order of time.

    Parameters
    ----------
    scenario : Scenario
    context : BuildContext
        In which the components of the run were built.
    components : mapping of name to Component
        Those of them that are right.
    """

    def __init__(
        self,
        scenario: Scenario,
        context: BuildContext,
        components: Mapping[str, Component],
    ) -> None:
        self._components = components
        self._scenario = scenario
        self._context = context
        self._specs = dict(scenario.specs)  # as they are at the time reached

    def is_fmu(self, name: str) -> bool:
        """Return whether the parameters of a component are those of an FMU, set in place."""
        return isinstance(self._specs[name], FmuKind)

    def action(self, name: str, values: Mapping[str, Any]) -> Action:
        """Return what sets parameters of a component.

        Raises
        ------
        TableProblems
            If one cannot be set, with those that can, a value does not fit, or the component cannot
            be built with them; their keys are those of an action.
        """
        try:
            return self._action(name, values)
        except (CosimError, ValueError) as error:
            found = problems_in(error, ())
            problems = [(_place_of(name, values, key), text) for key, text in found]
            raise TableProblems(problems) from error

    def _action(self, name: str, values: Mapping[str, Any]) -> Action:
        spec = self._specs[name]
        if isinstance(spec, FmuKind):
            from cosim.fmi.driving.tuning import check_tuning, tunable_parameters  # rarely needed

            fmu = self._context.opened(name)
            self._check_names(name, values, tunable_parameters(fmu.description))
            starts = _changed(spec, {"start": dict(values)}).start
            return FmuSetting(name, fmu, check_tuning(fmu.description, starts))
        self._check_names(name, values, spec.tunable_parameters)
        self._check_readers(name)
        changed = _changed(spec, values)
        for key, value in values.items():
            is_flag = isinstance(getattr(spec, key), bool)
            is_like_it = is_flag is isinstance(getattr(changed, key), bool)
            if not is_like_it or key not in changed.tunable_parameters:
                expected = "true or false" if is_flag else "a number or a list of numbers"
                raise TableProblems([((key,), f"expected {expected}, got {quoted(value)}")])
        component = self._component(name, changed)
        if component.interface != self._components[name].interface:
            raise UsageError(
                f"the new values change the signals or the direct feedthrough of {name!r}; "
                "expected values of the same sizes that keep both"
            )
        self._specs[name] = changed
        numbers = {
            key: tuple(np.ravel(value).astype(float).tolist()) for key, value in values.items()
        }
        return Setting(name, component, numbers)

    def recorded(self, name: str, values: ParameterValues) -> Action:
        """Return what set parameters of a component in a recorded run."""
        plain: dict[str, Any] = {}
        for key, own in values.items():
            current = getattr(self._specs[name], key, None)
            if isinstance(current, bool):
                plain[key] = bool(own[0])
            else:
                is_row = isinstance(current, tuple) or len(own) != 1
                plain[key] = list(own) if is_row else own[0]
        return self.action(name, plain)

    def _check_names(self, name: str, values: Mapping[str, Any], known: Collection[str]) -> None:
        """Check that parameters are among those of a component that can be set.

        Raises
        ------
        TableProblems
            If one is not.
        """
        problems: list[Problem] = []
        for key in [key for key in values if key not in known]:
            text = f"{name!r} has no tunable parameter {key!r}; {nearest(key, known)}"
            if not key:
                text = f"expected a tunable parameter of {name!r}, got none; {nearest(key, known)}"
            elif key in self._specs[name].tunable:
                text = f"expected numbers for {key!r} in the table of {name!r}"
            problems.append(((key,), text))
        if problems:
            raise TableProblems(problems)

    def _check_readers(self, name: str) -> None:
        """Check that no other component is designed on what is set.

        Raises
        ------
        UsageError
            If one is.
        """
        readers = []
        for other, tables in self._context.reads.items():
            if f"components.{name}" in tables and other not in ("", name):
                readers.append(other)
        if readers:
            raise UsageError(
                f"{name!r} cannot change during the run: {listing(readers)} is derived from its "
                "table"
            )

    def _component(self, name: str, spec: Kind) -> Component:
        """Build a component with other parameters, in a context of its own."""
        scenario = replace(self._scenario, specs={**self._specs, name: spec})
        context = self._context.beside(scenario, name)
        component = spec.build(name, context)
        component = with_units(component, spec.units_of(component.interface))
        if not isinstance(spec, PeriodicKind):
            return component
        return spec.with_period(component, spec.period_steps(name, context.step_ns))


def _changed(spec: AnyKind, values: Mapping[str, Any]) -> AnyKind:
    """Return a table with other values.

    Raises
    ------
    TableProblems
        If one does not fit.
    """
    table = {**spec.model_dump(exclude_unset=True, by_alias=True), **values}
    try:
        return type(spec).model_validate(table)
    except ValidationError as error:
        raise TableProblems(problems_of(error, type(spec), table, ())) from error


def recorded_settings(
    builder: SettingBuilder, events: Sequence[SignalEvent], copied: Sequence[str]
) -> dict[tuple[int, str], Action]:
    """Return what sets the parameters in a replay, by time [ns] and component.

    Parameters
    ----------
    builder : SettingBuilder
    events : sequence of SignalEvent
        Of the recorded run, in the order of time.
    copied : sequence of str
        Components that are taken from the recording.

    Raises
    ------
    LogError
        If an event does not fit the scenario.
    """
    values: dict[tuple[int, str], dict[str, tuple[float, ...]]] = {}
    for event in events:
        if event.cause == "set":
            port = Port.parse(event.signal)
            if port.component not in copied:
                values.setdefault((event.time_ns, port.component), {})[port.name] = event.values
    actions = {}
    for (time_ns, name), own in values.items():
        try:
            actions[time_ns, name] = builder.recorded(name, own)
        except (UsageError, KeyError) as error:
            where = f"{name!r} at t = {time_ns / 1e9} s"
            raise LogError(f"the recorded event of {where} does not match: {error}") from error
    return actions


def recorded_designs(recording: Recording) -> dict[str, Design]:
    """Return the designs of a log of the components that took the places of others.

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    try:
        records = recording.metadata.get(SETTINGS, {})
        return {key: decode_design(text) for key, text in records.items()}
    except (ValueError, KeyError, TypeError) as error:
        raise LogError(f"{SETTINGS} of {recording.label} is damaged: {error}") from error


@dataclass(frozen=True, slots=True)
class StateTransfer:
    """Hands continuous states over by their names.

    Parameters
    ----------
    source, target : ModelExchange
    """

    source: ModelExchange
    target: ModelExchange

    def take(self) -> dict[str, float]:
        """Return the states of the source by name."""
        values = self.source.states().tolist()
        return dict(zip(self.source.state_names, values, strict=True))

    def give(self, state: Mapping[str, float]) -> None:
        """Set the states of the target."""
        x = np.array([state[name] for name in self.target.state_names])
        self.target.continue_from(x)


def _check_place(name: str, path: str, place: Interface, other: Interface) -> None:
    """Check that a component fits into the place of another one, as it is wired and ordered.

    Raises
    ------
    UsageError
        If it does not.
    """
    begin = f"{path} cannot replace {name!r}"
    for kind in ("inputs", "outputs"):
        needed = [(signal.name, signal.size, signal.type) for signal in getattr(place, kind)]
        found = [(signal.name, signal.size, signal.type) for signal in getattr(other, kind)]
        if needed != found:
            raise UsageError(
                f"{begin}: expected the {kind} {listing([name for name, *_ in needed])}, with the "
                "same sizes and types, in this order"
            )
    for output in place.outputs:
        more = set(other.feeds(output.name)) - set(place.feeds(output.name))
        if more:
            raise UsageError(
                f"{begin}: {output.name} has direct feedthrough from {listing(sorted(more))}, "
                "which the execution order does not allow for"
            )
    if place.rollback and not other.rollback:
        raise UsageError(
            f"{path} cannot save its state, but {name!r} can; expected an FMU with the capability "
            "canGetAndSetFMUstate"
        )


# --- conditions ---


def check_condition(
    text: str, components: Mapping[str, Component], unknown: Set[str], context: BuildContext
) -> None:
    """Check a condition, as far as its signals are known.

    Parameters
    ----------
    text : str
    components : mapping of component name to Component
    unknown : set of str
        Components whose signals are not known.
    context : BuildContext
        Whose communication step it is checked at.

    Raises
    ------
    UsageError
        If it is wrong.
    """
    signals = compile_condition(text).program.signals
    if unknown.isdisjoint(signal.partition(".")[0] for signal in signals):
        Condition(text, layout_of(dict(components)), context.step_ns)
