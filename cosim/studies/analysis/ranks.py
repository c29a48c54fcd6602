"""Ranks of values, and the standard deviation of their correlation.

Spearman's correlation is a function of the joint distribution of two columns. What one member
contributes to its error is its influence [1]_, also where the columns depend on each other without
rising or falling together, as of a metric that is smallest in the middle of a parameter: there the
formulas for normal columns give too short an interval, however many members there are.

References
----------
.. [1] C. Croux, C. Dehon, "Influence functions of the Spearman and Kendall correlation measures",
   Statistical Methods & Applications 19 (2010).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.studies.analysis.columns import is_constant


@dataclass(frozen=True)
class Ranks:
    """The ranks of values; equal values share the mean of theirs.

    Parameters
    ----------
    centered : Vector, shape (n,)
        Ranks less their mean, over n: from -0.5 to 0.5.
    order : array, shape (n,)
        That sorts the values.
    begin, end : array, shape (n,)
        How many values are smaller than each; than each or equal to it.
    """

    centered: Vector
    order: NDArray[np.intp]
    begin: NDArray[np.intp]
    end: NDArray[np.intp]

    @classmethod
    def of(cls, values: Vector) -> Ranks:
        """Return the ranks of values, shape (n,), without NaN; what rounding adds has none."""
        if is_constant(values):
            values = np.zeros(len(values))
        order = np.argsort(values, kind="stable")
        ordered = values[order]
        begin = np.searchsorted(ordered, values, "left")
        end = np.searchsorted(ordered, values, "right")
        count = max(len(values), 1)
        return cls((begin + end - count) / (2.0 * count), order, begin, end)

    @cached_property
    def squares(self) -> float:
        """The sum of squares of the centered ranks."""
        return float(self.centered @ self.centered)

    @cached_property
    def influence(self) -> Vector:
        """What each member contributes to the error of the mean square, shape (n,)."""
        return _influence(self, self)

    def mean_above(self, weights: Vector) -> Vector:
        """Return the sum of the weights of larger values, and half of equal ones, over n."""
        sums = np.concatenate([[0.0], np.cumsum(weights[self.order])])
        above: Vector = (sums[-1] - 0.5 * (sums[self.begin] + sums[self.end])) / len(weights)
        return above


def rank_correlation(first: Ranks, other: Ranks) -> float | None:
    """Return Spearman's rank correlation; None: one of them has one value, or there is one."""
    scale = math.sqrt(first.squares * other.squares)
    return float(first.centered @ other.centered) / scale if scale > 0.0 else None


def rank_correlation_deviation(
    first: Ranks, other: Ranks, value: float, *, units: NDArray[np.int64] | None = None
) -> float:
    """Return the standard deviation of Spearman's rank correlation.

    Parameters
    ----------
    first, other : Ranks
        Of the same members, two at least; neither has one value alone.
    value : float
        The correlation.
    units : array of int, shape (n,), optional
        Members of one unit depend on each other, and units do not; left out: all are independent.
    """
    influence = _influence(first, other) / math.sqrt(first.squares * other.squares)
    for one in (first, other):
        influence -= 0.5 * value / one.squares * one.influence
    if units is not None:
        _, places = np.unique(units, return_inverse=True)
        influence = np.bincount(places, weights=influence).astype(np.float64)
    count = len(influence)
    return math.sqrt(float(influence @ influence) * count / (count - 1.0))


def _influence(first: Ranks, other: Ranks) -> Vector:
    """Return what each member contributes to the error of the mean product of ranks, shape (n,)."""
    products = first.centered * other.centered
    moved = first.mean_above(other.centered) + other.mean_above(first.centered)
    total = products + moved
    centered: Vector = total - total.mean()
    return centered
