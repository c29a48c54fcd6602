"""Look-up tables: static functions by their values."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator, interp1d

from cosim.blocks.look_up import LookUpTable
from cosim.core.contracts import Stopped
from cosim.errors import RunError, UsageError

T = np.zeros(2)


def at(table, *u):
    """Return y at one point."""
    return float(table.outputs(0.0, np.array(u))[0])


def points(low=2, high=6):
    """Return increasing points, a spacing of at least 0.1 apart."""
    widths = st.lists(st.floats(0.1, 10.0), min_size=low - 1, max_size=high - 1)
    return widths.map(lambda widths: np.cumsum([-5.0, *widths]))


@given(points(), st.data())
def test_one_input_is_interpolated_as_scipy_does(grid, data):
    """Inside and, with "linear", outside; rounding of a few spacings of the largest term."""
    count = len(grid)
    values = np.array(data.draw(st.lists(st.floats(-9, 9), min_size=count, max_size=count)))
    u = data.draw(st.floats(float(grid[0]) - 5.0, float(grid[-1]) + 5.0))
    reference = interp1d(grid, values, fill_value="extrapolate")
    found = at(LookUpTable([grid], values, extrapolation="linear"), u)
    assert found == pytest.approx(float(reference(u)), rel=1e-12, abs=1e-11)


@given(points(), points(), st.integers(0, 2**32 - 1), st.floats(-0.5, 1.5), st.floats(-0.5, 1.5))
def test_two_inputs_are_interpolated_as_scipy_does(first, second, seed, part1, part2):
    """Bilinear in each cell, also where the border's cell goes on."""
    values = np.random.default_rng(seed).uniform(-9.0, 9.0, (len(first), len(second)))
    u1 = float(first[0] + part1 * np.ptp(first))
    u2 = float(second[0] + part2 * np.ptp(second))
    reference = RegularGridInterpolator(
        (first, second), values, bounds_error=False, fill_value=None
    )
    found = at(LookUpTable([first, second], values, extrapolation="linear"), u1, u2)
    assert found == pytest.approx(float(reference([[u1, u2]])[0]), rel=1e-10, abs=1e-7)


@given(points(), points(), st.integers(0, 2**32 - 1))
def test_the_values_of_the_grid_are_exact(first, second, seed):
    """At its points there is nothing to interpolate, to the last bit."""
    values = np.random.default_rng(seed).standard_normal((len(first), len(second)))
    table = LookUpTable([first, second], values)
    for i, u1 in enumerate(first):
        for j, u2 in enumerate(second):
            assert at(table, u1, u2) == values[i, j]


@given(st.floats(-1e300, 1e300), st.floats(-1e300, 1e300))
def test_held_inputs_stay_within_the_grid(u1, u2):
    """The value at the border, whatever lies beyond."""
    grid = [np.array([0.0, 1.0]), np.array([0.0, 2.0])]
    values = np.array([[0.0, 2.0], [3.0, 5.0]])  # 3 u1 + u2
    found = at(LookUpTable(grid, values, extrapolation="hold"), u1, u2)
    assert found == pytest.approx(3.0 * min(max(u1, 0.0), 1.0) + min(max(u2, 0.0), 2.0), rel=1e-15)


def test_outside_of_the_grid_the_run_stops_there():
    """With the rows before it, where it covers what, and the way out."""
    table = LookUpTable([np.array([0.0, 1.0])], np.array([0.0, 2.0]))
    u = np.array([[0.0], [0.5], [1.0], [1.5], [0.0]])
    text = r'covers u from 0\.0 to 1\.0.*1\.5\).*extrapolation = "hold" or "linear" to'
    with pytest.raises(Stopped, match=text) as stop:
        table.advance(np.arange(5.0), 1.0, u)
    assert stop.value.outputs.tolist() == [[1.0], [2.0]]
    with pytest.raises(RunError, match=r"got -0\.1"):
        at(table, -0.1)


@pytest.mark.parametrize(
    ("grid", "values", "text"),
    [
        ([[0.0]], [1.0], r"u:.*at least 2 points.*1"),
        ([[0.0, 1.0]], [1.0], r"y:.*shape \(2,\), one value for each point of u.*\(1,\)"),
        ([[0.0, 1.0]], [[1.0, 2.0]], r"y:.*shape \(2,\).*\(1, 2\)"),
        ([[0.0, 0.0]], [1.0, 2.0], r"u:.*increasing.*u\[1\] = 0\.0 after 0\.0"),
        ([[0.0, np.nan]], [1.0, 2.0], r"u:.*finite.*finite range"),
        ([[-1.7e308, 1.7e308]], [1.0, 2.0], r"u:.*finite.*finite range"),
        ([[0.0, 1.0]], [1.0, np.inf], r"y:.*NaN or infinity"),
        ([[0.0, 1.0], [1.0, 0.0]], [[1.0, 2.0], [1.0, 2.0]], r"u2:.*u2\[1\] = 0\.0"),
        ([], [], r"one or two inputs.*0"),
    ],
)
def test_only_tables_with_increasing_points_are_taken(grid, values, text):
    """Shape, finiteness, order."""
    with np.errstate(over="ignore"), pytest.raises(UsageError, match=text):
        LookUpTable([np.array(row) for row in grid], np.array(values))
