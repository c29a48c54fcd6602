"""Predicted errors of theta: noise of delta, the covariance of the estimators, the best delays."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.linalg import toeplitz

from cosim.errors import AssumptionError
from cosim.theory.disturbances.families import (
    Exponential,
    Polynomial,
    Sine,
    coefficients,
    generators,
    group_by_alpha,
)
from cosim.theory.disturbances.regression import alpha_products, chi, expand, mu
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.least_squares import least_squares, plan, recover, trapezoid_weights
from cosim.theory.estimators.rayleigh import rayleigh_constants
from cosim.theory.experiment_design.bound import accuracy_bound
from cosim.theory.experiment_design.delay_search import search_delays
from cosim.theory.experiment_design.minors import Minors
from cosim.theory.experiment_design.predictions import RegressionExperiment
from cosim.theory.experiment_design.reconstruction_noise import ReconstructionNoise
from cosim.theory.experiment_design.regression_noise import NoisyRegression
from tests.theory.academic import THETA, alpha, delta
from tests.theory.estimators.passes import means, noise_covariance, rayleigh

H = 0.02
T = np.arange(1500) * H
EXPONENTIALS = (Exponential(), Exponential())
# of a filtered derivative: its samples nearly cancel
RESPONSE = np.array([[1.0], [-0.6], [-0.24], [-0.1], [-0.05]])


def dense_covariance(noise: ReconstructionNoise, size: int):
    """Return the covariance of so many successive samples, by its definition."""
    g = noise.response
    padded = np.zeros((size + len(g), g.shape[1]))
    padded[: len(g)] = g
    column = [np.sum(padded[: len(g)] * padded[k : k + len(g)]) for k in range(size)]
    return toeplitz(column)


def test_the_autocovariance_is_that_of_filtered_white_noise():
    """Of two outputs their sum; of sums of samples that of their sums."""
    noise = ReconstructionNoise(np.array([[1.0, 0.2], [0.5, 0.0], [-0.3, 0.1]]))
    R = dense_covariance(noise, 12)
    np.testing.assert_allclose(noise.covariance(np.arange(-3, 12)), [*R[0, 3:0:-1], *R[0]])
    ones = np.zeros((2, 12))
    ones[0, :4] = 1.0
    for apart, value in enumerate(noise.averaged(4)):
        ones[1] = 0.0
        ones[1, apart : apart + 4] = 1.0
        assert value == pytest.approx((ones @ R @ ones.T)[0, 1], abs=1e-13)


@pytest.mark.parametrize(
    ("names", "families", "theta"),
    [
        ("ab", EXPONENTIALS, (-0.1, -0.3)),
        ("aa", EXPONENTIALS, (-0.1, -0.3)),
        ("aab", (Sine(), Exponential(), Exponential()), (1.3, -0.2, 0.1)),
    ],
)
def test_chi_and_its_derivatives(names, families, theta):
    """chi as the regression has it; derivatives against differences of the fourth order."""
    groups = group_by_alpha(list(names), families)
    terms = expand(tuple(group.size for group in groups))
    delays = np.array([0.0, 0.4, 1.1, 1.5, 2.3][: terms[0].row + 1])

    def of(point):
        K = []
        for group in groups:
            own = [point[i] for i in group.components]
            K.append(coefficients(group.families, own, delays))
        return chi(terms, K)

    point = np.array(theta)
    value, slopes = Minors(generators(families), groups, terms).chi(point, delays)
    np.testing.assert_allclose(value, of(point), rtol=1e-12)
    e = 1e-3
    for j, direction in enumerate(e * np.eye(len(theta))):
        near = of(point + direction) - of(point - direction)
        far = of(point + 2.0 * direction) - of(point - 2.0 * direction)
        np.testing.assert_allclose(slopes[j], (8.0 * near - far) / (12.0 * e), atol=1e-9)


def test_no_estimate_from_noisy_delta_is_predicted_below_its_cramer_rao_bound():
    """Five functions under two alphas leave a regression of nothing but rounding.

    Whatever minimum of it is met first, there is another one beside.
    """
    t = np.arange(601) * 0.005
    rate = 2.479
    known = 1.0 + 0.5 * np.sin(3.0 * t)
    deviation = 1e-3
    experiment = RegressionExperiment(
        delta=np.sin(rate * t) + known + 1.0 + 0.2 * t,
        alpha=np.column_stack([np.ones_like(t), known, np.ones_like(t)]),
        names=("1", "a", "1"),
        families=(Sine(), Polynomial(0), Polynomial(1)),
        theta=np.array([rate]),
        step=0.005,
        noise=ReconstructionNoise(np.array([[deviation]])),
        settled=20,
    )
    basis = np.column_stack([np.sin(rate * t), np.cos(rate * t), known, np.ones_like(t), t])
    slope = t * np.cos(rate * t)
    left = slope - basis @ np.linalg.lstsq(basis, slope, rcond=None)[0]
    bound = deviation / np.linalg.norm(left)
    rng = np.random.default_rng(0)
    for _ in range(60):
        steps = np.sort(rng.choice(50, 6, replace=False))
        try:
            predicted = experiment.rayleigh(tuple(steps.tolist()))
        except AssumptionError:
            continue
        assert predicted.error[0] >= bound


@pytest.mark.parametrize("block", [1, 5])
def test_moments_and_covariance_are_those_of_gaussian_noise(block):
    """Against sums over all pairs of samples; Isserlis' theorem for the quadratic part.

    Over a block the products are constant here, as the quadratic part takes them.
    """
    rng = np.random.default_rng(1)
    samples = 30
    steps = (0, 3, 7)
    row = np.array([0, 0, 1, 1, 2, 2])
    products = np.repeat(rng.standard_normal((6, samples // block)), block, axis=1)
    noise = ReconstructionNoise(RESPONSE)
    delta_at = rng.standard_normal((3, samples))
    regression = NoisyRegression(
        products=products, row=row, delta=delta_at, steps=steps, block=block, noise=noise
    )
    longest = max(steps)
    R = dense_covariance(noise, samples + longest)
    x = np.zeros((samples // block, 6, samples + longest))  # rows of noise, by its samples
    for k in range(samples):
        for c in range(6):
            x[k // block, c, longest + k - steps[row[c]]] += products[c, k]
    m = (products * delta_at[row]).reshape(6, -1, block).sum(axis=2).T
    moment = np.einsum("rcs,st,rdt->cd", x, R, x)
    np.testing.assert_allclose(regression.noise_moment, moment, atol=1e-10)
    np.testing.assert_allclose(regression.moment, m.T @ m + moment, atol=1e-10)
    d = rng.standard_normal((2, 6))
    g = rng.standard_normal(6)
    of_d = np.einsum("ic,rcs->irs", d, x)
    of_g = np.einsum("c,rcs->rs", g, x)
    linear = np.einsum("ri,rs->is", m @ d.T, of_g) + np.einsum("r,irs->is", m @ g, of_d)
    Q = np.einsum("irs,rt->ist", of_d, of_g)
    Q = 0.5 * (Q + Q.transpose(0, 2, 1))
    quadratic = 2.0 * np.einsum("iab,bc,jcd,da->ij", Q, R, Q, R)
    expected = linear @ R @ linear.T + quadratic
    np.testing.assert_allclose(regression.covariance(d, g), expected, rtol=1e-9)


def test_the_bound_of_terms_that_are_alike_is_infinite_and_that_of_others_is_not():
    """Two exponentials of one theta: their sum is known, not either; a third is known as alone."""
    plant = DisturbedPlant(
        A=np.zeros((0, 0)),
        B=np.zeros((0, 0)),
        Bd=np.zeros((0, 3)),
        C=np.zeros((2, 0)),
        D=np.zeros((2, 0)),
        Dd=np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    )
    families = (*EXPONENTIALS, Exponential())
    theta = np.array([-0.1, -0.1, -0.3])
    y = np.column_stack([2.0 * np.exp(-0.1 * T), np.exp(-0.3 * T)])
    data = DataSet(T, y, np.zeros((len(T), 0)), np.ones((len(T), 3)))
    found = accuracy_bound(plant, families, theta, data, noise=1e-6 * np.eye(2))
    assert np.isinf(found.standard_error[:2]).all()
    own = y[:, 1]
    slope = T * own  # of the third by theta, less what its amplitude takes of it
    free = slope - own * (slope @ own) / (own @ own)
    assert found.standard_error[2] == pytest.approx(1e-3 / np.linalg.norm(free), rel=1e-6)


# --- predictions against Monte Carlo ---


def experiment(size=0.002, error=0.0):
    """Return a record of the paper's disturbance, and the noise that its filter leaves."""
    return RegressionExperiment(
        delta=delta(T) + error * np.cos(T),
        alpha=alpha(T),
        names=("a", "b"),
        families=EXPONENTIALS,
        theta=np.array(THETA),
        step=H,
        noise=ReconstructionNoise(size * RESPONSE),
        settled=0,
    )


def estimates(of: RegressionExperiment, method: str, steps, seeds: int):
    """Return what a method finds in records with noise, shape (seeds, P)."""
    terms = expand((1, 1))
    groups = group_by_alpha(of.names, of.families)
    begin = max(steps)
    places = np.arange(begin, len(T))[:, np.newaxis] - np.array(steps)
    factors = alpha(T)[places]
    products = alpha_products(terms, factors)
    delays = [H * count for count in steps]
    recovery = plan(terms, groups, delays)
    weights = trapezoid_weights(T[begin:])
    constants = rayleigh_constants(of.families, groups, terms, delays)
    count = max(1, round(0.5 * np.diff(np.sort(steps)).min()))
    N = noise_covariance(terms, means(products, count))
    found = []
    for seed in range(seeds):
        white = np.random.default_rng(seed).standard_normal(len(T) + len(RESPONSE) - 1)
        noise = np.convolve(white, of.noise.response[:, 0], "valid")
        rows = mu(terms, (of.delta + noise)[places], factors)
        if method == "rayleigh":
            found.append(rayleigh(constants, means(rows, count), N, theta=of.theta).theta)
        else:
            found.append(recover(recovery, least_squares(rows, weights)))
    return np.array(found)


def predicted(of: RegressionExperiment, method: str, steps):
    return of.rayleigh(steps) if method == "rayleigh" else of.least_squares(steps)


DESIGNS = {
    "paper": (50, 100, 150),
    "from 0": (0, 50, 100),
    "long": (0, 300, 400),
    "close": (0, 12, 30),
}


def check_prediction(of, method, steps, seeds):
    """Compare mean and deviation with those of Monte Carlo, within four of their own errors."""
    prediction = predicted(of, method, steps)
    found = estimates(of, method, steps, seeds)
    bias = found.mean(axis=0) - of.theta
    deviation = found.std(axis=0, ddof=1)
    # a mean is known to s / sqrt(n); a deviation to s / sqrt(2 n) where the estimates are Gaussian
    np.testing.assert_array_less(
        np.abs(prediction.bias - bias), 4.0 * deviation / np.sqrt(seeds) + 0.1 * deviation
    )
    relative = prediction.standard_error / deviation
    assert np.abs(relative - 1.0).max() < 4.0 / np.sqrt(2.0 * seeds) + 0.1
    return np.hypot(bias, deviation).max(), prediction.error.max()


@pytest.mark.parametrize("method", ["rayleigh", "least-squares"])
def test_predictions_agree_with_monte_carlo_and_so_does_their_order(method):
    """Of mean and deviation within their sampling errors; 40 seeds a design."""
    found = {}
    for name, steps in DESIGNS.items():
        found[name] = check_prediction(experiment(), method, steps, 40)
    for one, other in combinations(found.values(), 2):
        if max(one[1], other[1]) > 2.0 * min(one[1], other[1]):
            assert (one[0] < other[0]) == (one[1] < other[1])


@pytest.mark.campaign
@pytest.mark.parametrize("method", ["rayleigh", "least-squares"])
@pytest.mark.parametrize("size", [5e-4, 2e-3, 4e-3])
@pytest.mark.parametrize("steps", DESIGNS.values())
def test_predictions_agree_with_long_monte_carlo(method, size, steps):
    """400 seeds, of less and of more noise."""
    check_prediction(experiment(size), method, steps, 400)


@pytest.mark.parametrize("steps", [(50, 100, 150), (1, 2, 3)])
def test_exact_data_are_predicted_to_lead_to_theta(steps):
    """Without noise chi is in the null space of the rows, to rounding: it is theta's own."""
    of = experiment(size=1e-15)
    prediction = of.rayleigh(steps)
    np.testing.assert_allclose(prediction.bias, 0.0, atol=1e-6)
    assert prediction.standard_error.max() < 1e-6
    assert prediction.standard_error.min() > 0.0


def test_an_information_that_is_singular_to_rounding_has_no_least_squares():
    """Two components of one rate under one alpha: their regressors are dependent."""
    both = experiment(size=1e-15)
    of = replace(both, delta=np.exp(-0.1 * T), names=("a", "a"), alpha=np.ones((len(T), 2)))
    with pytest.raises(AssumptionError, match="no estimate: the rows of the regression are dep"):
        of.least_squares((50, 100, 150))


@pytest.mark.parametrize("size", [1e-6, 1e-8])
def test_predictions_agree_with_monte_carlo_for_delays_of_single_samples(size):
    """There the rows are dependent but for 1e-7 of them, of which sums of products know nothing."""
    check_prediction(experiment(size), "rayleigh", (1, 2, 3), 40)


def test_an_error_of_delta_is_bias():
    """What the observer leaves of u in delta: without noise the estimate is off by as much."""
    of = experiment(size=1e-7, error=0.01)
    for method in ("rayleigh", "least-squares"):
        found = estimates(of, method, (50, 100, 150), 1)[0]
        prediction = predicted(of, method, (50, 100, 150))
        np.testing.assert_allclose(prediction.bias, found - of.theta, rtol=1e-3)
        assert np.abs(prediction.bias).max() > 1e-3


def test_a_prior_pulls_least_squares_away():
    """P0 of (34) as the estimator has it, on rows without noise."""
    of = experiment(size=1e-9)
    steps = (50, 100, 150)
    places = np.arange(150, len(T))[:, np.newaxis] - np.array(steps)
    rows = mu(expand((1, 1)), of.delta[places], alpha(T)[places])
    eta = least_squares(rows, trapezoid_weights(T[150:]), prior=1e-3)
    groups = group_by_alpha(of.names, of.families)
    theta = recover(plan(expand((1, 1)), groups, [1.0, 2.0, 3.0]), eta)
    bias = of.least_squares(steps, P0=1e3).bias
    np.testing.assert_allclose(bias, theta - of.theta, rtol=1e-6)
    assert np.abs(bias).max() > 0.01


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ((0, 50), "delays: expected 3, .* got 2"),
        ((0, 50, 50), "expected distinct delays"),
        ((0, 50, 1499), "at least 12 rows of the regression, got [0-9]"),
    ],
)
def test_delays_that_do_not_fit_are_refused(steps, words):
    """Too few, equal ones, and those that are as long as the record."""
    with pytest.raises(AssumptionError, match=words):
        experiment().least_squares(steps)


# --- the search ---


def test_the_search_is_at_least_as_good_as_a_grid():
    """The best of all sets of a grid of 1.6 s, of which the search knows nothing."""
    of = experiment()

    def error(steps):
        try:
            prediction = of.rayleigh(steps)
        except AssumptionError:
            return np.inf
        return np.inf if prediction is None else float(prediction.error.max())

    found = search_delays(error, count=3, longest=400)
    grid = [(0, *others) for others in combinations(range(80, 401, 80), 2)]
    assert found.error <= min(map(error, grid))
    assert found.error < 0.5 * error((0, 50, 100))
    assert found.error == error(found.steps)
    assert found.tried < 250


def test_the_search_tries_the_delays_that_it_is_given():
    """Where only these give an estimate, they are the best; where none does, that is an error."""

    def only(steps):
        return 1.0 if steps == (0, 17, 23) else np.inf

    assert search_delays(only, count=3, longest=100, starts=[(40, 17, 34)]).steps == (0, 17, 23)
    with pytest.raises(AssumptionError, match=r"none of .* sets of 3 delays"):
        search_delays(only, count=3, longest=100)
    with pytest.raises(AssumptionError, match="at least 2 distinct delays"):
        search_delays(only, count=4, longest=2)
