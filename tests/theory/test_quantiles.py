"""Quantiles, against the tails of mpmath at 40 digits and against scipy."""

from itertools import product

import mpmath
import numpy as np
import pytest
from scipy import special

from cosim.theory.quantiles import (
    chi_square_above,
    chi_square_limits,
    normal_two_sided,
    ratio_above,
    student_two_sided,
)

PROBABILITIES = [1e-12, 1e-8, 0.01, 0.05, 0.5, 0.9]
# Each of the few hundred operations of a tail rounds once, and the exponents of its density are
# some tens: a relative error of 1e-12 leaves room for both.
ROUNDING = 1e-12


def test_a_chi_square_exceeds_the_quantile_with_the_probability(subtests):
    """The tail beyond the quantile is the probability."""
    for probability, degrees in product(PROBABILITIES, [0.5, 1, 2, 7.3, 40, 1000]):
        with subtests.test(probability=probability, degrees=degrees):
            quantile = chi_square_above(probability, degrees)
            with mpmath.workdps(40):
                half = mpmath.mpf(degrees) / 2
                tail = mpmath.gammainc(half, mpmath.mpf(quantile) / 2, regularized=True)
            assert float(tail) == pytest.approx(probability, rel=ROUNDING)


def test_a_ratio_exceeds_the_quantile_with_the_probability(subtests):
    """The tail beyond the quantile is the probability."""
    for probability, degrees, freedom in product(
        PROBABILITIES, [0.5, 1, 7.3, 400], [0.7, 10, 200, 4e4]
    ):
        with subtests.test(probability=probability, degrees=degrees, freedom=freedom):
            quantile = ratio_above(probability, degrees, freedom)
            with mpmath.workdps(40):
                half = mpmath.mpf(freedom) / 2
                x = mpmath.mpf(freedom) / (mpmath.mpf(freedom) + mpmath.mpf(quantile))
                tail = mpmath.betainc(half, mpmath.mpf(degrees) / 2, 0, x, regularized=True)
            assert float(tail) == pytest.approx(probability, rel=ROUNDING)


def test_normal_and_student_values_are_those_of_scipy(subtests):
    """Of one value, and of several that all are within."""
    for confidence in [0.5, 0.95, 0.999, 1.0 - 2.0**-20]:
        with subtests.test(confidence=confidence):
            for count in (1, 3):
                normal = -special.ndtri((1.0 - confidence) / (2.0 * count))
                assert normal_two_sided(confidence, count) == pytest.approx(normal, rel=ROUNDING)
            for degrees in (1, 2, 30.5, 39995.0):
                student = -special.stdtrit(degrees, 0.5 * (1.0 - confidence))
                assert student_two_sided(confidence, degrees) == pytest.approx(
                    student, rel=ROUNDING
                )


def test_a_ratio_to_a_known_scale_is_a_chi_square():
    """So it is in the limit of many degrees of freedom."""
    known = ratio_above(0.01, 3.0, np.inf)
    assert known == chi_square_above(0.01, 3.0)
    assert ratio_above(0.01, 3.0, 1e9) == pytest.approx(known, rel=1e-7)


def test_limits_leave_equal_tails():
    """Of each of several chi-squares."""
    degrees = np.array([1.0, 8.0, 300.0])
    lower, upper = chi_square_limits(0.95, degrees)
    for i, value in enumerate(degrees):
        assert chi_square_above(0.975, value) == pytest.approx(lower[i], rel=ROUNDING)
        assert chi_square_above(0.025, value) == pytest.approx(upper[i], rel=ROUNDING)
