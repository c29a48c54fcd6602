"""What a recorded signal is between its rows, and how far values are from what it has near them.

A continuous signal is a straight line between two rows, any other keeps its value; so does an input
that was held, and what is made of such inputs alone. A jump has two rows of one time, and of a line
all values between them, as another tool may have a steep slope there. NaN is a value, and so are
the lines to it.

Functions are of one element; times ascend.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Nanoseconds, Vector, is_absent
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.signals import RecordedPort, own_columns
from cosim.core.recording import Recording

_Time = TypeVar("_Time", np.int64, np.float64)


def held_elements(run: Recording, port: RecordedPort) -> list[bool]:
    """Return which elements of a signal keep their value between two rows."""
    signal = port.signal
    if signal.type != "real" or signal.variability == "discrete":
        return [True] * port.size
    name = port.channel.name
    of_inputs = run.held[name]
    columns = declared_channels(run.channels)[name].interface.input_columns().get(signal.name)
    if columns is not None:
        first = port.columns.start - own_columns(port.channel, signal).start
        return [bool(held) for held in of_inputs[columns][first : first + port.size]]
    is_held = signal.variability == "inherited" and len(of_inputs) > 0 and bool(of_inputs.all())
    return [is_held] * port.size


def measured(times: Nanoseconds, values: Vector, nan_is_gap: bool) -> tuple[Nanoseconds, Vector]:
    """Return the rows of an element, without those in which it has no value."""
    is_gap = np.isnan(values) if nan_is_gap else is_absent(values)
    return (times[~is_gap], values[~is_gap]) if is_gap.any() else (times, values)


def values_at(
    times: NDArray[_Time], known: NDArray[_Time], values: Vector, is_line: bool
) -> Vector:
    """Return values at times, beyond those that are known the nearest.

    At a jump it is the last value, but for times that come again those before it, in their order.
    """
    number = np.arange(len(times)) - np.searchsorted(times, times)
    comes_again = np.append(times[1:] == times[:-1], False)
    times = np.clip(times, known[0], known[-1])
    before = np.searchsorted(known, times, side="right") - 1
    earlier = np.searchsorted(known, times, side="left") + number
    before = np.where(comes_again, np.minimum(earlier, before), before)
    found: Vector = values[before]
    between = np.flatnonzero(known[before] != times)
    if is_line and len(between):
        first = before[between]
        part = (times[between] - known[first]) / (known[first + 1] - known[first])
        with np.errstate(invalid="ignore", over="ignore"):
            found[between] = values[first] + part * (values[first + 1] - values[first])
    return found


def distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute |a - b|: 0 where both are NaN or the same infinity, infinite where only one is."""
    with np.errstate(invalid="ignore", over="ignore"):
        apart: NDArray[np.float64] = np.abs(a - b)
    # Infinity minus itself is NaN, as is everything minus NaN: first what agrees, then the rest.
    apart[(a == b) | (np.isnan(a) & np.isnan(b))] = 0.0
    apart[np.isnan(apart)] = np.inf
    return apart


def distance_within(
    values: Vector,
    span: tuple[Nanoseconds, Nanoseconds],
    known: Nanoseconds,
    rows: Vector,
    is_line: bool,
) -> Vector:
    """Return how far values are from the nearest that a signal has in a span of time around each.

    Parameters
    ----------
    values : Vector, shape (n,)
    span : (Nanoseconds, Nanoseconds), each of shape (n,)
        Where it begins and ends for each value; both ascend.
    known, rows : Nanoseconds and Vector, shape (N,)
        Instants and values of the signal.
    is_line : bool
    """
    return (
        _from_lines(values, span, known, rows) if is_line else _from_held(values, span, known, rows)
    )


def _from_held(
    values: Vector, span: tuple[Nanoseconds, Nanoseconds], known: Nanoseconds, rows: Vector
) -> Vector:
    begin, end = span
    first = np.searchsorted(known, begin, side="left")
    stop = np.searchsorted(known, end, side="right")
    # what a row before the span has set is there, too, unless the span begins with another row
    is_row = (first < len(known)) & (known[np.minimum(first, len(known) - 1)] == begin)
    first = np.where(is_row, first, np.maximum(first - 1, 0))
    apart = np.full(len(values), np.inf)
    for number in range(int((stop - first).max(initial=0))):
        near = np.flatnonzero(first + number < stop)
        held = distance(values[near], rows[first[near] + number])
        apart[near] = np.minimum(apart[near], held)
    return apart


def _from_lines(
    values: Vector, span: tuple[Nanoseconds, Nanoseconds], known: Nanoseconds, rows: Vector
) -> Vector:
    begin, end = span
    apart = np.full(len(values), np.inf)
    is_nan = np.isnan(rows)
    if is_nan.any():
        number = np.append(0, np.cumsum(is_nan))
        first = np.searchsorted(known, begin, side="left")
        stop = np.searchsorted(known, end, side="right")
        ends = [np.isnan(values_at(at, known, rows, is_line=True)) for at in span]
        apart[np.isnan(values) & (ends[0] | ends[1] | (number[stop] > number[first]))] = 0.0
    for piece in _pieces(is_nan):
        own_known, own_rows = known[piece], rows[piece]
        near = slice(
            int(np.searchsorted(end, own_known[0], side="left")),
            int(np.searchsorted(begin, own_known[-1], side="right")),
        )
        if near.start >= near.stop:
            continue
        lower, upper = _bounds(own_known, own_rows, begin[near], end[near])
        found = distance(values[near], np.clip(values[near], lower, upper))
        found[np.isnan(values[near])] = np.inf
        apart[near] = np.minimum(apart[near], found)
    return apart


def _pieces(is_nan: Mask) -> Iterator[slice]:
    """Yield the rows of lines that hang together: there are none to and from NaN."""
    edges = np.flatnonzero(np.diff(is_nan, prepend=True, append=True)).tolist()
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        yield slice(start, stop)


def _bounds(
    known: Nanoseconds, rows: Vector, begin: Nanoseconds, end: Nanoseconds
) -> tuple[Vector, Vector]:
    """Return the lowest and the highest value of lines in spans that have a part of them."""
    at_begin, at_end = (values_at(at, known, rows, is_line=True) for at in (begin, end))
    lower, upper = np.minimum(at_begin, at_end), np.maximum(at_begin, at_end)
    first = np.searchsorted(known, begin, side="left")
    stop = np.searchsorted(known, end, side="right")
    near = np.flatnonzero(stop > first)
    if len(near):
        bounds = np.stack([first[near], stop[near]], axis=1).ravel()
        padded = np.append(rows, rows[-1])  # reduceat takes no end behind the last row
        lower[near] = np.minimum(lower[near], np.minimum.reduceat(padded, bounds)[::2])
        upper[near] = np.maximum(upper[near], np.maximum.reduceat(padded, bounds)[::2])
    return lower, upper
