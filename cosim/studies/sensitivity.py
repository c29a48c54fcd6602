"""Sobol indices: which share of the variance of a metric each parameter has.

The estimators are those of ``scipy.stats.sobol_indices`` and SALib: A. Saltelli et al., "Variance
based sensitivity analysis of model output. Design and estimator for the total sensitivity index",
Computer Physics Communications 181, 2010, table 2 (b) and (f). They are written out here because
scipy's want every base point, a power of two of them and more than one parameter, and because its
bootstrap takes memory that grows with the square of their number.

A base point is a row of the matrices A and B with its rows of AB_1, ..., AB_d, in each of which one
column comes from B. Where one of its members failed, or has no value, the whole base point is left
out. If parameters decide which members fail, those of the others are no longer independent of each
other, and the indices are biased: nothing in the values tells by how much.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import starmap
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError
from cosim.studies.layout import MemberColumns, NumberColumn, StudyLayout
from cosim.studies.statistics import NO_INTERVAL, TAIL, ConfidenceInterval, is_constant

_RESAMPLES: Final = 1000  # of the bootstrap


@dataclass(frozen=True)
class SobolIndices:
    """Sobol indices of a metric by parameter; ``omitted`` base points have no part in them.

    Intervals are percentiles of the bootstrap: rough, none of fewer than 64 base points.
    """

    metric: str
    parameters: tuple[str, ...]
    first_order: Vector
    total_order: Vector
    first_intervals: tuple[ConfidenceInterval, ...]
    total_intervals: tuple[ConfidenceInterval, ...]
    base_points: int
    omitted: NumberColumn

    @property
    def has_intervals(self) -> bool:
        """There are intervals."""
        return self.first_intervals[0] != NO_INTERVAL

    @property
    def remark(self) -> str:
        """What shows that there are too few base points: sums that no function has."""
        left_out = ", or those that were left out" if len(self.omitted) else ""
        total, first = float(self.total_order.sum()), float(self.first_order.sum())
        found = f"first orders sum to {first:.2f}, above 1" if first > 1.1 else ""
        found = f"total orders sum to {total:.2f}, below 1" if total < 0.9 else found
        return f"too few base points{left_out}: {found}" if found else ""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        names = ("first_order", "first_interval", "total_order", "total_interval")
        firsts = (self.first_order.tolist(), self.first_intervals)
        totals = (self.total_order.tolist(), self.total_intervals)
        rows = zip(*firsts, *totals, strict=True)
        return {
            "parameters": {
                parameter: dict(zip(names, row, strict=True))
                for parameter, row in zip(self.parameters, rows, strict=True)
            },
            "base_points": self.base_points,
            "omitted_base_points": self.omitted.tolist(),
            "remark": self.remark,
        }


def check_has_indices(layout: StudyLayout) -> None:
    """Raise a UsageError if a study has no design that Sobol indices can be found from."""
    if layout.kind != "saltelli":
        wanted = "the design 'saltelli' ([study] sampling = \"saltelli\")"
        raise UsageError(f"Sobol indices: expected {wanted}, got {layout.kind!r}")
    together = layout.seeds * layout.grid
    if together > 1:
        wanted = "one member per sample (no seeds, no lists of values besides the samples)"
        raise UsageError(f"Sobol indices: expected {wanted}, got {together}")


def sobol_indices(columns: MemberColumns, layout: StudyLayout, metric: str) -> SobolIndices:
    """Return the Sobol indices of a metric; UsageError if there are none."""
    check_has_indices(layout)
    columns.metric(metric)
    values = np.full(layout.samples, np.nan)
    values[columns.numbers] = columns.numeric(metric)
    matrices = values.reshape(layout.matrices, -1)
    complete = np.isfinite(matrices).all(axis=0)
    found = int(complete.sum())
    if found < 8:  # of fewer the indices are chance
        wanted = "at least 8 base points whose members all have a value"
        got = f"{found} of {layout.base_points}"
        raise UsageError(f"Sobol indices of {metric!r}: expected {wanted}, got {got}")
    kept = matrices[:, complete]
    first, total = _indices_of(kept, np.ones((1, found)))
    if is_constant(kept.ravel()) or not np.isfinite(first).all():
        wanted = "a metric that depends on the parameters"
        got = "the same value in all members"
        raise UsageError(f"Sobol indices of {metric!r}: expected {wanted}, got {got}")
    intervals = [(NO_INTERVAL,) * len(layout.parameters)] * 2
    if found >= 64:  # of fewer as few as 70 % of the intervals hold
        intervals = _bootstrap(kept)
    omitted = np.flatnonzero(~complete)
    indices = (first[0], total[0], intervals[0], intervals[1])
    return SobolIndices(metric, layout.parameters, *indices, found, omitted)


def _indices_of(values: Matrix, weights: Matrix) -> tuple[Matrix, Matrix]:
    """Return first and total order indices, each of shape (r, d).

    Parameters
    ----------
    values : Matrix, shape (d + 2, n)
        A metric in the rows of A, B, AB_1, ..., AB_d.
    weights : Matrix, shape (r, n)
        How often each base point counts, r times; each row sums to n.
    """
    count = values.shape[1]
    of_a, of_b, *_ = centered = values - values[:2].mean()
    differences = centered[2:] - of_a
    mean = weights @ (of_a + of_b) / (2.0 * count)
    variance = weights @ (of_a**2 + of_b**2) / (2.0 * count) - mean**2
    column = variance[:, np.newaxis]
    of_one = weights @ (of_b * differences).T / count
    with_others = weights @ (differences**2).T / (2.0 * count)
    with np.errstate(divide="ignore", invalid="ignore"):
        return of_one / column, with_others / column


def _bootstrap(values: Matrix) -> list[tuple[ConfidenceInterval, ...]]:
    """Return the intervals of first and total order indices, of resampled base points."""
    rng = np.random.default_rng(0)  # the same study has the same intervals
    count = values.shape[1]
    at_once = max(1, 2**22 // count)  # resamples: their counts take 32 MB
    found = []
    for start in range(0, _RESAMPLES, at_once):
        rows = min(at_once, _RESAMPLES - start)
        drawn = [np.bincount(rng.integers(count, size=count), minlength=count) for _ in range(rows)]
        found.append(_indices_of(values, np.array(drawn, np.float64)))
    ends = np.quantile(np.concatenate(found, axis=1), [TAIL, 1.0 - TAIL], axis=1)
    return [tuple(starmap(ConfidenceInterval, pairs)) for pairs in ends.transpose(1, 2, 0).tolist()]
