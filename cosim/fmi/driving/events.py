"""Events: where those of model exchange are, the iteration that settles them in every kind, and the list of what happened.

A state event is where an event indicator changes its domain, z > 0 or z <= 0 (FMI 2.0.4 section 3.1.1, FMI 3.0 section 3.1.1).
Times that differ by a few roundings are one time: ``close``.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Final, Literal, TypeAlias, final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import RunError
from cosim.fmi.binary.messages import Message
from cosim.fmi.instance import CoSimulationInstance, DiscreteStates, ModelExchangeInstance

EventKind: TypeAlias = Literal["state event", "time event", "step event", "input event"]

ITERATIONS: Final = 100  # of the discrete states in one event
EVENTS: Final = 1000  # in one communication step
KEPT: Final = 100  # events in the list until they are fetched


def close(t: float) -> float:
    """Give the distance [s] below which two times near ``t`` are one."""
    return 4.0 * math.ulp(t)


def crosses(before: Vector, after: Vector) -> bool:
    """Whether an indicator has changed its domain."""
    return bool(((before > 0.0) != (after > 0.0)).any())


def locate(
    indicators: Callable[[float], Vector], a: float, za: Vector, b: float, zb: Vector
) -> float:
    """Give the time in (a, b] at which the domains of ``za`` are left for the first time.

    The ITP method (Oliveira and Takahashi, ACM Trans. Math. Softw. 47(1), 2020): secants, in no more steps than bisection plus
    one. Whichever indicator changes first bounds the search, so of several it finds the earliest, as far as the domains at both
    ends tell. What is given is the far end of a bracket ``close`` to its near end: there the unit sees the domain changed.

    Parameters
    ----------
    indicators : callable
        Event indicators at a time in the step, shape (n_z,).
    a, b : float
        Begin and end of the step [s].
    za, zb : Vector, shape (n_z,)
        Indicators there; some domain differs.
    """
    resolution = close(max(abs(a), abs(b)))
    spare = resolution * 2.0 ** (math.ceil(math.log2(max((b - a) / resolution, 1.0))) + 1)
    scale = 0.2 / (b - a)
    while b - a > resolution:
        width, middle = b - a, 0.5 * (a + b)
        change = np.flatnonzero((za > 0.0) != (zb > 0.0))
        secant = min(
            (a + width * _root(float(za[j]), float(zb[j])) for j in change.tolist()), default=middle
        )
        truncation = max(scale * width * width, 0.5 * resolution)
        toward = math.copysign(1.0, middle - secant)
        t = secant + toward * truncation if truncation <= abs(middle - secant) else middle
        radius = max(0.5 * (spare - width), 0.0)
        if abs(t - middle) > radius:
            t = middle - toward * radius
        spare *= 0.5
        z = indicators(t)
        if crosses(za, z):
            b, zb = t, z
        else:
            a, za = t, z
    return b


def _root(za: float, zb: float) -> float:
    """Where a straight line from za to zb is zero, 0 to 1."""
    return min(max(za / (za - zb), 0.0), 1.0) if math.isfinite(za - zb) else 0.5


def settle(instance: ModelExchangeInstance | CoSimulationInstance, t: float) -> DiscreteStates:
    """Iterate the discrete states (FMI 2.0.4 section 3.2.2, FMI 3.0 sections 3.2.1 and 4.2.2); give what came of it all together.

    Raises
    ------
    RunError
        If they do not settle.
    """
    values, nominals = False, False
    for _ in range(ITERATIONS):
        found = instance.update_discrete_states()
        values, nominals = values or found.values_changed, nominals or found.nominals_changed
        if found.terminate or not found.need_update:
            return found._replace(values_changed=values, nominals_changed=nominals)
    raise RunError(
        f"{instance.description.name}: discrete states do not settle at t = {t} s after {ITERATIONS} iterations"
    )


@final
class EventList:
    """What happened since it was asked last: the latest ``KEPT`` events, and how many there were before."""

    def __init__(self) -> None:
        self._kept: deque[tuple[EventKind, float]] = deque(maxlen=KEPT)
        self._dropped = 0

    def add(self, kind: EventKind, t: float) -> None:
        """Note an event at ``t`` [s]."""
        self._dropped += len(self._kept) == KEPT
        self._kept.append((kind, t))

    def drain(self) -> list[Message]:
        """Give the events since the last call."""
        found = [Message(t, "debug", "event", f"{kind} at t = {t!r} s") for kind, t in self._kept]
        if self._dropped:
            found.insert(
                0,
                Message(
                    found[0].time,
                    "debug",
                    "event",
                    f"{self._dropped} earlier events are not listed",
                ),
            )
        self._kept.clear()
        self._dropped = 0
        return found

    def save(self) -> object:
        """Copy the list."""
        return tuple(self._kept), self._dropped

    def restore(self, state: object) -> None:
        """Go back to a saved list."""
        kept: tuple[tuple[EventKind, float], ...]
        kept, self._dropped = state  # type: ignore[misc]
        self._kept = deque(kept, maxlen=KEPT)
