"""Solving w(v) = v: closed forms, an independent solver, what cannot be solved."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cosim.core.initialization.fixed_point import (
    SingularError,
    eliminate,
    iterate,
    measure,
    newton,
    newton_step,
)

elements = st.floats(-1.0, 1.0).map(lambda x: round(x, 3))


@given(
    st.integers(1, 6).flatmap(
        lambda n: st.tuples(
            arrays(float, (n, n), elements=elements), arrays(float, n, elements=elements)
        )
    )
)
def test_elimination_agrees_with_lapack(system):
    """A diagonal that outweighs its row keeps the condition number below 2 n + 1.

    Rounding stays below 1e-13.
    """
    matrix, right = system
    matrix = matrix + np.diag(1.0 + 2.0 * np.abs(matrix).sum(axis=1))
    assert np.abs(eliminate(matrix, right) - np.linalg.solve(matrix, right)).max() <= 1e-13


def test_elimination_needs_its_pivots():
    """A zero on the diagonal is no obstacle; a rank too low is, also where rounding hides it.

    Of numbers near 1e6 rounding leaves more, so it is measured by the largest of its row.
    """
    assert eliminate(np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([2.0, 3.0])).tolist() == [
        3.0,
        2.0,
    ]
    for matrix in (
        [[1.0, 2.0], [2.0, 4.0]],
        [[0.1, 0.3], [0.1 + 1e-12, 0.3]],
        [[1e6, 3e6], [1e6 + 1e-5, 3e6]],
        [[np.nan, 1.0], [1.0, 1.0]],
    ):
        with pytest.raises(SingularError):
            eliminate(np.array(matrix), np.ones(2))


@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_a_linear_loop_has_its_closed_form(n, seed):
    """``w = G v + b``: v = (1 - G)^-1 b to 1e-13, from any start.

    The sizes of the unknowns differ by up to 1e8.
    """
    random = np.random.default_rng(seed)
    G = random.uniform(-3.0, 3.0, (n, n))
    b = random.uniform(-1.0, 1.0, n)
    size = 10.0 ** random.uniform(-4.0, 4.0, n)
    if np.linalg.cond(np.eye(n) - G) > 50.0:
        return
    found = newton(
        lambda v: (G @ (v / size) + b) * size, random.uniform(-1.0, 1.0, n) * size, lambda: 0.0
    )
    exact = np.linalg.solve(np.eye(n) - G, b)
    # the residual at the level of rounding, some 16 eps of the largest term, times the condition
    # number
    assert np.abs(found.v / size - exact).max() <= 1e-13 * max(1.0, np.abs(exact).max())
    assert found.excess <= 1.0


def test_a_nonlinear_loop_is_solved():
    """v = cos v has the root 0.7390851332151607 (Dottie's number, OEIS A003957).

    The root of v^2 = 2 is found although the slope there repels sweeps.
    """
    assert abs(newton(np.cos, np.zeros(1), lambda: 1.0).v[0] - 0.7390851332151607) <= 2e-16
    assert (
        abs(newton(lambda v: v + (2.0 - v * v) * 3.0, np.ones(1), lambda: 2.0).v[0] - np.sqrt(2.0))
        <= 4e-16
    )


def test_a_solution_at_zero_is_measured_by_the_values_involved():
    """Its own size says nothing: 1 - 1 leaves rounding errors of 1."""
    found = newton(lambda v: 3.0 * v + (0.1 + 0.2 - 0.3), np.array([5.0]), lambda: 0.3)
    assert abs(found.v[0]) <= 1e-16
    assert found.excess <= 1.0
    assert measure(np.zeros(1), np.array([1e-3]), 0.3).excess > 1e8


def test_no_fixed_point_is_found_where_there_is_none():
    """No root: the residual of v^2 + 1 stays above 0.75; a singular matrix is distinguished."""
    found = newton(lambda v: v * v + 1.0, np.array([0.2]), lambda: 1.0)
    assert found.residual >= 0.75
    assert found.excess > 1.0
    with pytest.raises(SingularError):
        newton(lambda v: v + 1.0, np.array([0.7]), lambda: 1.0)
    with pytest.raises(SingularError):
        newton_step(lambda v: v[::-1].copy(), np.ones(2), np.ones(2))
    assert newton(lambda v: v * np.nan, np.ones(1), lambda: 1.0).excess == np.inf


def test_fixed_point_iteration_ends_on_equal_bits_or_not_at_all():
    """A chain ends after as many sweeps as it has links; a loop that grows ends at infinity."""
    chain = np.diag(np.ones(3), 1)
    assert iterate(lambda v: chain @ v + 1.0, np.zeros(4), 5).tolist() == [4.0, 3.0, 2.0, 1.0]
    assert iterate(lambda v: chain @ v + 1.0, np.zeros(4), 4) is None
    with np.errstate(over="ignore"):
        assert iterate(lambda v: v * 1e200, np.ones(1), 100) is None
