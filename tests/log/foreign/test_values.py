"""Times of messages are whole ns."""

import math
from fractions import Fraction

import numpy as np
import pytest

from cosim.log.foreign.fields import FieldProblem, nanoseconds_in

SECOND_NS = 10**9


def test_a_time_is_the_nearest_ns_of_its_number():
    """Though no float64 has as many digits as a time of today in ns."""
    for unit_ns in (1, 1000, 10**6, SECOND_NS):
        random = np.random.default_rng(unit_ns)
        # one rounding of a product below the unit, and one to whole ns
        bound = Fraction(1, 2) + Fraction(unit_ns, 2**53)
        for value in random.uniform(0.0, 4e18 / unit_ns, 500).tolist():
            distance = abs(nanoseconds_in(value, unit_ns) - Fraction(value) * unit_ns)
            assert distance <= bound, (value, unit_ns)
    assert nanoseconds_in(1_700_000_000.0625, SECOND_NS) == 1_700_000_000_062_500_000
    assert nanoseconds_in(-1.5, SECOND_NS) == -1_500_000_000


def test_neighboring_doubles_keep_their_distance_in_ns():
    """As far apart as their numbers are."""
    later = math.nextafter(2.2e9, math.inf)
    between = nanoseconds_in(later, SECOND_NS) - nanoseconds_in(2.2e9, SECOND_NS)
    assert between == round(Fraction(math.ulp(2.2e9)) * SECOND_NS)


def test_values_that_are_no_time_are_refused():
    """Or are beyond the year 2262."""
    for value in (math.nan, math.inf, 1e10, True, "1.5", None):
        with pytest.raises(FieldProblem, match="expected a time, got"):
            nanoseconds_in(value, SECOND_NS)
