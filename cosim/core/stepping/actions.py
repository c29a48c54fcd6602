"""Actions: what happens to a graph at communication points that are known before the run.

An action is performed when its point is reached, before anything else is done there: the row has
the left limits, the next step starts behind the action.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, final

from cosim.core.signals import FaultKind
from cosim.core.stages.overrides import OverrideValue


class ActedOn(Protocol):
    """What actions do to a simulation; see :class:`cosim.core.Simulation`."""

    def __setitem__(self, to: str, value: OverrideValue) -> None: ...

    def inject(self, to: str, kind: FaultKind, parameters: Sequence[float] = ()) -> None:
        """Inject a fault into an input, or elements of it."""
        ...

    def release(self, to: str) -> None:
        """Release an input, or elements of it."""
        ...


class Action(Protocol):
    """What happens at a communication point."""

    def perform(self, simulation: ActedOn) -> None:
        """Do it to a simulation that has reached the point."""
        ...


@dataclass(frozen=True, slots=True)
class Override:
    """An input, or elements of it, get values of their own."""

    to: str
    values: tuple[float, ...]

    def perform(self, simulation: ActedOn) -> None:
        """Override it."""
        simulation[self.to] = self.values


@dataclass(frozen=True, slots=True)
class Injection:
    """A fault of an input, or elements of it; see :mod:`cosim.core.stages.faults`."""

    to: str
    kind: FaultKind
    parameters: tuple[float, ...]

    def perform(self, simulation: ActedOn) -> None:
        """Inject it."""
        simulation.inject(self.to, self.kind, self.parameters)


@dataclass(frozen=True, slots=True)
class Release:
    """The end of an override or a fault."""

    to: str

    def perform(self, simulation: ActedOn) -> None:
        """Release it."""
        simulation.release(self.to)


@dataclass(frozen=True, slots=True)
class TimedAction:
    """An action, and the number of its communication point."""

    index: int
    action: Action


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

    def at(self, index: int) -> Sequence[Action]:
        """Return the actions at a communication point."""
        return self._actions.get(index, ())
