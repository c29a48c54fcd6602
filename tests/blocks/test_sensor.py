"""Sensors: each effect by itself, their order, and the statistics of what is random.

Every statistic of n samples is asked to be within five of its standard errors.
"""

import math
import re

import numpy as np
import pytest
from scipy.stats import chi2

from cosim.blocks.measurement import DRAWN_AHEAD, SamplingInstants, SensorParameters
from cosim.blocks.sensor import Sensor
from cosim.blocks.source import Noise, sine
from cosim.core import Clock, Graph, Memory, run
from cosim.errors import UsageError
from cosim.native.blocks.sensor import DrawnSamples, SensorConstants, SensorStep
from tests.blocks.stepping import drive, times

N = 100_000
SIGMA = 0.3


def report(u, *, held=False, size=None, **parameters):
    """Return y of a sensor at all communication points, and valid after it where it is there."""
    u = np.asarray(u, np.float64)
    u = u[:, np.newaxis] if u.ndim == 1 else u
    sensor = Sensor(SensorParameters(**parameters), size=size or u.shape[1])
    return drive(sensor, u, held=held)


def uniform(seed, stream, shape):
    """Return the numbers of [0, 1) that the description of sensors promises."""
    generator = np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(stream,)))
    words = generator.random_raw(math.prod(shape))
    return (words >> np.uint64(11)).reshape(shape) * 2.0**-53


def random_inputs(rows, size=1):
    return np.random.default_rng(7).standard_normal((rows, size))


def test_without_effects_a_sensor_reports_its_input():
    """To the last bit; an effect of no size is none."""
    u = random_inputs(500, 3)
    assert (report(u) == u).all()
    assert (report(u, jitter=0.0, delay=0.0, noise=0.0, bias=0.0) == u).all()
    both = report(u, dropout=0.0)
    assert (both[:, :3] == u).all()
    assert (both[:, 3:] == 1.0).all()


def test_noise_has_its_deviation_and_is_white():
    """Mean, deviation, independence of elements; the first 20 autocorrelations together.

    n times the sum of their squares is chi-squared (Box and Pierce).
    """
    noise = report(np.zeros((N, 2)), noise=[SIGMA, 2.0 * SIGMA], seed=5) / [1.0, 2.0]
    assert abs(noise.mean(axis=0)).max() < 5.0 * SIGMA / math.sqrt(N)
    assert abs(noise.std(axis=0) - SIGMA).max() < 5.0 * SIGMA / math.sqrt(2 * N)
    assert abs(np.corrcoef(noise.T)[0, 1]) < 5.0 / math.sqrt(N)
    for element in noise.T / SIGMA:
        correlations = [np.mean(element[lag:] * element[:-lag]) for lag in range(1, 21)]
        assert N * np.sum(np.square(correlations)) < chi2.isf(1e-6, 20)


def test_noise_is_added_to_every_sample_and_begins_with_the_first():
    """It does not depend on the input, and is not that of a noise source with the same seed."""
    u = random_inputs(100)
    noise = report(np.zeros(100), noise=SIGMA, seed=5)
    np.testing.assert_array_equal(report(u, noise=SIGMA, seed=5), u + noise)
    assert (noise != 0.0).all()
    source = drive(Noise(deviation=SIGMA, seed=5), np.zeros((100, 0)))
    assert not np.isin(noise, source).any()
    assert (report(np.zeros(100), noise=SIGMA, seed=6) != noise).all()


def test_a_bias_is_added():
    """One number, or one for each element."""
    u = random_inputs(50, 2)
    np.testing.assert_array_equal(report(u, bias=0.25), u + 0.25)
    np.testing.assert_array_equal(report(u, bias=[0.25, -1.0]), u + np.array([0.25, -1.0]))


def test_a_sample_beyond_a_limit_is_the_limit():
    """On one side, or on both; noise does not lead beyond it."""
    u = random_inputs(5000, 2)
    np.testing.assert_array_equal(report(u, lower=-0.5), np.maximum(u, -0.5))
    np.testing.assert_array_equal(report(u, upper=[0.5, 0.1]), np.minimum(u, [0.5, 0.1]))
    noisy = report(u, noise=1.0, seed=1, lower=-0.5, upper=0.7)
    assert noisy.min() == -0.5
    assert noisy.max() == 0.7


def test_quantization_takes_the_nearest_multiple():
    """A tie goes to the even one; a resolution of a power of two makes all of it exact."""
    u = np.array([0.0, 0.124, 0.125, 0.126, 0.375, -0.125, -0.374, -0.375, 1e300, -5e-324])
    expected = [0.0, 0.0, 0.0, 0.25, 0.5, 0.0, -0.25, -0.5, 1e300, 0.0]
    np.testing.assert_array_equal(report(u, resolution=0.25)[:, 0], expected)


def test_the_error_of_quantization_is_uniform():
    """At most half the resolution q; its mean is 0, its square q^2/12 with deviation q^2/sqrt(180).

    One step of rounding of values below 5 is 1e-15.
    """
    q = np.array([0.1, 0.03])
    u = random_inputs(N, 2)
    error = report(u, resolution=q.tolist()) - u
    assert (abs(error) <= q / 2.0 + 1e-15).all()
    assert (abs(error.mean(axis=0)) < 5.0 * q / math.sqrt(12.0 * N)).all()
    squares = np.mean(error**2, axis=0)
    assert (abs(squares - q**2 / 12.0) < 5.0 * q**2 / math.sqrt(180.0 * N)).all()


def test_levels_are_within_the_limits():
    """A multiple beyond a limit is no level; decimals count as they are written.

    3 times 0.1 is above 0.3 in doubles, and 0.3 over 0.1 below 3; both are the level 0.3.
    """
    u = np.linspace(-3.0, 3.0, 601)
    y = report(u, resolution=0.1, lower=-0.3, upper=0.3)
    assert np.unique(y).size == 7
    assert y.max() == 0.3
    assert y.min() == -0.3
    # the multiples next to these limits are -1.5 and 2
    y = report(u, resolution=0.5, lower=-1.3, upper=1.8)
    assert np.unique(y).tolist() == [-1.0, -0.5, 0.0, 0.5, 1.0, 1.5]


def test_a_converter_has_its_number_of_levels():
    """2**bits from the lower to the upper limit, both included, at equal distances."""
    u = np.linspace(-2.0, 4.0, 4001)
    y = report(u, bits=5, lower=-1.1, upper=3.3)[:, 0]
    levels = np.unique(y)
    assert levels[[0, -1]].tolist() == [-1.1, 3.3]
    # a last bit of 3.3 is 4.4e-16
    np.testing.assert_allclose(levels, np.linspace(-1.1, 3.3, 32), rtol=0.0, atol=1e-15)
    inside = (u > -1.1) & (u < 3.3)
    assert abs(y - u)[inside].max() <= 4.4 / 31 / 2 + 1e-15


def test_levels_closer_than_doubles_change_nothing():
    """Nor do they make large values infinite."""
    u = np.array([1e300, -1e20, 1.0])
    np.testing.assert_array_equal(report(u, resolution=1e-200)[:, 0], u)
    u = random_inputs(1000)
    np.testing.assert_array_equal(report(u, resolution=1e-20), u)
    u = np.array([1e300, -1e20, 1.0])
    y = report(u, resolution=1e-200, lower=-1e10, upper=1e10)
    np.testing.assert_array_equal(y[:, 0], [1e10, -1e10, 1.0])


def test_the_effects_come_in_the_order_of_a_measuring_chain():
    """Bias before limits, limits before levels: no sample carries the bias or is a limit.

    1.25 is limited to 1.1, nearest to 1.0; 0.75 is a tie, which goes to 2 x 0.5; noise and dropouts
    leave levels.
    """
    y = report([0.9, 0.4, -3.0], bias=0.35, upper=1.1, resolution=0.5, lower=-1.0)[:, 0]
    assert y.tolist() == [1.0, 1.0, -1.0]
    noisy = report(np.zeros(1000), noise=1.0, seed=2, resolution=0.5, dropout=0.5)[:, 0]
    assert (noisy % 0.5 == 0.0).all()
    assert np.unique(noisy).size > 5


def test_a_whole_delay_is_that_of_the_past_input():
    """Before the first sample it is the first input; in elements of any size, to the last bit."""
    u = random_inputs(50, 2)
    expected = np.vstack([np.repeat(u[:1], 7, axis=0), u[:-7]])
    assert (report(u, delay=7.0) == expected).all()
    assert (report(u, delay=7.0, held=True) == expected).all()


def test_a_delay_between_communication_points_interpolates():
    """The input is a straight line over a step, or holds."""
    u = random_inputs(50)[:, 0]
    k = np.arange(50.0)
    y = report(u, delay=2.25)[:, 0]
    # values below 4: a few of their last bits
    np.testing.assert_allclose(y, np.interp(k - 2.25, k, u), rtol=0.0, atol=4e-15)
    held = report(u, delay=2.25, held=True)[:, 0]
    np.testing.assert_array_equal(held, u[np.maximum(np.floor(k - 2.25).astype(int), 0)])


@pytest.mark.parametrize("period", [1, 4])
def test_a_sampling_instant_is_where_jitter_puts_it(period):
    """The input at t - delay + j, j the documented number; y holds within a period."""
    u = random_inputs(400, 2)
    k = np.arange(400.0)
    y = report(u, delay=3.5, jitter=0.5, seed=11, period=period)
    samples = k[::period, np.newaxis]
    j = 0.5 * (2.0 * uniform(11, 1, (len(samples), 2)) - 1.0)
    instants = np.repeat(samples - 3.5 + j, period, axis=0)[:400]
    for i in range(2):
        expected = np.interp(instants[:, i], k, u[:, i])
        # the instants, below 400, are rounded to 6e-14, and slopes are below 7
        np.testing.assert_allclose(y[:, i], expected, rtol=0.0, atol=4e-13)


def test_a_jittered_instant_of_a_held_input_reads_the_staircase():
    """Before a communication point its value is that of the step before."""
    u = random_inputs(400)
    y = report(u, jitter=0.5, seed=11, held=True)[:, 0]
    is_late = uniform(11, 1, (400, 1))[:, 0] < 0.5
    previous = np.concatenate([u[:1, 0], u[:-1, 0]])
    np.testing.assert_array_equal(y, np.where(is_late, previous, u[:, 0]))


def test_after_the_last_input_its_line_goes_on():
    """Exact on a line; on a parabola within j (h + j)/2 u'', and as good as what interpolates.

    The first row has no line: its input is constant before.
    """
    k = np.arange(2000.0)
    j = 0.4 * (2.0 * uniform(3, 1, (2000, 1))[:, 0] - 1.0)
    line = report(3.0 * k, jitter=0.4, seed=3)[:, 0]
    np.testing.assert_allclose(line[1:], 3.0 * (k + j)[1:], rtol=4e-16)
    parabola = report(k**2, jitter=0.4, seed=3)[:, 0]
    error = abs(parabola - (k + j) ** 2)[1:]
    # squares below 4e6 are rounded to 4.7e-10
    assert error.max() <= 0.4 * 1.4 / 2.0 * 2.0 + 1e-9
    assert error[j[1:] < 0.0].max() <= 2.0 / 8.0 + 1e-9


def test_the_last_instant_is_a_step_after_the_last_input():
    """The line of the last step goes on to there; the first instant is the oldest past input."""
    instants = SamplingInstants(SensorParameters(delay=1.0, jitter=2.0, period=4), 1)
    positions = np.array([[-3.0], [1.0], [0.0]])
    drawn = DrawnSamples(positions, np.zeros((3, 1)), np.zeros((3, 1)))
    constants = SensorConstants(
        depth=instants.depth,
        period=1,
        drops=False,
        samples=False,
        stamps=False,
        bias=np.zeros(1),
        lower=np.array([-np.inf]),
        upper=np.array([np.inf]),
        levels=None,
    )
    kernel = SensorStep(constants, drawn)
    kernel.start(0.0, np.array([3.0]))
    u = np.array([[5.0], [8.0]])
    assert kernel.step.outputs_at(0.0, u[0]) == 3.0
    assert kernel.step.advance(np.array([0.0, 1.0]), 1.0, u) == 11.0


def test_jitter_attenuates_a_sine_and_makes_noise_of_the_rest():
    """The mean of sin(w (t + j)) over j within J is sin(wJ)/(wJ) sin(wt); the powers add to 1/2.

    Linear interpolation takes (wh)^2/12 of the amplitude in the mean, and at most (wh)^2/8. The
    mean square of the rest is r = (1 - s^2)/2, so the amplitude 2 mean(y sin) has a standard error
    of sqrt(4 r/n), and that of the mean square of the rest, which is below 4, is at most 2/sqrt(n)
    sqrt(r).
    """
    period = 20
    rows = 5000 * period
    elements = 8
    w = 0.1  # per step: a product with J = 10 steps of 1
    t = np.arange(rows)
    u = np.repeat(np.sin(w * t)[:, np.newaxis], elements, axis=1)
    y = report(u, delay=10.0, jitter=10.0, period=period, seed=4)[period::period]
    expected = np.sin(w * (t[period::period] - 10.0))[:, np.newaxis]
    gain = math.sin(1.0)
    rest = (1.0 - gain**2) / 2.0
    n = y.size
    amplitude = 2.0 * np.mean(y * expected)
    assert abs(amplitude - gain) < 5.0 * math.sqrt(4.0 * rest / n) + w**2 / 8.0
    left = np.mean((y - gain * expected) ** 2)
    assert abs(left - rest) < 5.0 * 2.0 * math.sqrt(rest / n) + w**2 / 8.0


def test_dropouts_have_their_rate_and_are_independent():
    """Their count is binomial; that of two in a row, or in both elements, goes with the square."""
    p = 0.2
    lost = report(np.zeros((N, 2)), dropout=p, seed=8)[1:, 2:] == 0.0
    n = len(lost)
    assert (abs(lost.mean(axis=0) - p) < 5.0 * math.sqrt(p * (1.0 - p) / n)).all()
    both = np.mean(lost[:, 0] & lost[:, 1])
    in_a_row = np.mean(lost[1:] & lost[:-1], axis=0)
    # neighboring pairs share a sample: at most three times the variance of independent ones
    assert abs(both - p**2) < 5.0 * math.sqrt(p**2 / n)
    assert (abs(in_a_row - p**2) < 5.0 * math.sqrt(3.0 * p**2 / n)).all()


def test_a_lost_sample_keeps_the_last_one():
    """Over as many as are lost; valid says which. The first is never lost."""
    u = random_inputs(2000, 2)
    both = report(u, dropout=0.7, seed=8, noise=SIGMA)
    y = both[:, :2]
    valid = both[:, 2:]
    lost = uniform(8, 2, (2000, 2)) < 0.7
    lost[0] = False
    np.testing.assert_array_equal(valid, ~lost)
    kept = report(u, noise=SIGMA, seed=8)
    for k in range(1, 2000):
        kept[k] = np.where(lost[k], kept[k - 1], kept[k])
    np.testing.assert_array_equal(y, kept)
    for seed in range(20):
        assert report([1.0, 2.0], dropout=0.99, seed=seed)[0].tolist() == [1.0, 1.0]


def test_an_effect_changes_no_number_of_another():
    """Noise, jitter and dropouts have streams of their own."""
    u = random_inputs(3000, 2)
    alone = report(u, noise=SIGMA, seed=3)
    with_all = report(np.zeros_like(u), noise=SIGMA, seed=3, jitter=0.3, dropout=0.3)
    is_new = with_all[:, 2:] == 1.0
    np.testing.assert_array_equal(
        with_all[:, :2][is_new], report(np.zeros_like(u), noise=SIGMA, seed=3)[is_new]
    )
    assert (alone != u).all()
    jittered = report(u, jitter=0.3, seed=3)
    both = report(u, jitter=0.3, seed=3, noise=SIGMA)
    # sums with noise are rounded once more
    np.testing.assert_allclose(both - jittered, alone - u, rtol=0.0, atol=2e-15)
    lost = report(u, dropout=0.3, seed=3)[:, 2:] == 0.0
    assert (lost == ~is_new).all()


def test_a_period_samples_less_often():
    """Every n-th point a sample with numbers of its own, held in between, and so is valid.

    They are the numbers that a sensor takes which sees these points only.
    """
    u = random_inputs(403, 2)
    parameters = {"noise": SIGMA, "dropout": 0.3, "seed": 9}
    sparse = report(u, period=4, **parameters)
    samples = report(u[::4], **parameters)
    np.testing.assert_array_equal(sparse, np.repeat(samples, 4, axis=0)[:403])


@pytest.mark.parametrize("period", [1, 4])
def test_samples_are_there_once_each(period):
    """Where one is taken, with the time; no value between, nor of what is lost; y holds them."""
    u = random_inputs(403, 2)
    parameters = SensorParameters(noise=SIGMA, dropout=0.3, seed=9, period=period)
    sensor = Sensor(parameters, size=2, samples=True)
    rows = drive(sensor, u)
    y, valid, samples, instants = np.split(rows, [2, 4, 6], axis=1)
    is_taken = np.arange(403) % period == 0
    assert np.isnan(samples[~is_taken]).all()
    assert np.isnan(instants[~is_taken]).all()
    np.testing.assert_array_equal(instants[is_taken, 0], times(402)[is_taken])
    expected = np.where(valid[is_taken] == 1.0, y[is_taken], np.nan)
    np.testing.assert_array_equal(samples[is_taken], expected)


@pytest.mark.parametrize(
    "parameters",
    [
        {"noise": SIGMA, "jitter": 0.5, "dropout": 0.4, "seed": 1},
        {"noise": SIGMA, "jitter": 1.4, "delay": 2.7, "dropout": 0.4, "seed": 1, "period": 3},
    ],
    ids=["every step", "period"],
)
def test_blocks_of_any_length_give_the_same_bits(parameters):
    """K = 1 against 1000 and one block, across what is drawn ahead; also from a saved state."""
    steps = 2 * DRAWN_AHEAD + 5
    u = random_inputs(steps + 1, 3)
    t = times(steps)
    expected = report(u, **parameters)
    sensor = Sensor(SensorParameters(**parameters), size=3)
    for size in (1, 1000):
        sensor.initialize(0.0, u[0])
        for begin in range(0, steps, size):
            block = slice(begin, begin + size + 1)
            found = sensor.advance(t[block], 1e-3, u[block])
            assert (found == expected[block][1:]).all()
            if begin == DRAWN_AHEAD - DRAWN_AHEAD % size:
                middle = (begin + size, sensor.save())
    begin, state = middle
    for _ in range(2):
        sensor.restore(state)
        found = sensor.advance(t[begin:], 1e-3, u[begin:])
        assert (found == expected[begin + 1 :]).all()


@pytest.mark.parametrize(
    ("parameters", "is_fed"),
    [
        ({}, True),
        ({"delay": 0.5}, True),
        ({"delay": 1.0}, False),
        ({"delay": 1.1, "jitter": 0.1, "seed": 1}, False),
        ({"delay": 1.1, "jitter": 0.2, "seed": 1}, True),
    ],
)
def test_only_what_reaches_the_present_feeds_through(parameters, is_fed):
    """A delay of a step beyond the jitter opens a loop; the first output is the first input's."""
    interface = Sensor(SensorParameters(**parameters)).interface
    assert interface.feeds("y") == (("u",) if is_fed else ())
    assert interface.delayed == (() if is_fed else ("u",))
    assert interface.feeds_initially("y") == ("u",)


@pytest.mark.parametrize("parameters", [{"period": 4}, {"delay": 0.5}, {"jitter": 0.5, "seed": 1}])
def test_it_samples_the_same_where_others_take_the_latest_values(parameters):
    """A sample is taken at its instant: the end of the step changes none of them."""
    runs = []
    for interpolation in ("zero-order", "latest"):
        graph = Graph(
            {"s": sine(rate=300.0), "m": Sensor(SensorParameters(**parameters))},
            {"m.u": "s.y"},
            input_interpolation=interpolation,
        )
        memory = Memory()
        run(graph, Clock(step=1e-3, stop=0.02), memory)
        runs.append(memory)
    assert (runs[0]["m.y"] == runs[1]["m.y"]).all()
    assert np.ptp(runs[0]["m.y"]) > 0.5


def test_y_is_interpolated_as_its_input_is():
    """It inherits; with a period it holds. Valid is a Boolean that holds."""
    y, valid = Sensor(SensorParameters(dropout=0.0)).interface.outputs
    assert (y.variability, y.type) == ("inherited", "real")
    assert (valid.variability, valid.type) == ("discrete", "boolean")
    (y,) = Sensor(SensorParameters(period=2)).interface.outputs
    assert y.variability == "discrete"


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"noise": -0.1, "seed": 1}, "noise: expected a standard deviation >= 0, got -0.1"),
        (
            {"noise": [0.1], "seed": 1},
            "noise: expected one number, or one for each of 2 elements, got 1",
        ),
        ({"noise": math.nan, "seed": 1}, "noise: expected finite numbers, got NaN or infinity"),
        (
            {"bias": [1.0, 2.0, 3.0]},
            "bias: expected one number, or one for each of 2 elements, got 3",
        ),
        (
            {"lower": 1.0, "upper": [2.0, 1.0]},
            "lower < upper, got lower = 1 and upper = 1",
        ),
        ({"resolution": 0.0}, "resolution: expected a number > 0, got 0"),
        ({"resolution": [0.1, -0.1]}, "resolution: expected a number > 0, got -0.1"),
        (
            {"resolution": 1.0, "lower": 0.2, "upper": 1.9},
            "resolution: expected two multiples or more between the limits 0.2 and 1.9, got 1",
        ),
        ({"bits": 8}, "bits: requires lower and upper, the range of the levels"),
        ({"bits": 8, "lower": 0.0}, "bits: requires lower and upper, the range of the levels"),
        ({"bits": 0, "lower": 0.0, "upper": 1.0}, "bits: expected 1 to 52, got 0"),
        ({"bits": 53, "lower": 0.0, "upper": 1.0}, "bits: expected 1 to 52, got 53"),
        (
            {"bits": 52, "lower": 8.0, "upper": 9.0},
            "bits: got 52, but there are fewer than 2**52 equidistant doubles from lower to upper",
        ),
        (
            {"bits": 9, "lower": -1e308, "upper": 1e308},
            "bits: got 9, but there are fewer than 2**9 equidistant doubles from lower to upper",
        ),
        (
            {"bits": 8, "resolution": 0.1, "lower": 0.0, "upper": 1.0},
            "resolution or bits, got both",
        ),
        ({"delay": -1.0}, "delay: expected a number of communication steps >= 0, got -1"),
        ({"delay": math.inf}, "delay: expected a number of communication steps >= 0, got inf"),
        (
            {"delay": 1e9},
            "delay: expected at most 134217728 values, got 1e+09 communication steps of 2 values",
        ),
        (
            {"jitter": -0.1, "seed": 1},
            "jitter: expected 0 to 0.5, half the sampling period, so that samples keep their",
        ),
        (
            {"jitter": 0.6, "delay": 3.0, "seed": 1},
            "jitter: expected 0 to 0.5, half the sampling period, so that samples keep their",
        ),
        (
            {"jitter": 2.0, "delay": 0.5, "period": 4, "seed": 1},
            "jitter: got 2 communication steps, so that samples are taken up to 1.5 after they",
        ),
        ({"dropout": 1.0, "seed": 1}, "dropout: expected a probability >= 0 and < 1, got 1"),
        ({"dropout": -0.1, "seed": 1}, "dropout: expected a probability >= 0 and < 1, got -0.1"),
        ({"noise": 0.1}, "seed: expected an integer, as noise, jitter and dropout require one"),
        ({"jitter": 0.1}, "seed: expected an integer, as noise, jitter and dropout require one"),
        ({"dropout": 0.1}, "seed: expected an integer, as noise, jitter and dropout require one"),
        ({"noise": 0.1, "seed": -1}, "seed: expected an integer >= 0, got -1"),
        ({"period": 0}, "period: expected at least 1 communication step, got 0"),
    ],
)
def test_impossible_sensors_are_refused(parameters, text):
    """With the parameter, what was found and what is needed."""
    with pytest.raises(UsageError, match=re.escape(text)):
        Sensor(SensorParameters(**parameters), size=2)
