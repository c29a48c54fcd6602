"""Intervals of confidence of a mean, a standard deviation, a quantile and a proportion.

Values that were not drawn one by one come in units: see ``independence``. The variance of a mean
is then that of the sums of units (linearization; Cochran, *Sampling Techniques*, 1977, section
9A). What has no such formula, takes the number of independent values that would have the same
variance, its *effective count* (Kish, *Survey Sampling*, 1965), shortened by the squared ratio of
the normal quantile to Student's t of so few units (Korn and Graubard, Survey Methodology 24, 1998).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import bdtr

from cosim.arrays import Vector
from cosim.studies.analysis.columns import NumberColumn
from cosim.studies.analysis.interval_quantiles import NORMAL_QUANTILE, TAIL, student_quantile

_LEAST_FOR_MEAN: Final = 10  # units: the skewness of fewer says little
_COCHRAN: Final = 25.0  # units for each squared skewness
_LEAST_FOR_DEVIATION: Final = 5  # values: the formula divides by n - 4 and by n - 1.96


@dataclass(frozen=True, slots=True)
class ConfidenceInterval:
    """An interval that holds the true value in a share of all studies.

    Parameters
    ----------
    lower, upper : float or None
        None: too few members for this end.
    """

    lower: float | None
    upper: float | None

    def to_list(self) -> list[float | None]:
        """Return plain values for JSON."""
        return [self.lower, self.upper]

    def holds(self, value: float) -> bool:
        """Return whether a value is in the interval; an end that is not known excludes none."""
        is_above = self.lower is None or self.lower <= value
        return is_above and (self.upper is None or value <= self.upper)

    def scaled(self, factor: float) -> ConfidenceInterval:
        """Return the interval of a value times a positive factor."""
        lower = None if self.lower is None else factor * self.lower
        upper = None if self.upper is None else factor * self.upper
        return ConfidenceInterval(lower, upper)


NO_INTERVAL: Final = ConfidenceInterval(None, None)


def mean_interval(
    values: Vector,
    units: NumberColumn | None = None,
    *,
    variance_factor: float = 1.0,
) -> ConfidenceInterval:
    """Return Student's interval of a mean.

    Exact for normal values; for others of finite variance as exact as the mean of so many units is
    normal.

    Parameters
    ----------
    values : Vector, shape (n,)
    units : NumberColumn, shape (n,), optional
        The unit of each value; None: each is one.
    variance_factor : float
        Of the variance of the mean, over that of independent units.
    """
    variance, count = mean_variance(values, units)
    if count < 2:
        return NO_INTERVAL
    quantile = student_quantile(count)
    half_width = quantile * math.sqrt(variance_factor * variance)
    mean = float(values.mean())
    return ConfidenceInterval(mean - half_width, mean + half_width)


def mean_variance(values: Vector, units: NumberColumn | None = None) -> tuple[float, int]:
    """Return the estimated variance of a mean, and the number of its independent units."""
    count = len(values)
    if not count:
        return math.nan, 0
    sums, number = _unit_sums(values, units)
    if number < 2:
        return math.nan, number
    return float(sums @ sums) * number / (number - 1.0) / count**2, number


def is_rough(values: Vector, units: NumberColumn | None = None) -> bool:
    """Return whether the interval of a mean is to be taken with care: it may be too short.

    Where there are fewer than 10 units, or fewer than 25 times the squared skewness of their
    values, the mean is not normal enough for it (Cochran, *Sampling Techniques*, 1977, p. 42).
    """
    sums, number = _unit_sums(values, units)
    if number < 2:
        return False
    squares = float(np.mean(sums**2))
    if squares <= 0.0:
        return False
    skewness = float(np.mean(sums**3)) / squares**1.5
    return number < _LEAST_FOR_MEAN or number < _COCHRAN * skewness**2


def effective_count(values: Vector, units: NumberColumn | None, *, factor: float = 1.0) -> float:
    """Return the number of independent values whose mean would have the same variance.

    At most that of the values.

    Parameters
    ----------
    values : Vector, shape (n,)
    units : NumberColumn, shape (n,), or None
        None: each value is a unit.
    factor : float
        As ``variance_factor`` of :func:`mean_interval`.
    """
    count = len(values)
    if units is None:
        return count / factor
    variance, number = mean_variance(values, units)
    if number < 2:
        return 0.0
    independent, _ = mean_variance(values)
    if number == count:
        return count / factor
    effective = count * independent / variance if variance > 0.0 else number
    spread = NORMAL_QUANTILE / student_quantile(number)
    return float(min(effective, count)) * spread**2 / factor


def deviation_interval(
    values: Vector,
    units: NumberColumn | None = None,
    *,
    variance_factor: float = 1.0,
) -> ConfidenceInterval:
    """Return Bonett's interval of a standard deviation; the values need not be normal.

    D. G. Bonett, "Approximate confidence interval for standard deviation of nonnormal
    distributions", Computational Statistics & Data Analysis 50, 2006. Of distributions with long
    tails, such as the exponential, it covers less than it should of some hundred members and fewer.

    Parameters
    ----------
    values, units, variance_factor
        As of :func:`mean_interval`.
    """
    from scipy.stats import trim_mean

    n = len(values)
    deviations = values - values.mean() if n else values
    squares = deviations**2
    count = effective_count(squares, units, factor=variance_factor)
    total = float(squares.sum())
    if count < _LEAST_FOR_DEVIATION or total <= 0.0:
        return NO_INTERVAL
    z = NORMAL_QUANTILE
    correction = count / (count - z)
    center = float(trim_mean(values, 0.5 / math.sqrt(n - 4.0)))
    kurtosis = n * float(((values - center) ** 4).sum()) / total**2
    spread = max(kurtosis - (count - 3.0) / count, 0.0) / (count - 1.0)
    half_width = z * correction * math.sqrt(spread)
    logarithm = math.log(correction * total / (n - 1.0))
    lower = math.exp(0.5 * (logarithm - half_width))
    upper = math.exp(0.5 * (logarithm + half_width))
    return ConfidenceInterval(lower, upper)


def quantile_interval(
    ordered: Vector,
    probability: float,
    *,
    count: float | None = None,
) -> ConfidenceInterval:
    """Return an interval of a quantile between two of the values, whatever their distribution.

    The number of independent values below a quantile is binomial (Conover, *Practical
    Nonparametric Statistics*, 1999, section 3.2).

    Parameters
    ----------
    ordered : Vector, shape (n,)
        Values, ascending.
    probability : float
        Of the quantile, in (0, 1).
    count : float, optional
        The effective count; None: the values are independent.
    """
    n = len(ordered)
    independent = n if count is None else int(count)
    if not n or not independent:
        return NO_INTERVAL
    low = int(_below(independent, probability, TAIL))
    high = independent + 1 - int(_below(independent, 1.0 - probability, TAIL))
    scale = (n + 1.0) / (independent + 1.0)
    lower = None
    upper = None
    if low:
        lower = float(ordered[max(math.floor(low * scale), 1) - 1])
    if high <= independent:
        upper = float(ordered[min(math.ceil(high * scale), n) - 1])
    return ConfidenceInterval(lower, upper)


def proportion_interval(passed: int, of: int, *, count: float | None = None) -> ConfidenceInterval:
    """Return Wilson's interval of a proportion.

    E. B. Wilson, "Probable inference, the law of succession, and statistical inference", Journal
    of the American Statistical Association 22, 1927.

    Parameters
    ----------
    passed, of : int
    count : float, optional
        The effective count; None: the members are independent.
    """
    n = float(of) if count is None else count
    if n < 1.0:
        return NO_INTERVAL
    share = passed / of
    square = NORMAL_QUANTILE**2
    center = (share + 0.5 * square / n) / (1.0 + square / n)
    inside = share * (1.0 - share) / n + 0.25 * square / n**2
    half_width = math.sqrt(square * inside) / (1.0 + square / n)
    lower = 0.0 if passed == 0 else center - half_width
    upper = 1.0 if passed == of else center + half_width
    return ConfidenceInterval(lower, upper)


def quantiles(ordered: Vector, probabilities: Sequence[float]) -> list[float]:
    """Return quantiles of ascending values, linear between them, as numpy's standard ones."""
    return [float(value) for value in np.quantile(ordered, probabilities)] if len(ordered) else []


def _below(count: int, probability: float, tail: float) -> int:
    """Return how many k have a binomial probability of k or less that is within ``tail``."""
    middle = count * probability
    reach = 10.0 * math.sqrt(count * probability * (1.0 - probability)) + 10.0
    first = max(math.floor(middle - reach), 0)
    k = np.arange(first, math.ceil(middle) + 1)
    return first + int(np.count_nonzero(bdtr(k, count, probability) <= tail))


def _unit_sums(values: Vector, units: NumberColumn | None) -> tuple[Vector, int]:
    """Return the sums over each unit of what values differ from their mean, and how many units."""
    if not len(values):
        return values, 0
    sums = values - values.mean()
    if units is not None:
        _, index = np.unique(units, return_inverse=True)
        sums = np.bincount(index, weights=sums)
    return sums, len(sums)
