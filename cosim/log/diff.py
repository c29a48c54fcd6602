"""Two recorded runs compared, signal by signal and event by event.

They are compared at the instants that they share, rows of one instant in their order. Of a partial
log what it has is compared: signals that it did not record are left out, and so are rows of the
other run at instants at which it has none.

Without tolerances the comparison is of bits: 0.0 and -0.0 differ. With tolerances a pair of values
agrees where ``|a - b| <= atol + rtol * max|a|``, the maximum over all the signal's rows and
elements, or where both are NaN. Values of b are converted to the unit of a.

Runs of different instants are compared at those of a. Between two rows of b a continuous signal is
a straight line, and any other keeps its value; where b jumps, its later value counts, but for the
earlier one of a that jumps there, too. NaN of a signal that may have no value is no row of it. In a
tube a value of a is right if b has it, within the tolerance, at some instant no farther away than
the tube is wide, and so is one of b.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, Literal, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from cosim.arguments import truth_argument
from cosim.arrays import Matrix, Nanoseconds
from cosim.core.port import Port
from cosim.core.recorded.joined_rows import numbered_instants
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.selection import is_pattern, matches, select_signals
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.recording import Recording, SignalEvent, TimedRows
from cosim.errors import LogError, UnknownSignalError, UsageError, nearest, option
from cosim.instants import NANOSECONDS
from cosim.log.difference import (
    LEFT_OUT,
    OF_COMPONENTS,
    DifferenceStatus,
    ElementDifference,
    ElementEvent,
    ElementEventDifference,
    EventsDifference,
    LogDifference,
    SignalDifference,
    bit_pattern,
)
from cosim.units import Conversion, conversions_between


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
    found = _found(a, b, [signals] if isinstance(signals, str) else signals, renamed)
    _check_used(tol, found)
    pairs: dict[str, _Pair] = {}
    groups: dict[tuple[str, str], list[_Pair]] = {}
    rows: dict[str, SignalDifference] = {}
    for name, (one, other) in found.items():
        own = [value for pattern, value in tol.items() if matches(pattern, name)]
        pair = _pair(name, one, other, (own[-1], 0.0) if own else (atol, rtol))
        if isinstance(pair, _Pair):
            pairs[name] = pair
            groups.setdefault((pair.a.channel.name, pair.b.channel.name), []).append(pair)
        else:
            rows[name] = SignalDifference(
                name, pair, (_count(a, one, span_ns), _count(b, other, span_ns), 0)
            )
    if rows and all(row.status in LEFT_OUT for row in rows.values()) and not pairs:
        raise LogError(
            f"{a.label} and {b.label} have no recorded signal in common: one of them is partial"
        )
    for group in groups.values():
        _compare(a, b, group, span_ns, round(tube * NANOSECONDS) if between else None)
    events = EventsDifference() if between else _compare_events(a, b, pairs, span_ns)
    ordered = (pairs[name].result() if name in pairs else rows[name] for name in found)
    return LogDifference(
        tuple(ordered), atol, rtol, events, tol, renamed, tube if between else None
    )


def _check_arguments(
    runs: Mapping[str, object], atol: object, rtol: object, tol: object, tube: object
) -> None:
    for name, run in runs.items():
        if getattr(type(run), "blocks", None) is None:
            raise LogError(
                f"{name}: expected a recording, got {type(run).__name__} {run!r}; open a log with "
                "cosim.open_log(path)"
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
                find_signal(run.channels, own_name, source=run.label)  # which says why
        found[name] = (one, other)
    return found


def _search(run: Recording, name: str) -> _Port:
    """Return elements of a signal by their name."""
    with suppress(UnknownSignalError):
        return find_signal(run.channels, name, source=run.label)
    with suppress(UnknownSignalError):
        find_signal(declared_channels(run.channels), name, source=run.label)
        return False
    return None


def _blocks(
    run: Recording, port: RecordedPort, span_ns: tuple[int, int] | None
) -> Iterator[TimedRows]:
    """Return the rows of a signal's component, or those of a span of time, some at a time."""
    first_ns, last_ns = span_ns or (None, None)
    return run.blocks(port.channel.name, first_ns=first_ns, last_ns=last_ns)


def _count(run: Recording, port: _Port, span_ns: tuple[int, int] | None) -> int:
    return sum(len(times) for times, _ in _blocks(run, port, span_ns)) if port else 0


def _is_thinned(run: Recording, port: RecordedPort) -> bool:
    """Return whether a run lacks rows of a signal's component."""
    return port.channel.period > declared_channels(run.channels)[port.channel.name].period


# --- one signal ---


@final
@dataclass(slots=True, eq=False)
class _Pair:
    """A signal of both runs, and what is known of how it compares.

    Parameters
    ----------
    name : str
    a, b : RecordedPort
        Of one size.
    conversions : sequence of Conversion
        Of each element, to the unit of a.
    atol, rtol : float
    """

    name: str
    a: RecordedPort
    b: RecordedPort
    conversions: Sequence[Conversion]
    atol: float
    rtol: float
    rows: tuple[int, int, int] = (0, 0, 0)  # in a, in b, and those that were compared
    is_equal: bool = True  # bits and instants
    has_other_times: bool = False
    scale: float = 0.0
    largest: float = 0.0
    first: ElementDifference | None = None

    @property
    def tolerance(self) -> float:
        """What |a - b| is compared with, by the scale as it is known."""
        return self.atol + self.rtol * self.scale

    @property
    def is_exact(self) -> bool:
        """Whether bits are compared."""
        return self.atol == 0.0 and self.rtol == 0.0

    def extend_scale(self, rows: Matrix) -> None:
        """Take more rows of a into account."""
        sizes = np.abs(rows[:, self.a.columns])
        self.scale = max(self.scale, float(sizes.max(initial=0.0, where=np.isfinite(sizes))))

    def values_of_b(self, rows: Matrix) -> Matrix:
        """Return its values in rows of b, in the units of a."""
        values = rows[:, self.b.columns]
        if all(convert.copies for convert in self.conversions):
            return values
        columns = zip(self.conversions, values.T, strict=True)
        return np.stack([convert(column) for convert, column in columns], axis=1)

    def take(self, times: Nanoseconds, a: Matrix, b: Matrix, apart: Matrix | None = None) -> None:
        """Take values of both at some times, and how far they are apart, if that is known."""
        same_bits = _bits(a) == _bits(b)
        if apart is None and same_bits.all():
            return
        self.is_equal = self.is_equal and bool(same_bits.all())
        by_bits = apart is None and self.is_exact
        apart = _distance(a, b) if apart is None else apart
        outside = ~same_bits if by_bits else ~(apart <= self.tolerance) | np.isinf(apart)
        self.largest = max(self.largest, float(apart.max(initial=0.0)))
        if outside.any():
            row, column = divmod(int(outside.argmax()), outside.shape[1])
            element = Port.parse(self.name).element_names(outside.shape[1])[column]
            values = float(a[row, column]), float(b[row, column])
            found = ElementDifference(element, int(times[row]), *values)
            if self.first is None or found.time_ns < self.first.time_ns:
                self.first = found

    def result(self) -> SignalDifference:
        """Return how it compares."""
        status: DifferenceStatus = "equal" if self.is_equal else "within"
        if self.first is not None:
            status = "outside"
        elif self.has_other_times:
            status = "other times"
        numbers = (self.largest, self.scale, self.tolerance)
        return SignalDifference(self.name, status, self.rows, *numbers, self.first)


def _pair(
    name: str, one: _Port, other: _Port, tolerances: tuple[float, float]
) -> _Pair | DifferenceStatus:
    """Return a signal of both runs to be compared, or why it cannot be."""
    if not other:
        return "only in a" if other is None else "not recorded in b"
    if not one:
        return "only in b" if one is None else "not recorded in a"
    if one.size != other.size:
        return "other size"
    conversions = [own for own in conversions_between(other.measures, one.measures) if own]
    return (
        _Pair(name, one, other, conversions, *tolerances)
        if len(conversions) == one.size
        else "other unit"
    )


def _bits(values: Matrix) -> NDArray[np.int64]:
    return np.ascontiguousarray(values).view(np.int64)


def _distance(a: Matrix, b: Matrix) -> Matrix:
    """Compute |a - b|: 0 where both are NaN or the same infinity, infinite where only one is."""
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.abs(a - b)
    # Infinity minus itself is NaN, as is everything minus NaN: first what agrees, then the rest.
    apart[(a == b) | (np.isnan(a) & np.isnan(b))] = 0.0
    apart[np.isnan(apart)] = np.inf
    return apart


def _compare(
    a: Recording,
    b: Recording,
    group: Sequence[_Pair],
    span_ns: tuple[int, int] | None,
    tube_ns: int | None,
) -> None:
    """Compare the signals of one component of each; ``tube_ns`` is None at shared instants."""
    first = group[0]
    if any(pair.rtol for pair in group):  # of the scale of the whole signal
        for _, rows in _blocks(a, first.a, span_ns):
            for pair in group:
                pair.extend_scale(rows)
    blocks = _blocks(a, first.a, span_ns), _blocks(b, first.b, span_ns)
    thinned = _is_thinned(a, first.a), _is_thinned(b, first.b)
    if tube_ns is None:
        _compare_shared(group, *blocks, thinned)
    else:
        _compare_between(group, *blocks, tube_ns, thinned[1])


# --- at the instants of both ---


def _compare_shared(
    group: Sequence[_Pair],
    a: Iterator[TimedRows],
    b: Iterator[TimedRows],
    thinned: tuple[bool, bool],
) -> None:
    """Compare signals of a component of each; a run that is thinned need not have all rows."""
    in_a = in_b = compared = 0
    for (times_a, rows_a), (times_b, rows_b) in windows(a, b):
        own_a: Any = slice(None)
        own_b: Any = slice(None)
        if not np.array_equal(times_a, times_b):
            instants = numbered_instants(times_a), numbered_instants(times_b)
            _, own_a, own_b = np.intersect1d(*instants, assume_unique=True, return_indices=True)
        times = times_a[own_a]
        in_a, in_b, compared = in_a + len(rows_a), in_b + len(rows_b), compared + len(times)
        for pair in group:
            pair.extend_scale(rows_a)
            pair.take(times, rows_a[own_a, pair.a.columns], pair.values_of_b(rows_b)[own_b])
    for pair in group:
        pair.rows = (in_a, in_b, compared)
        pair.has_other_times = (
            (in_a > compared and not thinned[1])
            or (in_b > compared and not thinned[0])
            or bool(in_a and in_b and not compared)
        )


def windows(
    a: Iterator[TimedRows], b: Iterator[TimedRows]
) -> Iterator[tuple[TimedRows, TimedRows]]:
    """Yield the rows of two runs, whose blocks are in order of time, one span after another.

    A span ends before an instant that is not whole yet, so that the rows of a jump stay together.
    """
    sources = (a, b)
    waiting = [next(source) for source in sources]
    is_open = [True, True]
    while True:
        for side, (times, rows) in enumerate(waiting):
            # of a single instant more rows may follow
            while is_open[side] and (not len(times) or times[0] == times[-1]):
                block = next(sources[side], None)
                is_open[side] = block is not None
                if block is not None:
                    times = np.concatenate([times, block[0]])
                    rows = np.concatenate([rows, block[1]])
            waiting[side] = times, rows
        ends = [int(times[-1]) for side, (times, _) in enumerate(waiting) if is_open[side]]
        taken = []
        for side, (times, rows) in enumerate(waiting):
            count = int(np.searchsorted(times, min(ends))) if ends else len(times)
            taken.append((times[:count], rows[:count]))
            waiting[side] = times[count:], rows[count:]
        if not any(len(times) for times, _ in taken):
            return
        yield taken[0], taken[1]


# --- at the instants of a ---


def _compare_between(
    group: Sequence[_Pair],
    a: Iterator[TimedRows],
    b: Iterator[TimedRows],
    tube_ns: int,
    b_is_thinned: bool,
) -> None:
    """Compare signals of a component at all instants of a that lie within b, or near it.

    In a tube those of b within a are compared with what a has near them: between the instants of a
    around them, at least, as what a has there is not known.
    """
    (times_a, rows_a), (times_b, rows_b) = _joined(a), _joined(b)
    for pair in group:
        pair.extend_scale(rows_a)
        known_a, values_a = _measured(pair.a, times_a, rows_a[:, pair.a.columns])
        known_b, values_b = _measured(pair.b, times_b, pair.values_of_b(rows_b))
        is_line = is_straight(pair.a) and is_straight(pair.b)
        times, values = _within(known_a, values_a, known_b, tube_ns)
        if len(times):
            span = times - tube_ns, times + tube_ns
            own, apart = _beside(times, values, span, (known_b, values_b), is_line)
            pair.take(times, values, own, apart)
        pair.rows = (len(known_a), len(known_b), len(times))
        pair.is_equal = pair.is_equal and np.array_equal(known_a, known_b)
        is_nothing = len(known_b) > 0 and not len(times)
        pair.has_other_times = is_nothing or (len(known_a) > len(times) and not b_is_thinned)
        times, values = _within(known_b, values_b, known_a, 0)
        if tube_ns and len(times):
            before = known_a[np.searchsorted(known_a, times, side="right") - 1]
            after = known_a[np.searchsorted(known_a, times, side="left")]
            span = np.minimum(times - tube_ns, before), np.maximum(times + tube_ns, after)
            own, apart = _beside(times, values, span, (known_a, values_a), is_line)
            pair.take(times, own, values, apart)


def _joined(blocks: Iterator[TimedRows]) -> TimedRows:
    parts = list(blocks)
    times = np.concatenate([times for times, _ in parts])
    return times, np.concatenate([rows for _, rows in parts])


def _measured(port: RecordedPort, times: Nanoseconds, values: Matrix) -> TimedRows:
    """Return the rows of a signal, without those in which it has no value, as it may."""
    if not port.signal.optional:
        return times, values
    is_there = ~np.isnan(values).all(axis=1)
    return times[is_there], values[is_there]


def _within(times: Nanoseconds, values: Matrix, known: Nanoseconds, margin_ns: int) -> TimedRows:
    """Return the rows at times within those that are known, or near them."""
    if not len(known):
        return times[:0], values[:0]
    is_there = (times >= known[0] - margin_ns) & (times <= known[-1] + margin_ns)
    return times[is_there], values[is_there]


def is_straight(port: RecordedPort) -> bool:
    """Return whether a signal is a straight line between two rows; else it keeps its value."""
    return port.signal.type == "real" and port.signal.variability != "discrete"


def values_at(times: Nanoseconds, known: Nanoseconds, values: Matrix, is_line: bool) -> Matrix:
    """Return values at times, beyond those that are known the nearest; shape (n, size).

    At a jump it is the last value, but for times that come again those before it, in their order.
    """
    number = np.arange(len(times)) - np.searchsorted(times, times)
    comes_again = np.append(times[1:] == times[:-1], False)
    times = np.clip(times, known[0], known[-1])
    before = np.searchsorted(known, times, side="right") - 1
    earlier = np.searchsorted(known, times, side="left") + number
    before = np.where(comes_again, np.minimum(earlier, before), before)
    found: Matrix = values[before]
    between = np.flatnonzero(known[before] != times)
    if is_line and len(between):
        first = before[between]
        width = (known[first + 1] - known[first])[:, np.newaxis]
        part = (times[between] - known[first])[:, np.newaxis] / width
        with np.errstate(invalid="ignore", over="ignore"):
            found[between] = values[first] + part * (values[first + 1] - values[first])
    return found


def _beside(
    times: Nanoseconds,
    values: Matrix,
    span: tuple[Nanoseconds, Nanoseconds],
    other: TimedRows,
    is_line: bool,
) -> tuple[Matrix, Matrix]:
    """Return the other run at some times, and how far values are from all that it has in spans.

    These begin and end around each time. Lines have all values between their lowest and highest,
    what is held those of its rows.
    """
    known, rows = other
    own = values_at(times, known, rows, is_line)
    apart = _distance(values, own)
    begin, end = span
    if np.array_equal(begin, end):
        return own, apart
    at_begin, at_end = (values_at(at, known, rows, is_line) for at in span)
    first = np.searchsorted(known, begin, side="left")
    stop = np.searchsorted(known, end, side="right")
    if not is_line:
        apart = np.minimum(apart, _distance(values, at_begin))
        for number in range(int((stop - first).max())):
            near = np.flatnonzero(first + number < stop)
            held = _distance(values[near], rows[first[near] + number])
            apart[near] = np.minimum(apart[near], held)
        return own, apart
    lower, upper = np.fmin(at_begin, at_end), np.fmax(at_begin, at_end)
    near = np.flatnonzero(stop > first)
    if len(near):
        bounds = np.stack([first[near], stop[near]], axis=1).ravel()
        padded = np.concatenate([rows, rows[-1:]])  # reduceat takes no end behind the last row
        lower[near] = np.fmin(lower[near], np.fmin.reduceat(padded, bounds)[::2])
        upper[near] = np.fmax(upper[near], np.fmax.reduceat(padded, bounds)[::2])
    from_lines = _distance(values, np.clip(values, lower, upper))
    return own, np.where(np.isnan(values), apart, np.minimum(apart, from_lines))


# --- events ---


# An instant, a signal that is compared, its element, and whether it is the left limit of what jumps
# by itself, not where something else led to.
_Place: TypeAlias = tuple[int, str, int, bool]


def _compare_events(
    a: Recording, b: Recording, pairs: Mapping[str, _Pair], span_ns: tuple[int, int] | None
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
    compared: Sequence[tuple[_Pair, RecordedPort, Sequence[Conversion] | None]],
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
