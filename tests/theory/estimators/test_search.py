"""The search of a start with many terms, and the one order in which theta is told."""

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim

from cosim.theory.assessment.assessing import assess
from cosim.theory.disturbances.families import (
    DampedSine,
    Exponential,
    Polynomial,
    Sine,
    TExponential,
)
from cosim.theory.disturbed_plant import (
    DataSet,
    disturbed_plant,
    white_noise,
)
from cosim.theory.estimators.output_error import OutputErrorProblem
from cosim.theory.estimators.start_grid import axis_points
from cosim.theory.plants.descriptor import reduce
from tests.theory.academic import academic
from tests.theory.closed_forms import ALPHAS, T, static_plant


def problem(families, parts, alphas, *, sigma=1e-4, seed=1):
    """Return y = sum of alpha f and noise, of a plant without states."""
    terms = len(families)
    plant = static_plant(terms)
    alpha = np.array(alphas).T
    y = np.sum(alpha * np.array(parts).T, axis=1)
    y = y + sigma * np.random.default_rng(seed).standard_normal(len(T))
    data = DataSet(T, y[:, np.newaxis], np.zeros((len(T), 0)), alpha)
    return OutputErrorProblem([data], plant, families)


def exponentials(theta, sizes=(1.0, 1.2, 1.5, 2.0)):
    return [size * np.exp(value * T) for value, size in zip(theta, sizes, strict=False)]


def found(of):
    """Return theta as it is told after a search."""
    assessment = assess(of)
    assert assessment.fit.converged
    return assessment.fit.theta


@pytest.mark.fast("3-one alpha", "4-an alpha each")
@pytest.mark.parametrize("shared", [True, False], ids=["one alpha", "an alpha each"])
@pytest.mark.parametrize("theta", [[-0.1, -0.5, -1.5], [-0.05, -0.3, -0.8, -2.0]], ids=len)
def test_several_exponentials_are_found(theta, shared):
    """Too many combinations of points to try each, and valleys that lead to wrong ones."""
    alphas = [ALPHAS[0]] * len(theta) if shared else ALPHAS[: len(theta)]
    of = problem([Exponential()] * len(theta), exponentials(theta), alphas, sigma=1e-5)
    # noise of 1e-5 over 1 000 samples: 1e-3 and less of the hardest, one of four under one alpha
    np.testing.assert_allclose(found(of), theta, rtol=0.02)


def test_a_damped_sine_is_found_beside_other_terms():
    """Of two parameters one has few points: its steps grow."""
    parts = [
        np.exp(-0.15 * T) * np.sin(2.0 * T + 0.5),
        0.7 * np.ones_like(T),
        np.exp(-0.8 * T) * (0.5 + T),
    ]
    families = [DampedSine(), Polynomial(0, "constant"), TExponential()]
    of = problem(families, parts, ALPHAS[:3])
    np.testing.assert_allclose(found(of), [0.15, 2.0, -0.8], rtol=1e-3)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1]])
def test_interchangeable_terms_are_reported_the_largest_first(order):
    """Whatever the order in which the disturbance was made."""
    theta = np.array([-0.1, -0.5, -1.5])[order]
    of = problem([Exponential()] * 3, exponentials(theta), [ALPHAS[0]] * 3, sigma=1e-6)
    np.testing.assert_allclose(found(of), [-0.1, -0.5, -1.5], rtol=1e-2)


def test_rates_are_reported_with_their_positive_sign():
    """A sine of rate -w is one of rate w; a decay has a sign."""
    part = np.exp(0.05 * T) * np.sin(0.9 * T)
    of = problem([DampedSine()], [part], ALPHAS[:1])
    told = of.in_order(np.array([-0.05, -0.9]))
    np.testing.assert_array_equal(told, [-0.05, 0.9])
    np.testing.assert_allclose(found(of), [-0.05, 0.9], rtol=1e-3)


def test_terms_of_different_alphas_are_not_interchangeable():
    """They keep the order of the scenario."""
    theta = [-1.5, -0.1]
    of = problem([Exponential()] * 2, exponentials(theta), ALPHAS[:2])
    assert of.interchangeable == (-1, -1)
    np.testing.assert_allclose(found(of), theta, rtol=1e-2)


def test_few_samples_say_the_same_whatever_u_is_between_them():
    """A plant driven by +-1 at every one of 5001 samples; every fifth is left, and noise alone."""
    t = np.arange(5001) * 0.004
    rng = np.random.default_rng(4)
    u = rng.choice([-1.0, 1.0], size=(len(t), 1))
    alpha = np.ones((len(t), 1))
    plant = disturbed_plant(reduce(academic()), [0])
    inputs = np.hstack([u, 1.5 * np.exp(-0.3 * t)[:, np.newaxis]])
    system = StateSpace(
        plant.A, np.hstack([plant.B, plant.Bd]), plant.C, np.hstack([plant.D, plant.Dd])
    )
    y = lsim(system, inputs, t, X0=[1.0, -1.0])[1]
    noise = 1e-3 * rng.standard_normal(len(t))
    data = DataSet(t, (y + noise)[:, np.newaxis], u, alpha)
    thinned = OutputErrorProblem([data], plant, [Exponential()]).thinned
    assert len(thinned.data[0].t) == 1001
    fit = thinned.fit(np.array([-0.3]), white_noise(1))
    # of 1 000 values the deviation is known to 1 / sqrt(2 000) = 2.2 %
    assert fit.deviation == pytest.approx(1e-3, rel=0.1)


def test_sorted_pairs_of_parameters_stay_together():
    """Two damped sines change places whole, by their rates."""
    of = problem([DampedSine()] * 2, [np.ones_like(T)] * 2, [ALPHAS[0]] * 2)
    assert of.interchangeable == (-1, 0)
    told = of.in_order(np.array([0.3, 1.0, 0.1, -2.0]))
    np.testing.assert_array_equal(told, [0.1, 2.0, 0.3, 1.0])


def test_a_grid_has_as_many_columns_as_it_may():
    """Points are shared among terms; a component of two parameters has few along one of them."""
    for families in ([Sine()] * 2, [DampedSine()], [DampedSine(), Exponential(), Sine()]):
        matrices = problem(families, [T] * len(families), ALPHAS[: len(families)]).generators
        graded = [flag for family in families for flag in family.graded]
        points = axis_points(matrices, graded, most=64, columns=240)
        assert len(points) == matrices.parameters
        columns = 0
        for generator, size in zip(matrices.each, matrices.size, strict=True):
            columns += size * int(np.prod(points[generator.theta]))
        assert 100 <= columns <= 240
