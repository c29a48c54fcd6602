"""What is said of one metric: mean, standard deviation and quantiles, with intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.studies.analysis.columns import MemberColumns, MetricColumn, exact_scale
from cosim.studies.analysis.confidence import (
    NO_INTERVAL,
    ConfidenceInterval,
    deviation_interval,
    effective_count,
    is_rough,
    mean_interval,
    quantile_interval,
    quantiles,
)
from cosim.studies.analysis.independence import Independence, StudyLayout, drawn_members
from cosim.studies.analysis.independence import independence_of as independence

PROBABILITIES: Final = (0.05, 0.5, 0.95)  # of the quantiles that are shown


@dataclass(frozen=True, slots=True)
class QuantileEstimate:
    """A quantile of a metric with its 95 % interval."""

    probability: float
    value: float
    interval: ConfidenceInterval

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "probability": self.probability,
            "value": self.value,
            "interval": self.interval.to_list(),
        }


@dataclass(frozen=True)
class MetricStatistics:
    """What is said of one metric.

    Parameters
    ----------
    name : str
    count : int
        Members with a finite value: what all figures are of.
    failed, without_value, infinite : int
        Members without one, by the reason: see :class:`MetricColumn`.
    mean, deviation, minimum, maximum : float or None
        None: no member has a value; of the standard deviation also: only one has.
    mean_interval, deviation_interval : ConfidenceInterval
    is_rough : bool
        Whether the interval of the mean may be too short, as of few members or skewed values.
    quantiles : tuple of QuantileEstimate
    basis : str
        What the intervals rest on, or why there are none.
    texts : mapping of str to int
        How often each text occurs.
    """

    name: str
    count: int
    failed: int
    without_value: int
    infinite: int
    mean: float | None
    mean_interval: ConfidenceInterval
    is_rough: bool
    deviation: float | None
    deviation_interval: ConfidenceInterval
    minimum: float | None
    maximum: float | None
    quantiles: tuple[QuantileEstimate, ...]
    basis: str
    texts: Mapping[str, int]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "count": self.count,
            "failed": self.failed,
            "without_value": self.without_value,
            "infinite": self.infinite,
            "mean": self.mean,
            "mean_interval": self.mean_interval.to_list(),
            "is_rough": self.is_rough,
            "deviation": self.deviation,
            "deviation_interval": self.deviation_interval.to_list(),
            "minimum": self.minimum,
            "maximum": self.maximum,
            "quantiles": [quantile.to_dict() for quantile in self.quantiles],
            "basis": self.basis,
            "texts": dict(self.texts),
        }


def study_statistics(columns: MemberColumns, layout: StudyLayout) -> dict[str, MetricStatistics]:
    """Return the statistics of every metric of a study, by its name.

    Of a Saltelli design they are of the members of its matrices A and B.
    """
    of_design = independence(layout)
    drawn = drawn_members(columns, layout)
    found = {}
    for name, column in drawn.metrics.items():
        found[name] = metric_statistics(column, of_design)
    return found


def metric_statistics(column: MetricColumn, of_design: Independence) -> MetricStatistics:
    """Return the statistics of one metric.

    Parameters
    ----------
    column : MetricColumn
    of_design : Independence
        What of the study was drawn independently.
    """
    scale = exact_scale(column.values)
    values = column.values / scale
    count = len(values)
    of_mean = NO_INTERVAL
    of_deviation = NO_INTERVAL
    rough = False
    if of_design.is_drawn and count:
        units = of_design.units_of(column.numbers)
        factor = of_design.variance_factor(column.numbers)
        of_mean = mean_interval(values, units, variance_factor=factor)
        of_deviation = deviation_interval(values, units, variance_factor=factor)
        rough = is_rough(values, units)
    return MetricStatistics(
        name=column.name,
        count=count,
        failed=len(column.failed),
        without_value=len(column.without_value),
        infinite=len(column.infinite),
        mean=scale * float(values.mean()) if count else None,
        mean_interval=of_mean.scaled(scale),
        is_rough=rough,
        deviation=scale * float(values.std(ddof=1)) if count > 1 else None,
        deviation_interval=of_deviation.scaled(scale),
        minimum=scale * float(values.min()) if count else None,
        maximum=scale * float(values.max()) if count else None,
        quantiles=_quantiles(column, of_design),
        basis=of_design.basis,
        texts=column.texts,
    )


def _quantiles(column: MetricColumn, of_design: Independence) -> tuple[QuantileEstimate, ...]:
    ordered = np.sort(column.values)
    if not len(ordered):
        return ()
    units = of_design.units_of(column.numbers)
    factor = of_design.variance_factor(column.numbers)
    estimates = []
    for probability, value in zip(PROBABILITIES, quantiles(ordered, PROBABILITIES), strict=True):
        interval = NO_INTERVAL
        if of_design.is_drawn:
            is_below = (column.values <= value).astype(np.float64)
            count = effective_count(is_below, units, factor=factor)
            interval = quantile_interval(ordered, probability, count=math.floor(count + 1e-9))
        estimates.append(QuantileEstimate(probability, value, interval))
    return tuple(estimates)
