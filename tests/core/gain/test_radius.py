"""The spectral radius where eigenvalues coincide, and where they only are close."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.core.gain.radius import spectral_radius


@pytest.mark.parametrize("n", range(2, 8))
def test_eigenvalues_that_coincide_are_found_to_rounding(n):
    """A Jordan block in other coordinates: an eigenvalue solver alone is off by up to 1e-5."""
    wrong = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        T = rng.normal(size=(n, n))
        M = T @ (np.eye(n) + 1e-3 * np.eye(n, k=1)) @ np.linalg.inv(T)
        found = spectral_radius(M)
        if found != pytest.approx(1.0, abs=1e-14 * np.linalg.cond(T) ** 2):
            wrong.append((seed, found))
    assert wrong == []


@settings(max_examples=200)
@given(st.integers(2, 12), st.integers(0, 10**6), st.sampled_from([1e-1, 1e-3, 1e-5]))
def test_eigenvalues_that_are_close_are_told_apart(n, seed, spread):
    """No mean hides one that is larger: each is known to rounding times its condition."""
    rng = np.random.default_rng(seed)
    eigenvalues = 1.0 + spread * rng.normal(size=n)
    T = rng.normal(size=(n, n))
    M = T @ np.diag(eigenvalues) @ np.linalg.inv(T)
    error = abs(spectral_radius(M) - np.abs(eigenvalues).max())
    assert error <= 1e-13 * n * np.linalg.cond(T) ** 2


@pytest.mark.parametrize("other", [0.9, 0.97, 1.02, 1.05])
def test_jordan_blocks_hide_no_eigenvalue_beside_them(other):
    """At 1 and at 0, of all sizes, with one eigenvalue more that is close to the one at 1."""
    sizes = [(n, k) for n in range(3, 15) for k in range(2, n)]
    wrong = []
    for (n, k), coupling in itertools.product(sizes, (1.0, 0.1, 0.01)):
        M = np.eye(n) + coupling * np.eye(n, k=1)
        M[k:, k:] = np.eye(n - k, k=1)
        M[k - 1, k] = 0.3
        M[0, 0] = other
        M[0, 1] = 0.0
        found = spectral_radius(M)
        if found != pytest.approx(max(other, 1.0), abs=1e-9):
            wrong.append((n, k, coupling, found))
    assert wrong == []


def test_a_defective_eigenvalue_hides_no_other():
    """Ten eigenvalues at 1 and at 0 in exact Jordan blocks, one beyond them."""
    M = np.eye(12) + np.eye(12, k=1)
    M[6:, 6:] = np.eye(6, k=1)
    M[0, 0] = 1.02
    M[0, 1] = 0.0
    assert spectral_radius(M) == pytest.approx(1.02, abs=1e-12)
    M[0, 0] = 0.98
    assert spectral_radius(M) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    "M", [[[3.0, -2.0], [2.0, -1.0]], [[3.0, -4.0], [1.0, -1.0]], [[2.75, -3.0625], [1.0, -0.75]]]
)
def test_a_defective_double_eigenvalue_is_found_to_rounding(M):
    """1, twice, also where a change by less than half a bit shows no second eigenvector."""
    assert spectral_radius(np.array(M)) == pytest.approx(1.0, abs=1e-14)


def test_the_radius_does_not_depend_on_units():
    """A state in other units scales a row and a column."""
    M = np.array([[0.9, 1e12], [1e-13, 0.8]])
    scale = np.diag([1.0, 1e12])
    expected = spectral_radius(scale @ M @ np.linalg.inv(scale))
    assert spectral_radius(M) == pytest.approx(expected, rel=1e-15)


def test_the_radius_of_an_empty_map_is_0_and_of_nan_infinite():
    """Nothing to hand on: 0. What is not finite: infinite."""
    assert spectral_radius(np.zeros((0, 0))) == 0.0
    assert spectral_radius(np.full((2, 2), np.nan)) == np.inf
