"""What the members of a study say: means, spreads, quantiles, shares, correlations, failures.

Intervals have 95 %: of a mean Student's t, of a standard deviation Bonett's [1]_, of a quantile
order statistics, of a share Wilson's, of a rank correlation Fisher's z, widened to the deviation
that the influence of each member has [2]_ (a metric may be smallest in the middle of a parameter).

Values that were not drawn one by one come in units: see :mod:`cosim.studies.layout`. The variance
of a mean is then that of the sums of units (linearization; Cochran, *Sampling Techniques*, 1977,
section 9A). What has no such formula takes the number of independent values that would have the
same variance, its *effective count* (Kish, *Survey Sampling*, 1965), shortened by the squared ratio
of the normal quantile to Student's t of so few units (Korn and Graubard, Survey Methodology 24,
1998).

References
----------
.. [1] D. G. Bonett, "Approximate confidence interval for standard deviation of nonnormal
   distributions", Computational Statistics & Data Analysis 50 (2006). Of long tails, such as the
   exponential, it covers less than it should of some hundred members and fewer.
.. [2] C. Croux, C. Dehon, "Influence functions of the Spearman and Kendall correlation measures",
   Statistical Methods & Applications 19 (2010).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cached_property, lru_cache
from operator import eq, ge, gt, le, lt, ne
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from scipy.special import ndtri, stdtrit

from cosim.arrays import Vector
from cosim.errors import UsageError, nearest, quoted
from cosim.studies.layout import (
    MemberColumns,
    MetricColumn,
    NumberColumn,
    StudyLayout,
    count_text,
    drawn_members,
    numbers_of,
)

CONFIDENCE: Final = 0.95
PROBABILITIES: Final = (0.05, 0.5, 0.95)  # of the quantiles that are shown
LEAST_MEMBERS: Final = 10  # of fewer, chance alone makes strong correlations
TAIL: Final = 0.5 * (1.0 - CONFIDENCE)  # beyond either end of an interval
_UPPER: Final = 0.5 + 0.5 * CONFIDENCE
_NORMAL_QUANTILE: Final = float(ndtri(_UPPER))
_LISTED: Final = 20  # members of a reason or condition that JSON names
Figures: TypeAlias = dict[str, Any]  # with the keys that --json has
Units: TypeAlias = NumberColumn | None  # of each value, shape (n,); None: each is one
_NUMBER: Final = re.compile(r"[-+]?\d+(\.\d*)?([eE][-+]?\d+)?")
_COMPARISONS: Final = {"<": lt, "<=": le, ">": gt, ">=": ge, "==": eq, "!=": ne}


class ConfidenceInterval(NamedTuple):
    """An interval that holds the true value in 95 % of all studies; None: no such end is known."""

    lower: float | None
    upper: float | None


NO_INTERVAL: Final = ConfidenceInterval(None, None)


def student_quantile(count: float) -> float:
    """Return the upper quantile of Student's t of a mean of so many values."""
    return float(stdtrit(count - 1, _UPPER))


def mean_interval(values: Vector, units: Units = None, factor: float = 1.0) -> ConfidenceInterval:
    """Return Student's interval of a mean, whose variance has a factor (that of the design)."""
    variance, number = _mean_variance(values, units)
    if number < 2:
        return NO_INTERVAL
    half_width = student_quantile(number) * math.sqrt(factor * variance)
    mean = float(values.mean())
    return ConfidenceInterval(mean - half_width, mean + half_width)


def is_rough(values: Vector, units: Units = None) -> bool:
    """Return whether the interval of a mean may be too short, as it is not normal enough.

    Of fewer than 10 units, or fewer than 25 times their squared skewness (Cochran, p. 42).
    """
    sums = _deviations(values, units)
    number = len(sums)
    if number < 2 or not sums.any():
        return False
    skewness = float(np.mean(sums**3)) / float(np.mean(sums**2)) ** 1.5
    return number < 10 or number < 25.0 * skewness**2


def effective_count(values: Vector, units: Units, factor: float = 1.0) -> float:
    """Return how many independent values, at most all, have a mean of the same variance."""
    count = len(values)
    variance, number = _mean_variance(values, units)
    if units is None or number == count > 1:
        return count / factor
    if number < 2:
        return 0.0
    independent, _ = _mean_variance(values)
    effective = count * independent / variance if variance > 0.0 else number
    spread = _NORMAL_QUANTILE / student_quantile(number)
    return float(min(effective, count)) * spread**2 / factor


def deviation_interval(
    values: Vector, units: Units = None, factor: float = 1.0
) -> ConfidenceInterval:
    """Return Bonett's interval of a standard deviation; the values need not be normal."""
    from scipy.stats import trim_mean

    n = len(values)
    squares = _centered(values) ** 2
    total = float(squares.sum())
    count = effective_count(squares, units, factor)
    if count < 5 or total <= 0.0:  # the formula divides by n - 4
        return NO_INTERVAL
    correction = count / (count - _NORMAL_QUANTILE)
    center = float(trim_mean(values, 0.5 / math.sqrt(n - 4.0)))
    kurtosis = n * float(((values - center) ** 4).sum()) / total**2
    spread = max(kurtosis - (count - 3.0) / count, 0.0) / (count - 1.0)
    half_width = _NORMAL_QUANTILE * correction * math.sqrt(spread)
    logarithm = math.log(correction * total / (n - 1.0))
    ends = [math.exp(0.5 * (logarithm + sign * half_width)) for sign in (-1.0, 1.0)]
    return ConfidenceInterval(*ends)


def quantile_interval(ordered: Vector, probability: float, independent: int) -> ConfidenceInterval:
    """Return the order statistics around a quantile, as if so many values were independent."""
    from scipy.stats import binom

    if not independent:
        return NO_INTERVAL
    n = len(ordered)
    below, above = binom.ppf(TAIL, independent, [probability, 1.0 - probability]).astype(int)
    scale = (n + 1.0) / (independent + 1.0)
    lower = ordered[max(math.floor(below * scale), 1) - 1] if below else None
    upper = ordered[min(math.ceil((independent + 1 - above) * scale), n) - 1] if above else None
    return ConfidenceInterval(*(None if end is None else float(end) for end in (lower, upper)))


def proportion_interval(passed: int, of: int, n: float) -> ConfidenceInterval:
    """Return Wilson's interval of a share, of an effective count of members."""
    if n < 1.0:
        return NO_INTERVAL
    share = passed / of
    square = _NORMAL_QUANTILE**2
    center = (share + 0.5 * square / n) / (1.0 + square / n)
    inside = share * (1.0 - share) / n + 0.25 * square / n**2
    half_width = math.sqrt(square * inside) / (1.0 + square / n)
    lower = 0.0 if passed == 0 else center - half_width
    return ConfidenceInterval(lower, 1.0 if passed == of else center + half_width)


def _mean_variance(values: Vector, units: Units = None) -> tuple[float, int]:
    """Return the estimated variance of a mean, and the number of its independent units."""
    sums = _deviations(values, units)
    number = len(sums)
    if number < 2:
        return math.nan, number
    return float(sums @ sums) * number / (number - 1.0) / len(values) ** 2, number


def _centered(values: Vector) -> Vector:
    """Return what values are above their mean; equal ones not by its rounding."""
    has_spread = len(values) and np.ptp(values) > 0.0
    return values - values.mean() if has_spread else np.zeros(len(values))


def _deviations(values: Vector, units: Units) -> Vector:
    """Return what units are above their share of the sum; zeros where that is rounding."""
    sums = _unit_sums(_centered(values), units)
    if units is not None and len(sums):
        rounding = 1e-15 * len(values) * float(np.abs(values).max())
        if np.abs(sums).max() <= rounding:
            return np.zeros(len(sums))
    return sums


def _unit_sums(values: Vector, units: Units) -> Vector:
    """Return the sums of values over the members of each unit."""
    if units is None:
        return values
    _, index = np.unique(units, return_inverse=True)
    return np.bincount(index, weights=values).astype(np.float64)


def _deviation(values: Vector) -> float:
    return float(values.std(ddof=1)) if np.ptp(values) > 0.0 else 0.0


def study_statistics(columns: MemberColumns, layout: StudyLayout) -> dict[str, Figures]:
    """Return what is said of each metric: figures of the members that have a finite value."""
    found = {}
    for name, column in drawn_members(columns, layout).metrics.items():
        values = column.values
        has_any = len(values) > 0
        drawn = (layout.units_of(column.numbers), layout.variance_factor(column.numbers))
        ordered = np.sort(values)
        quantiles = []
        for probability in PROBABILITIES if has_any else ():
            value = float(np.quantile(ordered, probability))
            known = effective_count((values <= value).astype(np.float64), *drawn)
            interval = quantile_interval(ordered, probability, math.floor(known + 1e-9))
            quantiles.append({"probability": probability, "value": value, "interval": interval})
        found[name] = {
            "count": len(values),
            "failed": len(column.failed),
            "without_value": len(column.without_value),
            "infinite": len(column.infinite),
            "mean": float(values.mean()) if has_any else None,
            "mean_interval": mean_interval(values, *drawn),
            "is_rough": is_rough(values, drawn[0]),
            "deviation": _deviation(values) if len(values) > 1 else None,
            "deviation_interval": deviation_interval(values, *drawn),
            "minimum": float(ordered[0]) if has_any else None,
            "maximum": float(ordered[-1]) if has_any else None,
            "quantiles": quantiles,
            "basis": layout.basis,
            "texts": column.texts,
        }
    return found


def statistics_by(columns: MemberColumns, layout: StudyLayout, key: str) -> list[Figures]:
    """Return the statistics for each value of a key; UsageError if not varied, or too many."""
    if key not in columns.parameters:
        raise UsageError(f"the study does not vary {key!r}; {nearest(key, columns.parameters)}")
    raw = columns.parameters[key].tolist()
    values = [None if value != value else value for value in raw]  # an empty cell of a case
    groups: dict[str, list[int]] = {}
    for row, value in enumerate(values):
        groups.setdefault(repr(value), []).append(row)
    if len(groups) > 200:
        wanted = "expected at most 200 values, as of a grid key"
        raise UsageError(f"{key!r}: {wanted}, got {len(groups)}")
    rows = list(groups.values())
    if numbers_of(columns.parameters[key]) is not None:
        rows.sort(key=lambda own: (values[own[0]] is None, values[own[0]] or 0.0))
    found = []
    for own in rows:
        part = columns.only(np.array(own))
        head = {"value": values[own[0]], "members": len(own), "failed": int(part.failed.sum())}
        found.append({**head, "statistics": study_statistics(part, layout)})
    return found


class RunningMean(NamedTuple):
    """The mean of the first members, and the half-width of its interval (NaN: of one unit)."""

    counts: NumberColumn
    means: Vector
    half_widths: Vector


def running_mean(column: MetricColumn, layout: StudyLayout) -> RunningMean:
    """Return the mean over the members, unit by unit; UsageError if they were chosen."""
    if not layout.is_drawn:
        raise UsageError(
            f"the mean of {column.name!r} does not converge: the members of this study were "
            "chosen, not drawn; use samples or seeds"
        )
    units = layout.units_of(column.numbers)
    _, index = np.unique(column.numbers if units is None else units, return_inverse=True)
    sizes = np.bincount(index)
    first = column.values[:1].sum()  # sums of squares about a value do not cancel
    sums = np.bincount(index, weights=column.values - first)
    number = np.arange(1.0, len(sums) + 1.0)
    counts = np.cumsum(sizes)
    mean = np.cumsum(sums) / counts
    squares = np.cumsum(sums**2) - mean * np.cumsum(sums * sizes) * 2.0
    squares += mean**2 * np.cumsum(sizes**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.maximum(squares, 0.0) * number / (number - 1.0) / counts**2
        half_widths = stdtrit(number - 1.0, _UPPER) * np.sqrt(variance)
        if layout.kind == "latin-hypercube":
            half_widths = half_widths * np.sqrt(number / (number - 1.0))
    return RunningMean(counts, mean + first, half_widths)


def passed_share(columns: MemberColumns, layout: StudyLayout, condition: str) -> Figures:
    """Return how many members pass ``METRIC < NUMBER``, several of them joined by ``and``.

    A metric that is a text is compared by ``METRIC == TEXT``. Members that failed or have no value
    do not pass.
    """
    drawn = drawn_members(columns, layout)
    passed = has_value = ~drawn.failed
    for part in re.split(r"\s+and\s+", condition):
        metric, compare, value = _comparison(drawn, part)
        has_value = has_value & drawn.has_value(metric)
        passed = passed & np.asarray(compare(drawn.raw_metrics[metric], value), np.bool_)
    passed = passed & has_value
    count, of = int(passed.sum()), len(passed)
    together = (layout.units_of(drawn.numbers), layout.variance_factor(drawn.numbers))
    known = effective_count(passed.astype(np.float64), *together)
    return {
        "condition": condition,
        "passed": count,
        "of": of,
        "failed": int(drawn.failed.sum()),
        "without_value": int((~has_value & ~drawn.failed).sum()),
        "share": count / of if of else None,
        "interval": proportion_interval(count, of, known),
        "basis": layout.basis,
        "first_not_passed": drawn.numbers[~passed][:_LISTED].tolist(),
    }


def _comparison(columns: MemberColumns, text: str) -> tuple[str, Any, float | str]:
    """Read ``METRIC < NUMBER``, or ``METRIC == TEXT`` of a metric that is a text."""
    found = re.fullmatch(r"\s*(.+?)\s*(<=|>=|==|!=|<|>)\s*(.+?)\s*", text)
    if found is not None:
        metric, comparison, value = found.groups()
        columns.check_metric(metric)
        if columns.raw_metrics[metric].dtype != object:
            with suppress(ValueError):
                if not math.isnan(float(value)):
                    return metric, _COMPARISONS[comparison], float(value)
        elif comparison in ("==", "!="):
            return metric, _COMPARISONS[comparison], value.strip("'\"")
    raise UsageError(
        f"condition: expected METRIC COMPARISON NUMBER (comparisons: {' '.join(_COMPARISONS)}), "
        f"such as 'rms < 0.1', or METRIC == TEXT of a metric that is a text; got {quoted(text)}"
    )


def is_constant(values: Vector) -> bool:
    """Return whether all values are one, but for rounding."""
    return not len(values) or float(np.ptp(values)) <= 1e-12 * float(np.abs(values).max())


class _Ranks:
    """Ranks of values without NaN; equal ones, but for rounding, share the mean of theirs."""

    def __init__(self, values: Vector) -> None:
        if is_constant(values):
            values = np.zeros(len(values))
        count = max(len(values), 1)
        self.order = np.argsort(values, kind="stable")
        self.begin = np.searchsorted(values[self.order], values, "left")  # how many are smaller
        self.end = np.searchsorted(values[self.order], values, "right")
        self.centered: Vector = (self.begin + self.end - count) / (2.0 * count)
        self.squares = float(self.centered @ self.centered)

    @cached_property
    def own_influence(self) -> Vector:
        return self.influence(self)

    def correlation(self, other: _Ranks) -> float | None:
        """Return Spearman's rank correlation; None: one of them has one value."""
        scale = math.sqrt(self.squares * other.squares)
        return float(self.centered @ other.centered) / scale if scale > 0.0 else None

    def deviation(self, other: _Ranks, value: float, units: Units = None) -> float:
        """Return the standard deviation of the rank correlation of this value."""
        influence = self.influence(other) / math.sqrt(self.squares * other.squares)
        for one in (self, other):
            influence -= 0.5 * value / one.squares * one.own_influence
        influence = _unit_sums(influence, units)
        count = len(influence)
        return math.sqrt(float(influence @ influence) * count / (count - 1.0))

    def influence(self, other: _Ranks) -> Vector:
        """Return what each member contributes to the error of the mean product of ranks."""
        moved = self._mean_above(other.centered) + other._mean_above(self.centered)
        return _centered(self.centered * other.centered + moved)

    def _mean_above(self, weights: Vector) -> Vector:
        """Return the sum of the weights of larger values, and half of equal ones, over n."""
        sums = np.concatenate([[0.0], np.cumsum(weights[self.order])])
        above: Vector = (sums[-1] - 0.5 * (sums[self.begin] + sums[self.end])) / len(weights)
        return above


def rank_correlations(columns: MemberColumns, layout: StudyLayout) -> list[Figures]:
    """Return the correlation of each metric with each parameter whose values are numbers.

    There is no ``value`` where one of them has one value in all members, or there are fewer than
    ``LEAST_MEMBERS``; ``is_distinct``: not by chance, at the 5 % level.
    """
    drawn = drawn_members(columns, layout)
    every = {key: numbers_of(raw) for key, raw in drawn.parameters.items()}
    parameters = {key: numbers for key, numbers in every.items() if numbers is not None}
    metrics = {name: drawn.numeric(name) for name, one in drawn.metrics.items() if not one.texts}
    numbers = {**parameters, **metrics}

    @lru_cache(maxsize=len(parameters) + 2)  # most metrics have all members
    def ranks(name: str, known: bytes) -> _Ranks:
        return _Ranks(numbers[name][np.frombuffer(known, np.bool_)])

    found = []
    for metric, of_metric in metrics.items():
        for key, of_key in parameters.items():
            known = np.isfinite(of_metric) & ~np.isnan(of_key)
            mask, members = known.tobytes(), drawn.numbers[known]
            correlation = _correlation(ranks(metric, mask), ranks(key, mask), members, layout)
            found.append({"metric": metric, "parameter": key, **correlation})
    return found


def _correlation(
    first: _Ranks, other: _Ranks, members: NumberColumn, layout: StudyLayout
) -> Figures:
    """Return a correlation, its interval, and whether it is distinct."""
    value = first.correlation(other) if len(members) >= LEAST_MEMBERS else None
    units = layout.units_of(members)
    independent = len(members if units is None else np.unique(units))
    interval, is_distinct = NO_INTERVAL, False
    if value is None:
        pass
    elif not layout.is_drawn or (units is None and abs(value) >= 1.0):
        is_distinct = True
    elif units is None:
        of_normal = math.sqrt((1.0 + 0.5 * value**2) / (independent - 3.0))
        deviation = max(of_normal, first.deviation(other, value) / (1.0 - value**2))
        half_width = _NORMAL_QUANTILE * deviation
        middle = math.atanh(value)
        lower, upper = math.tanh(middle - half_width), math.tanh(middle + half_width)
        interval, is_distinct = ConfidenceInterval(lower, upper), not lower <= 0.0 <= upper
    elif independent >= 5:  # of fewer, chance alone makes all of one sign
        largest = student_quantile(independent) * first.deviation(other, value, units)
        if layout.kind not in ("grid", "cases"):  # whose parameters were not drawn
            largest = max(largest, _NORMAL_QUANTILE / math.sqrt(independent - 1))
        is_distinct = abs(value) > largest
    count = len(members)
    return {"value": value, "interval": interval, "count": count, "is_distinct": is_distinct}


def strongest(correlations: Sequence[Figures], metric: str) -> list[Figures]:
    """Return the correlations of a metric that have a value, the strongest first."""
    known = [one for one in correlations if one["metric"] == metric and one["value"] is not None]
    return sorted(known, key=lambda one: -abs(one["value"]))


def spearman(first: Vector, other: Vector) -> float | None:
    """Return Spearman's rank correlation; None: one of them has one value."""
    return _Ranks(first).correlation(_Ranks(other))


def extremes(
    columns: MemberColumns, metric: str, count: int, *, largest: bool = True
) -> dict[int, float]:
    """Return the largest or smallest values by member, infinite ones too, in order."""
    columns.metric(metric)
    values = columns.numeric(metric)
    rows = np.flatnonzero(~np.isnan(values))
    order = np.argsort(-values[rows] if largest else values[rows], kind="stable")
    found = rows[order[:count]]
    return dict(zip(columns.numbers[found].tolist(), values[found].tolist(), strict=True))


def reasons_of(columns: MemberColumns, *, failed: bool) -> list[Figures]:
    """Return why members failed, or ended before their stop time, the most frequent first."""
    rows = zip(columns.numbers.tolist(), columns.failed, columns.reasons, strict=True)
    return grouped(
        (number, reason) for number, lost, reason in rows if lost == failed and (lost or reason)
    )


def warnings_by_text(columns: MemberColumns) -> list[Figures]:
    """Return what members warn of, the most frequent first."""
    rows = zip(columns.numbers.tolist(), columns.warnings, strict=True)
    return grouped((number, line) for number, lines in rows for line in lines.splitlines())


def grouped(pairs: Iterable[tuple[int, str]]) -> list[Figures]:
    """Group members by texts that differ in numbers only; the text is that of the first."""
    members: dict[str, tuple[str, dict[int, None]]] = {}
    for number, text in pairs:
        without_numbers = _NUMBER.sub("#", text)
        members.setdefault(without_numbers, (text, {}))[1][number] = None
    return [
        {"reason": text, "count": len(own), "first_members": [*own][:_LISTED]}
        for text, own in sorted(members.values(), key=lambda group: -len(group[1]))
    ]


def warning_lines(groups: Sequence[Figures], count: int) -> list[str]:
    """Return a line for each of the ten most frequent warnings, of so many members."""
    lines = []
    for group in groups[:10]:
        who = f"{group['count']} of {count_text(count)}"
        warn = "warns," if group["count"] == 1 else "warn, such as"
        lines.append(f"{who} {warn} {group['first_members'][0]}: {group['reason']}")
    if len(groups) > 10:
        lines.append(f"{len(groups) - 10} more warnings; see the column 'warnings'")
    return lines
