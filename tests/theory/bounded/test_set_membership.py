"""The interval of theta that recorded outputs allow, for a bounded irregular part and noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import OptimizeResult, linprog

from cosim.errors import AssumptionError
from cosim.theory.bounded.feasible_program import (
    Cells,
    FeasibleProgram,
    ProgramSolution,
    RecordedOutputs,
    cells_of,
    gaussian_noise_bound,
)
from cosim.theory.bounded.set_membership import (
    MOST_PROGRAMS,
    MOST_RETURNS,
    feasible_interval,
    least_bound,
    starts_around,
)
from cosim.theory.bounded.worst_case import (
    BoundedDisturbance,
    Prediction,
    first_order,
    irregular_response,
)
from tests.theory.academic import alpha
from tests.theory.bounded.worst_error import refit, worst_error
from tests.theory.exponential_plant import TRUTH, direct, example

NO_NOISE = np.zeros(1)
FIXED = np.array([True, True])


@pytest.fixture(scope="module")
def exact_data():
    """Return the example within 0.02, its exact data in cells of 1 s and their interval."""
    model = example(h=4e-2)
    problem = model.problem(0.02)
    recorded = RecordedOutputs(model(TRUTH).output, Cells(25, 1), NO_NOISE)
    return problem, recorded, feasible_interval(problem, recorded, TRUTH[np.newaxis])


def random_signal(rng, t, d):
    """Return a delta_0 of one of four kinds: white, bang-bang fast or slow, or smooth."""
    kind = rng.integers(4)
    if kind == 0:
        return rng.uniform(-d, d, (len(t), 1))
    if kind == 1:
        return d * rng.choice([-1.0, 1.0], (len(t), 1))
    knots = np.linspace(t[0], t[-1], rng.integers(3, 40))
    smooth = np.interp(t, knots, rng.standard_normal(len(knots)))[:, np.newaxis]
    return d * (np.sign(smooth) if kind == 2 else np.tanh(smooth))


def contains(interval, theta):
    return bool(np.all(interval.lower <= theta) and np.all(theta <= interval.upper))


def half_width(interval):
    return (interval.upper - interval.lower) / 2.0


def exact_extreme(d, parameter, direction):
    """Solve the example with exact data and delta_0 = 0, from the disturbance itself.

    y shows x1 and its derivative, so that delta is known but for x2(0) exp(-2 t): what remains is a
    band of width d around a curve, at every instant.
    """
    t = np.arange(0.0, 40.0, 0.04)
    factors = alpha(t)
    truth = (factors * np.exp(np.outer(t, TRUTH[:2]))).sum(axis=1)
    p = np.array([*TRUTH[:4], 0.0])
    cost = np.zeros(5)
    cost[parameter] = -direction
    for _ in range(12):
        basis = factors * np.exp(np.outer(t, p[:2]))
        slopes = basis * t[:, None] * p[2:4]
        columns = np.column_stack([slopes, basis, np.exp(-2.0 * t)])
        residual = truth - columns[:, 2:] @ p[2:]
        result = linprog(
            cost,
            np.vstack([columns, -columns]),
            np.concatenate([d + residual, d - residual]),
            bounds=[(-0.03, 0.03)] * 2 + [(None, None)] * 3,
        )
        p = p + result.x
        if np.abs(result.x).max() < 1e-8:
            break
    assert np.abs(result.x).max() < 1e-8
    return p[parameter]


def test_the_interval_of_a_decay_seen_directly_has_a_closed_form():
    """A constant 1 within d: `c exp(theta t)` fits if it goes from 1 - d to 1 + d, or back."""
    model = direct(samples=41, h=0.1)
    recorded = RecordedOutputs(np.ones((41, 1)), Cells(1, 1), NO_NOISE)
    found = feasible_interval(model.problem(0.1), recorded, np.array([[0.0, 1.0]]))
    expected = math.log(1.1 / 0.9) / 3.9  # from the first cell to the last
    # 1e-6 on every bound, and 1e-5 of the half width 0.073 of least squares
    assert expected < found.upper[0] < expected + 1e-6
    assert -expected - 1e-6 < found.lower[0] < -expected
    assert found.feasible


def test_bounded_noise_alone_has_the_same_closed_form():
    """What a sensor adds within a bound is what a disturbance seen directly adds."""
    model = direct(samples=41, h=0.1)
    recorded = RecordedOutputs(np.ones((41, 1)), Cells(1, 1), np.array([0.1]))
    found = feasible_interval(model.problem(0.0), recorded, np.array([[0.0, 1.0]]))
    expected = math.log(1.1 / 0.9) / 3.9
    assert expected < found.upper[0] < expected + 1e-6


def test_the_cells_enclose_the_exact_interval():
    """Coarser cells give a wider interval, never a narrower one: 0.064 in 80 cells, not 0.047."""
    model = example(h=2e-2)
    problem = model.problem(0.02)
    y = model(TRUTH).output
    exact = [exact_extreme(0.02, 1, direction) for direction in (-1, 1)]
    assert (exact[1] - exact[0]) / 2.0 == pytest.approx(0.047, abs=5e-4)
    widths = []
    for samples in (25, 50):
        recorded = RecordedOutputs(y, Cells(samples, 1), NO_NOISE)
        found = feasible_interval(problem, recorded, TRUTH[np.newaxis])
        assert found.lower[1] < exact[0]
        assert found.upper[1] > exact[1]
        widths.append(found.upper[1] - found.lower[1])
    assert widths[0] < widths[1]
    assert widths[0] / 2.0 == pytest.approx(0.064, abs=5e-4)


@pytest.mark.parametrize("d", [pytest.param(2e-4, marks=pytest.mark.campaign), 2e-3, 2e-2])
def test_the_interval_is_narrower_than_the_worst_error_of_the_estimate(d):
    """And contains the truth under the worst delta_0 for each theta, where the estimate errs most.

    A delta_0 of zero leaves the widest set: its half width is the radius of information, which the
    worst error of no estimator is below; the cells add less than what least squares is above it.
    """
    model = example(h=8e-2)
    problem = model.problem(d)
    exact = model(TRUTH).output
    recorded = RecordedOutputs(exact, Cells(8, 1), NO_NOISE)
    widest = feasible_interval(problem, recorded, TRUTH[np.newaxis])
    for parameter in (0, 1):
        worst = [worst_error(problem, TRUTH, parameter, direction) for direction in (-1, 1)]
        found = max(worst, key=lambda found: abs(found.error))
        assert half_width(widest)[parameter] < abs(found.error)
        y = exact + problem.response.respond(found.delta_0)
        recorded = RecordedOutputs(y, Cells(10, 1), NO_NOISE)
        interval = feasible_interval(problem, recorded, found.estimate[np.newaxis])
        assert contains(interval, TRUTH[:2])
        assert half_width(interval)[parameter] < abs(found.error)


def check_containment(h, cells, signals, seed):
    """Check that the interval contains the truth for random irregular parts of 0.02."""
    model = example(h)
    problem = model.problem(0.02)
    exact = model(TRUTH).output
    rng = np.random.default_rng(seed)
    for _ in range(signals):
        y = exact + problem.response.respond(random_signal(rng, model.t, 0.02))
        recorded = RecordedOutputs(y, cells, NO_NOISE)
        starts = starts_around(problem, recorded, refit(problem, y, TRUTH))
        interval = feasible_interval(problem, recorded, starts)
        assert contains(interval, TRUTH[:2])
        assert half_width(interval)[1] < 0.108  # the worst error found by search


def test_the_interval_contains_the_truth_for_random_signals():
    """White, bang-bang and smooth ones."""
    check_containment(16e-2, Cells(8, 1), signals=2, seed=0)


@pytest.mark.campaign
def test_the_interval_contains_the_truth_for_a_thousand_random_signals():
    """At 1 ms, in cells of 0.2 s."""
    check_containment(1e-3, cells_of(40001, noisy=False), signals=1000, seed=1)


@pytest.mark.parametrize("averaged", [1, 30])
def test_every_signal_between_the_samples_has_its_point_in_the_program(averaged):
    """The truth explains the data with a factor of at most 1, for signals at the ends too."""
    model = example(h=4e-2)
    problem = model.problem(0.02)
    exact = model(TRUTH).output
    rng = np.random.default_rng(2)
    for _ in range(12):
        delta_0 = random_signal(rng, model.t, 0.02)
        y = exact + problem.response.respond(delta_0)
        recorded = RecordedOutputs(y, Cells(30, averaged), NO_NOISE)
        found = least_bound(problem, recorded, TRUTH, FIXED)
        assert found.factor <= 1.0


def two_outputs():
    """Return a problem with two channels of delta_0, one of them in both outputs directly."""
    t = np.arange(301) * 0.05
    response = irregular_response(
        A=np.array([[-1.0, 4.0], [-4.0, -1.0]]),
        Bd=np.array([[1.0, 0.0], [0.0, 2.0]]),
        C=np.array([[1.0, 0.0], [0.5, 1.0]]),
        Dd=np.array([[0.3, 0.0], [1.0, 0.0]]),
        h=0.05,
    )

    def model(p):
        curve = response.respond(np.exp(p[0] * t)[:, np.newaxis] * [1.0, 0.5])
        slope = response.respond((t * np.exp(p[0] * t))[:, np.newaxis] * [1.0, 0.5])
        jacobian = np.stack([p[1] * slope, curve], axis=-1)
        return Prediction(p[1] * curve, jacobian)

    weight = np.array([[4.0, 1.0], [1.0, 2.0]])
    return BoundedDisturbance(model, response, np.array([0.02, 0.05]), weight, 1)


def test_several_outputs_and_channels_have_one_interval():
    """It contains the truth, for exact and for noisy data, and noise makes it wider."""
    problem = two_outputs()
    truth = np.array([-0.2, 1.0])
    rng = np.random.default_rng(5)
    exact = problem.model(truth).output
    for _ in range(2):
        delta_0 = problem.bound * rng.uniform(-1.0, 1.0, (301, 2))
        y = exact + problem.response.respond(delta_0)
        start = refit(problem, y, truth)
        quiet = feasible_interval(
            problem, RecordedOutputs(y, Cells(10, 1), np.zeros(2)), start[np.newaxis]
        )
        noise = np.array([0.01, 0.02])
        noisy_y = y + noise * rng.uniform(-1.0, 1.0, y.shape)
        noisy = feasible_interval(
            problem, RecordedOutputs(noisy_y, Cells(10, 1), noise), start[np.newaxis]
        )
        assert contains(quiet, truth[:1])
        assert contains(noisy, truth[:1])
        assert half_width(quiet)[0] < half_width(noisy)[0]


def test_the_profile_shows_that_the_ends_are_the_ends(exact_data):
    """The least bound that explains a theta2 is d at both ends, less inside, more beyond.

    That is another program: the bound is minimized with theta2 fixed, not theta2 with the bound.
    """
    problem, recorded, interval = exact_data
    middle = (interval.lower[1] + interval.upper[1]) / 2.0
    second_fixed = np.array([False, True])
    for end in (interval.lower[1], interval.upper[1]):
        factors = []
        for theta2 in (middle + 0.9 * (end - middle), end, middle + 1.1 * (end - middle)):
            start = TRUTH.copy()
            start[1] = theta2
            factors.append(least_bound(problem, recorded, start, second_fixed).factor)
        assert factors[1] == pytest.approx(1.0, rel=1e-3)
        assert factors[0] < 0.99
        assert factors[2] > 1.01


def test_no_theta_of_a_grid_outside_of_the_interval_explains_the_data(exact_data):
    """The least bound for fixed theta is a convex problem: no start, no local minimum."""
    problem, recorded, interval = exact_data
    start = TRUTH.copy()
    inside = 0
    for theta1 in np.linspace(-0.13, -0.07, 4):
        for theta2 in np.linspace(-0.5, -0.1, 5):
            start[:2] = (theta1, theta2)
            if least_bound(problem, recorded, start, FIXED).factor <= 1.0:
                inside += 1
                assert contains(interval, start[:2])
    assert inside > 1


def test_several_starts_give_one_interval(exact_data):
    """From anywhere near, the ends are the same; what any start reaches is enclosed."""
    problem, recorded, alone = exact_data
    other = TRUTH + np.array([0.02, -0.1, 0.1, 0.2, 0.1, 0.1])
    both = feasible_interval(problem, recorded, np.array([TRUTH, other]))
    np.testing.assert_allclose(both.lower, alone.lower, rtol=1e-5)
    np.testing.assert_allclose(both.upper, alone.upper, rtol=1e-5)


@pytest.fixture(scope="module")
def two_pieces():
    """Return data of two switchings at which the least bound has a second minimum, above 1.

    The estimate lies beyond that one; the truth, and all that is feasible, lies around the other.
    """
    model = example(h=8e-2)
    problem = model.problem(0.02)
    between = (model.t > 14.0) & (model.t < 36.0)
    delta_0 = np.where(between, 0.02, -0.02)[:, np.newaxis]
    y = model(TRUTH).output + problem.response.respond(delta_0)
    recorded = RecordedOutputs(y, Cells(5, 1), NO_NOISE)
    return problem, recorded, starts_around(problem, recorded, refit(problem, y, TRUTH))


def test_a_set_that_the_search_from_the_estimate_misses_is_there_around_it(two_pieces):
    """No theta is feasible near the estimate; from a larger theta2 the search finds one."""
    problem, recorded, starts = two_pieces
    alone = feasible_interval(problem, recorded, starts[:1])
    assert not alone.feasible
    assert alone.unsolved == 0
    assert least_bound(problem, recorded, starts[2]).factor < 1.0


@pytest.mark.campaign
def test_the_interval_from_around_the_estimate_contains_the_truth(two_pieces):
    """The interval of all that the starts reach."""
    problem, recorded, starts = two_pieces
    assert not contains(feasible_interval(problem, recorded, starts[:1]), TRUTH[:2])
    assert contains(feasible_interval(problem, recorded, starts[[0, 2]]), TRUTH[:2])


def test_starts_are_a_half_width_apart():
    """All combinations of two theta, the estimate first; the nuisance parameters fit y there."""
    problem = example(h=4e-2).problem(0.02)
    recorded = RecordedOutputs(problem.model(TRUTH).output, Cells(10, 1), NO_NOISE)
    starts = starts_around(problem, recorded, TRUTH)
    assert starts.shape == (9, 6)
    half_width = first_order(problem, TRUTH).half_width(problem.bound)
    steps = (starts - TRUTH)[:, :2] / half_width
    np.testing.assert_allclose(np.unique(steps.round(12)), [-1.0, 0.0, 1.0])
    assert len(np.unique(steps.round(12), axis=0)) == 9
    np.testing.assert_array_equal(starts[0], TRUTH)
    for start in starts:
        left = recorded.y - problem.model(start).output
        by_nuisance = problem.model(start).jacobian[:, 0, 2:]
        of_each = np.linalg.norm(by_nuisance, axis=0) * np.linalg.norm(recorded.y)
        assert (np.abs(by_nuisance.T @ left[:, 0]) < 1e-9 * of_each).all()


def test_gaussian_noise_is_bounded_with_the_stated_probability():
    """No cell's mean noise is beyond the bound in all but some of 400 recordings.

    With confidence 0.9 the expected number is below 40, its deviation 6.
    """
    cells = Cells(10, 10)
    sigma = np.array([0.5, 2.0])
    bound = gaussian_noise_bound(sigma, cells, recorded=201, confidence=0.9)
    rng = np.random.default_rng(6)
    beyond = 0
    for _ in range(400):
        noise = sigma * rng.standard_normal((201, 2))
        beyond += bool((np.abs(cells.means(noise)) > bound).any())
    assert 16 < beyond < 64


def test_noise_and_irregular_part_together_leave_the_truth_inside():
    """Deviation 1e-3 on y and a bang-bang delta_0 of 0.02: the case of the field."""
    model = example(h=2e-2)
    problem = model.problem(0.02)
    cells = cells_of(2001, noisy=True)
    assert cells == Cells(10, 10)
    cells = Cells(40, 40)  # which takes a tenth of the time
    noise = gaussian_noise_bound(np.array([1e-3]), cells, recorded=2001)
    rng = np.random.default_rng(7)
    knots = rng.standard_normal(15)
    delta_0 = 0.02 * np.sign(np.interp(model.t, np.linspace(0.0, 40.0, 15), knots))
    y = model(TRUTH).output + problem.response.respond(delta_0[:, np.newaxis])
    y += 1e-3 * rng.standard_normal(y.shape)
    start = refit(problem, y, TRUTH)
    interval = feasible_interval(problem, RecordedOutputs(y, cells, noise), start[np.newaxis])
    assert contains(interval, TRUTH[:2])
    assert half_width(interval)[1] < 0.075  # the first-order half width of the estimate


def test_a_bound_that_is_too_small_is_seen():
    """A constant 0.02 is not within 0.005: no theta is feasible, and the least bound says so."""
    model = example(h=4e-2)
    problem = model.problem(0.005)
    y = model(TRUTH).output + problem.response.respond(np.full((len(model.t), 1), 0.02))
    recorded = RecordedOutputs(y, Cells(25, 1), NO_NOISE)
    start = refit(problem, y, TRUTH)
    interval = feasible_interval(problem, recorded, start[np.newaxis])
    assert not interval.feasible
    assert np.isnan(interval.lower).all()
    assert np.isnan(interval.upper).all()
    least = least_bound(problem, recorded, start)
    assert 1.0 < least.factor <= 4.0
    enough = model.problem(0.005 * least.factor * 1.02)
    assert feasible_interval(enough, recorded, least.p[np.newaxis]).feasible


def test_a_signal_within_the_bound_has_no_upper_end():
    """With |delta_0| <= 1 the data allow any fast decay: there is no end, not a large number."""
    model = example(h=4e-2)
    recorded = RecordedOutputs(model(TRUTH).output, Cells(40, 1), NO_NOISE)
    interval = feasible_interval(model.problem(1.0), recorded, TRUTH[np.newaxis])
    assert interval.lower[1] == -np.inf


def test_the_interval_scales_with_the_bound_where_the_first_order_holds():
    """Ten times less d, ten times less width, to the size of the second order."""
    model = example(h=8e-2)
    y = model(TRUTH).output
    recorded = RecordedOutputs(y, Cells(7, 1), NO_NOISE)
    narrow = half_width(feasible_interval(model.problem(2e-4), recorded, TRUTH[np.newaxis]))
    wide = half_width(feasible_interval(model.problem(2e-3), recorded, TRUTH[np.newaxis]))
    np.testing.assert_allclose(wide, 10.0 * narrow, rtol=1e-3)
    worst = first_order(model.problem(2e-4), TRUTH).half_width(np.array([2e-4]))
    assert (narrow < worst).all()


def test_a_program_that_cannot_be_solved_is_no_verdict(monkeypatch):
    """A solver that fails says nothing of the data: not that no theta explains them, but no end."""
    attempts = []

    def fail(*_, method, options):
        attempts.append((method, options["presolve"]))
        return OptimizeResult(status=4)

    monkeypatch.setattr("scipy.optimize.linprog", fail)
    model = direct(samples=9, h=0.1)
    recorded = RecordedOutputs(np.ones((9, 1)), Cells(1, 1), NO_NOISE)
    interval = feasible_interval(model.problem(0.1), recorded, np.array([[0.0, 1.0]]))
    assert (interval.lower.item(), interval.upper.item()) == (-np.inf, np.inf)
    assert interval.unsolved == 1
    assert attempts == [("highs-ipm", False), ("highs", True)]


def within_a_tenth():
    """Return the problem, the data and the start of a constant 1 within 0.1, seen directly."""
    model = direct(samples=9, h=0.1)
    recorded = RecordedOutputs(np.ones((9, 1)), Cells(1, 1), NO_NOISE)
    return model.problem(0.1), recorded, np.array([[0.0, 1.0]])


def test_a_search_returns_to_the_set_a_limited_number_of_times(monkeypatch):
    """Where every step leaves it: 8 times for each end, after which there is no end."""
    monkeypatch.setattr(FeasibleProgram, "solve", lambda *_: None)
    counted = []
    interval = feasible_interval(*within_a_tenth(), watch=counted.append)
    assert counted[-1] == 1 + 2 * MOST_RETURNS == 17
    assert (interval.lower.item(), interval.upper.item()) == (-np.inf, np.inf)


def test_a_search_that_never_rests_ends(monkeypatch):
    """After 60 linear programs for each end, or for a feasible point: it shows none."""
    taken = []

    def step_aside(*_):
        taken.append(None)
        step = np.array([0.01 * (-1.0) ** len(taken), 0.0])
        return ProgramSolution(step, multiple=1.0, violation=1.0)

    with monkeypatch.context() as patch:
        patch.setattr(FeasibleProgram, "solve", step_aside)
        interval = feasible_interval(*within_a_tenth())
    assert len(taken) == 2 * MOST_PROGRAMS == 120
    assert (interval.lower.item(), interval.upper.item()) == (-np.inf, np.inf)
    taken.clear()
    monkeypatch.setattr(FeasibleProgram, "restore", step_aside)
    interval = feasible_interval(*within_a_tenth())
    assert len(taken) == 2 * MOST_PROGRAMS  # where it is and near it, 60 times
    assert not interval.feasible
    assert np.isnan(interval.lower.item())
    assert interval.unsolved == 0


def test_an_interval_takes_no_more_programs_than_it_may(monkeypatch):
    """Then nothing is known of the starts that are left: they are counted, and there is no end."""
    monkeypatch.setattr("cosim.theory.bounded.feasible_program.MOST_PROGRAMS_IN_ALL", 1)
    model = direct(samples=9, h=0.1)
    recorded = RecordedOutputs(np.ones((9, 1)), Cells(1, 1), NO_NOISE)
    starts = np.array([[0.0, 1.0], [0.0, 1.0]])
    counted = []
    interval = feasible_interval(model.problem(0.1), recorded, starts, watch=counted.append)
    assert counted == [1]
    assert (interval.lower.item(), interval.upper.item()) == (-np.inf, np.inf)
    assert interval.unsolved == 1


def test_recordings_that_do_not_fit_are_refused(subtests):
    """Each with what was found and what was needed."""
    for arguments, message in [
        ((np.zeros((9, 1)), Cells(2, 1), np.zeros(2)), r"noise: expected 1, .* got \[0.0, 0.0\]"),
        ((np.zeros((9, 1)), Cells(2, 1), np.array([-1.0])), r"noise: expected 1, .* got \[-1.0\]"),
        ((np.zeros((9, 1)), Cells(9, 1), np.zeros(1)), "samples: expected at least 10, .* got 9"),
        ((np.full((9, 1), np.nan), Cells(2, 1), np.zeros(1)), "outputs: expected a finite"),
    ]:
        with subtests.test(message=message), pytest.raises(AssumptionError, match=message):
            RecordedOutputs(*arguments)


def test_cells_that_cannot_be_averaged_are_refused(subtests):
    """At least one sample, at most all."""
    for averaged in [0, 3]:
        with (
            subtests.test(averaged=averaged),
            pytest.raises(AssumptionError, match=f"averaged: expected 1 to 2, .* got {averaged}"),
        ):
            Cells(2, averaged)


def test_the_least_multiple_of_no_bound_is_refused():
    """Zero has no multiples."""
    model = direct(samples=9, h=0.1)
    recorded = RecordedOutputs(np.ones((9, 1)), Cells(1, 1), np.array([0.1]))
    with pytest.raises(AssumptionError, match=r"bounds of delta_0: .* only zeros"):
        least_bound(model.problem(0.0), recorded, np.array([0.0, 1.0]))
