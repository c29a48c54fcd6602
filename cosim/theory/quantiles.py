"""Quantiles behind tests and intervals.

What a chi-square, over an estimate of its scale or over its scale itself, exceeds with a
probability p is the root q of log(tail(q)) = log(p). In u = log(q) the left side decreases and is
concave, for both: minus its derivative, q times the hazard rate, increases. So Newton's method
meets the root from the right after at most one step, from wherever it starts. Student's t and the
normal value are the square roots for one degree of freedom. The tails are by continued fractions
(DLMF 8.9.2 and 8.17.22). scipy.special has all this too, but takes longer to import than a short
run takes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Final

from cosim.arrays import Vector

CONFIDENCE: Final = 0.95  # of the intervals and bands that are shown
GUARANTEED_CONFIDENCE: Final = 0.999  # of noise within its bounds in a guaranteed interval

_MOST_STEPS: Final = 500  # of Newton's method: a step of 1 in u at least, until it is near
_NEAR: Final = 1e-9  # a step in u, whose square is below rounding
_SMALL: Final = 1e-300  # in place of 0, in a continued fraction
_EPSILON: Final = 2.0**-52
_LARGE: Final = 100.0  # from where three terms of Stirling's series are exact to rounding


@lru_cache
def chi_square_above(probability: float, degrees: float) -> float:
    """Return what a chi-square of ``degrees`` degrees of freedom exceeds with a probability."""
    shape = 0.5 * degrees

    def tail(q: float) -> tuple[float, float]:
        return _log_gamma_tail(shape, 0.5 * q)

    return _quantile(tail, probability, degrees)


@lru_cache
def ratio_above(probability: float, degrees: float, freedom: float) -> float:
    """Return what a chi-square over the estimate of its scale exceeds with a probability.

    Parameters
    ----------
    probability : float
    degrees : float
        Degrees of freedom of the chi-square.
    freedom : float
        Those of the estimate, whose expectation is 1; infinite: it is known.
    """
    if math.isinf(freedom):
        return chi_square_above(probability, degrees)

    def tail(q: float) -> tuple[float, float]:
        return _log_beta_tail(0.5 * freedom, 0.5 * degrees, q / freedom)

    return _quantile(tail, probability, degrees)


def chi_square_limits(confidence: float, degrees: Vector) -> tuple[Vector, Vector]:
    """Return the limits within which chi-squares are with a probability, equal tails outside.

    Parameters
    ----------
    confidence : float
        In (0, 1).
    degrees : Vector, shape (n,)
        Degrees of freedom of each.
    """
    from scipy.special import gammaincinv  # takes long to import, and is rarely needed

    tail = 0.5 * (1.0 - confidence)
    lower: Vector = 2.0 * gammaincinv(0.5 * degrees, tail)
    upper: Vector = 2.0 * gammaincinv(0.5 * degrees, 1.0 - tail)
    return lower, upper


def student_two_sided(confidence: float, degrees: float) -> float:
    """Return the limit within which Student's t is on both sides with a probability."""
    return math.sqrt(ratio_above(1.0 - confidence, 1.0, degrees))


def normal_two_sided(confidence: float, count: int = 1) -> float:
    """Return the limit within which ``count`` standard normal values all are with a probability.

    By the inequality of Bonferroni, so whether they are independent or not.
    """
    return math.sqrt(chi_square_above((1.0 - confidence) / count, 1.0))


def _quantile(
    tail: Callable[[float], tuple[float, float]], probability: float, start: float
) -> float:
    """Return where a tail has a probability.

    Parameters
    ----------
    tail : callable
        Returns the logarithm of the tail beyond q, and the tail over q times the density.
    probability : float
        In (0, 1).
    start : float
        Where Newton's method starts.
    """
    wanted = math.log(probability)
    u = math.log(start)
    for _ in range(_MOST_STEPS):
        log_tail, inverse_slope = tail(math.exp(u))
        step = (log_tail - wanted) * inverse_slope
        u += step
        if abs(step) <= _NEAR:
            break
    return math.exp(u)


def _log_gamma_tail(a: float, x: float) -> tuple[float, float]:
    """Return the logarithm of Q(a, x), and Q over x times its density."""
    log_density = a * math.log(x) - x - math.lgamma(a)
    if x < a + 1.0:
        term = 1.0 / a
        series = term
        order = a
        while term > _EPSILON * series:  # DLMF 8.7.1
            order += 1.0
            term *= x / order
            series += term
        log_tail = math.log1p(-math.exp(log_density) * series)
        return log_tail, math.exp(log_tail - log_density)

    def terms() -> Iterator[tuple[float, float]]:  # DLMF 8.9.2, even part
        odd = x + 1.0 - a
        yield 1.0, odd
        n = 0
        while True:
            n += 1
            odd += 2.0
            yield n * (a - n), odd

    fraction = _continued_fraction(terms())
    return log_density + math.log(fraction), fraction


def _log_beta_tail(a: float, b: float, r: float) -> tuple[float, float]:
    """Return the logarithm of I = I_x(a, b), x = 1 / (1 + r), and I over r times its density."""
    x = 1.0 / (1.0 + r)
    y = r / (1.0 + r)
    log_x = -math.log1p(r)
    log_y = math.log(r) + log_x
    log_density = a * log_x + b * log_y - _log_beta(a, b)
    if x < (a + 1.0) / (a + b + 2.0):
        fraction = _continued_fraction(_beta_terms(a, b, x)) / a
        return log_density + math.log(fraction), fraction
    lower = math.exp(log_density) * _continued_fraction(_beta_terms(b, a, y)) / b
    log_tail = math.log1p(-lower)
    return log_tail, math.exp(log_tail - log_density)


def _beta_terms(a: float, b: float, x: float) -> Iterator[tuple[float, float]]:
    """Yield numerators and denominators of DLMF 8.17.22."""
    yield 1.0, 1.0
    m = 0
    while True:
        yield -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0)), 1.0
        m += 1
        yield m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m)), 1.0


def _continued_fraction(terms: Iterator[tuple[float, float]]) -> float:
    """Return a continued fraction by Lentz's method."""
    value = upper = _SMALL
    lower = 0.0
    for numerator, denominator in terms:
        lower = 1.0 / (denominator + numerator * lower or _SMALL)
        upper = denominator + numerator / upper or _SMALL
        change = upper * lower
        value *= change
        if abs(change - 1.0) <= 2.0 * _EPSILON:
            break
    return value


def _log_beta(a: float, b: float) -> float:
    """Return log(B(a, b)), without cancellation where a parameter is large."""
    small = min(a, b)
    large = max(a, b)
    total = a + b
    if large < _LARGE:
        return math.lgamma(small) + math.lgamma(large) - math.lgamma(total)
    grown = (large - 0.5) * math.log1p(small / large) + small * (math.log(total) - 1.0)
    return math.lgamma(small) - grown - _stirling(total) + _stirling(large)


def _stirling(x: float) -> float:
    """Return the rest of Stirling's approximation of log(Gamma(x)), DLMF 5.11.1."""
    return (1.0 - (1.0 - 2.0 / (7.0 * x * x)) / (30.0 * x * x)) / (12.0 * x)
