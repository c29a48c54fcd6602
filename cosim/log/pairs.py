"""A signal of two runs that is compared: at the instants of both, or at all of the first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Nanoseconds, Vector, as_columns, is_absent
from cosim.core.port import Port
from cosim.core.recorded.joined_rows import numbered_instants
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.signals import RecordedPort
from cosim.core.recording import Recording, TimedRows, joined
from cosim.instants import NANOSECONDS
from cosim.log.between import distance, distance_within, held_elements, measured, values_at
from cosim.log.difference import DifferenceStatus, ElementDifference, SignalDifference
from cosim.units import Conversion


@final
@dataclass(slots=True, eq=False)
class Pair:
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

    def converted(self, values: Matrix) -> Matrix:
        """Return values of b in the units of a."""
        if all(convert.copies for convert in self.conversions):
            return values
        columns = zip(self.conversions, values.T, strict=True)
        return np.stack([convert(column) for convert, column in columns], axis=1)

    def add_rows(self, *counts: int) -> None:
        """Count rows of a, of b, and those that are compared."""
        in_a, in_b, compared = map(sum, zip(self.rows, counts, strict=True))
        self.rows = in_a, in_b, compared

    def take(
        self,
        times: Nanoseconds,
        a: NDArray[np.float64],
        b: NDArray[np.float64],
        apart: Vector | None = None,
        element: int = 0,
    ) -> None:
        """Take values of both at some times: of all elements, or of one and how far it is apart."""
        same_bits = _bits(a) == _bits(b)
        if apart is None and same_bits.all():
            return
        self.is_equal = self.is_equal and bool(same_bits.all())
        by_bits = apart is None and self.is_exact
        sizes = as_columns(distance(a, b) if apart is None else apart)
        outside = np.isinf(sizes) | ~(sizes <= self.tolerance)
        if by_bits:
            outside = ~same_bits
        self.largest = max(self.largest, float(sizes.max(initial=0.0)))
        if outside.any():
            row, column = divmod(int(outside.argmax()), outside.shape[1])
            name = Port.parse(self.name).element_names(self.a.size)[element + column]
            values = float(as_columns(a)[row, column]), float(as_columns(b)[row, column])
            found = ElementDifference(name, int(times[row]), *values)
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


def blocks_of_port(
    run: Recording, port: RecordedPort, span_ns: tuple[int, int] | None
) -> Iterator[TimedRows]:
    """Return the rows of a signal's component, or those of a span of time, some at a time."""
    first_ns, last_ns = span_ns or (None, None)
    return run.blocks(port.channel.name, first_ns=first_ns, last_ns=last_ns)


def _is_thinned(run: Recording, port: RecordedPort) -> bool:
    """Return whether a run lacks rows of a signal's component."""
    return port.channel.period > declared_channels(run.channels)[port.channel.name].period


def _bits(values: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.ascontiguousarray(values).view(np.int64)


def compare(
    a: Recording,
    b: Recording,
    group: Sequence[Pair],
    span_ns: tuple[int, int] | None,
    tube_ns: int | None,
) -> str:
    """Compare signals of one component of each; return what was not; ``tube_ns``: not shared."""
    first = group[0]
    if tube_ns is None and any(pair.rtol for pair in group):  # of the scale of the whole signal
        for _, rows in blocks_of_port(a, first.a, span_ns):
            for pair in group:
                pair.extend_scale(rows)
    blocks = blocks_of_port(a, first.a, span_ns), blocks_of_port(b, first.b, span_ns)
    thinned = _is_thinned(a, first.a), _is_thinned(b, first.b)
    if tube_ns is None:
        spans = _compare_shared(group, *blocks, thinned)
    else:
        held = [(held_elements(a, pair.a), held_elements(b, pair.b)) for pair in group]
        spans = _compare_between(group, *blocks, held, tube_ns, thinned[1])
    return _apart_in_time(first, *spans, is_between=tube_ns is not None)


# of a run: its first and last instant, [ns]; empty: it has no rows
_Extent: TypeAlias = tuple[int, ...]


def _apart_in_time(pair: Pair, a: _Extent, b: _Extent, *, is_between: bool) -> str:
    """Return what of two runs is not compared as the other has nothing there; empty: nothing."""
    if not a or not b:
        return ""
    in_a, in_b = (f"{begin / NANOSECONDS} s to {end / NANOSECONDS} s" for begin, end in (a, b))
    name = pair.a.channel.name
    if not any(pair.rows[2:]):
        return (
            f"{name}: no instant in common, a has rows from {in_a}, b from {in_b}; a recording "
            "begins at t = 0 in a run in which it takes the place of a component (swap)"
        )
    if is_between and (b[0] < a[0] or b[1] > a[1]):
        return f"{name}: b has rows from {in_b}, a only from {in_a}"
    return ""


# --- at the instants of both ---


def _compare_shared(
    group: Sequence[Pair],
    a: Iterator[TimedRows],
    b: Iterator[TimedRows],
    thinned: tuple[bool, bool],
) -> tuple[_Extent, _Extent]:
    """Compare signals of a component of each; a run that is thinned need not have all rows.

    Returns the spans of time of both.
    """
    spans: tuple[_Extent, _Extent] = ((), ())
    for (times_a, rows_a), (times_b, rows_b) in windows(a, b):
        spans = _extended(spans[0], times_a), _extended(spans[1], times_b)
        shared = _shared(times_a, times_b)
        for pair in group:
            pair.extend_scale(rows_a)
            one = _present(pair.a, times_a, rows_a)
            other = _present(pair.b, times_b, rows_b)
            is_whole = one[0] is times_a and other[0] is times_b
            own_a, own_b = shared if is_whole else _shared(one[0], other[0])
            times = one[0][own_a]
            pair.add_rows(len(one[0]), len(other[0]), len(times))
            pair.take(times, one[1][own_a], pair.converted(other[1])[own_b])
    for pair in group:
        in_a, in_b, compared = pair.rows
        pair.has_other_times = (
            (in_a > compared and not thinned[1])
            or (in_b > compared and not thinned[0])
            or bool(in_a and in_b and not compared)
        )
    return spans


def _extended(span: _Extent, times: Nanoseconds) -> _Extent:
    """Return a span up to the last of more times."""
    if not len(times):
        return span
    return (span[0] if span else int(times[0])), int(times[-1])


def _shared(a: Nanoseconds, b: Nanoseconds) -> tuple[Any, Any]:
    """Return the rows of instants that both have, those of a jump in their order."""
    if np.array_equal(a, b):
        return slice(None), slice(None)
    instants = numbered_instants(a), numbered_instants(b)
    _, own_a, own_b = np.intersect1d(*instants, assume_unique=True, return_indices=True)
    return own_a, own_b


def _present(port: RecordedPort, times: Nanoseconds, rows: Matrix) -> TimedRows:
    """Return the rows of a signal, without those in which all of its cells are empty."""
    values = rows[:, port.columns]
    if port.signal.optional:
        is_empty = np.all(is_absent(values), axis=1)
        if is_empty.any():
            return times[~is_empty], values[~is_empty]
    return times, values


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
                    times, rows = joined([(times, rows), block])
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
    group: Sequence[Pair],
    a: Iterator[TimedRows],
    b: Iterator[TimedRows],
    held: Sequence[tuple[Sequence[bool], Sequence[bool]]],
    tube_ns: int,
    b_is_thinned: bool,
) -> tuple[_Extent, _Extent]:
    """Compare signals of a component at all instants of a that lie within b, or near it.

    In a tube those of b within a are compared with what a has near them: between the instants of a
    around them, at least, as what a has there is not known. Returns the spans of time of both.
    """
    (times_a, rows_a), (times_b, rows_b) = joined(a), joined(b)
    for pair, (held_a, held_b) in zip(group, held, strict=True):
        pair.extend_scale(rows_a)
        values_a, values_b = rows_a[:, pair.a.columns], pair.converted(rows_b[:, pair.b.columns])
        for element in range(pair.a.size):
            one = measured(pair.a, times_a, values_a[:, element])
            other = measured(pair.b, times_b, values_b[:, element])
            is_line = not (held_a[element] or held_b[element])
            _compare_element(pair, element, one, other, is_line, tube_ns, b_is_thinned)
    return _extended((), times_a), _extended((), times_b)


def _compare_element(
    pair: Pair,
    element: int,
    a: tuple[Nanoseconds, Vector],
    b: tuple[Nanoseconds, Vector],
    is_line: bool,
    tube_ns: int,
    b_is_thinned: bool,
) -> None:
    known_a, _ = a
    known_b, _ = b
    times, values = _within(*a, known_b, tube_ns)
    if len(times):
        own = values_at(times, *b, is_line)
        apart = distance(values, own)
        if tube_ns:
            near = distance_within(values, (times - tube_ns, times + tube_ns), *b, is_line)
            apart = np.minimum(apart, near)
        pair.take(times, values, own, apart, element)
    in_a, in_b, compared = pair.rows
    pair.rows = max(in_a, len(known_a)), max(in_b, len(known_b)), max(compared, len(times))
    pair.is_equal = pair.is_equal and np.array_equal(known_a, known_b)
    is_nothing = len(known_b) > 0 and not len(times)
    is_longer = len(known_a) > len(times) and not b_is_thinned
    pair.has_other_times = pair.has_other_times or is_nothing or is_longer
    times, values = _within(*b, known_a, 0)
    if tube_ns and len(times):
        before = known_a[np.searchsorted(known_a, times, side="right") - 1]
        after = known_a[np.searchsorted(known_a, times, side="left")]
        span = np.minimum(times - tube_ns, before), np.maximum(times + tube_ns, after)
        own = values_at(times, *a, is_line)
        apart = np.minimum(distance(values, own), distance_within(values, span, *a, is_line))
        pair.take(times, own, values, apart, element)


def _within(
    times: Nanoseconds, values: Vector, known: Nanoseconds, margin_ns: int
) -> tuple[Nanoseconds, Vector]:
    """Return the rows at times within those that are known, or near them."""
    if not len(known):
        return times[:0], values[:0]
    is_there = (times >= known[0] - margin_ns) & (times <= known[-1] + margin_ns)
    return times[is_there], values[is_there]
