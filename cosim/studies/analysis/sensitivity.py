"""Sobol indices: which share of the variance of a metric each parameter has.

The estimators are those of ``scipy.stats.sobol_indices``: A. Saltelli et al., "Variance based
sensitivity analysis of model output. Design and estimator for the total sensitivity index",
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
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError
from cosim.studies.analysis.columns import (
    MemberColumns,
    NumberColumn,
    exact_scale,
    is_constant,
)
from cosim.studies.analysis.confidence import NO_INTERVAL, ConfidenceInterval
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.analysis.interval_quantiles import TAIL

RESAMPLES: Final = 1000  # of the bootstrap
_SUM_TOLERANCE: Final = 0.1  # of sums of indices: those of additive functions are 1
_SEED: Final = 0  # of the bootstrap: the same study has the same intervals
_LEAST: Final = 8  # base points: of fewer the indices are chance
_LEAST_FOR_INTERVALS: Final = 64  # base points: of fewer as few as 70 % of the intervals hold
_LARGEST_BLOCK: Final = 2**22  # counts of resampled base points at a time


@dataclass(frozen=True)
class SobolIndices:
    """The Sobol indices of a metric.

    Parameters
    ----------
    metric : str
    parameters : tuple of str, length d
    first_order, total_order : Vector, shape (d,)
        Share of the variance that a parameter has alone; with everything that it does together
        with others. Estimates: they can be below 0 or above 1.
    first_intervals, total_intervals : tuple of ConfidenceInterval, length d
        95 %, by a bootstrap over base points as if these were independent: rough. Of the Ishigami
        and the g function 85 to 100 % of those of each index hold, from 64 base points on; there
        are none of fewer.
    base_points : int
        That were complete.
    omitted : NumberColumn
        The base points that were left out, because a member of theirs has no value.
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
    def remark(self) -> str:
        """What shows that the base points are too few; empty: nothing does.

        Of independent parameters total orders sum to 1 at least, first orders to 1 at most.
        """
        cause = "too few base points"
        if len(self.omitted):
            cause += ", or those that were left out"
        total = float(self.total_order.sum())
        if total < 1.0 - _SUM_TOLERANCE:
            return f"{cause}: total orders sum to {total:.2f}, below 1"
        first = float(self.first_order.sum())
        if first > 1.0 + _SUM_TOLERANCE:
            return f"{cause}: first orders sum to {first:.2f}, above 1"
        return ""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        rows = {}
        for index, parameter in enumerate(self.parameters):
            rows[parameter] = {
                "first_order": float(self.first_order[index]),
                "first_interval": self.first_intervals[index].to_list(),
                "total_order": float(self.total_order[index]),
                "total_interval": self.total_intervals[index].to_list(),
            }
        return {
            "parameters": rows,
            "base_points": self.base_points,
            "omitted_base_points": self.omitted.tolist(),
            "remark": self.remark,
        }


def sobol_indices(columns: MemberColumns, layout: StudyLayout, metric: str) -> SobolIndices:
    """Return the Sobol indices of a metric of a study.

    Raises
    ------
    UsageError
        If the design of the study is none of Saltelli's, or a sample has several members; if there
        is no such metric, it has one value everywhere, or too few base points are complete.
    """
    check_has_indices(layout)
    columns.metric(metric)
    matrices = _matrices(columns, layout, metric)
    complete = np.isfinite(matrices).all(axis=0)
    omitted = np.flatnonzero(~complete).astype(np.int64)
    found = int(complete.sum())
    if found < _LEAST:
        raise UsageError(
            f"Sobol indices of {metric!r}: expected at least {_LEAST} base points whose members "
            f"all have a value, got {found} of {layout.base_points}"
        )
    values = matrices[:, complete]
    values = values / exact_scale(values)
    first, total = indices_of(values, np.ones((1, found)))
    if is_constant(values.ravel()) or not np.isfinite(first).all():
        raise UsageError(
            f"Sobol indices of {metric!r}: expected a metric that depends on the parameters, got "
            "the same value in all members"
        )
    first_intervals: tuple[ConfidenceInterval, ...] = (NO_INTERVAL,) * len(first[0])
    total_intervals = first_intervals
    if found >= _LEAST_FOR_INTERVALS:
        firsts, totals = bootstrap(values)
        first_intervals = _percentiles(firsts)
        total_intervals = _percentiles(totals)
    return SobolIndices(
        metric=metric,
        parameters=layout.parameters,
        first_order=first[0],
        total_order=total[0],
        first_intervals=first_intervals,
        total_intervals=total_intervals,
        base_points=found,
        omitted=omitted,
    )


def check_has_indices(layout: StudyLayout) -> None:
    """Raise UsageError if a study has no design that Sobol indices can be found from."""
    if layout.kind != "saltelli":
        raise UsageError(
            "Sobol indices: expected the design 'saltelli' ([study] sampling = \"saltelli\"), got "
            f"{layout.kind!r}"
        )
    together = layout.seeds * layout.grid
    if together > 1:
        raise UsageError(
            "Sobol indices: expected one member per sample (no seeds and no lists of values "
            f"besides the samples), got {together}"
        )


def indices_of(values: Matrix, weights: Matrix) -> tuple[Matrix, Matrix]:
    """Return first and total order indices, each of shape (r, d).

    Parameters
    ----------
    values : Matrix, shape (d + 2, n)
        A metric in the rows of A, B, AB_1, ..., AB_d.
    weights : Matrix, shape (r, n)
        How often each base point counts, r times; each row sums to n.
    """
    count = values.shape[1]
    centered = values - values[:2].mean()
    of_a = centered[0]
    of_b = centered[1]
    differences = centered[2:] - of_a
    mean = weights @ (of_a + of_b) / (2.0 * count)
    variance = weights @ (of_a**2 + of_b**2) / (2.0 * count) - mean**2
    column = variance[:, np.newaxis]
    of_one = weights @ (of_b * differences).T / count
    with_others = weights @ (differences**2).T / (2.0 * count)
    with np.errstate(divide="ignore", invalid="ignore"):
        return of_one / column, with_others / column


def bootstrap(values: Matrix, *, resamples: int = RESAMPLES) -> tuple[Matrix, Matrix]:
    """Return the indices of base points that were drawn again, each of shape (resamples, d)."""
    rng = np.random.default_rng(_SEED)
    count = values.shape[1]
    at_once = max(1, _LARGEST_BLOCK // count)
    firsts = []
    totals = []
    for start in range(0, resamples, at_once):
        rows = min(at_once, resamples - start)
        drawn = [np.bincount(rng.integers(count, size=count), minlength=count) for _ in range(rows)]
        first, total = indices_of(values, np.array(drawn, np.float64))
        firsts.append(first)
        totals.append(total)
    return np.concatenate(firsts), np.concatenate(totals)


def _matrices(columns: MemberColumns, layout: StudyLayout, metric: str) -> Matrix:
    """Return a metric in the rows of A, B, AB_1, ..., AB_d; NaN: there is none, or not yet."""
    values = np.full(layout.samples, np.nan)
    values[columns.numbers] = columns.numeric(metric)
    return values.reshape(layout.matrices, -1)


def _percentiles(resampled: Matrix) -> tuple[ConfidenceInterval, ...]:
    lower, upper = np.quantile(resampled, [TAIL, 1.0 - TAIL], axis=0)
    pairs = zip(lower, upper, strict=True)
    return tuple(ConfidenceInterval(float(low), float(high)) for low, high in pairs)
