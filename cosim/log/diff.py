"""Two recorded runs compared, signal by signal, at the times they share.

Without tolerances the comparison is of bits: 0.0 and -0.0 differ. With tolerances a pair of values agrees where
``|a - b| <= atol + rtol * max|a|``, the maximum over all the signal's rows and elements, or where both are NaN.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds
from cosim.core.contracts import Recording
from cosim.core.signals import Signal

Status = Literal[
    "equal", "within", "outside", "other times", "other size", "only in a", "only in b"
]


@dataclass(frozen=True, slots=True)
class Moment:
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
        ``equal``: the same bits at the same times; ``within`` or ``outside`` the tolerance; ``other times``: within it where
        both have values, but they have not the same instants; ``other size``, ``only in a``, ``only in b``: not compared.
    rows : tuple of int
        Numbers of rows in a and in b, and at times they share.
    largest : float
        Largest |a - b|; infinite where one alone is NaN or infinite.
    scale : float
        Largest finite |a|.
    tolerance : float
        What |a - b| was compared with.
    first : Moment or None
        The first time outside the tolerance.
    """

    signal: str
    status: Status
    rows: tuple[int, int, int]
    largest: float = 0.0
    scale: float = 0.0
    tolerance: float = 0.0
    first: Moment | None = None

    @property
    def ratio(self) -> float:
        """``largest`` as a part of ``scale``."""
        if self.largest == 0.0:
            return 0.0
        return self.largest / self.scale if self.scale else float("inf")


@dataclass(frozen=True, slots=True)
class LogDifference:
    """How two runs compare, signal by signal."""

    rows: tuple[SignalDifference, ...]
    atol: float
    rtol: float

    @property
    def equal(self) -> bool:
        """Whether all signals have the same bits at the same times."""
        return all(row.status == "equal" for row in self.rows)

    @property
    def within(self) -> bool:
        """Whether all signals are there at the same times, within the tolerance."""
        return all(row.status in {"equal", "within"} for row in self.rows)

    @property
    def first(self) -> Moment | None:
        """The earliest time outside the tolerance; of several, the first signal's in the order of a."""
        return min(
            (row.first for row in self.rows if row.first),
            key=lambda moment: moment.time_ns,
            default=None,
        )

    def to_dict(self) -> dict[str, Any]:
        """Give everything as JSON values."""
        rows = [{**asdict(row), "ratio": row.ratio} for row in self.rows]
        first = asdict(self.first) if self.first else None
        return {
            "equal": self.equal,
            "within": self.within,
            "atol": self.atol,
            "rtol": self.rtol,
            "first": first,
            "signals": rows,
        }


def diff(a: Recording, b: Recording, *, atol: float = 0.0, rtol: float = 0.0) -> LogDifference:
    """Compare two runs signal by signal.

    Parameters
    ----------
    a, b : Recording
        ``a`` is the reference: its signals give the scales.
    atol : float
        In the unit of each signal.
    rtol : float
        As a part of each signal's largest |a|.
    """
    sizes = [
        {f"{c.name}.{s.name}": (c.name, s) for c in run.channels.values() for s in c.signals}
        for run in (a, b)
    ]
    shared = {
        name: _shared(a.time_ns(name), b.time_ns(name)) for name in a.channels if name in b.channels
    }
    rows = []
    for name in [*sizes[0], *(name for name in sizes[1] if name not in sizes[0])]:
        component, signal = sizes[0].get(name) or sizes[1][name]
        if name not in sizes[1]:
            rows.append(SignalDifference(name, "only in a", (len(a.time_ns(component)), 0, 0)))
        elif name not in sizes[0]:
            rows.append(SignalDifference(name, "only in b", (0, len(b.time_ns(component)), 0)))
        elif signal.size != sizes[1][name][1].size:
            rows.append(
                SignalDifference(
                    name, "other size", (len(a.time_ns(component)), len(b.time_ns(component)), 0)
                )
            )
        else:
            pair = a[name].reshape(-1, signal.size), b[name].reshape(-1, signal.size)
            rows.append(
                _compare(
                    name,
                    signal,
                    pair,
                    times=a.time_ns(component),
                    shared=shared[component],
                    tol=(atol, rtol),
                )
            )
    return LogDifference(tuple(rows), atol, rtol)


Shared = (
    tuple[NDArray[np.intp], NDArray[np.intp]] | None
)  # rows of a and of b at the same instants; None: all, one by one


def _shared(a: Nanoseconds, b: Nanoseconds) -> Shared:
    if np.array_equal(a, b):
        return None
    _, rows_a, rows_b = np.intersect1d(
        _instants(a), _instants(b), assume_unique=True, return_indices=True
    )
    return rows_a, rows_b


def _instants(time_ns: Nanoseconds) -> NDArray[np.void]:
    """Tell rows of one instant (both limits of a jump) apart by counting them; times are in order."""
    instants = np.empty(len(time_ns), dtype=[("time", "<i8"), ("count", "<i8")])
    instants["time"] = time_ns
    instants["count"] = np.arange(len(time_ns)) - np.searchsorted(time_ns, time_ns)
    return instants


def _compare(
    name: str,
    signal: Signal,
    pair: tuple[Matrix, Matrix],
    *,
    times: Nanoseconds,
    shared: Shared,
    tol: tuple[float, float],
) -> SignalDifference:
    a, b = pair
    finite = np.abs(a[np.isfinite(a)])
    scale = float(finite.max()) if finite.size else 0.0
    if shared is not None:
        times, a, b = times[shared[0]], a[shared[0]], b[shared[1]]
    tolerance = tol[0] + tol[1] * scale
    bits = np.ascontiguousarray(a).view(np.int64) == np.ascontiguousarray(b).view(np.int64)
    with np.errstate(invalid="ignore", over="ignore"):
        distance = np.where(bits | (a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
    distance[np.isnan(distance)] = np.inf
    outside = ~bits if tol == (0.0, 0.0) else ~(distance <= tolerance) | np.isinf(distance)
    status: Status = "outside" if outside.any() else "equal" if bits.all() else "within"
    if shared is not None and status != "outside":
        status = "other times"
    largest = float(distance.max()) if distance.size else 0.0
    count = (len(pair[0]), len(pair[1]), len(times))
    return SignalDifference(
        name, status, count, largest, scale, tolerance, _first(name, signal, outside, (times, a, b))
    )


def _first(
    name: str, signal: Signal, outside: Mask, values: tuple[Nanoseconds, Matrix, Matrix]
) -> Moment | None:
    """Give the first time, and there the first element, that is outside."""
    if not outside.any():
        return None
    times, a, b = values
    row, column = divmod(int(outside.argmax()), signal.size)
    element = name if signal.size == 1 else f"{name}[{column}]"
    return Moment(element, int(times[row]), float(a[row, column]), float(b[row, column]))
