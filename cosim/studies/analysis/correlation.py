"""Rank correlation of metrics with parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.studies.analysis.columns import MemberColumns, NumberColumn, numbers_of
from cosim.studies.analysis.confidence import NO_INTERVAL, ConfidenceInterval
from cosim.studies.analysis.independence import (
    Independence,
    StudyLayout,
    drawn_members,
    independence_of,
)
from cosim.studies.analysis.interval_quantiles import NORMAL_QUANTILE, student_quantile
from cosim.studies.analysis.ranks import Ranks, rank_correlation, rank_correlation_deviation

LEAST_MEMBERS: Final = 10  # of fewer, chance alone makes strong correlations
LEAST_UNITS: Final = 5  # of fewer seeds or samples, chance alone makes all of one sign


@dataclass(frozen=True, slots=True)
class RankCorrelation:
    """Spearman's rank correlation of a metric with a parameter.

    Parameters
    ----------
    metric, parameter : str
    value : float or None
        In [-1, 1]; None: one of them has one value in all members, or there are fewer than
        ``LEAST_MEMBERS``.
    interval : ConfidenceInterval
        95 %; there is one where the members were drawn one by one.
    count : int
        Members that have the metric, and a value of the parameter.
    is_distinct : bool
        Whether it is stronger than chance alone makes it in 19 of 20 studies; of members that were
        chosen there is no chance.
    """

    metric: str
    parameter: str
    value: float | None
    interval: ConfidenceInterval
    count: int
    is_distinct: bool

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "metric": self.metric,
            "parameter": self.parameter,
            "value": self.value,
            "interval": self.interval.to_list(),
            "count": self.count,
            "is_distinct": self.is_distinct,
        }


def rank_correlations(columns: MemberColumns, layout: StudyLayout) -> list[RankCorrelation]:
    """Return the correlation of every metric with every parameter that are numbers.

    Of a Saltelli design that of its matrices A and B.
    """
    drawn = drawn_members(columns, layout)
    of_design = independence_of(layout)
    parameters = {}
    for key, raw in drawn.parameters.items():
        numbers = numbers_of(raw)
        if numbers is not None:
            parameters[key] = numbers
    found = []
    ranked: dict[str, Ranks] = {}
    ranked_rows = np.zeros(0, np.intp)
    for name, column in drawn.metrics.items():
        if column.is_text:
            continue
        rows = drawn.rows_of(column.numbers)
        if not ranked or not np.array_equal(rows, ranked_rows):  # most metrics have all members
            ranked = {key: Ranks.of(numbers[rows]) for key, numbers in parameters.items()}
            ranked_rows = rows
        of_metric = Ranks.of(column.values)
        for key, of_parameter in ranked.items():
            pair = (of_metric, of_parameter)
            members = column.numbers
            numbers = parameters[key][rows]
            known = ~np.isnan(numbers)
            if not known.all():
                pair = (Ranks.of(column.values[known]), Ranks.of(numbers[known]))
                members = members[known]
            found.append(_correlation_of(name, key, pair, members, of_design))
    return found


def _correlation_of(
    metric: str,
    parameter: str,
    pair: tuple[Ranks, Ranks],
    members: NumberColumn,
    of_design: Independence,
) -> RankCorrelation:
    """Return a correlation with what is known of it."""
    count = len(members)
    value = rank_correlation(*pair)
    if value is None or count < LEAST_MEMBERS:
        return RankCorrelation(metric, parameter, None, NO_INTERVAL, count, is_distinct=False)
    if not of_design.is_drawn:
        return RankCorrelation(metric, parameter, value, NO_INTERVAL, count, is_distinct=True)
    units = of_design.units_of(members)
    if units is None:
        interval = _interval(value, pair)
        is_distinct = interval.lower is None or not interval.holds(0.0)
        return RankCorrelation(metric, parameter, value, interval, count, is_distinct=is_distinct)
    is_distinct = abs(value) > _largest_by_chance(value, pair, units, of_design.layout)
    return RankCorrelation(metric, parameter, value, NO_INTERVAL, count, is_distinct=is_distinct)


def _largest_by_chance(
    value: float, pair: tuple[Ranks, Ranks], units: NumberColumn, layout: StudyLayout
) -> float:
    """Return how large chance alone makes a correlation in 1 of 20 studies.

    The members of a seed, or of a sample, count together: what the noise adds may grow with the
    parameter, so that all members of a seed err to one side.
    """
    independent = len(np.unique(units))
    if independent < LEAST_UNITS:
        return math.inf
    deviation = rank_correlation_deviation(*pair, value, units=units)
    largest = student_quantile(independent) * deviation
    if layout.kind in ("grid", "cases"):  # whose parameters were not drawn
        return largest
    return max(largest, NORMAL_QUANTILE / math.sqrt(independent - 1))


def strongest(correlations: Sequence[RankCorrelation], metric: str) -> list[RankCorrelation]:
    """Return the correlations of a metric, the strongest first."""
    known = [one for one in correlations if one.metric == metric and one.value is not None]
    return sorted(known, key=lambda one: -abs(one.value or 0.0))


def spearman(first: Vector, other: Vector) -> float | None:
    """Return Spearman's rank correlation; None: one of them has one value, or there is one."""
    return rank_correlation(Ranks.of(first), Ranks.of(other))


def _interval(value: float, pair: tuple[Ranks, Ranks]) -> ConfidenceInterval:
    """Return the interval by Fisher's z.

    Its deviation is the larger one of that of Bonett and Wright, which holds of few members that
    are about normal, and of that of the influence of each member, which holds of many members
    however they depend on each other. D. G. Bonett and T. A. Wright, "Sample size requirements for
    estimating Pearson, Kendall and Spearman correlations", Psychometrika 65, 2000.
    """
    count = len(pair[0].order)
    if count < LEAST_MEMBERS or abs(value) >= 1.0:
        return NO_INTERVAL
    of_normal = math.sqrt((1.0 + 0.5 * value**2) / (count - 3.0))
    deviation = max(of_normal, rank_correlation_deviation(*pair, value) / (1.0 - value**2))
    half_width = NORMAL_QUANTILE * deviation
    middle = math.atanh(value)
    return ConfidenceInterval(math.tanh(middle - half_width), math.tanh(middle + half_width))
