"""Quantiles behind tests and intervals; scipy.stats would take long to import."""

from __future__ import annotations


def chi_square_above(probability: float, degrees: float) -> float:
    """Return what a chi-square of ``degrees`` degrees of freedom exceeds with a probability."""
    from scipy.special import gammainccinv

    return 2.0 * float(gammainccinv(0.5 * degrees, probability))


def student_above(probability: float, degrees: float) -> float:
    """Return what Student's t of ``degrees`` degrees of freedom exceeds with a probability."""
    from scipy.special import stdtrit

    return -float(stdtrit(degrees, probability))
