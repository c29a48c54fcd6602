"""Integrator, with limits and without, against closed forms."""

from itertools import pairwise

import numpy as np
import pytest
from mpmath import mp, mpf

from cosim.blocks.dynamics import integrator
from cosim.blocks.limited_integrator import LimitedIntegrator
from cosim.core.linear import Linear
from cosim.errors import UsageError
from tests.blocks.stepping import drive, times

RANDOM = np.random.default_rng(5).standard_normal((60, 2))
SPACING = 2.0**-52


def test_an_integral_of_straight_lines_is_that_of_the_trapezoids():
    """Held inputs give rectangles; a rounding of y a step, of which the largest is below 0.1."""
    area = np.vstack([np.zeros(2), np.cumsum((RANDOM[:-1] + RANDOM[1:]) * 0.5e-3, axis=0)])
    held = np.vstack([np.zeros(2), np.cumsum(RANDOM[:-1] * 1e-3, axis=0)])
    for make in (lambda: Linear(integrator(size=2)), lambda: LimitedIntegrator(size=2)):
        np.testing.assert_allclose(drive(make(), RANDOM), area, rtol=0, atol=60 * 0.1 * SPACING)
        y = drive(make(), RANDOM, held=True)
        np.testing.assert_allclose(y, held, rtol=0, atol=60 * 0.1 * SPACING)


def test_the_initial_value_is_that_of_every_element():
    """Whatever the input is."""
    assert (drive(Linear(integrator(initial=2.0, size=2)), RANDOM)[0] == 2.0).all()
    assert (drive(LimitedIntegrator(initial=-3.0, size=2), RANDOM)[0] == -3.0).all()


def exact(u, h, lower, upper, x):
    """Integrate straight lines within limits, in exact pieces of 40 digits."""
    rows = [x]
    for begin, end in pairwise(map(mpf, u)):
        pieces = [(begin, end, mpf(1))]
        if begin * end < 0:
            at = begin / (begin - end)
            pieces = [(begin, mpf(0), at), (mpf(0), end, 1 - at)]
        for first, last, length in pieces:
            x = min(max(x + h * length * (first + last) / 2, lower), upper)
        rows.append(x)
    return np.array(rows, np.float64)


@pytest.mark.parametrize(("lower", "upper"), [(-0.01, 0.02), (-1.0, 0.0), (0.0, 1e-4)])
def test_it_stops_at_its_limits_and_leaves_them_within_a_step(lower, upper):
    """Exactly, to the rounding of a step: limits forget what was before."""
    with mp.workdps(40):
        h = mpf(1) / 50
        expected = exact(RANDOM[:, 0], h, mpf(lower), mpf(upper), mpf(0))
    component = LimitedIntegrator(lower=lower, upper=upper)
    y = drive(component, RANDOM[:, :1], step_ns=20_000_000)[:, 0]
    np.testing.assert_allclose(y, expected, rtol=0, atol=60 * 0.05 * SPACING)
    assert y.min() >= lower
    assert y.max() <= upper
    assert (y == lower).any() or (y == upper).any()


def test_there_is_no_windup():
    """For u = cos t up to 0.5 it leaves the limit as u passes 0, at pi/2, not later."""
    h = 0.01
    t = times(400, 10_000_000)
    y = drive(LimitedIntegrator(lower=-2.0, upper=0.5), np.cos(t)[:, None], step_ns=10_000_000)
    exactly = np.where(t < np.pi / 2, np.minimum(np.sin(t), 0.5), np.sin(t) - 0.5)
    # the error of straight lines in the place of the cosine: h^2/12 a second
    np.testing.assert_allclose(y[:, 0], exactly, rtol=0, atol=4.0 * h**2 / 12.0)


def test_limits_that_are_none_are_refused():
    """With what was found."""
    with pytest.raises(UsageError, match=r"lower < upper.*lower = 1\.0 and upper = 1\.0"):
        LimitedIntegrator(lower=1.0, upper=1.0)
    with pytest.raises(UsageError, match=r"initial: .*lower = 1\.0.*, got 0\.0"):
        LimitedIntegrator(lower=1.0, upper=2.0)
