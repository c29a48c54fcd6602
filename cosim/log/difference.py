"""How two recorded runs differ: what a comparison of them returns.

The jumps of two recorded runs compared, element by element.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from struct import pack
from typing import Any, Final, Literal, NamedTuple, TypeAlias

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


DifferenceStatus: TypeAlias = Literal[
    "equal",
    "within",
    "outside",
    "other times",
    "other size",
    "only in a",
    "only in b",
    "not recorded in a",
    "not recorded in b",
]
# what a partial log does not have says nothing about its run
LEFT_OUT: Final = frozenset({"not recorded in a", "not recorded in b"})
NOT_COMPARED: Final = LEFT_OUT | {"other size", "only in a", "only in b"}


@dataclass(frozen=True, slots=True)
class ElementDifference:
    """One element of one signal at one instant of both runs."""

    signal: str  # component.signal, with the element's index
    time_ns: int
    a: float
    b: float

    @property
    def differing_bits(self) -> int:
        """How many of the 64 bits of the two values differ."""
        return (_bit_pattern(self.a) ^ _bit_pattern(self.b)).bit_count()

    @property
    def texts(self) -> tuple[str, str]:
        """Both values as texts that give their bits back: as Python writes them, NaN with these."""
        return _exact_text(self.a), _exact_text(self.b)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values; the bits are those of both values, hexadecimal."""
        bits = [f"0x{_bit_pattern(value):016x}" for value in (self.a, self.b)]
        return {**asdict(self), "bits": bits, "differing_bits": self.differing_bits}


def _bit_pattern(value: float) -> int:
    """Return the 64 bits of a number as an integer."""
    (pattern,) = struct.unpack("<Q", struct.pack("<d", value))
    return int(pattern)


def _exact_text(value: float) -> str:
    # all NaN look the same, and differ in up to 52 bits
    return f"nan (0x{_bit_pattern(value):016x})" if math.isnan(value) else repr(value)


@dataclass(frozen=True, slots=True)
class SignalDifference:
    """How one signal compares.

    Parameters
    ----------
    signal : str
        ``component.signal``.
    status : str
        ``equal``: the same bits at the same times; ``within`` or ``outside`` the tolerance;
        ``other times``: within it where both have values, but their instants differ;
        ``other size``, ``only in a``, ``only in b``: not compared; ``not recorded in a`` or
        ``b``: neither, as that log is partial, which is no difference.
    rows : tuple of int
        Numbers of rows in a and in b, and at times they share.
    largest : float
        Largest |a - b|; infinite where only one is NaN or infinite.
    scale : float
        Largest finite |a|.
    tolerance : float
        What |a - b| was compared with.
    first : ElementDifference or None
        The first time outside the tolerance.
    """

    signal: str
    status: DifferenceStatus
    rows: tuple[int, int, int]
    largest: float = 0.0
    scale: float = 0.0
    tolerance: float = 0.0
    first: ElementDifference | None = None

    @property
    def ratio(self) -> float:
        """``largest`` as a part of ``scale``."""
        if self.largest == 0.0:
            return 0.0
        return self.largest / self.scale if self.scale else float("inf")


@dataclass(frozen=True, slots=True)
class LogDifference:
    """How two runs compare, signal by signal.

    Parameters
    ----------
    rows : tuple of SignalDifference
        The signals of a in their order, then those that only b has.
    atol, rtol : float
        The tolerances of :func:`diff`.
    events : EventsDifference
        How the jumps compare.
    tol : mapping of name or pattern to float
        The signals' own tolerances.
    """

    rows: tuple[SignalDifference, ...]
    atol: float
    rtol: float
    events: EventsDifference
    tol: Mapping[str, float] = field(default_factory=dict)

    @property
    def equal(self) -> bool:
        """Whether all signals have the same bits at the same times, and the same events."""
        return self.same_rows and self.events.equal

    @property
    def same_rows(self) -> bool:
        """Whether all signals have the same bits at the same times."""
        return all(row.status == "equal" for row in self._compared)

    @property
    def _compared(self) -> list[SignalDifference]:
        return [row for row in self.rows if row.status not in LEFT_OUT]

    @property
    def within(self) -> bool:
        """Whether both runs have all signals and events at the same times, within the tolerance."""
        same_rows = all(row.status in {"equal", "within"} for row in self._compared)
        return same_rows and not self.events.outside

    @property
    def first(self) -> ElementDifference | None:
        """The earliest time outside the tolerance; of several signals, the first row's."""
        candidates = [row.first for row in self.rows if row.first]
        return min(candidates, key=lambda element: element.time_ns, default=None)

    @property
    def worst(self) -> SignalDifference | None:
        """The signal that is farthest apart, measured by its tolerance; None: none is apart.

        Of those without a tolerance it is the one that is farthest apart as a part of its scale.
        """
        apart = [row for row in self.rows if row.largest > 0.0]
        return max(apart, key=_badness, default=None)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        first = self.first
        signals = []
        for row in self.rows:
            own = None if row.first is None else row.first.to_dict()
            signals.append({**asdict(row), "first": own, "ratio": row.ratio})
        return {
            "equal": self.equal,
            "within": self.within,
            "atol": self.atol,
            "rtol": self.rtol,
            "tol": dict(self.tol),
            "first": None if first is None else first.to_dict(),
            "signals": signals,
            "events": asdict(self.events),
        }


def _badness(row: SignalDifference) -> tuple[bool, float, float]:
    """Return what orders signals by how far they are apart."""
    is_outside = row.status == "outside"
    excess = row.largest / row.tolerance if row.tolerance else math.inf
    return is_outside, excess, row.ratio
