"""Starts of theta from y alone: every point of the grid is a least squares of its own."""

import numpy as np
import pytest

from cosim.native.estimation import OutputErrorModel, ResponseRecord
from cosim.native.start_grid import StartGridModel
from cosim.theory.disturbance import Exponential, Sine, generators
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, sample_plant, white_noise
from cosim.theory.estimators.start_grid import search_starts, start_grid

T = np.arange(401) * 0.02
LOWER = np.array([-3.0, 0.2])
UPPER = np.array([0.1, 3.0])
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


def sampled(offset=False):
    """Return the model of y with a record of it, made of its own columns at the true theta."""
    nothing = np.zeros((len(T), 2))
    alpha = np.stack([1.0 + 0.3 * np.sin(1.7 * T), np.ones_like(T)], axis=1)
    data = DataSet(T, nothing, np.zeros((len(T), 0)), alpha)
    plant = sample_plant(PLANT, generators(FAMILIES), data, noise=white_noise(2), offset=offset)
    columns = plant.record(data).rows(TRUE)
    unknowns = np.array([1.3, 0.7, -0.9, 0.5, -0.2, 0.3, 0.1])[: plant.model.linear]
    y = columns[:, :, : plant.model.linear] @ unknowns
    y += 1e-3 * np.random.default_rng(0).standard_normal(y.shape)
    return plant.model, ResponseRecord(plant.model, y, alpha)


def least_squares(model, record, theta, average):
    """Return the squares at theta: means and their least squares by numpy."""
    columns = ResponseRecord(model, record.residual, record.alpha).rows(theta)
    whole = len(T) // average
    blocks = columns[: whole * average].reshape(whole, average, 2, -1).mean(axis=1)
    rows = blocks.reshape(2 * whole, -1)
    regressors = rows[:, : model.linear]
    solution = np.linalg.lstsq(regressors, rows[:, -1], rcond=None)[0]
    return float(np.sum((rows[:, -1] - regressors @ solution) ** 2))


@pytest.mark.parametrize("offset", [False, True])
def test_the_best_point_is_that_of_all_least_squares(offset):
    """And all starts are ordered by their squares; none has a better neighbor."""
    model, record = sampled(offset)
    points = 9
    grid = start_grid(model.constants, LOWER, UPPER, points=points, average=8)
    starts = search_starts(grid, record, most=4)
    axes = [LOWER[j] + (np.arange(points) + 0.5) / points * (UPPER - LOWER)[j] for j in (0, 1)]
    squares = np.array(
        [[least_squares(model, record, np.array([a, b]), 8) for b in axes[1]] for a in axes[0]]
    )
    best = np.unravel_index(squares.argmin(), squares.shape)
    np.testing.assert_allclose(starts[0], [axes[0][best[0]], axes[1][best[1]]], rtol=1e-13)
    found = [least_squares(model, record, start, 8) for start in starts]
    assert found == sorted(found)
    for start in starts:
        i = int(np.abs(axes[0] - start[0]).argmin())
        j = int(np.abs(axes[1] - start[1]).argmin())
        for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            if 0 <= a < points and 0 <= b < points:
                assert squares[a, b] >= squares[i, j]


def test_a_theta_that_is_known_has_one_point():
    """Bounds without width are no direction to search in."""
    model, record = sampled()
    lower = np.array([-0.4, 0.2])
    upper = np.array([-0.4, 3.0])
    grid = start_grid(model.constants, lower, upper, points=20, average=4)
    assert grid.points == (1, 20)
    starts = search_starts(grid, record, most=1)
    assert starts[0, 0] == -0.4
    assert abs(starts[0, 1] - 1.7) <= 0.5 * 2.8 / 20


def test_samples_may_be_added_piece_by_piece():
    """One pass over all samples, or several, make the same R up to rounding."""
    model, record = sampled()
    grid = start_grid(model.constants, LOWER, UPPER, points=5, average=7)
    side_by_side = StartGridModel(grid).model
    assert isinstance(side_by_side, OutputErrorModel)
    whole = ResponseRecord(side_by_side, record.residual, record.alpha)
    R = whole.make(np.zeros(0))
    assert R.shape == (5 + 10 + 2 + 1,) * 2
    first = ResponseRecord(side_by_side, record.residual[:200], record.alpha[:200])
    fewer = first.make(np.zeros(0))
    # R'R grows with the rows
    assert (np.diag(R.T @ R) > np.diag(fewer.T @ fewer)).all()


def test_rows_that_say_the_same_leave_numbers():
    """Fewer rows than columns: what rounding leaves is divided by nothing that vanishes."""
    model, record = sampled()
    grid = start_grid(model.constants, LOWER, UPPER, points=24, average=1)
    for count in range(1, 30):
        short = ResponseRecord(
            StartGridModel(grid).model, record.residual[:count], record.alpha[:count]
        )
        assert np.isfinite(short.make(np.zeros(0))).all()
