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
from cosim.log.between import distance, distance_within, held_elements, measured, values_at
from cosim.log.difference import DifferenceStatus, ElementDifference, SignalDifference
from cosim.log.text import exact_seconds
from cosim.units import Conversion

_Extent: TypeAlias = tuple[int, ...]  # first and last instant [ns]; empty: there is none


def _extended(span: _Extent, times: Nanoseconds) -> _Extent:
    """Return a span that has more times, too."""
    if not len(times):
        return span
    return min([*span, int(times[0])]), max([*span, int(times[-1])])


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
    spans: tuple[_Extent, _Extent] = ((), ())  # of a and b
    is_longer_in_b: bool = False  # b has rows before or after all of a, which are not compared

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

    def extend_spans(self, a: Nanoseconds, b: Nanoseconds) -> None:
        """Take more instants of both into account."""
        self.spans = _extended(self.spans[0], a), _extended(self.spans[1], b)

    @property
    def not_compared(self) -> str:
        """What is not, as the other run has nothing there; empty: nothing."""
        if not all(self.spans):
            return ""
        in_a, in_b = (" s to ".join(exact_seconds(np.array(span))) for span in self.spans)
        if not self.rows[2]:
            return f"no instant in common, a has rows from {in_a} s, b from {in_b} s"
        return f"b has rows from {in_b} s, a only from {in_a} s" if self.is_longer_in_b else ""

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
        if apart is None and (self.a.signal.optional or self.b.signal.optional):
            sizes[is_absent(a) != is_absent(b)] = np.inf
        outside = ~same_bits if by_bits else np.isinf(sizes) | ~(sizes <= self.tolerance)
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
        elif any(self.rows) and not self.rows[2]:  # one of them is thinned
            status = "not recorded in b" if self.rows[0] else "not recorded in a"
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
) -> None:
    """Compare signals of one component of each; ``tube_ns`` is None at shared instants."""
    first = group[0]
    if tube_ns is None and any(pair.rtol for pair in group):  # of the scale of the whole signal
        for _, rows in blocks_of_port(a, first.a, span_ns):
            for pair in group:
                pair.extend_scale(rows)
    blocks = blocks_of_port(a, first.a, span_ns), blocks_of_port(b, first.b, span_ns)
    thinned = _is_thinned(a, first.a), _is_thinned(b, first.b)
    if tube_ns is None:
        _compare_shared(group, *blocks, thinned)
        return
    (times_a, rows_a), (times_b, rows_b) = map(joined, blocks)
    for pair in group:
        pair.extend_scale(rows_a)
        values_a, values_b = rows_a[:, pair.a.columns], pair.converted(rows_b[:, pair.b.columns])
        nan_is_gap = any(
            port.signal.optional and run.left_out is None
            for run, port in ((a, pair.a), (b, pair.b))
        )
        held = zip(held_elements(a, pair.a), held_elements(b, pair.b), strict=True)
        for element, is_held in enumerate(map(any, held)):
            one = measured(times_a, values_a[:, element], nan_is_gap)
            other = measured(times_b, values_b[:, element], nan_is_gap)
            _compare_element(pair, element, one, other, not is_held, tube_ns, thinned[1])


# --- at the instants of both ---


def _compare_shared(
    group: Sequence[Pair],
    a: Iterator[TimedRows],
    b: Iterator[TimedRows],
    thinned: tuple[bool, bool],
) -> None:
    """Compare signals of a component of each; a run that is thinned need not have all rows."""
    for (times_a, rows_a), (times_b, rows_b) in windows(a, b):
        shared = _shared(times_a, times_b)
        for pair in group:
            pair.extend_scale(rows_a)
            one = _present(pair.a, times_a, rows_a)
            other = _present(pair.b, times_b, rows_b)
            is_whole = one[0] is times_a and other[0] is times_b
            own_a, own_b = shared if is_whole else _shared(one[0], other[0])
            times = one[0][own_a]
            pair.add_rows(len(one[0]), len(other[0]), len(times))
            pair.extend_spans(one[0], other[0])
            pair.take(times, one[1][own_a], pair.converted(other[1])[own_b])
    for pair in group:
        in_a, in_b, compared = pair.rows
        pair.has_other_times = (
            (in_a > compared and not thinned[1])
            or (in_b > compared and not thinned[0])
            or bool(in_a and in_b and not compared)
        )


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


def _compare_element(
    pair: Pair,
    element: int,
    a: tuple[Nanoseconds, Vector],
    b: tuple[Nanoseconds, Vector],
    is_line: bool,
    tube_ns: int,
    b_is_thinned: bool,
) -> None:
    """Compare an element at all instants of a that lie within b, or near it.

    In a tube those of b within a are compared with what a has near them: between the instants of a
    around them, at least, as what a has there is not known.
    """
    known_a, _ = a
    known_b, _ = b
    pair.extend_spans(known_a, known_b)
    pair.is_longer_in_b |= bool(
        len(known_a) and len(known_b) and (known_b[0] < known_a[0] or known_b[-1] > known_a[-1])
    )
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
