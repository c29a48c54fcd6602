"""The error of a step by three runs, and the cases in which three runs show none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.theory.richardson import step_error

T = np.linspace(0.0, 10.0, 401)


def runs(error):
    """Return three runs of sin t, with the error of a step of 1, 1/2 and 1/4."""
    return [np.sin(T) + error(h) for h in (1.0, 0.5, 0.25)]


def test_an_error_of_one_order_is_exact(subtests):
    """Without terms of higher order the extrapolation has no error but rounding."""
    for p in [1, 2, 3, 4]:
        with subtests.test(p=p):
            found = step_error(T, *runs(lambda h, p=p: 1e-3 * h**p * np.cos(0.7 * T)))
            assert found.order == pytest.approx(p, abs=1e-9)
            assert found.largest == pytest.approx(1e-3, rel=1e-9)
            assert found.time == 0.0
            assert found.last == pytest.approx(1e-3 * np.cos(7.0), rel=1e-9)
            assert not found.reason


@given(
    st.sampled_from([1, 2]),
    st.floats(-0.5, 0.5),
    st.floats(0.1, 3.0),
    st.floats(0.0, 6.0),
)
def test_an_estimate_that_is_given_is_right(p, further, rate, phase):
    """With a term of the next order, up to half of the first, of another course.

    The extrapolation leaves ``c h^(p+1) (2^-p - 2^-(p+1)) ...`` of it: at most a quarter of that
    term at h for p = 1, so an eighth of the error; less for p = 2. Within 20 % with its own order.
    """

    def error(h):
        return 1e-3 * (h**p * np.cos(0.7 * T) + further * h ** (p + 1) * np.sin(rate * T + phase))

    found = step_error(T, *runs(error))
    if found.largest is not None:
        assert found.largest == pytest.approx(np.abs(error(1.0)).max(), rel=0.2)
    if found.last is not None:
        scale = np.abs(error(1.0)[350:]).max()
        assert abs(found.last - error(1.0)[-1]) <= 0.2 * scale


@given(
    st.floats(-1.0, 1.0),
    st.floats(0.01, 1.0),
    st.floats(0.1, 3.0),
    st.floats(0.0, 6.0),
)
def test_orders_1_and_2_together_have_a_bound_or_an_estimate(first, second, rate, phase):
    """``a(t) h + b(t) h^2`` with any a and b, also such that cancel each other in one run.

    A bound is |d1| + 3 |d2|, the error is 2/3 d1 + 8/3 d2: at most 3/2 of the error for one order,
    and not less for any mixture. Nothing is said where the differences do not shrink.
    """

    def error(h):
        return 1e-3 * (first * h * np.cos(0.7 * T) + second * h**2 * np.sin(rate * T + phase))

    found = step_error(T, *runs(error))
    if found.bound is not None and not found.is_rounding:
        assert found.bound >= np.abs(error(1.0)).max()


def test_equal_runs_have_no_error():
    found = step_error(T, *runs(lambda h: 0.0))
    assert found.largest == 0.0
    assert found.order is None


def test_rounding_is_no_error():
    rng = np.random.default_rng(1)
    found = step_error(T, *runs(lambda h: 1e-15 * rng.standard_normal(len(T))))
    assert found.largest is None
    assert "at the level of rounding" in found.reason


def test_rounding_that_grows_is_told_from_an_error_in_any_unit(subtests):
    """Differences that grow as 1/h: 1e-9 of the signal is rounding, 1e-3 of it is not."""
    for unit in [1e-6, 1.0, 1e6]:
        for relative, is_rounding in [(1e-9, True), (1e-3, False)]:
            with subtests.test(unit=unit, relative=relative):
                values = runs(lambda h, size=relative: size / h * np.sign(np.cos(T)))
                found = step_error(T, *(unit * run for run in values))
                assert (found.is_rounding, found.grows) == (is_rounding, not is_rounding)
                # the largest difference is that of the last two runs, (4 - 2) times the size
                bound = pytest.approx(4.0 * relative * unit, rel=1e-6)
                assert found.bound == (bound if is_rounding else None)


def test_differences_of_no_order_are_no_error():
    """As of a chaotic signal: each run has a course of its own."""
    rng = np.random.default_rng(1)
    found = step_error(T, *runs(lambda h: 1e-3 * rng.standard_normal(len(T))))
    assert found.largest is None
    assert found.last is None
    assert found.bound is None
    assert "the observed order is -0.04" in found.reason


def test_growth_is_named():
    found = step_error(T, *runs(lambda h: 1e-3 / h * np.sign(np.cos(T))))
    assert found.grows
    assert "the differences grow as the step is halved, from 0.001 to 0.002 rms" in found.reason


def test_an_order_that_changes_on_the_way_is_named():
    """Of first order, then of second: log2 of 2.34 on the whole, by the squares of both halves."""

    def error(h):
        return 1e-3 * np.where(T < 5.0, h, 0.5 * h**2)

    found = step_error(T, *runs(error))
    assert found.largest is None
    # 2 d1 at first, of which |d1| + 3 |d2| is 1.25
    assert found.bound == pytest.approx(1.25e-3, rel=1e-9)
    assert "the order is not steady: 1.23 on the whole, 2.00 from t = 5 s" in found.reason
    assert found.last == pytest.approx(5e-4, rel=1e-9)


def test_a_part_with_another_course_is_named():
    """The amplitudes of the second half have first order, but not its values."""

    def error(h):
        shift = np.where(T < 5.0, 0.0, 0.7 * np.log2(h))
        return 1e-3 * h * np.cos(2.0 * T + shift)

    found = step_error(T, *runs(error))
    assert found.largest is None
    assert "differences of another course from t = 5 s" in found.reason


def test_one_point_that_differs_is_named():
    """Where the error is largest the order is none, in a run where it is steady elsewhere."""

    def error(h):
        values = 1e-3 * h * np.cos(0.7 * T)
        values[0] = 3e-3 * np.sign(h - 0.75)
        return values

    found = step_error(T, *runs(error))
    assert found.largest is None
    assert found.reason


def test_small_parts_do_not_count():
    """Where the error is a thousandth of the largest, what the differences are does not matter."""
    rng = np.random.default_rng(1)

    def error(h):
        noise = 1e-6 * rng.standard_normal(len(T))
        return np.where(T < 8.0, 1e-3 * h, noise)

    found = step_error(T, *runs(error))
    assert found.largest == pytest.approx(1e-3, rel=1e-6)
    assert found.last is None


def test_values_at_other_instants_are_not_compared():
    coarse, half, quarter = runs(lambda h: h * 1e-3)
    coarse[T < 2.0] = np.nan
    assert "at other instants" in step_error(T, coarse, half, quarter).reason
    half[T < 2.1] = np.nan
    quarter[T < 2.0] = np.nan
    assert step_error(T, coarse, half, quarter).largest == pytest.approx(1e-3)


def test_a_signal_without_values_has_no_error():
    none = np.full(len(T), np.nan)
    assert step_error(T, none, none, none).reason == "it has no value"


def test_few_values_show_nothing():
    values = runs(lambda h: h * 1e-3)
    found = step_error(T[:15], *(run[:15] for run in values))
    assert "it has values at 15 instants; expected 16" in found.reason
