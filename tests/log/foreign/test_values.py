"""Times of messages are whole ns."""

import math
from fractions import Fraction

import numpy as np
import pytest

from cosim.log.foreign.field_path import FieldProblem
from cosim.log.foreign.values import nanoseconds_in

SECOND_NS = 10**9


@pytest.mark.parametrize("unit_ns", [1, 1000, 10**6, SECOND_NS])
def test_a_time_is_the_nearest_ns_of_its_number(unit_ns):
    """Though no float64 has as many digits as a time of today in ns."""
    random = np.random.default_rng(unit_ns)
    for value in random.uniform(0.0, 4e18 / unit_ns, 500).tolist():
        distance = abs(nanoseconds_in(value, unit_ns) - Fraction(value) * unit_ns)
        # one rounding of a product below the unit, and one to whole ns
        assert distance <= Fraction(1, 2) + Fraction(unit_ns, 2**53)
    assert nanoseconds_in(1_700_000_000.0625, SECOND_NS) == 1_700_000_000_062_500_000
    assert nanoseconds_in(-1.5, SECOND_NS) == -1_500_000_000


def test_neighboring_times_are_two():
    """As far apart as their numbers are."""
    later = math.nextafter(2.2e9, math.inf)
    between = nanoseconds_in(later, SECOND_NS) - nanoseconds_in(2.2e9, SECOND_NS)
    assert between == round(Fraction(math.ulp(2.2e9)) * SECOND_NS)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e10, True, "1.5", None])
def test_what_is_no_time_is_refused(value):
    """Or is beyond the year 2262."""
    with pytest.raises(FieldProblem, match="needed a time"):
        nanoseconds_in(value, SECOND_NS)
