"""Times on the grid of whole nanoseconds and between."""

import math

from hypothesis import given
from hypothesis import strategies as st

from cosim.instants import (
    NANOSECONDS,
    duration,
    first_nanosecond,
    last_nanosecond,
    whole_duration,
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
