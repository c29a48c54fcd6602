"""Output error by variable projection: exact on exact data, efficient on noisy data."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.errors import AssumptionError
from cosim.native.estimation.output_error import ParameterState
from cosim.theory.covariance import is_covariance
from cosim.theory.disturbances.families import Exponential, Sine, generators
from cosim.theory.disturbed_plant import (
    DataSet,
    DisturbedPlant,
    NoiseModel,
    disturbed_plant,
    sample_plant,
    white_noise,
)
from cosim.theory.estimators.output_error import (
    OutputErrorProblem,
    fit_output_error,
    squares_at,
)
from cosim.theory.plants.descriptor import reduce
from tests.theory.academic import THETA, academic, alpha, delta

FAMILIES = (Exponential(), Exponential())
START = np.array([-0.05, -0.5])
H = 1e-3
# Cramer-Rao bound over the deviation of the noise, 40 s at 1 ms, amplitudes and x(0) unknown too
BOUND = np.array([7.0863e-3, 6.2226e-2])


def plant() -> DisturbedPlant:
    return disturbed_plant(reduce(academic()), [0, 0])


def trajectory(t):
    """Solve the plant for the true disturbance, to 1e-12, with an integrator of its own."""
    reduced = reduce(academic())

    def rate(t, x):
        forced = reduced.B_1a[:, 0] * np.sin(t) + reduced.B_2a[:, 0] * delta(np.array([t]))[0]
        return reduced.A_a @ x + forced

    end = float(t[-1])
    solution = solve_ivp(
        rate, (0.0, end), [1.0, -1.0], method="DOP853", rtol=1e-12, atol=1e-13, t_eval=t
    )
    return (reduced.C3 @ solution.y).T + np.outer(np.sin(t), reduced.C4[0])


def data(t, y) -> DataSet:
    return DataSet(t, y, np.sin(t)[:, np.newaxis], alpha(t))


@pytest.fixture(scope="module")
def exact():
    """Return times and outputs, 40 s at 1 ms."""
    t = np.arange(40001) * H
    return t, trajectory(t)


def test_data_of_another_solver_give_theta_to_the_square_of_the_step(exact):
    """Straight lines between samples cost less than 5e-7 at 1 ms, four times that at 2 ms."""
    t, y = exact
    errors = []
    for every in (1, 2):
        fit = fit_output_error([data(t[::every], y[::every])], plant(), FAMILIES, START)
        assert fit.converged
        errors.append(np.abs(fit.theta - THETA))
    assert (errors[0] < 5e-7).all()
    ratio = errors[1] / errors[0]
    assert (ratio > 3.8).all()
    assert (ratio < 4.2).all()


def test_noise_gives_the_error_of_the_cramer_rao_bound(exact):
    """The standard errors are the bound to 2 %, and the errors are of that size."""
    t, y = exact
    sigma = 1e-3
    errors = []
    for seed in range(12):
        noise = sigma * np.random.default_rng(seed).standard_normal(y.shape)
        fit = fit_output_error([data(t, y + noise)], plant(), FAMILIES, START)
        errors.append((fit.theta - THETA) / fit.standard_error)
        np.testing.assert_allclose(fit.standard_error, sigma * BOUND, rtol=0.02)
        assert fit.freedom == len(t) - 6
    # 24 squares of deviation 1: their mean is within 4 deviations, sqrt(2 / 24) each
    assert np.mean(np.square(errors)) < 1.0 + 4.0 * np.sqrt(2.0 / 24.0)


def test_amplitudes_and_initial_state_come_with_theta(exact):
    """The linear unknowns are those of the true disturbance and of x(0)."""
    t, y = exact
    fit = fit_output_error([data(t, y)], plant(), FAMILIES, START)
    np.testing.assert_allclose(fit.amplitudes[0], 1.0, atol=1e-5)
    np.testing.assert_allclose(fit.x0[0], [1.0, -1.0], atol=1e-5)


def test_samples_count_at_their_own_times(exact):
    """Lost samples and jitter of 0.1 ms leave the error of the step."""
    rng = np.random.default_rng(4)
    t = np.arange(10001) * 4e-3 + rng.uniform(0.0, 1e-4, 10001)
    t = t[np.sort(rng.choice(len(t), 9900, replace=False))]
    t -= t[0]
    fit = fit_output_error([data(t, trajectory(t))], plant(), FAMILIES, START)
    assert np.abs(fit.theta - THETA).max() < 1e-6


def test_columns_at_unequal_intervals_are_the_closed_forms():
    """Of more components than are computed side by side, of one state and of two.

    y is the disturbance itself: ``exp(theta t)`` with the derivative ``t exp(theta t)``, and the
    cosine and sine of a rate with theirs.
    """
    rng = np.random.default_rng(5)
    t = 1e-9 * np.cumsum(rng.integers(200_000, 3_000_000, 3000))
    t -= t[0]
    thetas = np.array([-0.1, 0.3, -2.0, 0.0, -40.0, -0.7])
    rate = 1.7
    families = (*(Exponential() for _ in thetas), Sine())
    components = len(families)
    direct = DisturbedPlant(
        A=np.zeros((0, 0)),
        B=np.zeros((0, 1)),
        Bd=np.zeros((0, components)),
        C=np.zeros((1, 0)),
        D=np.zeros((1, 1)),
        Dd=np.ones((1, components)),
    )
    ones = np.ones((len(t), components))
    samples = DataSet(t, np.zeros((len(t), 1)), np.zeros((len(t), 1)), ones)
    sampled = sample_plant(direct, generators(families), samples, noise=white_noise(1))
    rows = sampled.record(samples).rows(np.append(thetas, rate))[:, 0]
    exponentials = np.exp(np.outer(t, thetas))
    waves = np.column_stack([np.cos(rate * t), np.sin(rate * t)])
    turned = np.column_stack([-waves[:, 1], waves[:, 0]])
    basis = np.hstack([exponentials, waves])
    slopes = t[:, np.newaxis] * np.hstack([exponentials, turned])
    # a rounding or two at each of 3000 intervals, which add up like those of a sum
    atol = 2.0 * len(t) * np.finfo(np.float64).eps * max(basis.max(), slopes.max())
    count = basis.shape[1]
    np.testing.assert_allclose(rows[:, :count], basis, rtol=0, atol=atol)
    np.testing.assert_allclose(rows[:, count : 2 * count], slopes, rtol=0, atol=atol)


def test_missing_outputs_are_left_out(exact):
    """NaN in y is no sample: the fit is that of the others."""
    t, y = exact
    holes = y.copy()
    holes[np.random.default_rng(1).random(len(t)) < 0.05] = np.nan
    fit = fit_output_error([data(t, holes)], plant(), FAMILIES, START)
    assert fit.freedom == np.isfinite(holes).sum() - 6
    assert np.abs(fit.theta - THETA).max() < 5e-7


def test_an_unstable_plant_is_predicted():
    """A mode that grows by 4e6 over the record costs no digits: the innovations are white."""
    A = np.array([[0.8, 1.0], [-1.0, -2.0]])
    B = np.array([[-1.0], [1.0]])
    Bd = np.array([[1.0, 1.0], [0.0, 0.0]])
    C = np.array([[1.0, 0.0]])
    unstable = DisturbedPlant(A=A, B=B, Bd=Bd, C=C, D=np.zeros((1, 1)), Dd=np.zeros((1, 2)))
    t = np.arange(40001) * H

    def rate(t, x):
        return A @ x + B[:, 0] * np.sin(t) + Bd[:, 0] * delta(np.array([t]))[0]

    solution = solve_ivp(
        rate, (0.0, 40.0), [0.0, 0.0], method="DOP853", rtol=1e-13, atol=1e-12, t_eval=t
    )
    assert np.abs(solution.y[0]).max() > 1e3
    noise = 1e-3 * np.random.default_rng(2).standard_normal((len(t), 1))
    fit = fit_output_error(
        [data(t, solution.y[:1].T + noise)], unstable, FAMILIES, START, offset=True
    )
    assert (np.abs(fit.theta - THETA) < 4.0 * fit.standard_error).all()
    assert fit.deviation == pytest.approx(1e-3, rel=0.02)
    assert (fit.standard_error < 1e-4).all()


def test_several_records_are_one_fit(exact):
    """Two records with their own amplitudes and initial states share theta."""
    t, y = exact
    noise = 1e-3 * np.random.default_rng(3).standard_normal(y.shape)
    first = data(t[:20001], (y + noise)[:20001])
    second = data(t[20000:], (y + noise)[20000:])
    both = fit_output_error([first, second], plant(), FAMILIES, START)
    alone = fit_output_error([first], plant(), FAMILIES, START)
    assert (both.standard_error < alone.standard_error).all()
    assert (np.abs(both.theta - THETA) < 4.0 * both.standard_error).all()
    np.testing.assert_allclose(both.amplitudes[1], np.exp(20.0 * np.array(THETA)), rtol=0.05)


def test_theta_is_fixed_and_bounded(exact):
    """Equal bounds fix a parameter; a bound that the optimum is beyond is reached, and said."""
    t, y = exact
    record = data(t[::10], y[::10])
    fixed = fit_output_error([record], plant(), FAMILIES, START, bounds={1: (-0.3, -0.3)})
    assert fixed.theta[1] == -0.3
    assert fixed.states == (ParameterState.ESTIMATED, ParameterState.FIXED)
    assert abs(fixed.theta[0] - THETA[0]) < 1e-5
    bounded = fit_output_error([record], plant(), FAMILIES, START, bounds={0: (-0.08, 0.0)})
    assert bounded.theta[0] == -0.08
    assert bounded.states[0] is ParameterState.AT_BOUND


def test_an_absent_component_has_no_theta():
    """Of two exponentials of which one is there, only that one is estimated."""
    t = np.arange(4001) * 1e-2
    reduced = reduce(academic())

    def rate(t, x):
        only = alpha(np.array([t]))[0, 0] * np.exp(-0.1 * t)
        return reduced.A_a @ x + reduced.B_1a[:, 0] * np.sin(t) + reduced.B_2a[:, 0] * only

    solution = solve_ivp(
        rate, (0.0, 40.0), [1.0, -1.0], method="DOP853", rtol=1e-12, atol=1e-13, t_eval=t
    )
    y = (reduced.C3 @ solution.y).T + np.outer(np.sin(t), reduced.C4[0])
    noise = 1e-3 * np.random.default_rng(6).standard_normal(y.shape)
    fit = fit_output_error([data(t, y + noise)], plant(), FAMILIES, START)
    assert fit.states == (ParameterState.ESTIMATED, ParameterState.ABSENT)
    assert abs(fit.theta[0] + 0.1) < 4.0 * fit.standard_error[0]


def test_a_sine_is_found():
    """A component of two basis functions: its rate, and amplitude and phase from beta."""
    t = np.arange(20001) * H
    plain = DisturbedPlant(
        A=np.array([[-1.0]]),
        B=np.zeros((1, 0)),
        Bd=np.ones((1, 1)),
        C=np.ones((1, 1)),
        D=np.zeros((1, 0)),
        Dd=np.zeros((1, 1)),
    )
    rate = 1.3
    # x' = -x + 2 sin(w t + 0.5), x(0) = 0, by hand
    gain = 2.0 / np.hypot(1.0, rate)
    phase = 0.5 - np.arctan(rate)
    x = gain * (np.sin(rate * t + phase) - np.sin(phase) * np.exp(-t))
    record = DataSet(t, x[:, np.newaxis], np.zeros((len(t), 0)), np.ones((len(t), 1)))
    fit = fit_output_error([record], plain, [Sine()], np.array([1.2]))
    assert abs(fit.theta[0] - rate) < 1e-6
    beta = fit.amplitudes[0]
    assert np.hypot(*beta) == pytest.approx(2.0, abs=1e-5)
    assert np.arctan2(beta[0], beta[1]) == pytest.approx(0.5, abs=1e-5)


def test_several_outputs_are_weighted_by_their_noise(exact):
    """With the covariance stated, a bad second sensor costs nothing; the deviation is then 1."""
    t, y = exact
    one = plant()
    two = DisturbedPlant(
        A=one.A,
        B=one.B,
        Bd=one.Bd,
        C=np.vstack([one.C, one.C]),
        D=np.vstack([one.D, one.D]),
        Dd=np.zeros((2, 2)),
    )
    rng = np.random.default_rng(8)
    deviations = np.array([1e-3, 1e-1])
    noisy = np.hstack([y, y]) + deviations * rng.standard_normal((len(t), 2))
    noise = NoiseModel(covariance=np.diag(deviations**2), a=np.zeros((2, 0)))
    fit = fit_output_error([data(t, noisy)], two, FAMILIES, START, noise=noise)
    assert fit.deviation == pytest.approx(1.0, rel=0.02)
    np.testing.assert_allclose(fit.standard_error, 1e-3 * BOUND, rtol=0.02)


def test_samples_that_are_none_are_refused(subtests):
    """Each with what was found."""
    for change, text in [
        (
            {"t": np.array([0.0, 2.0, 1.0])},
            r"t: .* ascending .* got 2.0 s at sample 1",
        ),
        ({"u": np.array([[0.0], [np.nan], [0.0]])}, r"u: .* at t = 1.0 s"),
        ({"y": np.full((3, 1), np.nan)}, r"y\[0\]: expected at least one"),
        ({"y": np.zeros((2, 1))}, "y: expected 3 samples, one for every time, got 2"),
        ({"y": np.zeros(3)}, "y: "),
        ({"t": "late"}, "t: could not convert string to float"),
        ({"alpha": np.full((3, 2), np.inf)}, r"alpha: .* at t = 0.0 s"),
    ]:
        with subtests.test(text=text):
            good = {
                "t": np.arange(3.0),
                "y": np.zeros((3, 1)),
                "u": np.zeros((3, 1)),
                "alpha": np.ones((3, 2)),
            }
            with pytest.raises(AssumptionError, match=text.replace("(", r"\(").replace(")", r"\)")):
                DataSet(**{**good, **change})


def test_fewer_samples_than_unknowns_are_refused():
    """Six unknowns need seven values."""
    t = np.arange(5.0)
    record = data(t, np.sin(t)[:, np.newaxis])
    with pytest.raises(AssumptionError, match="6 measured values for 6 unknowns, got 5"):
        fit_output_error([record], plant(), FAMILIES, START)


@pytest.mark.parametrize("start", [[-0.1], [-0.1, -0.3, 0.0], -0.1])
def test_a_start_of_another_size_is_refused(exact, start):
    """One number would be taken for both theta."""
    with pytest.raises(AssumptionError, match=r"theta: .* \(2,\), .* got \(.*\)"):
        fit_output_error([data(*exact)], plant(), FAMILIES, np.array(start))


def test_a_problem_that_does_not_fit_together_is_refused(exact, subtests):
    """When it is stated, not in the midst of a fit."""
    for number, (change, text) in enumerate(
        [
            ({"data": []}, "data: .* got none"),
            ({"stated": np.array([[-1.0]])}, r"stated: .* covariance .* got \[\[-1.0\]\]"),
            ({"stated": np.array([[np.nan]])}, "stated: expected"),
            ({"stated": np.eye(2)}, r"stated: .* of shape \(1, 1\), got"),
            ({"stated": np.array([1.0])}, "stated: expected"),
            ({"bounds": {2: (0.0, 1.0)}}, r"bounds: no theta\[2\]"),
            ({"bounds": {0: (1.0, 0.0)}}, r"bounds of theta\[0\]: .* 1.0 > 0.0"),
            ({"families": FAMILIES[:1]}, "families: expected 2 columns, as of the plant, got 1"),
        ]
    ):
        with subtests.test(number=number):
            good = {"data": [data(*exact)], "plant": plant(), "families": FAMILIES}
            with pytest.raises(AssumptionError, match=text):
                OutputErrorProblem(**{**good, **change})


def test_a_covariance_is_symmetric_and_positive_definite(subtests):
    """Whatever the units of its outputs are."""
    for matrix, is_one in [
        ([[1e-12, 0.0], [0.0, 1e12]], True),
        ([[1.0, 0.5], [0.5, 1.0]], True),
        ([[1.0, 0.5], [0.4, 1.0]], False),
        ([[1.0, 2.0], [2.0, 1.0]], False),
        ([[1.0, 1.0], [1.0, 1.0]], False),
        ([[1.0, 0.0], [0.0, 0.0]], False),
        ([[1.0, np.inf], [np.inf, 1.0]], False),
    ]:
        with subtests.test(matrix=matrix):
            assert is_covariance(np.array(matrix)) == is_one


@pytest.mark.parametrize("rate", [2.0, 8.9, 10.0, 16.0, 20.0])
def test_squares_of_a_response_beyond_all_numbers_are_infinite(rate):
    """Of e^(2 t) over 40 s they are those of regression; of e^(8.9 t) = e^356 no square is one."""
    plant = DisturbedPlant(
        A=[[-1.0]], B=np.zeros((1, 0)), Bd=[[1.0]], C=[[1.0]], D=np.zeros((1, 0)), Dd=[[0.0]]
    )
    t = np.arange(401) * 0.1
    y = np.random.default_rng(1).standard_normal((401, 1))
    record = DataSet(t, y, np.zeros((401, 0)), np.ones((401, 1)))
    records = OutputErrorProblem([record], plant, [Exponential()]).sampled(white_noise(1)).records
    squares = squares_at(records, np.array([rate]))
    if rate > 2.0:
        assert squares == np.inf
        return
    columns = np.column_stack([np.exp(-t), np.exp(rate * (t - 40.0))])
    _, expected, *_ = np.linalg.lstsq(columns, y[:, 0], rcond=None)
    # the disturbance is a straight line between samples, which a column takes up but at its end
    assert squares == pytest.approx(expected[0], rel=0.02)
