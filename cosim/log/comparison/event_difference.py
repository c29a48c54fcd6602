"""The jumps of two recorded runs compared, element by element."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from struct import pack
from typing import NamedTuple, TypeAlias

from cosim.core.port import Port
from cosim.core.recorded.partial import partial_of
from cosim.core.recorded.signals import find_signal
from cosim.core.recording import EventCause, Recording, SignalEvent
from cosim.errors import LogError

SignalColumnsByName: TypeAlias = Mapping[str, slice]  # of signals, in the rows of their components


OF_COMPONENTS = ("set", "swap")  # causes of events that name no signal


class ElementEvent(NamedTuple):
    """Why an element jumped, and where to."""

    cause: EventCause
    value: float


class _Place(NamedTuple):
    """An instant, and an element of a signal that is compared."""

    time_ns: int
    signal: str
    element: int
    is_left: bool  # the left limit of what jumps by itself; else where something else led to


@dataclass(frozen=True, slots=True)
class ElementEventDifference:
    """An element that jumps otherwise in one run than in the other.

    Parameters
    ----------
    signal : str
        ``component.signal``, with the element's index.
    time_ns : int
    a, b : ElementEvent or None
        None: it does not jump there.
    """

    signal: str
    time_ns: int
    a: ElementEvent | None
    b: ElementEvent | None


@dataclass(frozen=True, slots=True)
class EventsDifference:
    """How the events of two runs compare.

    Parameters
    ----------
    events : tuple of int
        Numbers of events of the compared signals in a and in b.
    jumps : int
        Elements that jump, at the instants where they do, in one run or both.
    outside : int
        Those of them that jump in one run only, for another cause, or to a value outside the
        tolerance of their signals.
    equal : bool
        Whether all have the same causes and the same bits.
    first : ElementEventDifference or None
        The first of those outside.
    """

    events: tuple[int, int] = (0, 0)
    jumps: int = 0
    outside: int = 0
    equal: bool = True
    first: ElementEventDifference | None = None


def compare_events(
    runs: tuple[Recording, Recording],
    columns: tuple[SignalColumnsByName, SignalColumnsByName],
    tolerances: Mapping[str, float | None],
    span_ns: tuple[int, int] | None = None,
) -> EventsDifference:
    """Compare the events of two runs.

    Parameters
    ----------
    runs, columns
        Of a and of b.
    tolerances : mapping of signal to float or None
        The signals that are compared, which both runs have with one size; None: their bits are.
    span_ns : (int, int), optional
        The first and the last instant [ns] whose events are compared.

    Raises
    ------
    LogError
        If an event is of a signal that its run does not have, or not of its size.
    """
    events_a = _events(runs[0], span_ns)
    events_b = _events(runs[1], span_ns)
    count_a, jumps_a = _jumps(runs[0], events_a, columns[0], tolerances)
    count_b, jumps_b = _jumps(runs[1], events_b, columns[1], tolerances)
    places = sorted(dict.fromkeys([*jumps_a, *jumps_b]), key=lambda place: place.time_ns)
    outside = []
    is_equal = _settings(events_a) == _settings(events_b)
    for place in places:
        a = jumps_a.get(place)
        b = jumps_b.get(place)
        is_same = _agree(a, b, None)
        is_equal = is_equal and is_same
        tolerance = tolerances[place.signal]
        if not is_same and (tolerance is None or not _agree(a, b, tolerance)):
            outside.append(place)
    first = None
    if outside:
        place = outside[0]
        size = columns[0][place.signal].stop - columns[0][place.signal].start
        name = Port.parse(place.signal).element_names(size)[place.element]
        first = ElementEventDifference(name, place.time_ns, jumps_a.get(place), jumps_b.get(place))
    return EventsDifference((count_a, count_b), len(places), len(outside), is_equal, first)


def _events(run: Recording, span_ns: tuple[int, int] | None) -> list[SignalEvent]:
    """Return the events of a run, or those of a span of time."""
    events = run.events()
    if span_ns is None:
        return events
    first_ns, last_ns = span_ns
    return [event for event in events if first_ns <= event.time_ns <= last_ns]


def _settings(events: Sequence[SignalEvent]) -> list[SignalEvent]:
    """Return where parameters were set, or components swapped."""
    return [event for event in events if event.cause in OF_COMPONENTS]


def _jumps(
    run: Recording,
    events: Sequence[SignalEvent],
    columns: SignalColumnsByName,
    compared: Mapping[str, float | None],
) -> tuple[int, dict[_Place, ElementEvent]]:
    """Return the number of events of the compared signals, and where each element jumped to."""
    known: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for signal in compared:
        for element, column in enumerate(range(columns[signal].start, columns[signal].stop)):
            known.setdefault((Port.parse(signal).component, column), []).append((signal, element))
    count = 0
    jumps = {}
    for event in events:
        is_compared = False
        if event.cause in OF_COMPONENTS or _is_left_out(run, event):
            continue
        for column, value in _elements(run, event):
            for signal, element in known.get((Port.parse(event.signal).component, column), ()):
                place = _Place(event.time_ns, signal, element, event.cause == "jump")
                jumps[place] = ElementEvent(event.cause, value)
                is_compared = True
        count += is_compared
    return count, jumps


def _is_left_out(run: Recording, event: SignalEvent) -> bool:
    """Return whether an event is of a signal that a partial run did not record.

    Raises
    ------
    UnknownSignalError
        If the run does not have it.
    """
    partial = partial_of(run.channels)
    if partial is None:
        return False
    port = find_signal(partial.declared, event.signal, source="the run")
    channel = run.channels.get(port.channel.name)
    return channel is None or port.signal.name not in channel.by_name


def _elements(run: Recording, event: SignalEvent) -> list[tuple[int, float]]:
    """Return the columns of an event in the row of its component, and its values."""
    columns = find_signal(run.channels, event.signal, source="the run").columns
    size = columns.stop - columns.start
    if len(event.values) != size:
        raise LogError(
            f"event of {event.signal!r} at t = {event.time_ns / 1e9} s: expected {size} values, "
            f"got {len(event.values)}"
        )
    return list(zip(range(columns.start, columns.stop), event.values, strict=True))


def _agree(a: ElementEvent | None, b: ElementEvent | None, tolerance: float | None) -> bool:
    if a is None or b is None:
        return a is b
    if a.cause != b.cause:
        return False
    if pack("d", a.value) == pack("d", b.value):
        return True
    return tolerance is not None and math.isfinite(a.value) and abs(a.value - b.value) <= tolerance
