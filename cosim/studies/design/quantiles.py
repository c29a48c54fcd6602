"""Quantile functions of the distributions of a study, on arrays.

The inverses of the normal and the beta distribution are those of ``scipy.special``, that of a
truncated normal distribution is the one of ``scipy.stats``, which keeps its precision in the
tails; the others are closed forms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.studies.document.variations import SampledVariation

SIGMAS: Final = 3.0  # standard deviations that the tolerance of a normal distribution is


def quantiles(variation: SampledVariation, p: Vector, own_value: float) -> Vector:
    """Return the quantiles of a distribution, shape (N,).

    Parameters
    ----------
    variation : SampledVariation
        Of numbers; not ``choice``.
    p : Vector, shape (N,)
        Probabilities, 0 < p < 1.
    own_value : float
        That a tolerance is relative to.
    """
    numbers = variation.numbers
    match variation.distribution:
        case "tolerance":
            width = abs(own_value) * numbers[0]
            return _uniform(p, (own_value - width, own_value + width))
        case "tolerance-normal":
            width = abs(own_value) * numbers[0]
            bounds = (own_value - width, own_value + width)
            return _normal(p, (own_value, width / SIGMAS, *bounds))
        case name:
            return _QUANTILES[name](p, numbers)


def chosen(variation: SampledVariation, p: Vector) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return which of its values a choice has at some probabilities, shape (N,)."""
    weights = np.array(variation.numbers)
    cumulative = np.cumsum(weights / weights.sum())
    indices = np.searchsorted(cumulative, p, side="right")
    last = int(np.flatnonzero(weights)[-1])  # the sum may round to less than 1
    return np.minimum(indices, last)


def _uniform(p: Vector, numbers: Sequence[float]) -> Vector:
    lower, upper = numbers
    values: Vector = lower * (1.0 - p) + upper * p  # their difference could overflow
    return np.clip(values, lower, upper)


def _log_uniform(p: Vector, numbers: Sequence[float]) -> Vector:
    lower, upper = numbers
    exponents = _uniform(p, (math.log(lower), math.log(upper)))
    values: Vector = np.exp(exponents)
    return np.clip(values, lower, upper)


def _normal(p: Vector, numbers: Sequence[float]) -> Vector:
    mean, deviation, lower, upper = numbers
    if lower == -math.inf and upper == math.inf:
        from scipy.special import ndtri

        values: Vector = mean + deviation * ndtri(p)
        return values
    from scipy.stats import truncnorm

    below = (lower - mean) / deviation
    above = (upper - mean) / deviation
    truncated: Vector = mean + deviation * truncnorm.ppf(p, below, above)
    return np.clip(truncated, lower, upper)


def _lognormal(p: Vector, numbers: Sequence[float]) -> Vector:
    from scipy.special import ndtri

    median, deviation = numbers
    with np.errstate(over="ignore"):  # the planning refuses what is not finite
        values: Vector = median * np.exp(deviation * ndtri(p))
    return values


def _triangular(p: Vector, numbers: Sequence[float]) -> Vector:
    lower, mode, upper = numbers
    width = upper - lower
    rising = lower + np.sqrt(p * width * (mode - lower))
    falling = upper - np.sqrt((1.0 - p) * width * (upper - mode))
    values: Vector = np.where(p * width < mode - lower, rising, falling)
    return np.clip(values, lower, upper)


def _exponential(p: Vector, numbers: Sequence[float]) -> Vector:
    values: Vector = -numbers[0] * np.log1p(-p)
    return values


def _beta(p: Vector, numbers: Sequence[float]) -> Vector:
    from scipy.special import betaincinv

    alpha, beta, lower, upper = numbers
    return _uniform(betaincinv(alpha, beta, p), (lower, upper))


def _weibull(p: Vector, numbers: Sequence[float]) -> Vector:
    scale, shape = numbers
    with np.errstate(over="ignore"):
        values: Vector = scale * (-np.log1p(-p)) ** (1.0 / shape)
    return values


_QUANTILES: Final[Mapping[str, Callable[[Vector, Sequence[float]], Vector]]] = {
    "uniform": _uniform,
    "log-uniform": _log_uniform,
    "normal": _normal,
    "lognormal": _lognormal,
    "triangular": _triangular,
    "exponential": _exponential,
    "beta": _beta,
    "weibull": _weibull,
}
