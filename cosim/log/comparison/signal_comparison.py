"""A signal that two runs have, compared window by window."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds
from cosim.core.port import Port
from cosim.log.comparison.difference import DifferenceStatus, ElementDifference, SignalDifference
from cosim.log.comparison.pairing import Window, windows
from cosim.log.comparison.tolerances import Tolerances


def compare_signals(
    comparisons: Sequence[SignalComparison],
    a: Callable[[], Iterator[tuple[Nanoseconds, Matrix]]],
    b: Callable[[], Iterator[tuple[Nanoseconds, Matrix]]],
    tolerances: Tolerances,
    *,
    thinned: tuple[bool, bool],
    between: Callable[[Sequence[SignalComparison]], None] | None = None,
) -> dict[str, SignalDifference]:
    """Compare the signals of a component; leave out those whose sizes differ.

    ``a`` and ``b`` return the blocks of its rows in both runs, which need not have them all where
    they are ``thinned``. ``between`` compares them in another way than at the instants of both.
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
    if between is not None:
        between(same_size)
    else:
        for window in windows(a(), b()):
            for comparison in same_size:
                comparison.add(window)
    return {comparison.name: comparison.result(thinned) for comparison in same_size}


@final
class SignalComparison:
    """A signal that both runs have, compared window by window."""

    def __init__(self, name: str, columns_a: slice, columns_b: slice) -> None:
        self.name = name
        self.columns_a = columns_a
        self.columns_b = columns_b
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
        a = self.columns_a
        b = self.columns_b
        return bool(a.stop - a.start == b.stop - b.start)

    def extend_scale(self, rows: Matrix) -> None:
        """Take more rows of a into account."""
        values = rows[:, self.columns_a]
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
        values_a = rows_a[:, self.columns_a]
        values_b = rows_b[:, self.columns_b]
        if window.shared is not None:
            shared_a, shared_b = window.shared
            times = times[shared_a]
            values_a = values_a[shared_a]
            values_b = values_b[shared_b]
        self.count(len(rows_a), len(rows_b), len(times))
        apart = distance(values_a, values_b)
        self.take(times, (values_a, values_b), apart, by_bits=self._exact)

    def count(self, rows_a: int, rows_b: int, shared: int) -> None:
        """Count more rows: those of a, those of b, and those at instants of both."""
        count_a, count_b, count_shared = self._rows
        self._rows = (count_a + rows_a, count_b + rows_b, count_shared + shared)

    def take(
        self, times: Nanoseconds, values: tuple[Matrix, Matrix], apart: Matrix, *, by_bits: bool
    ) -> None:
        """Take values of both runs at some times, and how far they are apart."""
        same_bits = _bits(values[0]) == _bits(values[1])
        outside = ~same_bits
        if not by_bits:
            outside = ~(apart <= self._tolerance) | np.isinf(apart)
        self._same_bits = self._same_bits and bool(same_bits.all())
        self._largest = max(self._largest, float(apart.max(initial=0.0)))
        if self._first is None:
            self._first = _first_outside(self.name, outside, times, *values)

    def result(self, thinned: tuple[bool, bool]) -> SignalDifference:
        """Return how the signal compares in two runs, of which some lack rows."""
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


def distance(a: Matrix, b: Matrix) -> Matrix:
    """Compute |a - b|: 0 where both are NaN or the same infinity, infinite where only one is."""
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.abs(a - b)
    # Infinity minus itself is NaN, as is everything minus NaN: first what agrees, then the rest.
    both_nan = np.isnan(a) & np.isnan(b)
    apart[(a == b) | both_nan] = 0.0
    apart[np.isnan(apart)] = np.inf
    return apart


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
