"""A signal that two runs have, compared window by window.

Tolerances of a comparison: one for all signals, and others for some of them.

Rows of two runs at the instants that they share, one window of time after another.

A window ends before an instant that is not whole yet, so that the rows of a jump stay together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds
from cosim.core.port import Port
from cosim.core.recorded.joined_rows import numbered_instants
from cosim.core.recorded.selection import matches
from cosim.core.recording import TimedRows
from cosim.errors import LogError, UsageError, nearest, option
from cosim.log.difference import DifferenceStatus, ElementDifference, SignalDifference


@final
@dataclass(frozen=True, slots=True)
class Tolerances:
    """The tolerances of a comparison.

    Parameters
    ----------
    atol : float
        In the unit of each signal.
    rtol : float
        As a part of each signal's largest |a|.
    own : mapping of name or pattern to float
        Instead of both for the signals that it matches; of several the last. 0: their bits are
        compared.

    Raises
    ------
    UsageError
        If one is not a finite number >= 0.
    """

    atol: float = 0.0
    rtol: float = 0.0
    own: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_tolerance(option("atol"), self.atol)
        _check_tolerance(option("rtol"), self.rtol)
        if not isinstance(self.own, Mapping):
            raise UsageError(
                f"{option('tol')}: expected a mapping such as {{'plant.y': 1e-6}}, got {self.own!r}"
            )
        for name, value in self.own.items():
            _check_tolerance(option("tol", name), value)

    def of(self, signal: str) -> tuple[float, float]:
        """Return the absolute and the relative tolerance of a signal."""
        chosen = [value for pattern, value in self.own.items() if matches(pattern, signal)]
        return (chosen[-1], 0.0) if chosen else (self.atol, self.rtol)

    def check_used(self, signals: Sequence[str]) -> None:
        """Check that every tolerance is of a signal that is compared.

        Raises
        ------
        UsageError
            If one is not; names the nearest signal.
        """
        for pattern in self.own:
            if not any(matches(pattern, signal) for signal in signals):
                raise UsageError(
                    f"{option('tol', pattern)}: no compared signal has this name; "
                    f"{nearest(pattern, signals)}"
                )


def _check_tolerance(name: str, value: object) -> None:
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not 0.0 <= value < math.inf:  # type: ignore[operator]
        raise UsageError(f"{name}: expected a finite number >= 0, got {value!r}")


MOST_ROWS = 2**24  # of one instant


@dataclass(frozen=True, slots=True)
class Window:
    """What two runs have in a window of time.

    Parameters
    ----------
    a, b : TimedRows
        All rows of each.
    shared : (n,) arrays of rows of a and of b, or None
        Those of the same instants; None: all, one by one.
    """

    a: TimedRows
    b: TimedRows
    shared: tuple[NDArray[np.intp], NDArray[np.intp]] | None


def windows(a: Iterator[TimedRows], b: Iterator[TimedRows]) -> Iterator[Window]:
    """Yield the windows of two runs, whose blocks are in order of time.

    Raises
    ------
    LogError
        If one has more rows of one instant than can be kept.
    """
    first = WaitingRows(a)
    second = WaitingRows(b)
    while first.times.size or second.times.size:
        end = min(first.whole_before, second.whole_before)
        rows_a = first.take(end)
        rows_b = second.take(end)
        if len(rows_a[0]) or len(rows_b[0]):
            yield Window(rows_a, rows_b, _shared_rows(rows_a[0], rows_b[0]))


@final
class WaitingRows:
    """Rows that have been read and not yet taken.

    Parameters
    ----------
    blocks : iterator of (times [ns], rows)
        In order of time; one at least, which may have no rows.

    Raises
    ------
    LogError
        If there are more rows of one instant than can be kept.
    """

    def __init__(self, blocks: Iterator[tuple[Nanoseconds, Matrix]]) -> None:
        self._blocks = blocks
        self.times: Nanoseconds
        self.times, self._rows = next(blocks)
        self._next = self._next_block()
        if self._next is not None and not len(self.times):
            self._read_on(*self._next)

    @property
    def whole_before(self) -> float:
        """The instant before which all rows are here; infinite: these are all."""
        return np.inf if self._next is None else int(self.times[-1])

    def take(self, end: float) -> tuple[Nanoseconds, Matrix]:
        """Take the rows before an instant, and read on where none are left before it."""
        count = len(self.times)
        if end < np.inf:
            count = int(np.searchsorted(self.times, int(end)))
        taken = self.times[:count], self._rows[:count]
        self.times = self.times[count:]
        self._rows = self._rows[count:]
        # Rows of a single instant may have more after them: nothing could be taken but with those.
        if self._next is not None and (not len(self.times) or self.times[0] == self.times[-1]):
            self._read_on(*self._next)
        return taken

    def _read_on(self, times: Nanoseconds, rows: Matrix) -> None:
        if len(self.times) + len(times) > MOST_ROWS:
            raise LogError(
                f"more than {MOST_ROWS} rows at t = {int(times[0]) / 1e9} s: too many to be "
                "compared in memory"
            )
        self.times = np.concatenate([self.times, times])
        self._rows = np.concatenate([self._rows, rows])
        self._next = self._next_block()

    def _next_block(self) -> tuple[Nanoseconds, Matrix] | None:
        """Return the next block with rows; None: there is none."""
        return next((block for block in self._blocks if len(block[0])), None)


def _shared_rows(
    times_a: Nanoseconds, times_b: Nanoseconds
) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Return the rows of a and of b that stand for the same instants."""
    if np.array_equal(times_a, times_b):
        return None
    instants_a = numbered_instants(times_a)
    instants_b = numbered_instants(times_b)
    _, rows_a, rows_b = np.intersect1d(
        instants_a, instants_b, assume_unique=True, return_indices=True
    )
    return rows_a, rows_b


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
