import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosim.theory.plants.geometry import null_space, orthogonal_complement, output_nulling, rank


def test_empty_matrices_have_rank_zero():
    """A map from or to nothing reaches nothing."""
    assert rank(np.zeros((0, 3))) == rank(np.zeros((3, 0))) == rank(np.zeros((2, 2))) == 0


@given(st.integers(-6, 6), st.integers(-6, 6))
def test_units_do_not_change_the_unobservable_subspace(time_unit, output_unit):
    """Scaling time or an output by powers of ten leaves the subspace."""
    A = np.array([[-1.0, 1, 0], [0, -2, 0], [1, 0, -3]]) * 10.0**time_unit
    C = np.array([[1.0, 0, 0], [0, 10.0**output_unit, 0]])
    V = output_nulling(A, np.zeros((3, 0)), C, np.zeros((2, 0)))
    np.testing.assert_allclose(
        np.abs(V), [[0.0], [0], [1]], atol=1e-12
    )  # an exact coordinate direction


@given(st.integers(0, 4), st.randoms(use_true_random=False))
def test_null_space_and_complement_split_the_space(k, random):
    """Together they are an orthonormal basis."""
    matrix = np.array([[random.uniform(-1, 1) for _ in range(4)] for _ in range(k)]).reshape(k, 4)
    V = null_space(matrix)
    W = orthogonal_complement(V)
    np.testing.assert_allclose(
        np.hstack([W, V]).T @ np.hstack([W, V]), np.eye(4), atol=1e-12
    )  # orthonormal factors of an SVD
    np.testing.assert_allclose(matrix @ V, 0.0, atol=1e-8)  # what counts as zero: 1e-9
