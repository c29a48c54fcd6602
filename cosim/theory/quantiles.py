"""Quantiles behind tests and intervals; scipy.stats would take long to import."""

from __future__ import annotations

from typing import Final

import numpy as np

from cosim.arrays import Vector

CONFIDENCE: Final = 0.95  # of the intervals and bands that are shown
GUARANTEED_CONFIDENCE: Final = 0.999  # of noise within its bounds in a guaranteed interval


def chi_square_above(probability: float, degrees: float) -> float:
    """Return what a chi-square of ``degrees`` degrees of freedom exceeds with a probability."""
    from scipy.special import gammainccinv

    return 2.0 * float(gammainccinv(0.5 * degrees, probability))


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
    from scipy.special import betaincinv

    if np.isinf(freedom):
        return chi_square_above(probability, degrees)
    part = float(betaincinv(0.5 * freedom, 0.5 * degrees, probability))
    return freedom * (1.0 - part) / part


def chi_square_limits(confidence: float, degrees: Vector) -> tuple[Vector, Vector]:
    """Return the limits within which chi-squares are with a probability, equal tails outside.

    Parameters
    ----------
    confidence : float
        In (0, 1).
    degrees : Vector, shape (n,)
        Degrees of freedom of each.
    """
    from scipy.special import gammaincinv

    tail = 0.5 * (1.0 - confidence)
    lower: Vector = 2.0 * gammaincinv(0.5 * degrees, tail)
    upper: Vector = 2.0 * gammaincinv(0.5 * degrees, 1.0 - tail)
    return lower, upper


def student_two_sided(confidence: float, degrees: float) -> float:
    """Return the limit within which Student's t is on both sides with a probability."""
    from scipy.special import stdtrit

    return -float(stdtrit(degrees, 0.5 * (1.0 - confidence)))


def normal_two_sided(confidence: float, count: int = 1) -> float:
    """Return the limit within which ``count`` standard normal values all are with a probability.

    By the inequality of Bonferroni, so whether they are independent or not.
    """
    from scipy.special import ndtri

    return -float(ndtri((1.0 - confidence) / (2.0 * count)))
