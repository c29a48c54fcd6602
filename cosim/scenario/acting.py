"""The actions of a scenario, checked against its components before the run.

An input has one override or fault at a time. A later action takes the place of the earlier one;
two at one instant would contradict each other, and a release needs something to be released.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Any, TypeAlias, cast

from cosim.core.clock import Clock, whole_steps
from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.core.signals import FaultKind
from cosim.core.stages.overrides import checked_values
from cosim.core.stepping.actions import Action, Injection, Override, Release, TimedAction
from cosim.core.stepping.fault_injection import faults_of
from cosim.core.structure.ports import ConnectionEnd, Ports
from cosim.errors import ClockError, CosimError, GraphError, listing, nearest
from cosim.scenario.action_tables import effect_of, signals_of
from cosim.scenario.problems import Key, Problem, TableProblems
from cosim.scenario.schema import ActionTable
from cosim.scenario.settings import SettingBuilder

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
    ports : Ports
        Of the components that are right.
    connections : mapping of Port to Connection
    invalid : set of str
        Components that are not right: actions on their signals are not checked.
    clock : Clock or None
        None: its times are not right.
    settings : SettingBuilder or None
        None: parameters that are set are not looked at.

    Attributes
    ----------
    timed : list of TimedAction
    problems : list of Problem
    """

    def __init__(
        self,
        ports: Ports,
        connections: Mapping[Port, Connection],
        invalid: Set[str],
        clock: Clock | None,
        settings: SettingBuilder | None,
    ) -> None:
        self._settings = settings
        self._ports = ports
        self._connections = connections
        self._invalid = invalid
        self._clock = clock
        self._overridden = _Overridden()
        self.timed: list[TimedAction] = []
        self.problems: list[Problem] = []

    def check(self, actions: Mapping[int, ActionTable]) -> None:
        """Check actions by their numbers; those of one instant in the order of the file."""
        if self._clock is None:
            return
        instants = self._instants(actions, self._clock)
        if self._settings is not None:
            self._check_settings(actions, instants, self._settings)
        for number in sorted(instants, key=lambda number: (instants[number], number)):
            table = actions[number]
            for text in signals_of(table):
                try:
                    self._check(number, instants[number], table, text)
                except TableProblems as error:
                    self._add(number, error.problems)
                except CosimError as error:
                    self._add(number, [(("signal",), str(error))])

    def _check_settings(
        self,
        actions: Mapping[int, ActionTable],
        instants: Mapping[int, int],
        builder: SettingBuilder,
    ) -> None:
        """Check the parameters that are set: those of a component at one instant together."""
        together: dict[tuple[int, str], dict[str, tuple[int, Any]]] = {}
        for number in instants:
            for text, value in (actions[number].set or {}).items():
                name, _, parameter = text.partition(".")
                own = together.setdefault((instants[number], name), {})
                if parameter in own:
                    other = own[parameter][0]
                    problem = f"is set by actions.{other} at the same instant; needed one of them"
                    self._add(number, [(("set", text), problem)])
                own.setdefault(parameter, (number, value))
        for (index, name), parameters in sorted(together.items(), key=lambda item: item[0][0]):
            values = {parameter: value for parameter, (_, value) in parameters.items()}
            places = {
                parameter: (number, ("set", f"{name}.{parameter}"))
                for parameter, (number, _) in parameters.items()
            }
            try:
                self._check_component(name)
                self.timed.append(TimedAction(index, builder.action(name, values)))
            except TableProblems as error:
                for key, text in error.problems:
                    number, place = places.get(str(key[0]) if key else "", first(places))
                    self._add(number, [(place, text)])
            except NotChecked:
                pass
            except (CosimError, ValueError) as error:
                number, place = first(places)
                self._add(number, [(place, str(error))])

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

    def _instants(self, actions: Mapping[int, ActionTable], clock: Clock) -> dict[int, int]:
        """Return the communication points of actions by their numbers."""
        instants = {}
        for number, action in actions.items():
            assert action.at is not None, "validated before"
            try:
                instants[number] = _point(action.at, clock)
            except ClockError as error:
                self._add(number, [(("at",), str(error).removeprefix("at: "))])
        return instants

    def _check(self, number: int, index: int, table: ActionTable, text: str) -> None:
        """Check an action on one signal."""
        port = Port.parse(text)
        if port.component in self._invalid:
            return
        end = self._input(port)
        assert self._clock is not None, "checked before"
        action = _action_of(table, text, end, self._clock)
        self._overridden.take(number, index, end, is_release=isinstance(action, Release))
        self.timed.append(TimedAction(index, action))

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

    def take(self, number: int, index: int, end: ConnectionEnd, *, is_release: bool) -> None:
        """Take the next action in the order of time.

        Raises
        ------
        GraphError
            If another one has changed the same signal at the same instant, or there is nothing to
            release.
        """
        columns = range(end.columns.start, end.columns.stop)
        for column in columns:
            other = self._changed.get(column)
            if other is not None and other[1] == index:
                raise GraphError(
                    f"'{end.port}' is changed by actions.{other[0]} at the same instant; needed "
                    "one of them, or another time"
                )
        if is_release and not self._active.issuperset(columns):
            raise GraphError(
                f"'{end.port}' is not overridden then, as a whole; needed an earlier action that "
                "does, or no release"
            )
        for column in columns:
            self._changed[column] = (number, index)
        if is_release:
            self._active.difference_update(columns)
        else:
            self._active.update(columns)


def _point(at: float, clock: Clock) -> int:
    """Return the communication point of an instant [s].

    Raises
    ------
    ClockError
        If it is none, or none of the run before its end.
    """
    index = clock.steps_until(at, "at")
    if index < 0:
        raise ClockError(f"at: found {at} s, before the start of the run at {clock.start_time} s")
    if index >= clock.steps:
        raise ClockError(
            f"at: found {at} s, and the run ends at {clock.stop} s; needed an earlier time, as the "
            "last step begins before the end"
        )
    return index


def _action_of(table: ActionTable, to: str, end: ConnectionEnd, clock: Clock) -> Action:
    """Return what happens to an input.

    Raises
    ------
    TableProblems
        If the values of the table do not fit the input.
    """
    effect = effect_of(table)
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
        raise TableProblems([((effect,), str(error))]) from error
    return Injection(to, kind, parameters)


def _broadcast(value: Any, size: int) -> list[float]:
    """Return a value for each element, where there is one for all of them."""
    if isinstance(value, tuple):
        return list(map(float, value))
    return [float(value)] * size


def _parameters(table: ActionTable, effect: str, size: int, clock: Clock) -> tuple[float, ...]:
    """Return the parameters of a fault, one element's behind the other's.

    Raises
    ------
    CosimError
        If there are not as many as elements, or a delay is no whole number of steps.
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
            return (float(whole_steps(value, clock.step_ns, "delay")),) * size
    values = _broadcast(value, size)
    if len(values) != size:
        raise GraphError(f"found {len(values)} values; needed {size}, one an element, or one")
    if effect == "noise":
        parameters: list[float] = []
        for deviation in values:
            parameters += [deviation, seed]
        return tuple(parameters)
    return tuple(values)
