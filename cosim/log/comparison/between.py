"""Signals compared between the instants of the second run, for runs of different instants.

Between two rows a continuous signal is a straight line, and any other keeps its value; where a
signal jumps, its later value counts. In a tube a value of the first run is right if the second has
it, within the tolerance, at some instant no farther away than the tube is wide.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.signals import Signal
from cosim.log.comparison.signal_comparison import SignalComparison, distance
from cosim.log.reading.rows import TimedRows


def compare_between(
    comparisons: Sequence[SignalComparison],
    a: Iterator[TimedRows],
    b: Iterator[TimedRows],
    signals: Sequence[Signal],
    tube_ns: int,
) -> None:
    """Compare signals of a component at all instants of a that lie within b.

    Parameters
    ----------
    comparisons : sequence of SignalComparison
        Of one size in both runs.
    a, b : iterators of times [ns] and rows
        Of the component in both.
    signals : sequence of Signal
        Of the comparisons, as a declares them.
    tube_ns : int
        Half its width [ns].
    """
    times_a, rows_a = _joined(a)
    times_b, rows_b = _joined(b)
    inside = np.zeros(len(times_a), np.bool_)
    if len(times_b):
        inside = (times_a >= times_b[0]) & (times_a <= times_b[-1])
    times = times_a[inside]
    for comparison, signal in zip(comparisons, signals, strict=True):
        is_line = signal.type == "real" and signal.variability != "discrete"
        values_a = rows_a[inside, comparison.columns_a]
        own = rows_b[:, comparison.columns_b]
        values_b = _at(times, times_b, own, is_line=is_line) if len(times) else own[:0]
        apart = distance(values_a, values_b)
        if tube_ns and len(times):
            ends = [
                _at(np.clip(times + by, times_b[0], times_b[-1]), times_b, own, is_line=is_line)
                for by in (-tube_ns, tube_ns)
            ]
            apart = np.minimum(apart, _from_tube(values_a, times, times_b, own, ends, tube_ns))
        comparison.extend_scale(rows_a)
        comparison.take(times, (values_a, values_b), apart, by_bits=False)
        comparison.count(len(times_a), len(times), len(times))


def _joined(blocks: Iterator[TimedRows]) -> TimedRows:
    parts = list(blocks)
    return np.concatenate([times for times, _ in parts]), np.concatenate(
        [rows for _, rows in parts]
    )


def _at(times: Nanoseconds, known: Nanoseconds, values: Matrix, *, is_line: bool) -> Matrix:
    """Return values at times within those that are known, shape (n, size)."""
    before = np.searchsorted(known, times, side="right") - 1
    found: Matrix = values[before]
    between = np.flatnonzero(known[before] != times)
    if is_line and len(between):
        first = before[between]
        width = (known[first + 1] - known[first])[:, np.newaxis]
        part = (times[between] - known[first])[:, np.newaxis] / width
        with np.errstate(invalid="ignore", over="ignore"):
            found[between] = values[first] + part * (values[first + 1] - values[first])
    return found


def _from_tube(
    values: Matrix,
    times: Nanoseconds,
    known: Nanoseconds,
    rows: Matrix,
    ends: Sequence[Matrix],
    tube_ns: int,
) -> Matrix:
    """Return how far values are from what the other run has around their times; inside it 0."""
    first = np.searchsorted(known, times - tube_ns, side="left")
    stop = np.searchsorted(known, times + tube_ns, side="right")
    lower, upper = np.fmin(*ends), np.fmax(*ends)
    has_rows = np.flatnonzero(stop > first)
    if len(has_rows):
        bounds = np.stack([first[has_rows], stop[has_rows]], axis=1).ravel()
        padded = np.concatenate([rows, rows[-1:]])  # reduceat takes no end behind the last row
        lower[has_rows] = np.fmin(lower[has_rows], np.fmin.reduceat(padded, bounds)[::2])
        upper[has_rows] = np.fmax(upper[has_rows], np.fmax.reduceat(padded, bounds)[::2])
    with np.errstate(invalid="ignore"):
        apart = np.fmax(np.fmax(lower - values, values - upper), 0.0)
    apart[np.isnan(values) | np.isnan(lower)] = np.inf
    result: NDArray[np.float64] = apart
    return result
