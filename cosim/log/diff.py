"""Two recorded runs compared, signal by signal, at the times they share, and event by event.

Of a partial log what it has is compared: signals that it did not record are left out, and so are
rows of the other run at instants at which it has none.

Without tolerances the comparison is of bits: 0.0 and -0.0 differ. With tolerances a pair of values
agrees where ``|a - b| <= atol + rtol * max|a|``, the maximum over all the signal's rows and
elements, or where both are NaN.

Signals compared between the instants of the second run, for runs of different instants.

Between two rows a continuous signal is a straight line, and any other keeps its value; where a
signal jumps, its later value counts. In a tube a value of the first run is right if the second has
it, within the tolerance, at some instant no farther away than the tube is wide.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cosim.arguments import number_argument, truth_argument
from cosim.arrays import Matrix, Nanoseconds
from cosim.core.port import Port
from cosim.core.recorded.partial import partial_of
from cosim.core.recorded.selection import is_pattern, matches
from cosim.core.recorded.signals import find_signal
from cosim.core.recording import Recording, TimedRows
from cosim.core.signals import Signal
from cosim.errors import LogError, UnknownSignalError, UsageError, nearest
from cosim.instants import NANOSECONDS
from cosim.log.difference import (
    LEFT_OUT,
    NOT_COMPARED,
    DifferenceStatus,
    EventsDifference,
    LogDifference,
    SignalDifference,
    compare_events,
)
from cosim.log.signal_comparison import SignalComparison, Tolerances, compare_signals, distance


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
        Absolute tolerances instead of both, for signals of a name or pattern (``*.delta``); of
        several that match the last. 0: the bits are compared.
    signals : sequence of str
        The signals to compare, elements of them, ``plant.x_a[0:2]``, or patterns; none: all.
    span_ns : (int, int), optional
        The first and the last instant [ns] that are compared.
    interpolate : bool
        Compare at every instant of a that lies within b: between its rows a continuous signal of b
        is a straight line, and any other keeps its value. Without it, runs are compared at the
        instants that they share.
    tube : float
        A value of a is right if b has it, within the tolerance, at some instant no farther away
        [s]; implies ``interpolate``. Events are not compared then, and the rows of a component are
        in memory.

    Raises
    ------
    LogError
        If a or b is not a recording, or one of ``signals`` is in neither; names the nearest. If an
        event is of no signal.
    UsageError
        If a tolerance is not a number >= 0, or is of no signal that is compared.
    """
    _check_recording("a", a)
    _check_recording("b", b)
    tolerance = Tolerances(atol, rtol, tol or {})
    _check_tube(tube)
    truth_argument("interpolate", interpolate)
    if signals:
        names = _expanded(a, b, [signals] if isinstance(signals, str) else signals)
        columns_a, columns_b = _chosen(a, b, names)
    else:
        columns_a = _all_columns(a)
        columns_b = _all_columns(b)
        names = list(dict.fromkeys([*columns_a, *columns_b]))
    tolerance.check_used(names)
    rows: dict[str, SignalDifference] = {}
    tube_ns = round(tube * NANOSECONDS) if interpolate or tube else None
    for component, pairs in _pairs_by_component(names, columns_a, columns_b).items():
        blocks = (partial(_blocks, a, component, span_ns), partial(_blocks, b, component, span_ns))
        between = None if tube_ns is None else partial(_compare_between, a, blocks, tube_ns)
        thinned = (_is_thinned(a, component), _is_thinned(b, component))
        rows.update(compare_signals(pairs, *blocks, tolerance, thinned=thinned, between=between))
    for name in names:
        if name not in rows:
            rows[name] = _not_compared(name, (a, columns_a), (b, columns_b), span_ns)
    if rows and all(row.status in LEFT_OUT for row in rows.values()):
        raise LogError(
            f"{a.label} and {b.label} have no recorded signal in common: one of them is partial"
        )
    tolerances: dict[str, float | None] = {}
    for name, row in rows.items():
        if row.status not in NOT_COMPARED:
            tolerances[name] = row.tolerance if any(tolerance.of(name)) else None
    events = EventsDifference()
    if tube_ns is None:
        events = compare_events((a, b), (columns_a, columns_b), tolerances, span_ns)
    return LogDifference(tuple(rows[name] for name in names), atol, rtol, events, tolerance.own)


def _check_tube(tube: object) -> None:
    width = number_argument("tube", tube)
    if not 0.0 <= width < math.inf:
        raise UsageError(f"tube: expected a finite number of seconds >= 0, got {tube!r}")


def _compare_between(
    a: Recording,
    blocks: Sequence[Callable[[], Iterator[TimedRows]]],
    tube_ns: int,
    comparisons: Sequence[SignalComparison],
) -> None:
    signals = []
    for comparison in comparisons:
        signals.append(find_signal(a.channels, comparison.name, source="the first run").signal)
    compare_between(comparisons, blocks[0](), blocks[1](), signals, tube_ns)


def _is_thinned(run: Recording, component: str) -> bool:
    """Return whether a run lacks rows of a component."""
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
) -> dict[str, list[SignalComparison]]:
    """Return a comparison of every signal that both runs have, by component."""
    pairs: dict[str, list[SignalComparison]] = {}
    for name in names:
        if name in columns_a and name in columns_b:
            comparison = SignalComparison(name, columns_a[name], columns_b[name])
            pairs.setdefault(_component_of(name), []).append(comparison)
    return pairs


def _check_recording(name: str, run: object) -> None:
    if getattr(type(run), "blocks", None) is None:
        found = type(run).__name__
        raise LogError(
            f"{name}: expected a recording, got {found} {run!r}; open a log with "
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
                    f"no signal of either run matches {signal!r}; {nearest(signal, known)}"
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
            raise LogError(f"expected the name of a signal, such as 'plant.y', got {signal!r}")
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
    name: str,
    a: tuple[Recording, Mapping[str, slice]],
    b: tuple[Recording, Mapping[str, slice]],
    span_ns: tuple[int, int] | None,
) -> SignalDifference:
    """Describe a signal that only one run has, or that the runs have with different sizes."""
    counts = []
    for run, columns in (a, b):
        blocks = _blocks(run, _component_of(name), span_ns) if name in columns else iter(())
        counts.append(_count(blocks))
    status: DifferenceStatus = "other size"
    if name not in b[1]:
        status = "not recorded in b" if _was_left_out(b[0], name) else "only in a"
    elif name not in a[1]:
        status = "not recorded in a" if _was_left_out(a[0], name) else "only in b"
    return SignalDifference(name, status, (counts[0], counts[1], 0))


def _blocks(
    run: Recording, component: str, span_ns: tuple[int, int] | None
) -> Iterator[tuple[Nanoseconds, Matrix]]:
    """Return times and rows of a component, or those of a span of time, some at a time."""
    first_ns, last_ns = (None, None) if span_ns is None else span_ns
    return run.blocks(component, first_ns=first_ns, last_ns=last_ns)


def _count(blocks: Iterator[tuple[Nanoseconds, Matrix]]) -> int:
    return sum(len(times) for times, _ in blocks)
