"""Starts of theta from y alone: every point of the grid is a least squares of its own."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cosim.native.estimation.output_error import ResponseRecord
from cosim.native.estimation.start_grid import StartGridModel
from cosim.theory.disturbances.families import Exponential, SearchBox, Sine, generators
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, sample_plant, white_noise
from cosim.theory.estimators.output_error import OutputErrorProblem
from cosim.theory.estimators.start_grid import (
    MOST_POINTS,
    MOST_POINTS_ON_AN_AXIS,
    box_of_search,
    grid_points,
    records_on_grid,
    search_start,
    start_grid,
)
from tests.theory.straight_lines import simulate_lines

T = np.arange(401) * 0.02
LOWER = np.array([-3.0, 0.2])
UPPER = np.array([0.1, 3.0])
BOX = SearchBox(LOWER, UPPER)
TRUE = np.array([-0.4, 1.7])
FAMILIES = (Exponential(), Sine())
# two outputs, and a disturbance that feeds through to the second one
PLANT = DisturbedPlant(
    A=np.array([[-1.0, 0.5], [0.0, -2.0]]),
    B=np.zeros((2, 0)),
    Bd=np.array([[1.0, 0.3], [0.5, -1.0]]),
    C=np.eye(2),
    D=np.zeros((2, 0)),
    Dd=np.array([[0.0, 0.0], [0.0, 0.4]]),
)


def known_factors(t):
    """Return alpha of both components."""
    return np.stack([1.0 + 0.3 * np.sin(1.7 * t), np.ones_like(t)], axis=-1)


def disturbances(t):
    """Return the exponential, and a sine of known phase."""
    sine = 0.7 * np.cos(TRUE[1] * t) - 0.9 * np.sin(TRUE[1] * t)
    return known_factors(t) * np.stack([1.3 * np.exp(TRUE[0] * t), sine], axis=-1)


def found_start(data, plant, families, bounds=()):
    """Return the start that a search finds, for white noise."""
    problem = OutputErrorProblem([data], plant, families, bounds=dict(bounds))
    return search_start(problem, white_noise(len(plant.C)))


@cache
def simulated(present=(1.0, 1.0)):
    """Return y by another solver, with noise; ``present``: how much of each component there is."""
    solution = solve_ivp(
        lambda t, x: PLANT.A @ x + PLANT.Bd @ (present * disturbances(t)),
        (0.0, T[-1]),
        [0.5, -0.2],
        t_eval=T,
        rtol=1e-9,
        atol=1e-10,
    )
    y = solution.y.T @ PLANT.C.T + (present * disturbances(T)) @ PLANT.Dd.T
    return y + 1e-3 * np.random.default_rng(0).standard_normal(y.shape)


def sampled(offset=False, present=(1.0, 1.0)):
    """Return the record of y, with an offset where it is unknown."""
    y = simulated(present) + (np.array([0.3, 0.1]) if offset else 0.0)
    data = DataSet(T, y, np.zeros((len(T), 0)), known_factors(T))
    plant = sample_plant(PLANT, generators(FAMILIES), data, noise=white_noise(2), offset=offset)
    return plant.record(data)


@cache
def response(component, kind, rate):
    """Return the outputs under one basis function, straight between samples, shape (N, 2)."""
    shape = {"exp": np.exp, "cos": np.cos, "sin": np.sin}[kind]
    signal = known_factors(T)[:, component] * shape(rate * T)
    system = (PLANT.A, PLANT.Bd[:, [component]], PLANT.C, PLANT.Dd[:, [component]])
    return simulate_lines(system, signal, T)


@cache
def free_response(state):
    """Return the outputs from one initial state of 1, shape (N, 2)."""
    start = np.eye(2)[state]
    return np.array([PLANT.C @ expm(PLANT.A * t) @ start for t in T])


def least_squares(record, theta, average, offset):
    """Return the squares at theta: means of columns that are made here, and numpy."""
    a, w = (float(value) for value in theta)
    columns = [response(0, "exp", a), response(1, "cos", w), response(1, "sin", w)]
    columns += [free_response(0), free_response(1)]
    if offset:
        columns += [np.tile(row, (len(T), 1)) for row in np.eye(2)]
    columns.append(record.residual)
    whole = len(T) // average
    kept = np.stack(columns, axis=-1)[: whole * average]
    rows = kept.reshape(whole, average, 2, -1).mean(axis=1).reshape(2 * whole, -1)
    solution = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]
    return float(np.sum((rows[:, -1] - rows[:, :-1] @ solution) ** 2))


@pytest.mark.parametrize("offset", [False, True])
def test_every_point_is_a_least_squares_of_its_own(offset):
    """Its squares are those of its own columns, apart from the kernels."""
    record = sampled(offset)
    grid = StartGridModel(start_grid(record.model.constants, BOX, points=9, average=8))
    beside = ResponseRecord(grid.model, record.residual, record.alpha)
    squares = grid.squares([beside.make(np.zeros(0))]).reshape(9, 9).T
    axes = [LOWER[j] + (np.arange(9) + 0.5) / 9 * (UPPER - LOWER)[j] for j in (0, 1)]
    expected = [[least_squares(record, (a, b), 8, offset) for b in axes[1]] for a in axes[0]]
    # rounding of R, relative to all of y, over what is left of it
    np.testing.assert_allclose(squares, expected, rtol=1e-9)


@pytest.mark.parametrize("offset", [False, True])
def test_starts_are_the_best_points(offset):
    """Ordered by their squares; none has a better neighbor."""
    record = sampled(offset)
    points = 9
    starts = records_on_grid([record], BOX, points).search(4)
    axes = [LOWER[j] + (np.arange(points) + 0.5) / points * (UPPER - LOWER)[j] for j in (0, 1)]
    squares = np.array(
        [[least_squares(record, (a, b), 1, offset) for b in axes[1]] for a in axes[0]]
    )
    best = np.unravel_index(squares.argmin(), squares.shape)
    np.testing.assert_allclose(starts[0], [axes[0][best[0]], axes[1][best[1]]], rtol=1e-13)
    found = [least_squares(record, start, 1, offset) for start in starts]
    assert found == sorted(found)
    for start in starts:
        i = int(np.abs(axes[0] - start[0]).argmin())
        j = int(np.abs(axes[1] - start[1]).argmin())
        for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            if 0 <= a < points and 0 <= b < points:
                assert squares[a, b] >= squares[i, j]


def test_several_records_have_one_start():
    """In each of two one component is missing: only both together tell both theta."""
    first = sampled(present=(1.0, 0.0))
    second = sampled(present=(0.0, 1.0))
    for records in ([first, second], [second, first]):
        start = records_on_grid(records, BOX, 9).search(1)[0]
        assert (np.abs(start - TRUE) <= 0.5 * (UPPER - LOWER) / 9).all()


def test_a_theta_that_is_known_has_one_point():
    """Bounds without width are no direction to search in."""
    record = sampled()
    box = SearchBox(np.array([-0.4, 0.2]), np.array([-0.4, 3.0]))
    grid = start_grid(record.model.constants, box, points=20, average=4)
    assert grid.points == (1, 20)
    starts = records_on_grid([record], box, 20).search(1)
    assert starts[0, 0] == -0.4
    assert abs(starts[0, 1] - 1.7) <= 0.5 * 2.8 / 20


def test_a_known_theta_beyond_the_box_of_the_search_is_searched_with():
    """Held there, the other one is found."""
    data = DataSet(T, simulated(), np.zeros((len(T), 0)), known_factors(T))
    start = found_start(data, PLANT, FAMILIES, {0: (-9.0, -9.0)})
    assert start[0] == -9.0
    record = sampled()
    found = least_squares(record, (-9.0, start[1]), 1, False)
    others = [least_squares(record, (-9.0, rate), 1, False) for rate in np.linspace(0.3, 5.0, 16)]
    assert found <= min(others)


def test_rows_that_say_the_same_leave_numbers():
    """Fewer rows than columns: what rounding leaves is divided by nothing that vanishes."""
    record = sampled()
    grid = start_grid(record.model.constants, BOX, points=24, average=1)
    for count in range(1, 30):
        short = ResponseRecord(
            StartGridModel(grid).model, record.residual[:count], record.alpha[:count]
        )
        assert np.isfinite(short.make(np.zeros(0))).all()


def lag(rate, *, sigma=0.0, seed=0):
    """Return 20 s of x' = -x + sin(rate t), closed form, every 10 ms."""
    t = np.arange(2001) * 1e-2
    scale = 1.0 / (1.0 + rate**2)
    y = scale * (np.sin(rate * t) - rate * np.cos(rate * t) + rate * np.exp(-t))
    y += sigma * np.random.default_rng(seed).standard_normal(len(t))
    ones = np.ones((len(t), 1))
    return DataSet(t, y[:, np.newaxis], np.zeros((len(t), 0)), ones)


FIRST_ORDER = DisturbedPlant(
    A=np.array([[-1.0]]),
    B=np.zeros((1, 0)),
    Bd=np.ones((1, 1)),
    C=np.ones((1, 1)),
    D=np.zeros((1, 0)),
    Dd=np.zeros((1, 1)),
)


@pytest.mark.fast("0.3", "4.0", "30.0")
@pytest.mark.parametrize("rate", [0.3, 2.0, 4.0, 8.0, 20.0, 30.0])
def test_a_sine_is_found_up_to_a_hundred_periods(rate):
    """Of 20 s: its periodogram has lobes as narrow as 1/20 Hz, and the grid has a point in each."""
    start = found_start(lag(rate, sigma=1e-3), FIRST_ORDER, [Sine()])
    assert abs(start[0] - rate) < 1e-2


@pytest.mark.parametrize("bounds", [(95.0, 105.0), (60.0, np.inf), (0.0, np.inf)])
def test_a_rate_beyond_the_box_is_found_within_bounds(bounds):
    """Wherever they lie; without a lower one that is near the box ends before, and says where."""
    data = lag(100.0)
    box = box_of_search(OutputErrorProblem([data], FIRST_ORDER, [Sine()], bounds={0: bounds}))
    assert bounds[0] <= box.lower[0] < box.upper[0] <= bounds[1]
    start = found_start(data, FIRST_ORDER, [Sine()], {0: bounds})
    assert (abs(start[0] - 100.0) < 0.1) == (box.lower[0] <= 100.0 <= box.upper[0])


def test_bounds_cut_the_box_of_the_search(subtests):
    """Where they overlap it; beside it they are searched themselves."""
    for bounds, expected in [
        ((5.0, np.inf), (5.0, None)),
        ((-np.inf, 5.0), (None, 5.0)),
        ((2.0, 5.0), (2.0, 5.0)),
        ((-np.inf, np.inf), (None, None)),
        ((-9.0, -8.0), (-9.0, -8.0)),
    ]:
        with subtests.test(bounds=bounds):
            problem = OutputErrorProblem([lag(1.0).thinned(10)], FIRST_ORDER, [Sine()])
            box = box_of_search(problem)
            cut = box_of_search(replace(problem, bounds={0: bounds}))
            assert cut.lower[0] == (box.lower[0] if expected[0] is None else expected[0])
            assert cut.upper[0] == (box.upper[0] if expected[1] is None else expected[1])


@pytest.mark.parametrize("every", [1, 10])
def test_no_sine_is_searched_beyond_half_the_sampling_frequency(every):
    """There are others with the same samples: of every alias the slowest is found.

    Also of a sensor that is slower than the points at which the disturbance is computed.
    """
    data = lag(3.0, sigma=1e-2)
    short = slice(0, 1 + 20 * every)
    y = np.full_like(data.y, np.nan)
    y[::every] = data.y[::every]
    few = DataSet(data.t[short], y[short], data.u[short], data.alpha[short])
    spacing = every * (data.t[1] - data.t[0])
    assert few.sampling_interval == pytest.approx(spacing)
    box = box_of_search(OutputErrorProblem([few], FIRST_ORDER, [Sine()]))
    assert box.upper[0] == pytest.approx(np.pi / spacing)
    found = found_start(few, FIRST_ORDER, [Sine()])
    assert abs(found[0]) < np.pi / spacing


def test_two_sines_are_found_up_to_twenty_five_periods():
    """Each on its own axis of the grid, under one alpha."""
    one = lag(3.0)
    y = one.y + 0.5 * lag(7.5).y
    data = DataSet(one.t, y, one.u, np.ones((len(one.t), 2)))
    plant = replace(FIRST_ORDER, Bd=np.ones((1, 2)), Dd=np.zeros((1, 2)))
    start = found_start(data, plant, [Sine(), Sine()])
    np.testing.assert_allclose(np.sort(start), [3.0, 7.5], atol=1e-2)


def test_a_grid_has_all_the_points_that_are_searched(subtests):
    """One more in every direction is more than 4096 in all, or than an axis has; exact roots."""
    for parameters in range(1, 13):
        with subtests.test(parameters=parameters):
            points = grid_points(parameters)
            assert points**parameters <= MOST_POINTS
            assert points == MOST_POINTS_ON_AN_AXIS or (points + 1) ** parameters > MOST_POINTS
