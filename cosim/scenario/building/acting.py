"""The actions of a scenario, checked against its components before the run.

An input has one override or fault at a time. A later action takes the place of the earlier one;
two at one instant would contradict each other, and a release needs something to be released.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from typing import Any, TypeAlias, cast

from cosim.core.clock import Clock, whole_steps
from cosim.core.connections import Connection
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import FaultKind
from cosim.core.stages.overrides import checked_values
from cosim.core.stepping.actions import (
    Action,
    ConditionalAction,
    Injection,
    Override,
    Release,
    TimedAction,
)
from cosim.core.stepping.fault_injection import faults_of
from cosim.core.structure.ports import ConnectionEnd, Ports, layout_of
from cosim.errors import ClockError, CosimError, GraphError, UsageError, listing, nearest
from cosim.scenario.building.settings import SettingBuilder
from cosim.scenario.building.stopping import condition_problem
from cosim.scenario.building.timed_swaps import SwapBuilder
from cosim.scenario.document.places import Key, Problem
from cosim.scenario.document.problems import TableProblems
from cosim.scenario.document.schema import ActionTable

Place: TypeAlias = tuple[int, Key]  # of a value: the number of the action, and its key there


class NotChecked(Exception):
    """What is wrong elsewhere keeps an action from being checked."""


def first(places: Mapping[str, Place]) -> Place:
    """Return the first of some places."""
    return next(iter(places.values()))


class ActionChecker:
    """Checks the actions of a scenario, all of them.

    Parameters
    ----------
    components : mapping of name to Component
        Those that are right.
    connections : mapping of Port to Connection
    invalid : set of str
        Components that are not right: actions on their signals are not checked.
    clock : Clock
    settings : SettingBuilder, optional
        Left out: parameters that are set are not looked at.
    swaps : SwapBuilder, optional
        Left out: nor are components that are swapped.

    Attributes
    ----------
    timed : list of TimedAction
    reactions : list of ConditionalAction
    problems : list of Problem
    """

    def __init__(
        self,
        components: Mapping[str, Component],
        connections: Mapping[Port, Connection],
        invalid: Set[str],
        *,
        clock: Clock,
        settings: SettingBuilder | None = None,
        swaps: SwapBuilder | None = None,
    ) -> None:
        self._settings = settings
        self._swaps = swaps
        self._components = components
        self._ports = Ports(layout_of(components))
        self._connections = connections
        self._invalid = invalid
        self._clock = clock
        self._overridden = _Overridden()
        self._at_conditions: dict[int, list[Action]] = {}  # by number
        self.timed: list[TimedAction] = []
        self.reactions: list[ConditionalAction] = []
        self.problems: list[Problem] = []

    def check(self, actions: Mapping[int, ActionTable]) -> None:
        """Check actions by their numbers; those of one instant in the order of the file."""
        instants = self._instants(actions)
        if self._settings is not None:
            self._check_settings(actions, instants, self._settings)
        if self._swaps is not None:
            self._check_swaps(actions, instants, self._swaps)
        # Those at conditions first: what they may have done decides what others may release.
        for number in sorted(instants, key=lambda number: (instants[number], number)):
            table = actions[number]
            for text in table.signals:
                try:
                    self._check(number, instants[number], table, text)
                except TableProblems as error:
                    self._add(number, error.problems)
                except CosimError as error:
                    self._add(number, [(("signal",), str(error))])
        for number, own in sorted(self._at_conditions.items()):
            self.reactions.append(ConditionalAction(actions[number].when or "", tuple(own)))

    def _instants(self, actions: Mapping[int, ActionTable]) -> dict[int, int]:
        """Return the communication points of actions by their numbers.

        At a condition: a negative number, the same one for equal conditions.
        """
        instants = {}
        conditions: dict[str, int] = {}
        for number, action in actions.items():
            if action.at is None:
                assert action.when is not None, "validated before"
                step_ns = self._clock.step_ns
                text = condition_problem(action.when, self._components, self._invalid, step_ns)
                if text is not None:
                    self._add(number, [(("when",), text)])
                else:
                    instants[number] = conditions.setdefault(action.when, -1 - number)
                continue
            try:
                instants[number] = _point(action.at, self._clock)
            except ClockError as error:
                self._add(number, [(("at",), str(error).removeprefix("at: "))])
        return instants

    def _take(self, number: int, index: int, action: Action) -> None:
        """Take an action that is right."""
        if index < 0:
            self._at_conditions.setdefault(number, []).append(action)
        else:
            self.timed.append(TimedAction(index, action))

    def _check_settings(
        self,
        actions: Mapping[int, ActionTable],
        instants: Mapping[int, int],
        builder: SettingBuilder,
    ) -> None:
        """Check the parameters that are set: those of a component at one instant together."""
        together = _Together()
        for number, index in instants.items():
            for text, value in (actions[number].set or {}).items():
                other = together.add(number, index, text, value)
                if other is not None:
                    problem = (
                        f"is also set by actions[{other}] at the same instant; "
                        "remove one of the two"
                    )
                    self._add(number, [(("set", text), problem)])
        for index, name, values, places in together.in_order():
            number, place = first(places)
            try:
                self._check_component(name)
                other = together.another(index, name)
                if other is not None and other < number and not builder.is_fmu(name):
                    raise GraphError(
                        f"{name!r} is also set by actions[{other}], in an order that depends on a "
                        "condition; set it in one action, or at fixed times"
                    )
                self._take(number, index, builder.action(name, values))
            except TableProblems as error:
                for key, text in error.problems:
                    own_number, own_place = places.get(str(key[0]) if key else "", first(places))
                    self._add(own_number, [(own_place, text)])
            except NotChecked:
                pass
            except (CosimError, ValueError) as error:
                self._add(number, [(place, str(error))])

    def _check_swaps(
        self,
        actions: Mapping[int, ActionTable],
        instants: Mapping[int, int],
        builder: SwapBuilder,
    ) -> None:
        """Check the components that are swapped: each once, and not set beside it."""
        changed: dict[str, int] = {}
        for number in instants:
            for text in actions[number].set or {}:
                changed.setdefault(text.partition(".")[0], number)
        for number, index in instants.items():
            for name, path in (actions[number].swap or {}).items():
                try:
                    self._check_component(name)
                    if name in changed:
                        raise GraphError(
                            f"{name!r} is also changed by actions[{changed[name]}]; expected one "
                            "action"
                        )
                    changed[name] = number
                    self._take(number, index, builder.action(name, path))
                except NotChecked:
                    pass
                except (CosimError, ValueError) as error:
                    self._add(number, [(("swap", name), str(error))])

    def _check_component(self, name: str) -> None:
        """Check that there is a component, and that it is right.

        Raises
        ------
        GraphError
            If there is none.
        NotChecked
            If it is not right.
        """
        if name in self._invalid:
            raise NotChecked
        if name not in self._ports.channels:
            raise GraphError(
                f"there is no component {name!r}; {nearest(name, self._ports.channels)}"
            )

    def _add(self, number: int, problems: tuple[Problem, ...] | list[Problem]) -> None:
        for key, text in problems:
            self.problems.append((("actions", number, *key), text))

    def _check(self, number: int, index: int, table: ActionTable, text: str) -> None:
        """Check an action on one signal."""
        port = Port.parse(text)
        if port.component in self._invalid:
            return
        end = self._input(port)
        action = _action_of(table, text, end, self._clock)
        is_release = isinstance(action, Release)
        may_be = self._overridden.take(number, index, end, is_release=is_release)
        self._take(number, index, Release(text, is_needed=False) if may_be else action)

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
            for to, connection in self._connections.items():
                if any(source.whole == port.whole for source in connection.sources):
                    driven.append(str(to))
            if not driven:
                raise
            raise GraphError(f"{error}; '{port.whole}' drives {listing(driven)}") from error


class _Overridden:
    """Which elements of inputs are overridden, by which action and since when."""

    def __init__(self) -> None:
        self._changed: dict[int, tuple[int, int]] = {}  # action and instant, by column
        self._active: set[int] = set()
        self._unknown: set[int] = set()  # that change at conditions

    def take(self, number: int, index: int, end: ConnectionEnd, *, is_release: bool) -> bool:
        """Take the next action in the order of time, those at conditions first.

        Returns
        -------
        bool
            Whether it releases what may be overridden then, or not.

        Raises
        ------
        GraphError
            If another one has changed the same signal at the same instant, or there is nothing to
            release.
        """
        columns = range(end.columns.start, end.columns.stop)
        for column in columns:
            other = self._changed.get(column)
            if other == (number, index):
                raise GraphError(f"'{end.port}' is listed twice")
            if other is not None and other[1] == index:
                raise GraphError(
                    f"'{end.port}' is also changed by actions[{other[0]}] at the same instant; "
                    "remove one of the two, or choose another time"
                )
        if index < 0:
            self._unknown.update(columns)
        is_unknown = not self._unknown.isdisjoint(columns)
        if is_release and not (is_unknown or self._active.issuperset(columns)):
            raise GraphError(
                f"'{end.port}' is not overridden as a whole at that time; override it in an "
                "earlier action, or remove the release"
            )
        for column in columns:
            self._changed[column] = (number, index)
        if is_release:
            self._active.difference_update(columns)
        else:
            self._active.update(columns)
        return is_release and is_unknown


class _Together:
    """The parameters of components that are set at the same instants."""

    def __init__(self) -> None:
        self._set: dict[tuple[int, str], dict[str, tuple[int, Any]]] = {}

    def add(self, number: int, index: int, text: str, value: Any) -> int | None:
        """Add what an action sets; return the one that sets it at the same instant, if any."""
        name, _, parameter = text.partition(".")
        own = self._set.setdefault((index, name), {})
        other, _ = own.setdefault(parameter, (number, value))
        return None if other == number else other

    def another(self, index: int, name: str) -> int | None:
        """Return another action that sets a component, if either of them is at a condition."""
        for (other_index, other_name), own in self._set.items():
            is_other = other_name == name and other_index != index
            if is_other and min(index, other_index) < 0:
                number, _ = next(iter(own.values()))
                return number
        return None

    def in_order(self) -> Iterator[tuple[int, str, dict[str, Any], dict[str, Place]]]:
        """Yield instant, component, values and places of its parameters, in the order of time."""
        for (index, name), own in sorted(self._set.items(), key=lambda item: item[0][0]):
            values = {parameter: value for parameter, (_, value) in own.items()}
            places: dict[str, Place] = {}
            for parameter, (number, _) in own.items():
                text = f"{name}.{parameter}" if parameter else name
                places[parameter] = (number, ("set", text))
            yield index, name, values, places


def _point(at: float, clock: Clock) -> int:
    """Return the communication point of an instant [s].

    Raises
    ------
    ClockError
        If it is none, or none of the run before its end.
    """
    index = clock.steps_until(at, "at")
    if index < 0:
        raise ClockError(
            f"at: expected a time >= {clock.start_time} s (start of the run), got {at} s"
        )
    if index >= clock.steps:
        raise ClockError(
            f"at: expected a time < {clock.stop} s (end of the run), got {at} s; the last step "
            "begins before the end"
        )
    return index


def _action_of(table: ActionTable, to: str, end: ConnectionEnd, clock: Clock) -> Action:
    """Return what happens to an input.

    Raises
    ------
    TableProblems
        If the values of the table do not fit the input.
    """
    effect = table.effects[0]
    if effect == "release":
        return Release(to)
    try:
        if effect == "override":
            values = checked_values(to, _broadcast(table.override, end.size), end)
            return Override(to, tuple(values))
        parameters = _parameters(table, effect, end.size, clock)
        kind = cast(FaultKind, effect)
        faults_of(end, kind, parameters)
    except CosimError as error:
        text = str(error).removeprefix(f"{effect}: ")
        raise TableProblems([((effect,), text)]) from error
    return Injection(to, kind, parameters)


def _broadcast(value: Any, size: int) -> list[float]:
    """Return a value for each element, where there is one for all of them."""
    return list(value) if isinstance(value, tuple) else [value] * size


def _parameters(table: ActionTable, effect: str, size: int, clock: Clock) -> tuple[float, ...]:
    """Return the parameters of a fault, one element's behind the other's.

    Raises
    ------
    CosimError
        If there are not as many as elements, or a delay is no whole number of steps from 1 on.
    """
    value: Any = getattr(table, effect)
    seed = float(table.seed or 0)
    match effect:
        case "freeze":
            return ()
        case "drop":
            probability = 1.0 if value is True else float(value)
            return (probability, seed) * size
        case "delay":
            return (float(_late_steps(value, clock)),) * size
    values = _broadcast(value, size)
    if len(values) != size:
        raise GraphError(
            f"expected {size} values (one per element) or a single one, got {len(values)}"
        )
    if effect == "noise":
        parameters: list[float] = []
        for deviation in values:
            parameters += [deviation, seed]
        return tuple(parameters)
    return tuple(values)


def _late_steps(delay: float, clock: Clock) -> int:
    """Return a delay [s] in communication steps.

    Raises
    ------
    CosimError
        If it is no whole number of them, from 1 on.
    """
    if delay < clock.h:
        raise UsageError(
            f"delay: expected at least one communication step ({clock.step} s), got {delay} s"
        )
    return whole_steps(delay, clock.step_ns, "delay")
