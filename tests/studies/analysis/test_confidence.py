"""Intervals: against scipy, against a textbook, and how often they hold in simulations."""

import math

import numpy as np
import pytest
from scipy import stats

from cosim.studies.analysis.confidence import (
    NO_INTERVAL,
    deviation_interval,
    effective_count,
    is_rough,
    mean_interval,
    proportion_interval,
    quantile_interval,
)

SHORT = 1000
LONG = 20_000
# binomial: the share of SHORT intervals that hold is within 3.3 deviations of 95 % in 999 of 1000
WITHIN = {SHORT: (0.927, 0.973), LONG: (0.93, 0.97)}
COUNTS = [SHORT, pytest.param(LONG, marks=pytest.mark.campaign)]


def holds(interval, true):
    return interval.lower <= true <= interval.upper


def share_that_hold(intervals, true):
    return sum(holds(interval, true) for interval in intervals) / len(intervals)


def is_close(interval, lower, upper):
    return np.allclose([interval.lower, interval.upper], [lower, upper], rtol=1e-12)


@pytest.mark.parametrize("count", [2, 3, 30, 1000])
def test_a_mean_has_the_interval_of_students_t(count):
    """As scipy has it."""
    values = np.random.default_rng(count).normal(3.0, 2.0, count)
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert is_close(mean_interval(values), expected.low, expected.high)
    units = np.arange(count)[::-1]
    assert is_close(mean_interval(values, units), expected.low, expected.high)


def test_units_of_equal_size_have_the_interval_of_their_means():
    """The mean of all is the mean of the means of units, which are independent."""
    values = np.random.default_rng(1).normal(size=(12, 5)) + np.arange(12.0)[:, np.newaxis]
    units = np.repeat(np.arange(12), 5)
    expected = stats.ttest_1samp(values.mean(axis=1), 0.0).confidence_interval(0.95)
    assert is_close(mean_interval(values.ravel(), units), expected.low, expected.high)


def test_one_member_has_no_interval():
    """Nor has none."""
    assert mean_interval(np.ones(1)) == NO_INTERVAL
    assert mean_interval(np.ones(0)) == NO_INTERVAL
    assert mean_interval(np.ones(4), np.zeros(4, np.int64)) == NO_INTERVAL
    assert deviation_interval(np.arange(4.0)) == NO_INTERVAL
    assert deviation_interval(np.ones(100)) == NO_INTERVAL
    assert deviation_interval(np.zeros(0)) == NO_INTERVAL
    assert quantile_interval(np.zeros(0), 0.5) == NO_INTERVAL


@pytest.mark.parametrize("count", [1, 5, 58, 59, 200, 100_000])
@pytest.mark.parametrize("probability", [0.05, 0.5, 0.95, 0.99])
def test_a_quantile_has_the_interval_of_its_order_statistics(count, probability):
    """As scipy has it: NaN there is no end here."""
    values = np.sort(np.random.default_rng(count).exponential(size=count))
    expected = stats.quantile_test(values, p=probability).confidence_interval(0.95)
    found = quantile_interval(values, probability)
    lower = math.nan if found.lower is None else found.lower
    upper = math.nan if found.upper is None else found.upper
    assert np.array_equal([lower, upper], [expected.low, expected.high], equal_nan=True)


@pytest.mark.parametrize(("passed", "of"), [(0, 1), (0, 10), (3, 10), (10, 10), (999, 1000)])
def test_a_proportion_has_wilsons_interval(passed, of):
    """As scipy has it."""
    expected = stats.binomtest(passed, of).proportion_ci(method="wilson")
    found = proportion_interval(passed, of)
    assert np.allclose([found.lower, found.upper], [expected.low, expected.high], atol=1e-12)


def test_the_effective_count_is_that_of_independent_values():
    """Members that repeat the value of their unit count once, independent ones all."""
    rng = np.random.default_rng(4)
    single = rng.normal(size=4000)
    units = np.repeat(np.arange(4000), 5)
    repeated = effective_count(np.repeat(single, 5), units)
    assert repeated == pytest.approx(4000.0, rel=2e-3)
    independent = effective_count(rng.normal(size=20_000), units)
    # the variance of the sum of 4000 units is known to a share of sqrt(2 / 4000)
    assert independent == pytest.approx(20_000.0, rel=0.1)
    assert effective_count(np.ones(50), np.repeat(np.arange(10), 5)) < 10.0
    assert effective_count(np.ones(50), np.zeros(50, np.int64)) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("count", COUNTS)
def test_95_percent_of_the_intervals_hold(count):
    """Of normal, uniform and Rayleigh values: the mean and the deviation."""
    rng = np.random.default_rng(7)
    low, high = WITHIN[count]
    laws = [stats.norm(1.0, 2.0), stats.uniform(-1.0, 3.0), stats.rayleigh()]
    for law in laws:
        samples = law.rvs((count, 200), random_state=rng)
        assert low <= share_that_hold([*map(mean_interval, samples)], law.mean()) <= high
        assert low <= share_that_hold([*map(deviation_interval, samples)], law.std()) <= high


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("probability", [0.1, 0.5])
def test_as_many_intervals_of_quantiles_hold_as_the_binomial_law_says(count, probability):
    """At least 95 %, and at most 97 % of 200 members: order statistics are discrete."""
    ranks = quantile_interval(np.arange(1.0, 201.0), probability)
    below = stats.binom(200, probability)
    expected = below.cdf(ranks.upper - 1.0) - below.cdf(ranks.lower - 1.0)
    assert 0.95 <= expected <= 0.97
    ordered = np.sort(np.random.default_rng(6).exponential(size=(count, 200)), axis=1)
    intervals = [quantile_interval(row, probability) for row in ordered]
    deviation = math.sqrt(expected * (1.0 - expected) / count)
    found = share_that_hold(intervals, -math.log1p(-probability))
    assert abs(found - expected) <= 3.3 * deviation


@pytest.mark.parametrize("count", COUNTS)
def test_95_percent_of_the_intervals_of_proportions_hold(count):
    """On the average over proportions: those of one proportion go up and down with it."""
    rng = np.random.default_rng(8)
    low, high = WITHIN[count]
    proportions = rng.uniform(0.02, 0.98, count)
    passed = rng.binomial(150, proportions)
    hold = 0
    for k, proportion in zip(passed, proportions, strict=True):
        hold += holds(proportion_interval(int(k), 150), proportion)
    assert low <= hold / count <= high


@pytest.mark.slow
@pytest.mark.parametrize("count", COUNTS)
def test_95_percent_of_the_intervals_of_units_hold(count):
    """80 samples of 4 seeds each: the sample moves the value as much as the seed does.

    Without the units too few hold.
    """
    rng = np.random.default_rng(9)
    low, high = WITHIN[count]
    units = np.repeat(np.arange(80), 4)
    means, careless, deviations, medians, shares = [], [], [], [], []
    for _ in range(count):
        values = np.repeat(rng.normal(size=80), 4) + rng.normal(size=320)
        means.append(mean_interval(values, units))
        careless.append(mean_interval(values))
        deviations.append(deviation_interval(values, units))
        below = values <= np.median(values)
        number = effective_count(below.astype(float), units)
        medians.append(quantile_interval(np.sort(values), 0.5, count=number))
        positive = values > 0.0
        number = effective_count(positive.astype(float), units)
        shares.append(proportion_interval(int(positive.sum()), 320, count=number))
    assert low <= share_that_hold(means, 0.0) <= high
    assert low <= share_that_hold(deviations, math.sqrt(2.0)) <= high
    assert low <= share_that_hold(medians, 0.0) <= high + 0.01  # order statistics are discrete
    assert low <= share_that_hold(shares, 0.5) <= high
    assert share_that_hold(careless, 0.0) < 0.85


@pytest.mark.parametrize("count", COUNTS)
def test_where_too_few_intervals_of_a_mean_hold_they_are_rough(count):
    """Of 40 values with a long tail less than 88 % do; of as many normal ones no word is said."""
    rng = np.random.default_rng(12)
    skewed = rng.lognormal(0.0, 1.5, (count, 40))
    assert share_that_hold([*map(mean_interval, skewed)], math.exp(1.125)) < 0.88
    assert np.mean([*map(is_rough, skewed)]) > 0.9
    assert np.mean([*map(is_rough, rng.normal(size=(count, 40)))]) < 0.02


def test_few_units_make_a_rough_interval_and_equal_values_do_not():
    """Units count, not members."""
    values = np.random.default_rng(13).normal(size=90)
    assert is_rough(values[:9])
    assert not is_rough(values)
    assert is_rough(values, np.arange(90) // 10)
    assert not is_rough(np.ones(5))
    assert not is_rough(np.ones(1))
    assert not is_rough(np.ones(0))


@pytest.mark.parametrize("count", [300, pytest.param(5000, marks=pytest.mark.campaign)])
@pytest.mark.parametrize("sampler", ["latin", "sobol"])
def test_intervals_of_even_designs_are_conservative(count, sampler):
    """The mean of a smooth metric of a Latin hypercube, or a Sobol sequence, varies less."""
    rng = np.random.default_rng(10)
    means = []
    intervals = []
    for _ in range(count):
        if sampler == "latin":
            points = stats.qmc.LatinHypercube(3, rng=rng).random(64)
        else:
            points = stats.qmc.Sobol(3, rng=rng).random(64)
        values = np.exp(points[:, 0]) + points[:, 1] * points[:, 2]
        means.append(values.mean())
        intervals.append(mean_interval(values, variance_factor=64.0 / 63.0))
    # an integral of exp, and one of a product
    assert share_that_hold(intervals, math.e - 1.0 + 0.25) >= 0.99
    widths = [interval.upper - interval.lower for interval in intervals]
    assert np.mean(widths) > 2.0 * 3.92 * np.std(means)


@pytest.mark.parametrize("count", [1000, pytest.param(10_000, marks=pytest.mark.campaign)])
def test_intervals_of_a_latin_hypercube_hold_where_it_does_not_help(count):
    """Of a product of two parameters, which has no part that depends on one of them alone."""
    rng = np.random.default_rng(11)
    intervals = []
    for _ in range(count):
        points = stats.qmc.LatinHypercube(2, rng=rng).random(128)
        values = (points[:, 0] - 0.5) * (points[:, 1] - 0.5)
        intervals.append(mean_interval(values, variance_factor=128.0 / 127.0))
    assert 0.93 <= share_that_hold(intervals, 0.0) <= 0.975
