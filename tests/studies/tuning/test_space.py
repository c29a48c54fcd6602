"""Keys between bounds as coordinates from 0 to 1."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import UsageError
from cosim.studies.tuning.space import BoundedKey, ChoiceKey, SearchSpace, check_space

LINEAR = BoundedKey("a.x", -2.0, 6.0)
LOGARITHMIC = BoundedKey("a.rate", 10.0, 1e4, logarithmic=True)


@given(st.floats(0.0, 1.0), st.sampled_from([LINEAR, LOGARITHMIC]))
def test_a_value_has_its_coordinate_again(coordinate, key):
    """Rounding to 12 digits moves it by half a unit of the last of them."""
    value = key.value(coordinate)
    rounding = 0.5e-11 * max(abs(value), 1e-300) / key.slope(value)
    assert key.coordinate(value) == pytest.approx(coordinate, abs=rounding + 1e-15)


@given(st.floats(-1.0, 2.0), st.sampled_from([LINEAR, LOGARITHMIC]))
def test_a_value_stays_between_its_bounds_and_has_few_digits(coordinate, key):
    value = key.value(coordinate)
    assert key.lower <= value <= key.upper
    assert float(f"{value:.12g}") == value


def test_the_bounds_are_met_to_the_bit():
    key = BoundedKey("k", 0.1 + 0.2, 1.0 / 3.0 + 1.0, logarithmic=True)
    assert (key.value(0.0), key.value(1.0)) == (key.lower, key.upper)


def test_the_middle_of_a_logarithm_is_the_geometric_mean():
    assert LOGARITHMIC.value(0.5) == pytest.approx(math.sqrt(10.0 * 1e4), rel=1e-11)


def test_the_widest_bounds_do_not_overflow():
    key = BoundedKey("k", -1.7e308, 1.7e308)
    assert key.value(0.5) == 0.0
    assert key.coordinate(1.7e308) == 1.0


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ((), "vary: .*none"),
        ((LINEAR, LINEAR), r"vary\['a\.x'\]: .*twice"),
        ((BoundedKey("k", 2.0, 1.0),), "got 2.0 to 1.0"),
        ((BoundedKey("k", 0.0, math.inf),), "got 0.0 to inf"),
        ((BoundedKey("k", 0.0, 1.0, True),), "positive bounds.*0.0 to 1.0"),
        ((ChoiceKey("k", ()),), r"vary\['k'\]: .*got \[\]"),
        ((ChoiceKey("k", (1, 1)),), r"got \[1, 1\]"),
        ((ChoiceKey("k", (1, 1.0)),), r"got \[1, 1.0\]"),
    ],
)
def test_wrong_keys_are_refused(keys, message):
    with pytest.raises(UsageError, match=message):
        check_space(SearchSpace(keys))
