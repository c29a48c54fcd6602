"""Times on the grid of whole nanoseconds and between."""

import math
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.instants import (
    NANOSECONDS,
    Grid,
    duration,
    first_nanosecond,
    last_nanosecond,
    step_of,
    whole_duration,
    written_step,
)

LIMIT = 2**22  # s: up to there doubles tell nanoseconds apart
grid = st.integers(-LIMIT * NANOSECONDS, LIMIT * NANOSECONDS)


@given(grid)
def test_a_time_on_the_grid_is_its_own_nanosecond(n):
    """In both directions, and before 0 s too."""
    assert last_nanosecond(n / NANOSECONDS) == n
    assert first_nanosecond(n / NANOSECONDS) == n


@given(st.floats(-LIMIT, LIMIT))
def test_the_nanoseconds_around_a_time_enclose_it(t):
    """They are one and the same on the grid, else neighbors."""
    last = last_nanosecond(t)
    first = first_nanosecond(t)
    assert last / NANOSECONDS <= t <= first / NANOSECONDS
    assert first - last == (last / NANOSECONDS != t)


@given(st.integers(-(2**63), 2**63 - 1), st.integers(0, 10**30))
def test_the_nanoseconds_around_a_decimal_are_exact(n, rest):
    """Whatever its digits are, also behind the 28 that Python computes with."""
    on_grid = Decimal(f"{n}e-9")
    assert first_nanosecond(on_grid) == last_nanosecond(on_grid) == n
    between = Decimal(f"{n * 10**31 + rest}e-40")
    assert last_nanosecond(between) == n
    assert first_nanosecond(between) == n + (rest > 0)


@given(grid, grid)
def test_the_time_between_two_on_the_grid_is_on_it(first, last):
    """The difference of the doubles is not, mostly."""
    expected = (last - first) / NANOSECONDS
    assert whole_duration(first / NANOSECONDS, last / NANOSECONDS) == expected
    assert duration(first / NANOSECONDS, last / NANOSECONDS) == expected


def test_a_time_between_two_nanoseconds_has_no_whole_duration():
    """Their difference is taken as it is."""
    between = math.nextafter(0.3, 1.0)
    assert whole_duration(0.1, between) is None
    assert whole_duration(between, 0.4) is None
    assert duration(0.1, between) == between - 0.1


@given(st.integers(1, 50), st.integers(51, 50_000), st.integers(0, 10**4), st.integers(0, 10**4))
def test_points_of_a_fraction_are_next_to_its_multiples(numerator, denominator, first, number):
    """Stamps as whole nanoseconds, times as doubles; and a stamp leads back to its point."""
    step = Fraction(numerator, denominator)
    start = round(first * step * NANOSECONDS)
    grid = Grid(start, Fraction(step * NANOSECONDS))
    exact = (first + number) * step
    stamp = grid.stamp(number)
    assert abs(stamp - exact * NANOSECONDS) <= Fraction(1, 2)
    assert grid.time(np.array([number]))[0] == float(exact)
    assert [grid.number(stamp + late) for late in (-1, 0)] == [number - 1, number]
    numbers = np.arange(number, number + 5)
    assert (grid.number(grid.stamp(numbers)) == numbers).all()


@pytest.mark.parametrize(
    ("h", "step_ns", "written"),
    [
        (1e-3, 1_000_000, 1e-3),
        (1 / 60, Fraction(50_000_000, 3), "1/60"),
        (3 / 44_100, Fraction(10_000_000, 147), "1/14700"),
        (0.1 + 2**-53, Fraction(0.1 + 2**-53) * NANOSECONDS, 0.1 + 2**-53),
        (math.inf, None, math.inf),
    ],
)
def test_a_double_is_the_step_that_has_it(h, step_ns, written):
    """Whole nanoseconds, or the simplest fraction; nothing is made up where there is none."""
    if math.isfinite(h):
        assert step_of(h) == step_ns
    assert written_step(h) == written


def test_points_of_a_fraction_with_many_digits_are_the_doubles_next_to_them():
    """Beyond 2**53 neither the multiple of the numerator nor a product is a double."""
    step = Fraction("0.114279226627")
    points = Grid(0, step * NANOSECONDS)
    numbers = np.array([0, 1, 115_132, 1_000_000])
    assert points.time(numbers).tolist() == [float(k * step) for k in numbers.tolist()]
