"""Two recorded runs compared, signal by signal, at the times they share, and event by event.

Of a partial log there is what it has: signals that it did not record are left out, and where it has
not every row, the other run's rows there.

Without tolerances the comparison is of bits: 0.0 and -0.0 differ. With tolerances a pair of values
agrees where ``|a - b| <= atol + rtol * max|a|``, the maximum over all the signal's rows and
elements, or where both are NaN.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Final, Literal, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds
from cosim.core.partial import partial_of
from cosim.core.port import Port
from cosim.core.recorded import find_signal
from cosim.core.recording import Recording
from cosim.core.selection import is_pattern, matches
from cosim.errors import LogError, UnknownSignalError, nearest
from cosim.log.comparison.event_difference import EventsDifference, compare_events
from cosim.log.comparison.pairing import Window, windows
from cosim.log.comparison.tolerances import Tolerances

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
_LEFT_OUT: Final = frozenset({"not recorded in a", "not recorded in b"})
_NOT_COMPARED: Final = _LEFT_OUT | {"other size", "only in a", "only in b"}


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
        ``other times``: within it where both have values, but they have not the same instants;
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
        return [row for row in self.rows if row.status not in _LEFT_OUT]

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


def diff(
    a: Recording,
    b: Recording,
    *,
    atol: float = 0.0,
    rtol: float = 0.0,
    tol: Mapping[str, float] | None = None,
    signals: Sequence[str] = (),
    span_ns: tuple[int, int] | None = None,
) -> LogDifference:
    """Compare two runs signal by signal; of long logs only a part is in memory at a time.

    Parameters
    ----------
    a, b : Recording
        ``a`` is the reference: the scales are those of its signals.
    atol : float
        In the unit of each signal.
    rtol : float
        As a part of each signal's largest |a|.
    tol : mapping of signal or pattern to float, optional
        Absolute tolerances in the place of both, for signals of a name or pattern (``*.delta``); of
        several that match the last. 0: the bits are compared.
    signals : sequence of str
        The signals to compare, elements of them, ``plant.x_a[0:2]``, or patterns; none: all.
    span_ns : (int, int), optional
        The first and the last instant [ns] that are compared.

    Raises
    ------
    LogError
        If a or b is no recording, or one of ``signals`` is in neither; names the nearest. If an
        event is of no signal.
    UsageError
        If a tolerance is no number from 0 on, or is of no signal that is compared.
    """
    _check_recording("a", a)
    _check_recording("b", b)
    tolerance = Tolerances(atol, rtol, tol or {})
    if signals:
        names = _expanded(a, b, [signals] if isinstance(signals, str) else signals)
        columns_a, columns_b = _chosen(a, b, names)
    else:
        columns_a = _all_columns(a)
        columns_b = _all_columns(b)
        names = list(dict.fromkeys([*columns_a, *columns_b]))
    tolerance.check_used(names)
    rows: dict[str, SignalDifference] = {}
    for component, pairs in _pairs_by_component(names, columns_a, columns_b).items():
        blocks = [partial(_blocks, run, component, span_ns) for run in (a, b)]
        thinned = (_is_thinned(a, component), _is_thinned(b, component))
        rows.update(_compare(pairs, blocks[0], blocks[1], tolerance, thinned=thinned))
    for name in names:
        if name not in rows:
            run_a = a if name in columns_a else None
            run_b = b if name in columns_b else None
            rows[name] = _not_compared(name, run_a, run_b, span_ns)
            if run_a is None and _was_left_out(a, name):
                rows[name] = replace(rows[name], status="not recorded in a")
            elif run_b is None and _was_left_out(b, name):
                rows[name] = replace(rows[name], status="not recorded in b")
    if rows and all(row.status in _LEFT_OUT for row in rows.values()):
        raise LogError(
            f"{a.label} and {b.label} have no recorded signal in common: one of them is partial"
        )
    tolerances: dict[str, float | None] = {}
    for name, row in rows.items():
        if row.status not in _NOT_COMPARED:
            tolerances[name] = row.tolerance if any(tolerance.of(name)) else None
    events = compare_events((a, b), (columns_a, columns_b), tolerances, span_ns)
    return LogDifference(tuple(rows[name] for name in names), atol, rtol, events, tolerance.own)


def _is_thinned(run: Recording, component: str) -> bool:
    """Return whether a run has not every row of a component."""
    recorded = partial_of(run.channels)
    if recorded is None:
        return False
    return run.channels[component].period > recorded.declared[component].period


def _was_left_out(run: Recording, name: str) -> bool:
    """Return whether a run had a signal that it did not record."""
    recorded = partial_of(run.channels)
    if recorded is None:
        return False
    try:
        find_signal(recorded.declared, name, source=run.label)
    except UnknownSignalError:
        return False
    return True


def _pairs_by_component(
    names: Sequence[str], columns_a: Mapping[str, slice], columns_b: Mapping[str, slice]
) -> dict[str, list[_Comparison]]:
    """Return a comparison of every signal that both runs have, by component."""
    pairs: dict[str, list[_Comparison]] = {}
    for name in names:
        if name in columns_a and name in columns_b:
            comparison = _Comparison(name, columns_a[name], columns_b[name])
            pairs.setdefault(_component_of(name), []).append(comparison)
    return pairs


def _check_recording(name: str, run: object) -> None:
    if getattr(type(run), "blocks", None) is None:
        found = type(run).__name__
        raise LogError(
            f"{name}: found {found} {run!r}, needed a recording; open a log with "
            "cosim.open_log(path)"
        )


def _all_columns(run: Recording) -> dict[str, slice]:
    """Return the columns of all signals by ``component.signal``."""
    columns = {}
    for channel in run.channels.values():
        for name, whole_row in channel.signal_columns.items():
            own = slice(whole_row.start - channel.start, whole_row.stop - channel.start)
            columns[f"{channel.name}.{name}"] = own
    return columns


def _expanded(a: Recording, b: Recording, signals: Sequence[str]) -> list[str]:
    """Return the chosen signals, each once, with those that patterns stand for, of a and of b."""
    names: dict[str, None] = {}
    known = dict.fromkeys([*_all_columns(a), *_all_columns(b)])
    for signal in signals:
        own = [signal]
        for run in (a, b):
            if isinstance(signal, str) and not is_pattern(signal) and _was_left_out(run, signal):
                find_signal(run.channels, signal, source=run.label)
        if isinstance(signal, str) and is_pattern(signal) and signal not in known:
            own = [name for name in known if matches(signal, name)]
            if not own:
                raise UnknownSignalError(
                    f"no signal of the two runs matches {signal!r}; {nearest(signal, known)}"
                )
        names |= dict.fromkeys(own)
    return list(names)


def _chosen(
    a: Recording, b: Recording, signals: Sequence[str]
) -> tuple[dict[str, slice], dict[str, slice]]:
    """Return the columns of the chosen signals in a and in b, where these have them.

    Raises
    ------
    LogError
        If a signal is in neither of them.
    """
    columns_a: dict[str, slice] = {}
    columns_b: dict[str, slice] = {}
    for signal in signals:
        if not isinstance(signal, str):
            raise LogError(f"found {signal!r}, needed the name of a signal, such as 'plant.y'")
        problem: LogError | None = None
        for run, columns in ((a, columns_a), (b, columns_b)):
            try:
                columns[signal] = find_signal(run.channels, signal, source="the first run").columns
            except LogError as error:
                problem = problem or error  # of the reference, where neither has it
        if problem is not None and signal not in columns_a and signal not in columns_b:
            raise problem
    return columns_a, columns_b


def _component_of(name: str) -> str:
    return Port.parse(name).component


def _not_compared(
    name: str, a: Recording | None, b: Recording | None, span_ns: tuple[int, int] | None
) -> SignalDifference:
    """Describe a signal that only one run has, or that the runs have with different sizes."""
    component = _component_of(name)
    rows_a = 0 if a is None else _count(_blocks(a, component, span_ns))
    rows_b = 0 if b is None else _count(_blocks(b, component, span_ns))
    status: DifferenceStatus = "other size"
    if b is None:
        status = "only in a"
    elif a is None:
        status = "only in b"
    return SignalDifference(name, status, (rows_a, rows_b, 0))


def _blocks(
    run: Recording, component: str, span_ns: tuple[int, int] | None
) -> Iterator[tuple[Nanoseconds, Matrix]]:
    """Return times and rows of a component, or those of a span of time, some at a time."""
    first_ns, last_ns = (None, None) if span_ns is None else span_ns
    return run.blocks(component, first_ns=first_ns, last_ns=last_ns)


def _count(blocks: Iterator[tuple[Nanoseconds, Matrix]]) -> int:
    return sum(len(times) for times, _ in blocks)


def _compare(
    comparisons: Sequence[_Comparison],
    a: Callable[[], Iterator[tuple[Nanoseconds, Matrix]]],
    b: Callable[[], Iterator[tuple[Nanoseconds, Matrix]]],
    tolerances: Tolerances,
    *,
    thinned: tuple[bool, bool],
) -> dict[str, SignalDifference]:
    """Compare the signals of a component; leave out those whose sizes differ.

    ``a`` and ``b`` return the blocks of its rows in both runs, which need not have them all where
    they are ``thinned``.
    """
    same_size = [comparison for comparison in comparisons if comparison.same_size]
    if not same_size:
        return {}
    if tolerances.rtol:  # the tolerance is a part of the scale, which is that of the whole signal
        for _, rows in a():
            for comparison in same_size:
                comparison.extend_scale(rows)
    for comparison in same_size:
        comparison.set_tolerance(*tolerances.of(comparison.name))
    for window in windows(a(), b()):
        for comparison in same_size:
            comparison.add(window)
    return {comparison.name: comparison.result(thinned) for comparison in same_size}


@final
class _Comparison:
    """A signal that both runs have, compared window by window."""

    def __init__(self, name: str, columns_a: slice, columns_b: slice) -> None:
        self.name = name
        self._columns_a = columns_a
        self._columns_b = columns_b
        self._rows = (0, 0, 0)
        self._largest = 0.0
        self._scale = 0.0
        self._tolerance = 0.0
        self._exact = True
        self._same_bits = True
        self._first: ElementDifference | None = None

    @property
    def same_size(self) -> bool:
        """Whether the signal has as many elements in both runs."""
        a = self._columns_a
        b = self._columns_b
        return bool(a.stop - a.start == b.stop - b.start)

    def extend_scale(self, rows: Matrix) -> None:
        """Take more rows of a into account."""
        values = rows[:, self._columns_a]
        finite = values[np.isfinite(values)]
        self._scale = max(self._scale, float(np.abs(finite).max(initial=0.0)))

    def set_tolerance(self, atol: float, rtol: float) -> None:
        """Set what |a - b| is compared with, by the scale as it is known."""
        self._exact = atol == 0.0 and rtol == 0.0
        self._tolerance = atol + rtol * self._scale

    def add(self, window: Window) -> None:
        """Compare the rows of a window."""
        times, rows_a = window.a
        _, rows_b = window.b
        self.extend_scale(rows_a)
        values_a = rows_a[:, self._columns_a]
        values_b = rows_b[:, self._columns_b]
        if window.shared is not None:
            shared_a, shared_b = window.shared
            times = times[shared_a]
            values_a = values_a[shared_a]
            values_b = values_b[shared_b]
        counts = (len(rows_a), len(rows_b), len(times))
        count_a, count_b, count_shared = map(sum, zip(self._rows, counts, strict=True))
        self._rows = (count_a, count_b, count_shared)
        same_bits = _bits(values_a) == _bits(values_b)
        distance = _distance(values_a, values_b)
        outside = ~same_bits
        if not self._exact:
            outside = ~(distance <= self._tolerance) | np.isinf(distance)
        self._same_bits = self._same_bits and bool(same_bits.all())
        self._largest = max(self._largest, float(distance.max(initial=0.0)))
        if self._first is None:
            self._first = _first_outside(self.name, outside, times, values_a, values_b)

    def result(self, thinned: tuple[bool, bool]) -> SignalDifference:
        """Return how the signal compares in two runs, of which some have not every row."""
        return SignalDifference(
            self.name,
            self._status(*thinned),
            self._rows,
            self._largest,
            self._scale,
            self._tolerance,
            self._first,
        )

    def _status(self, a_thinned: bool, b_thinned: bool) -> DifferenceStatus:
        if self._first is not None:
            return "outside"
        count_a, count_b, count_shared = self._rows
        others = (count_a > count_shared and not b_thinned) or (
            count_b > count_shared and not a_thinned
        )
        if others or (count_a and count_b and not count_shared):
            return "other times"
        return "equal" if self._same_bits else "within"


def _bits(values: Matrix) -> NDArray[np.int64]:
    return np.ascontiguousarray(values).view(np.int64)


def _distance(a: Matrix, b: Matrix) -> Matrix:
    """Compute |a - b|: 0 where both are NaN or the same infinity, infinite where only one is."""
    with np.errstate(invalid="ignore", over="ignore"):
        distance = np.abs(a - b)
    # Infinity minus itself is NaN, as is everything minus NaN: first what agrees, then the rest.
    both_nan = np.isnan(a) & np.isnan(b)
    distance[(a == b) | both_nan] = 0.0
    distance[np.isnan(distance)] = np.inf
    return distance


def _first_outside(
    name: str, outside: Mask, times: Nanoseconds, a: Matrix, b: Matrix
) -> ElementDifference | None:
    """Return the first time, and there the first element, outside the tolerance."""
    if not outside.any():
        return None
    size = outside.shape[1]
    row, column = divmod(int(outside.argmax()), size)
    element = Port.parse(name).element_names(size)[column]
    value_a = float(a[row, column])
    value_b = float(b[row, column])
    return ElementDifference(element, int(times[row]), value_a, value_b)
