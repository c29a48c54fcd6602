import math

import numpy as np
import pytest

from cosim.blocks.source import Expression, Noise, Table, chirp, constant, ramp, sine, step
from cosim.core.contracts import Stopped
from cosim.errors import UsageError
from cosim.native.numerics.noise import normal
from tests.blocks.stepping import drive, times

STEPS = 2000
T = times(STEPS)


def rows(source):
    return drive(source, np.zeros((STEPS + 1, 0)))


def test_a_constant_is_its_value_to_the_last_bit():
    """Also from numpy's numbers, negative and tiny ones."""
    values = [0.1, -3.5, np.float64(5e-324), 1.7976931348623157e308, 7]
    assert (rows(constant(values)) == np.array(values)).all()


@pytest.mark.parametrize(("before", "after"), [(0.1, 0.3), (1e20, 1.0), (-0.7, 0.0), (0.0, -2.0)])
def test_a_step_gives_both_values_to_the_last_bit(before, after):
    """`before` until `time`, at `time` and later `after`, without rounding; a discrete signal."""
    source = step(time=0.3, before=before, after=after)
    assert source.interface.outputs[0].variability == "discrete"
    expected = np.where(np.arange(STEPS + 1) < 300, before, after)
    assert (rows(source)[:, 0] == expected).all()


def test_a_ramp_begins_at_its_start_time():
    """The ramp is offset + slope max(0, t - start), each operation rounded once, as numpy's."""
    computed = rows(ramp(slope=2.5, start_time=0.7, offset=-1.0))[:, 0]
    assert (computed == -1.0 + 2.5 * np.maximum(0.0, T - 0.7)).all()


def test_a_sine_is_the_closed_form():
    """The sine is offset + amplitude sin(rate t + phase)."""
    computed = rows(sine(amplitude=2.0, rate=30.0, phase=0.4, offset=1.0))[:, 0]
    # the argument is below 61: its last bit is 7e-15, times the amplitude; libm and numpy differ by
    # one more bit of 3
    np.testing.assert_allclose(computed, 1.0 + 2.0 * np.sin(30.0 * T + 0.4), rtol=0, atol=2e-14)


def test_the_rate_of_a_chirp_grows_by_the_sweep():
    """The phase is the integral of rate + sweep t."""
    computed = rows(chirp(amplitude=1.5, rate=3.0, sweep=4.0, offset=-0.5))[:, 0]
    np.testing.assert_allclose(
        computed, -0.5 + 1.5 * np.sin(3.0 * T + 2.0 * T**2), rtol=0, atol=1e-14
    )  # argument below 14
    assert rows(chirp(amplitude=1.0, rate=0.0, sweep=math.pi, offset=0.0))[
        1000, 0
    ] == pytest.approx(1.0, abs=1e-15)


def test_an_expression_gives_the_same_bits_at_a_point_and_in_a_block():
    """`outputs` and `advance` run the same kernel."""
    source = Expression(["exp(-t)*sin(50*t)", "t**3"])
    block = rows(source)
    points = np.array([source.outputs(t, np.zeros(0)) for t in T])
    assert (block == points).all()


def table(**options):
    return Table(
        np.array([0.0, 0.5, 1.0]), np.array([[0.0, 1.0], [2.0, 0.0], [2.0, 5.0]]), **options
    )


def test_a_table_interpolates_linearly():
    """Between the points, element by element."""
    source = table()
    assert source.interface.outputs[0].variability == "continuous"
    u = np.zeros((1001, 0))
    t = times(1000)
    expected = np.column_stack(
        [np.where(t < 0.5, 4.0 * t, 2.0), np.where(t < 0.5, 1.0 - 2.0 * t, 10.0 * (t - 0.5))]
    )
    np.testing.assert_allclose(
        drive(source, u), expected, rtol=0, atol=2e-15
    )  # values below 5: a few of their last bits


def test_a_held_table_keeps_each_value():
    """A discrete signal that changes at the instants of the table."""
    source = table(hold=True)
    assert source.interface.outputs[0].variability == "discrete"
    computed = drive(source, np.zeros((1001, 0)))
    k = np.arange(1001)[:, np.newaxis]
    assert (
        computed == np.where(k < 500, [0.0, 1.0], np.where(k < 1000, [2.0, 0.0], [2.0, 5.0]))
    ).all()


@pytest.mark.parametrize("hold", [False, True])
def test_a_table_refuses_beyond_its_ends(hold):
    """It does not extrapolate: no start outside it; at its end it stops with all rows before."""
    source = table(hold=hold)
    for t in (-0.001, 1.001):
        with pytest.raises(UsageError, match=rf"table: .*0\.0 s to 1\.0 s, got {t} s"):
            source.initialize(t, np.zeros(0))
    with pytest.raises(Stopped, match=r"table: .*0\.0 s to 1\.0 s, got 1\.001 s") as stop:
        drive(source, np.zeros((1501, 0)))
    assert stop.value.failed
    np.testing.assert_array_equal(stop.value.outputs, drive(source, np.zeros((1001, 0)))[1:])


def test_a_table_does_not_change_with_the_arrays_it_was_made_from():
    """It keeps copies."""
    t = np.array([0.0, 1.0])
    y = np.array([[1.0], [2.0]])
    source = Table(t, y)
    y[:] = 7.0
    t[:] = 9.0
    assert source.initialize(0.5, np.zeros(0)) == [1.5]


@pytest.mark.parametrize(
    ("t", "y", "text"),
    [
        (
            [0.0],
            [[1.0]],
            r"values.*instants, at least 2.*1 instants and 1 values",
        ),
        ([0.0, 1.0], [[1.0]], r"values.*instants.*2.*2 instants and 1 values"),
        ([0.0, np.nan], [[1.0], [2.0]], r"finite numbers.*NaN or infinity"),
        ([0.0, 1.0], [[1.0], [np.inf]], r"finite numbers.*NaN or infinity"),
        (
            [0.0, 1.0, 0.5],
            [[1.0], [2.0], [3.0]],
            r"increasing instants.*t\[2\] = 0\.5 s after.*= 1\.0 s",
        ),
    ],
)
def test_a_table_that_is_none_is_refused(t, y, text):
    """Number, finiteness, order."""
    with pytest.raises(UsageError, match=text):
        Table(np.array(t), np.array(y))


def test_noise_is_the_transformation_of_box_and_muller_of_the_generator_s_words():
    """sqrt(-2 ln u) cos(2 pi v) of 53 bits each of PCG64's words, the ends of both included.

    The error of 2 pi v is up to 2^-52 6.3, twice 2^-53 relative in 2 pi and once in the product,
    times the deviation of 8.6 at most.
    """
    mpmath = pytest.importorskip("mpmath")
    largest = 2**64 - 1
    words = np.random.PCG64(3).random_raw(2000)
    words[:6] = [0, 0, largest, largest, 2**11 - 1, largest // 4]
    computed = normal(words)
    for pair, value in zip(words.reshape(-1, 2).tolist(), computed.tolist(), strict=True):
        u = mpmath.mpf((pair[0] >> 11) + 1) / 2**53
        v = mpmath.mpf(pair[1] >> 11) / 2**53
        exact = mpmath.sqrt(-2 * mpmath.log(u)) * mpmath.cos(2 * mpmath.pi * v)
        assert abs(value - exact) <= 8.6 * 6.3 * 2.0**-52


def test_noise_is_gaussian():
    """Its distribution is the normal one, by the test of Kolmogorov.

    D is the largest distance; P(sqrt(n) D > 2.7) = 2 exp(-2 2.7^2) < 1e-6. The tails
    have the share that they should have.
    """
    n = 400_000
    values = np.sort(drive(Noise(deviation=1.0, seed=9), np.zeros((n + 1, 0)))[1:, 0])
    below = np.array([math.erfc(-x / math.sqrt(2.0)) / 2.0 for x in values])
    ranks = np.arange(n)
    distance = max((below - ranks / n).max(), ((ranks + 1) / n - below).max())
    assert math.sqrt(n) * distance < 2.7
    beyond_four = n * math.erfc(4.0 / math.sqrt(2.0))
    assert abs((np.abs(values) > 4.0).sum() - beyond_four) < 5.0 * math.sqrt(beyond_four)


def test_noise_repeats_with_its_seed_and_has_its_deviation():
    """The same seed gives the same bits, another seed another sequence.

    Mean and deviation are within five standard errors.
    """
    n = 100_000
    u = np.zeros((n + 1, 0))
    first, again, other = (drive(Noise(deviation=0.3, seed=seed, size=2), u) for seed in (5, 5, 6))
    assert (first == again).all()
    assert (first != other).all()
    assert abs(first.mean(axis=0)).max() < 5 * 0.3 / math.sqrt(n)
    assert abs(first.std(axis=0) - 0.3).max() < 5 * 0.3 / math.sqrt(2 * n)
    assert abs(np.corrcoef(first.T)[0, 1]) < 5 / math.sqrt(n)
    assert abs(np.corrcoef(first[1:, 0], first[:-1, 0])[0, 1]) < 5 / math.sqrt(n)


def test_a_table_may_hold_its_ends():
    """Before the first instant the first value, after the last one the last."""
    for hold in (False, True):
        source = Table(np.array([1.0, 2.0]), np.array([[3.0], [5.0]]), hold=hold, extrapolate=True)
        found = source.advance(np.array([0.0, 0.0, 0.5, 1.0, 2.0, 9.0]), 1.0, np.zeros((6, 0)))
        assert found[:, 0].tolist() == [3.0, 3.0, 3.0, 5.0, 5.0]


def test_a_slope_beyond_all_numbers_is_refused():
    """Between finite points it may be infinite."""
    t = np.array([0.0, 5e-324, 1.0])
    y = np.array([[0.0], [1.0], [1.0]])
    with pytest.raises(UsageError, match=r"the slope of y.*t\[0\] = 0\.0 s and 5e-324 s"):
        Table(t, y)
    assert Table(t, y, hold=True).outputs(0.0, np.zeros(0)) == 0.0
