"""Locate the state events of model exchange, iterate any event, and list what happened.

A state event is where an event indicator changes its domain, z > 0 or z <= 0 (FMI 2.0.4 section
3.1, FMI 3.0 section 3.1.1). Times that differ by a few roundings are one time: ``close``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final, Literal, NamedTuple, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.errors import RunError
from cosim.fmi.binary.messages import Message
from cosim.native.fmi.model_exchange import (
    INPUT_EVENT,
    NOT_LISTED,
    STATE_EVENT,
    STEP_EVENT,
    TIME_EVENT,
)

EventKind: TypeAlias = Literal["state event", "time event", "step event", "input event"]
EventRecord: TypeAlias = tuple[float, int, int]  # time [s], bit of the kind, events not listed
EventRecords: TypeAlias = "list[EventRecord] | NDArray[np.void]"  # an array from compiled steps

ITERATIONS: Final = 100  # of the discrete states in one event
KEPT: Final = 100  # events of one communication step that are listed

KINDS: Final[Mapping[int, EventKind]] = {
    STATE_EVENT: "state event",
    STEP_EVENT: "step event",
    TIME_EVENT: "time event",
    INPUT_EVENT: "input event",
}
"""By the bit of ``model_exchange.h``, in the order in which events that are due together stand."""
BITS: Final[Mapping[EventKind, int]] = {kind: bit for bit, kind in KINDS.items()}


def close(t: float) -> float:
    """Return the distance [s] below which two times near ``t`` are one."""
    return 4.0 * math.ulp(t)


def crosses(before: Vector, after: Vector) -> bool:
    """Return whether an indicator has changed its domain."""
    return bool(((before > 0.0) != (after > 0.0)).any())


def locate(
    indicators: Callable[[float], Vector], a: float, za: Vector, b: float, zb: Vector
) -> float:
    """Return the time in (a, b] at which the domains of ``za`` are left for the first time.

    The ITP method (Oliveira and Takahashi, ACM Trans. Math. Softw. 47(1), 2020): secants, in no
    more steps than bisection plus one. Whichever indicator changes first bounds the search, so of
    several it finds the earliest, as far as the domains at both ends show it.

    Returned is the far end of a bracket ``close`` to its near end: there the FMU sees the domain
    changed. At the near end it would not, and would handle an event that it does not know of.

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
    ratio = max((b - a) / resolution, 1.0)
    mantissa, exponent = math.frexp(ratio)
    bisections = exponent if mantissa > 0.5 else exponent - 1  # the logarithm, rounded up
    # Largest bracket from which the bisections that are left still end within the resolution.
    largest = resolution * 2.0 ** (bisections + 1)
    scale = 0.2 / (b - a)
    while b - a > resolution:
        width = b - a
        middle = 0.5 * (a + b)
        # Interpolation: where the first indicator crosses zero.
        secant = _first_root(a, za, zb, width, default=middle)
        # Truncation: a little towards the middle, so that both ends of the bracket move.
        truncation = max(scale * width * width, 0.5 * resolution)
        toward = math.copysign(1.0, middle - secant)
        t = middle
        if truncation <= abs(middle - secant):
            t = secant + toward * truncation
        # Projection: as near to the middle as the bound on the number of steps demands.
        radius = max(0.5 * (largest - width), 0.0)
        if abs(t - middle) > radius:
            t = middle - toward * radius
        largest *= 0.5
        z = indicators(t)
        if crosses(za, z):
            b = t
            zb = z
        else:
            a = t
            za = z
    return b


def _first_root(a: float, za: Vector, zb: Vector, width: float, *, default: float) -> float:
    """Return where the first of the changing indicators is zero by linear interpolation."""
    changed = np.flatnonzero((za > 0.0) != (zb > 0.0)).tolist()
    roots = []
    for j in changed:
        fraction = _root(float(za[j]), float(zb[j]))
        roots.append(a + width * fraction)
    return min(roots, default=default)


def _root(za: float, zb: float) -> float:
    """Return where linear interpolation from ``za`` to ``zb`` is zero, 0 to 1."""
    if not math.isfinite(za - zb):
        return 0.5
    return min(max(za / (za - zb), 0.0), 1.0)


def endless_iteration(name: str, t: float) -> RunError:
    """Return the error of an event iteration at ``t`` [s] that does not converge."""
    return RunError(
        f"{name}: the event iteration at t = {t} s does not converge in {ITERATIONS} iterations"
    )


class EventListState(NamedTuple):
    """A copy of an ``EventList``."""

    records: tuple[EventRecords, ...]
    in_step: int
    latest: float


@final
class EventList:
    """The first ``KEPT`` events of each communication step, and how many more it had.

    What is listed depends on the steps alone, not on when it is fetched.

    Attributes
    ----------
    in_step : int
        Events since a communication step began.
    first, latest : float
        Times of the first and the last one [s]; infinity: there was no first one.
    """

    def __init__(self) -> None:
        self._records: list[EventRecords] = []
        self.in_step = 0
        self.first = math.inf
        self.latest = 0.0

    def begin_step(self) -> None:
        """Begin to count anew; report of the step before what was not listed."""
        omitted = self.in_step - KEPT
        if omitted > 0:
            self._records.append([(self.latest, NOT_LISTED, omitted)])
        self.in_step = 0
        self.first = math.inf

    def add(self, kind: EventKind, t: float) -> None:
        """Add an event at ``t`` [s]."""
        if not self.in_step:
            self.first = t
        self.in_step += 1
        self.latest = t
        if self.in_step <= KEPT:
            self._records.append([(t, BITS[kind], 0)])

    def extend(
        self, records: NDArray[np.void], in_step: int, *, first: float, latest: float
    ) -> None:
        """Add what compiled steps listed; the attributes are as they are behind it."""
        if len(records):
            self._records.append(records)
        self.in_step = in_step
        self.first = first
        self.latest = latest

    def drain(self) -> list[Message]:
        """Return the events since the last call, at the end of a step."""
        self.begin_step()
        messages: list[Message] = []
        for records in self._records:
            messages += map(_message, records if isinstance(records, list) else records.tolist())
        self._records = []
        return messages

    def save(self) -> EventListState:
        """Copy the list."""
        return EventListState(tuple(self._records), self.in_step, self.latest)

    def restore(self, state: EventListState) -> None:
        """Go back to a saved list."""
        self._records = list(state.records)
        self.in_step = state.in_step
        self.latest = state.latest


def _message(record: EventRecord) -> Message:
    t, kind, omitted = record
    events = "event of this step is" if omitted == 1 else "events of this step are"
    text = f"{omitted} more {events} not listed"
    if kind != NOT_LISTED:
        text = f"{KINDS[kind]} at t = {t!r} s"
    return Message(t, "debug", "event", text)
