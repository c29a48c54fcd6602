"""Rank correlation of metrics with parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.special import ndtri

from cosim.arrays import Vector
from cosim.studies.analysis.columns import MemberColumns, numbers_of
from cosim.studies.analysis.confidence import CONFIDENCE, NO_INTERVAL, ConfidenceInterval
from cosim.studies.analysis.independence import StudyLayout, drawn_members, independence_of
from cosim.studies.analysis.ranks import Ranks, rank_correlation, rank_correlation_deviation

LEAST_MEMBERS: Final = 10  # of fewer, chance alone makes strong correlations


@dataclass(frozen=True, slots=True)
class RankCorrelation:
    """Spearman's rank correlation of a metric with a parameter.

    Parameters
    ----------
    metric, parameter : str
    value : float or None
        In [-1, 1]; None: one of them has one value in all members.
    interval : ConfidenceInterval
        95 %; there is one where the members were drawn one by one.
    count : int
        Members that have the metric, and a value of the parameter.
    """

    metric: str
    parameter: str
    value: float | None
    interval: ConfidenceInterval
    count: int

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "metric": self.metric,
            "parameter": self.parameter,
            "value": self.value,
            "interval": self.interval.to_list(),
            "count": self.count,
        }


def rank_correlations(columns: MemberColumns, layout: StudyLayout) -> list[RankCorrelation]:
    """Return the correlation of every metric with every parameter that are numbers.

    Of a Saltelli design that of its matrices A and B.
    """
    drawn = drawn_members(columns, layout)
    of_design = independence_of(layout)
    independent = of_design.is_drawn and of_design.units_of(drawn.numbers) is None
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
            numbers = parameters[key][rows]
            known = ~np.isnan(numbers)
            if not known.all():
                pair = (Ranks.of(column.values[known]), Ranks.of(numbers[known]))
            value = rank_correlation(*pair)
            interval = NO_INTERVAL
            if value is not None and independent:
                interval = _interval(value, pair)
            found.append(RankCorrelation(name, key, value, interval, len(pair[0].order)))
    return found


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
    half_width = float(ndtri(0.5 + 0.5 * CONFIDENCE)) * deviation
    middle = math.atanh(value)
    return ConfidenceInterval(math.tanh(middle - half_width), math.tanh(middle + half_width))
