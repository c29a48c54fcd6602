"""Actions: what happens to a graph at communication points that are known before the run.

An action is performed when its point is reached, before anything else is done there: the row has
the left limits, the next step starts behind the action.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Final, Protocol, final

from cosim.core.contracts import Component, Transfer
from cosim.core.recording import EventCause
from cosim.core.signals import FaultKind
from cosim.core.stages.overrides import OverrideValue
from cosim.core.stepping.jumps import ParameterValues

AT_CONDITION: Final = -1  # in place of a time [ns] that is not known before the run
NO_VARIANTS: Final[Mapping[str, Component]] = MappingProxyType({})


class ActedOn(Protocol):
    """What actions do to a simulation; see :class:`cosim.core.Simulation`."""

    @property
    def t(self) -> float:
        """The time that is reached [s]."""
        ...

    def __setitem__(self, to: str, value: OverrideValue) -> None: ...

    def inject(self, to: str, kind: FaultKind, parameters: Sequence[float] = ()) -> None:
        """Inject a fault into an input, or elements of it."""
        ...

    def release(self, to: str) -> None:
        """Release an input, or elements of it."""
        ...

    def release_overridden(self, to: str) -> None:
        """Release those elements of an input that are overridden."""
        ...

    def exchange(
        self,
        name: str,
        component: Component,
        settings: ParameterValues,
        *,
        cause: EventCause = "set",
        transfer: Transfer | None = None,
    ) -> None:
        """Put a component in the place of another one, with its state."""
        ...

    def change(self, name: str, settings: ParameterValues) -> None:
        """Evaluate the outputs of a component, whose parameters were set."""
        ...


class Action(Protocol):
    """What happens at a communication point."""

    def perform(self, simulation: ActedOn) -> None:
        """Do it to a simulation that has reached the point."""
        ...

    @property
    def variants(self) -> Mapping[str, Component]:
        """The components by name that it puts in the place of others."""
        ...

    @property
    def transfers(self) -> bool:
        """Whether it hands their states over by what knows both."""
        ...


@dataclass(frozen=True, slots=True)
class Override:
    """An input, or elements of it, get values of their own."""

    to: str
    values: tuple[float, ...]
    variants: ClassVar[Mapping[str, Component]] = NO_VARIANTS
    transfers: ClassVar[bool] = False

    def perform(self, simulation: ActedOn) -> None:
        """Override it."""
        simulation[self.to] = self.values


@dataclass(frozen=True, slots=True)
class Injection:
    """A fault of an input, or elements of it; see :mod:`cosim.core.stages.faults`."""

    to: str
    kind: FaultKind
    parameters: tuple[float, ...]
    variants: ClassVar[Mapping[str, Component]] = NO_VARIANTS
    transfers: ClassVar[bool] = False

    def perform(self, simulation: ActedOn) -> None:
        """Inject it."""
        simulation.inject(self.to, self.kind, self.parameters)


@dataclass(frozen=True, slots=True)
class Release:
    """The end of an override or a fault.

    Parameters
    ----------
    to : str
    is_needed : bool
        Whether it is overridden then, as a whole; else what is overridden of it is released.
    """

    to: str
    is_needed: bool = True
    variants: ClassVar[Mapping[str, Component]] = NO_VARIANTS
    transfers: ClassVar[bool] = False

    def perform(self, simulation: ActedOn) -> None:
        """Release it."""
        if self.is_needed:
            simulation.release(self.to)
        else:
            simulation.release_overridden(self.to)


@dataclass(frozen=True, slots=True)
class Setting:
    """Parameters of a component are set: another component takes its place, with its state.

    Parameters
    ----------
    name : str
    component : Component
        Designed with the new values, and prepared.
    settings : mapping of parameter to values
    """

    name: str
    component: Component
    settings: ParameterValues
    transfers: ClassVar[bool] = False

    @property
    def variants(self) -> Mapping[str, Component]:
        """The other component."""
        return {self.name: self.component}

    def perform(self, simulation: ActedOn) -> None:
        """Exchange the component."""
        simulation.exchange(self.name, self.component, self.settings)


@dataclass(frozen=True, slots=True)
class Swap:
    """Another component takes the place of one, with its state.

    Parameters
    ----------
    name : str
    component : Component
        As :meth:`Graph.prepare_variant` prepared it.
    source : str
        Where it comes from, for the record.
    transfer : Transfer
        Hands the state over.
    """

    name: str
    component: Component
    source: str
    transfer: Transfer
    transfers: ClassVar[bool] = True

    @property
    def variants(self) -> Mapping[str, Component]:
        """The other component."""
        return {self.name: self.component}

    def perform(self, simulation: ActedOn) -> None:
        """Exchange the component."""
        simulation.exchange(
            self.name, self.component, {self.source: ()}, cause="swap", transfer=self.transfer
        )


@dataclass(frozen=True, slots=True)
class TimedAction:
    """An action, and the number of its communication point."""

    index: int
    action: Action


@dataclass(frozen=True, slots=True)
class ConditionalAction:
    """Actions, and the condition that they are performed at: where it is met first.

    Parameters
    ----------
    when : str
        See :mod:`cosim.core.conditions`.
    actions : tuple of Action
    """

    when: str
    actions: tuple[Action, ...]


@final
class Reactions:
    """Actions at conditions, each performed once.

    Parameters
    ----------
    actions : sequence of ConditionalAction

    Attributes
    ----------
    performed : tuple of int
        The numbers of those that were performed, in their order.
    """

    def __init__(self, actions: Sequence[ConditionalAction]) -> None:
        self._actions = tuple(actions)
        self.performed: tuple[int, ...] = ()

    def __bool__(self) -> bool:
        return bool(self._actions)

    @property
    def texts(self) -> list[str]:
        """The conditions, each once."""
        return list(dict.fromkeys(action.when for action in self._actions))

    def due(self, came_true: Collection[str]) -> list[ConditionalAction]:
        """Return what is to be performed where some conditions are met; it counts as done."""
        due = []
        for number, action in enumerate(self._actions):
            if action.when in came_true and number not in self.performed:
                self.performed += (number,)
                due.append(action)
        return due

    def left(self) -> list[str]:
        """Return the conditions that never came true."""
        left = [a.when for i, a in enumerate(self._actions) if i not in self.performed]
        return list(dict.fromkeys(left))

    def variants(self) -> dict[str, Component]:
        """Return the components in the places of others, behind those that were performed."""
        variants: dict[str, Component] = {}
        for number in self.performed:
            for action in self._actions[number].actions:
                variants.update(action.variants)
        return variants


@final
class Agenda:
    """Actions in the order of time; of those of one point, in the order given.

    Parameters
    ----------
    actions : sequence of TimedAction
    """

    def __init__(self, actions: Sequence[TimedAction]) -> None:
        self._actions: dict[int, list[Action]] = {}
        for timed in sorted(actions, key=lambda timed: timed.index):
            self._actions.setdefault(timed.index, []).append(timed.action)
        self._points = list(self._actions)

    def __bool__(self) -> bool:
        return bool(self._points)

    def next_point(self, index: int, end: int) -> int:
        """Return the next point behind one at which something happens, or ``end`` before it."""
        place = bisect_right(self._points, index)
        return min([end, *self._points[place : place + 1]])

    def variants(self, index: int) -> dict[str, Component]:
        """Return the components in the places of others, behind the actions at a point."""
        variants: dict[str, Component] = {}
        for point in self._points[: bisect_right(self._points, index)]:
            for action in self._actions[point]:
                variants.update(action.variants)
        return variants

    def at(self, index: int) -> Sequence[Action]:
        """Return the actions at a communication point."""
        return self._actions.get(index, ())
