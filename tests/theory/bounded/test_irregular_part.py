"""From a recording to the guaranteed interval: the kernel of output error beside its own bounds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from cosim.errors import AssumptionError
from cosim.theory.bounded.irregular_part import bounded_problem, guaranteed_interval
from cosim.theory.disturbances.families import Exponential, Sine
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, disturbed_plant
from cosim.theory.estimators.output_error import fit_output_error
from cosim.theory.plants.descriptor import reduce
from tests.theory.academic import THETA, academic, alpha
from tests.theory.exponential_plant import TRUTH, example

FAMILIES = (Exponential(), Exponential())
START = np.array([-0.05, -0.5])
H = 1e-2


def recording(delta_0, h=H):
    """Return the example's data without its input u, 40 s; its model is another than the tested."""
    model = example(h)
    y = model(TRUTH).output + model.irregular.respond(delta_0)
    no_input = np.zeros((len(y), 1))
    return DataSet(model.t, y, no_input, alpha(model.t))


def plant():
    return disturbed_plant(reduce(academic()), [0, 0])


def test_the_problem_is_that_of_the_plant():
    """Output, Jacobian and response equal those of a model with arithmetic of its own."""
    model = example(H)
    data = recording(np.zeros((4001, 1)))
    problem, y = bounded_problem(data, plant(), FAMILIES, bound=0.02)
    computed = problem.model(TRUTH)
    expected = model(TRUTH)
    np.testing.assert_allclose(computed.output, expected.output, rtol=0, atol=1e-12)
    np.testing.assert_allclose(computed.jacobian, expected.jacobian, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(y, data.y)
    delta_0 = np.random.default_rng(0).standard_normal((4001, 1))
    np.testing.assert_allclose(
        problem.response.respond(delta_0), model.irregular.respond(delta_0), rtol=0, atol=1e-12
    )


def test_the_jacobian_of_every_family_is_its_derivative():
    """A sine and an exponential on different channels, an offset, two outputs."""
    t = np.arange(200) * 0.05
    two = DisturbedPlant(
        A=np.array([[-1.0, 2.0], [-2.0, -1.0]]),
        B=np.zeros((2, 1)),
        Bd=np.array([[1.0, 0.0], [0.0, 1.0]]),
        C=np.eye(2),
        D=np.zeros((2, 1)),
        Dd=np.array([[0.0, 0.5], [0.0, 0.0]]),
    )
    data = DataSet(t, np.zeros((200, 2)), np.zeros((200, 1)), alpha(t))
    problem, _ = bounded_problem(data, two, [Sine(), Exponential()], bound=0.1, offset=True)
    p = np.array([1.5, -0.2, 1.0, -0.5, 2.0, 0.3, -0.4, 0.1, 0.2])
    jacobian = problem.model(p).jacobian
    for j in range(len(p)):
        shift = np.zeros(len(p))
        shift[j] = 1e-5
        ahead = problem.model(p + shift).output
        behind = problem.model(p - shift).output
        # central differences: 1e-10 times the third derivative, up to 10^3 over 10 s
        np.testing.assert_allclose(jacobian[:, :, j], (ahead - behind) / 2e-5, rtol=0, atol=1e-6)
    assert problem.bound.shape == (2,)


def uncertain(seed):
    """Return what a lag of 1 s makes of exponentials -0.2 and -1.5 and of a signal within 0.05.

    Straight lines between samples 0.1 s apart, by a solver of its own.
    """
    t = np.arange(201) * 0.1
    rng = np.random.default_rng(seed)
    signals = (
        rng.uniform(-1.0, 1.0, len(t)),
        np.sign(rng.standard_normal(len(t))),
        np.sign(np.sin(rng.uniform(0.3, 3.0) * t + rng.uniform(0.0, 6.0))),
    )
    delta = np.exp(-0.2 * t) + np.exp(-1.5 * t) + 0.05 * signals[seed % 3]
    y = lsim(([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), delta, t, X0=[1.0])[1]
    return DataSet(t, y[:, np.newaxis], np.zeros((len(t), 0)), np.ones((len(t), 2)))


@pytest.mark.parametrize("seed", [1, 10])
def test_no_end_is_of_another_branch_where_the_first_order_says_little(seed, monkeypatch):
    """Both intervals contain what they must: the truth, and around the estimate itself.

    An irregular part of 0.05 leaves the faster theta a half width of 3 to 6: Newton's method finds
    points of another branch (seed 10), and a growing exponential with the amplitude of the decaying
    one overflows the digits of a linear program (seed 1).
    """
    lag = DisturbedPlant(
        A=np.array([[-1.0]]),
        B=np.zeros((1, 0)),
        Bd=np.ones((1, 2)),
        C=np.array([[1.0]]),
        D=np.zeros((1, 0)),
        Dd=np.zeros((1, 2)),
    )
    monkeypatch.setattr("cosim.theory.bounded.feasible_program.CELLS", 50)
    truth = np.array([-0.2, -1.5])
    data = uncertain(seed)
    fit = fit_output_error([data], lag, FAMILIES, truth)
    found = guaranteed_interval(data, lag, FAMILIES, fit, bound=0.05, sigma=np.zeros(1))
    rounding = 1e-6 * (1.0 + np.abs(truth))
    assert (found.lower <= truth + rounding).all()
    assert (found.upper >= truth - rounding).all()
    assert (found.around_estimate[:, 0] <= fit.theta).all()
    assert (found.around_estimate[:, 1] >= fit.theta).all()
    assert found.feasible.unsolved == 0


@pytest.mark.parametrize("sigma", [0.0, 1e-3])
def test_a_recording_gives_an_interval_that_contains_the_truth(sigma, monkeypatch):
    """Where the irregular part moves the estimate, with noise and without; in 25 cells."""
    monkeypatch.setattr("cosim.theory.bounded.feasible_program.CELLS", 25)
    h = 8e-2
    t = np.arange(501) * h
    delta_0 = 0.02 * np.sign(np.sin(0.4 * t))[:, np.newaxis]
    exact = recording(delta_0, h)
    noise = sigma * np.random.default_rng(1).standard_normal(exact.y.shape)
    data = DataSet(exact.t, exact.y + noise, exact.u, exact.alpha)
    fit = fit_output_error([data], plant(), FAMILIES, START)
    found = guaranteed_interval(data, plant(), FAMILIES, fit, bound=0.02, sigma=np.array([sigma]))
    assert (found.lower <= THETA).all()
    assert (found.upper >= THETA).all()
    assert (found.feasible.lower <= THETA).all()
    assert (found.feasible.upper >= THETA).all()
    assert np.abs(fit.theta[1] - THETA[1]) > 1e-3
    assert (found.around_estimate[:, 0] <= THETA).all()
    assert (found.around_estimate[:, 1] >= THETA).all()
    assert found.confidence == (0.999 if sigma else 1.0)
    # the first order is that of the example, 0.0137 and 0.0771, seen from the estimate
    np.testing.assert_allclose(found.half_width, [0.0137, 0.0771], rtol=0.25)


def test_much_noise_leaves_the_interval_around_the_estimate(monkeypatch):
    """Noise of 1e-3 beside 0.0002: the data bound theta less than the estimate's own errors do."""
    monkeypatch.setattr("cosim.theory.bounded.feasible_program.CELLS", 25)
    rng = np.random.default_rng(2)
    exact = recording(rng.uniform(-2e-4, 2e-4, (4001, 1)))
    data = DataSet(
        exact.t, exact.y + 1e-3 * rng.standard_normal(exact.y.shape), exact.u, exact.alpha
    )
    fit = fit_output_error([data], plant(), FAMILIES, START)
    found = guaranteed_interval(
        data, plant(), FAMILIES, fit, bound=2e-4, sigma=np.array([1e-3]), sampling_error=1e-6
    )
    assert (found.lower <= THETA).all()
    assert (found.upper >= THETA).all()
    width = found.upper - found.lower
    assert (width < found.feasible.upper - found.feasible.lower).all()
    half_width = np.diff(found.around_estimate)[:, 0] / 2.0
    # 3.66 deviations hold in both theta with probability 0.9995; sampling adds less than 4e-5
    by_noise = half_width - found.half_width
    np.testing.assert_allclose(by_noise, 3.66 * fit.standard_error, rtol=0.1)


def test_gaps_missing_values_and_unstable_plants_are_refused():
    """Samples at any times, missing outputs, and plants whose simulation overflows."""
    data = recording(np.zeros((4001, 1)))
    kept = np.arange(4001) != 7
    gap = DataSet(data.t[kept], data.y[kept], data.u[kept], data.alpha[kept])
    holes = data.y.copy()
    holes[7] = np.nan
    missing = DataSet(data.t, holes, data.u, data.alpha)
    for unsuitable, message in (
        (gap, "comes 0.02 s later"),
        (missing, "1 values are not measured"),
    ):
        with pytest.raises(AssumptionError, match=message):
            bounded_problem(unsuitable, plant(), FAMILIES, bound=0.1)
    one = plant()
    unstable = DisturbedPlant(A=-one.A, B=one.B, Bd=one.Bd, C=one.C, D=one.D, Dd=one.Dd)
    late = DataSet(data.t + 1000.0, data.y, data.u, data.alpha)
    with pytest.raises(AssumptionError, match="needs a stable plant: over 40 s a mode"):
        bounded_problem(late, unstable, FAMILIES, bound=0.1)


def test_the_rate_of_a_sine_has_no_negative_end():
    """A rate and its negative are the same signals: [-a, b] says that it is at most max(a, b)."""
    lag = DisturbedPlant(
        A=np.array([[-1.0]]),
        B=np.zeros((1, 0)),
        Bd=np.ones((1, 1)),
        C=np.array([[1.0]]),
        D=np.zeros((1, 0)),
        Dd=np.zeros((1, 1)),
    )
    t = np.arange(41) * 0.25
    y = lsim(([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), np.sin(0.3 * t + 0.4), t, X0=[1.0])[1]
    data = DataSet(t, y[:, np.newaxis], np.zeros((len(t), 0)), np.ones((len(t), 1)))
    fit = fit_output_error([data], lag, [Sine()], np.array([0.3]))
    found = guaranteed_interval(data, lag, [Sine()], fit, bound=0.5, sigma=np.zeros(1))
    assert found.feasible.lower[0] < 0.0
    assert found.lower[0] == 0.0
    assert found.upper[0] >= 0.3
