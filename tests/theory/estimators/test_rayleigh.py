"""The Rayleigh quotient of the regression: theta without a prior and without bias."""

import numpy as np
import pytest

from cosim.errors import AssumptionError
from cosim.theory.disturbances.families import Exponential, Sine, group_by_alpha
from cosim.theory.disturbances.regression import alpha_products, expand, mu
from cosim.theory.estimators.least_squares import least_squares, plan, recover
from cosim.theory.estimators.rayleigh import rayleigh_box, rayleigh_constants
from tests.theory.academic import DELAYS, THETA, delayed
from tests.theory.estimators.passes import means, noise_covariance, rayleigh

FAMILIES = (Exponential(), Exponential())
TERMS = expand((1, 1))
GROUPS = group_by_alpha(["a", "b"], FAMILIES)
T = np.arange(3000, 20000, 10) * 1e-3


def constants():
    return rayleigh_constants(FAMILIES, GROUPS, TERMS, DELAYS)


def regression(noise=0.0, seed=0):
    """Return mu and the products of the alphas, with white noise on delta every 10 ms."""
    samples, factors = delayed(T)
    if noise:
        grid = noise * np.random.default_rng(seed).standard_normal(2000)
        at = np.rint((T[:, np.newaxis] - np.array(DELAYS)) * 100.0).astype(int)
        samples = samples + grid[at]
    return mu(TERMS, samples, factors), alpha_products(TERMS, factors)


def test_the_search_finds_theta_of_exact_rows():
    """From nothing; what the condition of the regression, 3e4, leaves of the digits of its root."""
    rows, factors = regression()
    found = rayleigh(constants(), rows, noise_covariance(TERMS, factors))
    assert found.converged
    np.testing.assert_allclose(found.theta, THETA, rtol=1e-8)
    assert found.variance < 1e-20


def test_starts_far_away_reach_theta(subtests):
    """Also those where both are exchanged, or equal."""
    for start in [(-2.5, -2.5), (-0.3, -0.1), (0.0, -1.0), (-1.0, 0.0)]:
        with subtests.test(start=start):
            rows, factors = regression()
            N = noise_covariance(TERMS, factors)
            found = rayleigh(constants(), rows, N, theta=np.array(start))
            np.testing.assert_allclose(found.theta, THETA, rtol=1e-7)


def test_the_covariance_of_the_noise_is_the_sum_over_unit_noises():
    """A unit in one delayed sample makes a row; N is the sum of the products of all such rows."""
    _, factors = delayed(T[:50])
    expected = np.zeros((len(TERMS), len(TERMS)))
    for j in range(len(DELAYS)):
        unit = np.zeros((50, len(DELAYS)))
        unit[:, j] = 1.0
        for row in mu(TERMS, unit, factors):
            expected += np.multiply.outer(row, row)
    N = noise_covariance(TERMS, alpha_products(TERMS, factors))
    np.testing.assert_allclose(N, expected, rtol=1e-13, atol=1e-13)


def test_the_minimum_estimates_the_variance_of_the_noise():
    """Of 1 700 rows with three noises each; of means of 20 a twentieth of it, about."""
    sigma = 0.05
    rows, factors = regression(sigma)
    found = rayleigh(constants(), rows, noise_covariance(TERMS, factors))
    # the variance of N Gaussian numbers is known to sqrt(2 / N); they stand in rows three times
    assert found.variance == pytest.approx(sigma**2, rel=4.0 * np.sqrt(6.0 / len(rows)))
    averaged = rayleigh(constants(), means(rows, 20), noise_covariance(TERMS, means(factors, 20)))
    assert averaged.variance == pytest.approx(
        sigma**2 / 20, rel=4.0 * np.sqrt(6.0 * 20 / len(rows))
    )


def test_noise_makes_no_bias_where_least_squares_have_one():
    """Mean errors over 12 seeds: least squares is off by more than its scatter, this is not."""
    recovery = plan(TERMS, GROUPS, DELAYS)
    ours = []
    theirs = []
    for seed in range(12):
        rows, factors = regression(0.02, seed)
        averaged = means(rows, 50)
        N = noise_covariance(TERMS, means(factors, 50))
        ours.append(rayleigh(constants(), averaged, N).theta - THETA)
        solved = least_squares(rows, np.full(len(rows), 0.01), None)
        theirs.append(recover(recovery, solved) - THETA)
    scatter = np.std(ours, axis=0, ddof=1) / np.sqrt(12.0)
    assert (np.abs(np.mean(ours, axis=0)) < 4.0 * scatter).all()
    assert (np.abs(np.nanmean(theirs, axis=0)) > 10.0 * np.abs(np.mean(ours, axis=0))).all()


def test_means_leave_out_what_makes_no_whole_one():
    """Seven rows are two means of three."""
    rows = np.arange(14.0).reshape(7, 2)
    np.testing.assert_array_equal(means(rows, 3), [[2.0, 3.0], [8.0, 9.0]])


def test_the_rate_of_a_sine_is_found():
    """Two basis functions under one alpha; amplitude and phase drop out."""
    terms = expand((2,))
    groups = group_by_alpha(["1"], [Sine()])
    delays = (0.5, 1.0, 1.5)
    samples = np.sin(1.3 * (T[:, np.newaxis] - np.array(delays)) + 0.4)
    ones = np.ones((len(T), 3, 1))
    N = noise_covariance(terms, alpha_products(terms, ones))
    box = rayleigh_constants([Sine()], groups, terms, delays)
    found = rayleigh(box, mu(terms, samples, ones), N)
    np.testing.assert_allclose(found.theta, [1.3], rtol=1e-9)


def test_the_box_is_what_the_delays_tell_apart():
    """A sine up to half a period in the shortest gap, an exponential to three times its rate.

    And one that grows tenfold over all delays: how long a record is does not matter.
    """
    box = rayleigh_box([Sine(), Exponential()], [2.0, 0.0, 0.5])
    np.testing.assert_allclose(box.upper, [2.0 * np.pi, np.log(10.0) / 2.0])
    np.testing.assert_allclose(box.lower, [0.0, -6.0])
    np.testing.assert_allclose(box.step, (box.upper - box.lower) / 10.0)


def test_too_many_terms_are_refused():
    """Five alphas make 720 of them."""
    families = [Exponential()] * 5
    groups = group_by_alpha(list("abcde"), families)
    with pytest.raises(AssumptionError, match="at most 128 terms, got 720"):
        rayleigh_constants(families, groups, expand((1,) * 5), range(6))


def test_no_rows_have_no_quotient():
    """Where the alphas vanish, all of it is zero over zero."""
    N = np.zeros((6, 6))
    with pytest.raises(AssumptionError, match="the quotient of the regression has no value"):
        rayleigh(constants(), np.zeros((10, 6)), N)
