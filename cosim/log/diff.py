"""Two recorded runs compared, signal by signal and event by event.

They are compared at the instants that they share, rows of one instant in their order. Of a partial
log what it has is compared: signals that it did not record are left out, and so are rows of the
other run at instants at which it has none.

Without tolerances the comparison at these is of bits: 0.0 and -0.0 differ. With them a pair of
values agrees where ``|a - b| <= atol + rtol * max|a|``, the maximum over all the signal's rows and
elements, or where both are NaN. Values of b are converted to the unit of a.

Runs of different instants are compared at those of a. Between two rows of b a signal that is
continuous in both is a straight line, and any other keeps its value; where b jumps, its later value
counts, but for the earlier one of a that jumps there, too. NaN of a signal that may have no value,
as its log says, is no row of it; nor is an empty cell of a table. In a tube a value of a is right
if b has it, within the tolerance, at some instant no farther away than the tube is wide, and so is
one of b.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from operator import itemgetter
from typing import Final, Literal, TypeAlias, cast

import numpy as np

from cosim.arguments import truth_argument
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.selection import is_pattern, matches, select_signals
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.recording import Recording, SignalEvent
from cosim.errors import (
    LogError,
    UnknownSignalError,
    UsageError,
    listing,
    names_by_reason,
    nearest,
    option,
)
from cosim.instants import NANOSECONDS
from cosim.log.difference import (
    LEFT_OUT,
    OF_COMPONENTS,
    DifferenceStatus,
    ElementEvent,
    ElementEventDifference,
    EventsDifference,
    LogDifference,
    SignalDifference,
    bit_pattern,
)
from cosim.log.pairs import Pair, blocks_of_port, compare
from cosim.units import Conversion, conversions_between

_WIDEST_TUBE: Final = 1e9  # s


def diff(
    a: Recording,
    b: Recording,
    *,
    atol: float = 0.0,
    rtol: float = 0.0,
    tol: Mapping[str, float] | None = None,
    signals: Sequence[str] = (),
    span_ns: tuple[int, int] | None = None,
    interpolate: bool = False,
    tube: float = 0.0,
    map: Mapping[str, str] | None = None,
) -> LogDifference:
    """Compare two runs signal by signal; of long logs only a part is in memory at a time.

    Parameters
    ----------
    a, b : Recording
        ``a`` is the reference: the scales are those of its signals, and so are the units.
    atol : float
        In the unit of each signal.
    rtol : float
        As a part of each signal's largest |a|.
    tol : mapping of signal or pattern to float, optional
        Absolute tolerances instead of both, for signals of a name or pattern (``*.delta``); of
        several that match the last. 0: the bits are compared.
    signals : sequence of str
        The signals to compare, elements of them, ``plant.x_a[0:2]``, or patterns; none: all.
    span_ns : (int, int), optional
        The first and the last instant [ns] that are compared.
    interpolate : bool
        Compare at every instant of a that lies within b: between its rows a continuous signal of b
        is a straight line, and any other keeps its value. What b does between two instants of a is
        not seen. Without it, runs are compared at the instants that they share.
    tube : float
        A value of a is right if b has it, within the tolerance, at some instant no farther away
        [s]; and one of b, between two instants of a, if a has it there or that near. Implies
        ``interpolate``. Events are not compared then, and the rows of a component are in memory.
    map : mapping of signal to signal, optional
        Signals of a, or elements of them, by the names that b has for them:
        ``{"table.level": "tank.y"}``.

    Returns
    -------
    LogDifference
        Its ``not_compared`` tells what was left out, such as what a file of another tool has that
        could not be read: then the runs are neither equal nor within the tolerance.

    Raises
    ------
    LogError
        If a or b is not a recording, or one of ``signals`` is in neither; names the nearest. If an
        event is of no signal.
    UsageError
        If a tolerance is not a number >= 0, or is of no signal that is compared.
    """
    tol = {} if tol is None else tol
    renamed = map or {}
    _check_arguments({"a": a, "b": b}, atol, rtol, tol, tube)
    between = truth_argument("interpolate", interpolate) or tube > 0.0
    wanted = [signals] if isinstance(signals, str) else signals
    found = _found(a, b, wanted, renamed)
    _check_used(tol, found)
    if not wanted:
        found |= _namesakes(b, renamed)
    pairs: dict[str, Pair] = {}
    groups: dict[tuple[str, str], list[Pair]] = {}
    rows: dict[str, SignalDifference] = {}
    for name, (one, other) in found.items():
        own = [value for pattern, value in tol.items() if matches(pattern, name)]
        pair = _pair(name, one, other, (own[-1], 0.0) if own else (atol, rtol))
        if isinstance(pair, Pair):
            pairs[name] = pair
            groups.setdefault((pair.a.channel.name, pair.b.channel.name), []).append(pair)
        else:
            rows[name] = SignalDifference(
                name, pair, (_count(a, one, span_ns), _count(b, other, span_ns), 0)
            )
    tube_ns = round(tube * NANOSECONDS) if between else None
    lacking = [run.label for run in (a, b) if run.left_out is not None]
    for group in groups.values():
        compare(a, b, group, span_ns, tube_ns)
    notes = _texts({name: pair.not_compared for name, pair in pairs.items()})
    if lacking and any(not pair.rows[2] for pair in pairs.values() if all(pair.rows[:2])):
        notes.append("a recording begins at t = 0 in a run, in the place of a component (swap)")
    unread = _unread(a, b, wanted)
    notes += _texts(unread)
    events = EventsDifference()
    if not between and not lacking:
        events = _compare_events(a, b, pairs, span_ns)
    elif any(run.events() for run in (a, b)):
        reason = f"{lacking[0]} has no place for them" if lacking else "not between rows"
        notes.append(f"events: {reason}")
    ordered = [pairs[name].result() if name in pairs else rows[name] for name in found]
    ordered += [
        SignalDifference(name, "not read", (0, 0, 0)) for name in unread if name not in found
    ]
    if ordered and all(row.status in LEFT_OUT for row in ordered):
        raise LogError(
            f"{a.label} and {b.label} have no recorded signal in common: one of them is partial"
        )
    width = tube if between else None
    compared = tuple(ordered), atol, rtol, events, tol, renamed, width
    return LogDifference(*compared, tuple(notes))


def _check_arguments(
    runs: Mapping[str, object], atol: object, rtol: object, tol: object, tube: object
) -> None:
    for name, run in runs.items():
        if getattr(type(run), "blocks", None) is None:
            raise LogError(
                f"{name}: expected a recording, got {type(run).__name__} {run!r}; open it with "
                "cosim.open_recording(path)"
            )
    if not isinstance(tol, Mapping):
        raise UsageError(
            f"{option('tol')}: expected a mapping such as {{'plant.y': 1e-6}}, got {tol!r}"
        )
    given = {option("atol"): atol, option("rtol"): rtol, option("tube"): tube}
    for name, value in {**given, **{option("tol", name): own for name, own in tol.items()}}.items():
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not is_number or not 0.0 <= value < math.inf:
            raise UsageError(f"{name}: expected a finite number >= 0, got {value!r}")
    if cast(float, tube) > _WIDEST_TUBE:
        raise UsageError(f"{option('tube')}: expected at most {_WIDEST_TUBE:g} s, got {tube!r}")


def _check_used(tol: Mapping[str, float], names: Iterable[str]) -> None:
    """Check that every tolerance is of a signal that is compared."""
    for pattern in tol:
        if not any(matches(pattern, name) for name in names):
            raise UsageError(
                f"{option('tol', pattern)}: no compared signal has this name; "
                f"{nearest(pattern, names)}"
            )


# --- which signals ---

# of a run; None: it has none of that name, False: it did not record it
_Port: TypeAlias = RecordedPort | Literal[False] | None


def _found(
    a: Recording, b: Recording, signals: Sequence[str], renamed: Mapping[str, str]
) -> dict[str, tuple[_Port, _Port]]:
    """Return the chosen signals, by their names in a: what they are in a, and in b.

    Raises
    ------
    LogError
        If a signal is in neither of them, or one that is asked for was not recorded.
    """
    of_a, of_b = (select_signals(run.channels, None, source=run.label) for run in (a, b))
    others = [name for name in of_b if name not in renamed.values()]
    names = dict.fromkeys([*of_a, *renamed, *others])
    chosen: dict[str, None] = {}
    for signal in signals:
        if not isinstance(signal, str):
            raise LogError(f"expected the name of a signal, such as 'plant.y', got {signal!r}")
        own = [signal]
        if is_pattern(signal) and signal not in names:
            own = [name for name in names if matches(signal, name)]
            if not own:
                raise UnknownSignalError(
                    f"no signal of either run matches {signal!r}; {nearest(signal, names)}"
                )
        chosen |= dict.fromkeys(own)
    found = {}
    for name in chosen or names:
        name_in_b = renamed.get(name, name)
        one = of_a.get(name) or _search(a, name)
        other = of_b.get(name_in_b) or _search(b, name_in_b)
        for run, own_name, port in ((a, name, one), (b, name_in_b, other)):
            is_needed = name in renamed or (one is None and other is None)
            if not port and (is_needed or (port is False and name in signals)):
                reason = (run.left_out or {}).get(own_name)
                if reason is not None:
                    raise LogError(f"{run.label}: {own_name}: {reason}")
                find_signal(run.channels, own_name, source=run.label)  # which says why
        found[name] = (one, other)
    return found


def _namesakes(b: Recording, renamed: Mapping[str, str]) -> dict[str, tuple[_Port, _Port]]:
    """Return what b has of the names in a that a map gives other signals."""
    of_b = select_signals(b.channels, None, source=b.label)
    names = [name for name in renamed if name in of_b and name not in renamed.values()]
    return {f"{name} of b": (None, of_b[name]) for name in names}


def _texts(reasons: Mapping[str, str]) -> list[str]:
    """Return each reason with the signals that have it."""
    groups = names_by_reason(reasons).items()
    return [f"{listing(names)}: {reason}" for reason, names in groups if reason]


def _unread(a: Recording, b: Recording, wanted: Sequence[str]) -> dict[str, str]:
    """Return what could not be read of either file, of what is asked for, and why."""
    reasons: dict[str, list[str]] = {}
    for run in (a, b):
        for name, reason in (run.left_out or {}).items():
            if not wanted or any(matches(own, name) for own in wanted):
                reasons.setdefault(name, []).append(f"{run.label}: {reason}")
    return {name: "; ".join(own) for name, own in reasons.items()}


def _search(run: Recording, name: str) -> _Port:
    """Return elements of a signal by their name."""
    with suppress(UnknownSignalError):
        return find_signal(run.channels, name, source=run.label)
    with suppress(UnknownSignalError):
        find_signal(declared_channels(run.channels), name, source=run.label)
        return False
    return None


def _count(run: Recording, port: _Port, span_ns: tuple[int, int] | None) -> int:
    return sum(len(times) for times, _ in blocks_of_port(run, port, span_ns)) if port else 0


# --- one signal ---


def _pair(
    name: str, one: _Port, other: _Port, tolerances: tuple[float, float]
) -> Pair | DifferenceStatus:
    """Return a signal of both runs to be compared, or why it cannot be."""
    if not other:
        return "only in a" if other is None else "not recorded in b"
    if not one:
        return "only in b" if one is None else "not recorded in a"
    if one.size != other.size:
        return "other size"
    conversions = [own for own in conversions_between(other.measures, one.measures) if own]
    return (
        Pair(name, one, other, conversions, *tolerances)
        if len(conversions) == one.size
        else "other unit"
    )


# --- events ---


# An instant, a signal that is compared, its element, and whether it is the left limit of what jumps
# by itself, not where something else led to.
_Place: TypeAlias = tuple[int, str, int, bool]


def _compare_events(
    a: Recording, b: Recording, pairs: Mapping[str, Pair], span_ns: tuple[int, int] | None
) -> EventsDifference:
    """Compare the events of two runs, of the signals that are compared.

    Raises
    ------
    LogError
        If an event is of a signal that its run does not have, or not of its size.
    """
    first_ns, last_ns = span_ns or (-math.inf, math.inf)
    events_a, events_b = (
        [event for event in run.events() if first_ns <= event.time_ns <= last_ns] for run in (a, b)
    )
    count_a, jumps_a = _jumps(a, events_a, [(pair, pair.a, None) for pair in pairs.values()])
    count_b, jumps_b = _jumps(
        b, events_b, [(pair, pair.b, pair.conversions) for pair in pairs.values()]
    )
    places = sorted(dict.fromkeys([*jumps_a, *jumps_b]), key=itemgetter(0))
    settings = [[e for e in events if e.cause in OF_COMPONENTS] for events in (events_a, events_b)]
    is_equal = settings[0] == settings[1]
    outside: list[ElementEventDifference] = []
    for place in places:
        time_ns, signal, element, _ = place
        in_a, in_b = jumps_a.get(place), jumps_b.get(place)
        if _agree(in_a, in_b, None):
            continue
        is_equal = False
        pair = pairs[signal]
        if pair.is_exact or not _agree(in_a, in_b, pair.tolerance):
            name = Port.parse(signal).element_names(pair.a.size)[element]
            outside.append(ElementEventDifference(name, time_ns, in_a, in_b))
    first = outside[0] if outside else None
    return EventsDifference((count_a, count_b), len(places), len(outside), is_equal, first)


def _jumps(
    run: Recording,
    events: Sequence[SignalEvent],
    compared: Sequence[tuple[Pair, RecordedPort, Sequence[Conversion] | None]],
) -> tuple[int, dict[_Place, ElementEvent]]:
    """Return the number of events of the compared signals, and where each element jumped to."""
    known: dict[tuple[str, int], list[tuple[str, int, Conversion]]] = {}
    for pair, port, conversions in compared:
        for element, convert in enumerate(conversions or [Conversion()] * port.size):
            place = port.channel.name, port.columns.start + element
            known.setdefault(place, []).append((pair.name, element, convert))
    count = 0
    jumps: dict[_Place, ElementEvent] = {}
    for event in events:
        if event.cause in OF_COMPONENTS:
            continue
        found = find_signal(declared_channels(run.channels), event.signal, source="the run")
        if len(event.values) != found.size:
            raise LogError(
                f"event of {event.signal!r} at t = {event.time_ns / 1e9} s: expected {found.size} "
                f"values, got {len(event.values)}"
            )
        if not (recorded := _search(run, event.signal)):
            continue
        is_compared = False
        for column, value in enumerate(event.values, start=recorded.columns.start):
            for name, element, convert in known.get((recorded.channel.name, column), ()):
                place_of_jump = (event.time_ns, name, element, event.cause == "jump")
                jumps[place_of_jump] = ElementEvent(event.cause, convert(value))
                is_compared = True
        count += is_compared
    return count, jumps


def _agree(a: ElementEvent | None, b: ElementEvent | None, tolerance: float | None) -> bool:
    """Return whether both jump to the same bits, or to values within a tolerance, or neither."""
    if a is None or b is None or a.cause != b.cause:
        return a is b
    if bit_pattern(a.value) == bit_pattern(b.value):
        return True
    return tolerance is not None and math.isfinite(a.value) and abs(a.value - b.value) <= tolerance
