"""Two recorded runs compared, signal by signal, at the times they share.

Without tolerances the comparison is of bits: 0.0 and -0.0 differ. With tolerances a pair of values
agrees where ``|a - b| <= atol + rtol * max|a|``, the maximum over all the signal's rows and
elements, or where both are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds, as_columns
from cosim.core.contracts import Recording
from cosim.core.port import Port
from cosim.core.recorded import find_signal
from cosim.errors import LogError

DifferenceStatus: TypeAlias = Literal[
    "equal", "within", "outside", "other times", "other size", "only in a", "only in b"
]

# Rows of a and of b at the same instants; None: all, one by one.
SharedRows: TypeAlias = tuple[NDArray[np.intp], NDArray[np.intp]] | None

_INSTANT = np.dtype([("time", "<i8"), ("count", "<i8")])


@dataclass(frozen=True, slots=True)
class ElementDifference:
    """One element of one signal at one instant of both runs."""

    signal: str  # component.signal, with the element's index
    time_ns: int
    a: float
    b: float


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
        ``other size``, ``only in a``, ``only in b``: not compared.
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
    """

    rows: tuple[SignalDifference, ...]
    atol: float
    rtol: float

    @property
    def equal(self) -> bool:
        """Whether all signals have the same bits at the same times."""
        return all(row.status == "equal" for row in self.rows)

    @property
    def within(self) -> bool:
        """Whether both runs have all signals at the same times, within the tolerance."""
        return all(row.status in {"equal", "within"} for row in self.rows)

    @property
    def first(self) -> ElementDifference | None:
        """The earliest time outside the tolerance; of several signals, the first row's."""
        candidates = [row.first for row in self.rows if row.first]
        return min(candidates, key=lambda element: element.time_ns, default=None)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        first = self.first
        signals = []
        for row in self.rows:
            signals.append({**asdict(row), "ratio": row.ratio})
        return {
            "equal": self.equal,
            "within": self.within,
            "atol": self.atol,
            "rtol": self.rtol,
            "first": None if first is None else asdict(first),
            "signals": signals,
        }


def diff(
    a: Recording,
    b: Recording,
    *,
    atol: float = 0.0,
    rtol: float = 0.0,
    signals: Sequence[str] = (),
) -> LogDifference:
    """Compare two runs signal by signal.

    Parameters
    ----------
    a, b : Recording
        ``a`` is the reference: the scales are those of its signals.
    atol : float
        In the unit of each signal.
    rtol : float
        As a part of each signal's largest |a|.
    signals : sequence of str
        The signals to compare, or elements of them, ``plant.x_a[0:2]``; none: all.

    Raises
    ------
    LogError
        If one of ``signals`` is in neither run; names the nearest.
    """
    sizes_a = _sizes(a)
    sizes_b = _sizes(b)
    if signals:
        sizes_a, sizes_b = _chosen(a, b, signals)
    # Once per component: its signals have the same instants.
    shared_rows: dict[str, SharedRows] = {}
    for component in a.channels:
        if component in b.channels:
            times_a = a.time_ns(component)
            times_b = b.time_ns(component)
            shared_rows[component] = _shared_rows(times_a, times_b)
    rows = []
    for name in dict.fromkeys(signals or [*sizes_a, *sizes_b]):
        size_a = sizes_a.get(name)
        size_b = sizes_b.get(name)
        if size_a is not None and size_a == size_b:
            shared = shared_rows[_component_of(name)]
            row = _compare(name, a, b, shared=shared, atol=atol, rtol=rtol)
        else:
            run_a = None if size_a is None else a
            run_b = None if size_b is None else b
            row = _not_compared(name, run_a, run_b)
        rows.append(row)
    return LogDifference(tuple(rows), atol, rtol)


def _sizes(run: Recording) -> dict[str, int]:
    """Return the sizes of all signals by ``component.signal``."""
    sizes = {}
    for channel in run.channels.values():
        for signal in channel.signals:
            sizes[f"{channel.name}.{signal.name}"] = signal.size
    return sizes


def _chosen(
    a: Recording, b: Recording, signals: Sequence[str]
) -> tuple[dict[str, int], dict[str, int]]:
    """Return the sizes of the chosen signals in a and in b, where these have them.

    Raises
    ------
    LogError
        If a signal is in neither of them.
    """
    sizes_a: dict[str, int] = {}
    sizes_b: dict[str, int] = {}
    for signal in signals:
        problem: LogError | None = None
        for run, sizes in ((a, sizes_a), (b, sizes_b)):
            try:
                _, columns = find_signal(run.channels, signal, source="the first run")
            except LogError as error:
                problem = problem or error  # of the reference, where neither has it
            else:
                sizes[signal] = columns.stop - columns.start
        if problem is not None and signal not in sizes_a and signal not in sizes_b:
            raise problem
    return sizes_a, sizes_b


def _component_of(name: str) -> str:
    return Port.parse(name).component


def _not_compared(name: str, a: Recording | None, b: Recording | None) -> SignalDifference:
    """Describe a signal that only one run has, or that the runs have with different sizes."""
    component = _component_of(name)
    rows_a = 0 if a is None else len(a.time_ns(component))
    rows_b = 0 if b is None else len(b.time_ns(component))
    status: DifferenceStatus = "other size"
    if b is None:
        status = "only in a"
    elif a is None:
        status = "only in b"
    return SignalDifference(name, status, (rows_a, rows_b, 0))


def _shared_rows(times_a: Nanoseconds, times_b: Nanoseconds) -> SharedRows:
    """Return the rows of a and of b that stand for the same instants."""
    if np.array_equal(times_a, times_b):
        return None
    instants_a = _instants(times_a)
    instants_b = _instants(times_b)
    _, rows_a, rows_b = np.intersect1d(
        instants_a, instants_b, assume_unique=True, return_indices=True
    )
    return rows_a, rows_b


def _instants(time_ns: Nanoseconds) -> NDArray[np.void]:
    """Return the times, the rows of one instant numbered, so that each limit of a jump is found.

    The times are in order: bisection finds the first row of an instant.
    """
    first_rows = np.searchsorted(time_ns, time_ns)
    instants = np.empty(len(time_ns), dtype=_INSTANT)
    instants["time"] = time_ns
    instants["count"] = np.arange(len(time_ns)) - first_rows
    return instants


def _compare(
    name: str, a: Recording, b: Recording, *, shared: SharedRows, atol: float, rtol: float
) -> SignalDifference:
    """Compare a signal that both runs have with the same size."""
    times = a.time_ns(_component_of(name))
    values_a = as_columns(a[name])
    values_b = as_columns(b[name])
    rows_a = len(values_a)
    rows_b = len(values_b)
    # Before the rows are selected: the scale is that of the whole signal.
    scale = _largest_finite(values_a)
    tolerance = atol + rtol * scale
    if shared is not None:
        shared_a, shared_b = shared
        times = times[shared_a]
        values_a = values_a[shared_a]
        values_b = values_b[shared_b]
    same_bits = _bits(values_a) == _bits(values_b)
    distance = _distance(values_a, values_b)
    if atol == 0.0 and rtol == 0.0:
        outside = ~same_bits
    else:
        outside = ~(distance <= tolerance) | np.isinf(distance)
    status = _status(outside, same_bits, same_times=shared is None)
    largest = float(distance.max(initial=0.0))
    first = _first_outside(name, outside, times, values_a, values_b)
    counts = (rows_a, rows_b, len(times))
    return SignalDifference(name, status, counts, largest, scale, tolerance, first)


def _largest_finite(values: Matrix) -> float:
    finite = values[np.isfinite(values)]
    return float(np.abs(finite).max(initial=0.0))


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


def _status(outside: Mask, same_bits: Mask, *, same_times: bool) -> DifferenceStatus:
    if outside.any():
        return "outside"
    if not same_times:
        return "other times"
    return "equal" if same_bits.all() else "within"


def _first_outside(
    name: str, outside: Mask, times: Nanoseconds, a: Matrix, b: Matrix
) -> ElementDifference | None:
    """Return the first time, and there the first element, outside the tolerance."""
    if not outside.any():
        return None
    size = outside.shape[1]
    row, column = divmod(int(outside.argmax()), size)
    element = name if size == 1 else _element(name, column)
    value_a = float(a[row, column])
    value_b = float(b[row, column])
    return ElementDifference(element, int(times[row]), value_a, value_b)


def _element(name: str, column: int) -> str:
    """Return the name of an element of a signal, or of a slice of one."""
    port = Port.parse(name)
    if isinstance(port.element, range):
        return str(replace(port, element=port.element[column]))
    return f"{name}[{column}]"
