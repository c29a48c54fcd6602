"""The tests' own simulation of plants under straight lines between samples."""

from __future__ import annotations

import numpy as np
from scipy.signal import lsim

from tests.theory.straight_lines import simulate_lines


def test_the_outputs_are_those_of_scipy(subtests):
    """Of a random plant, of one without feedback and of one whose matrix has no eigenvectors."""
    rng = np.random.default_rng(0)
    t = 0.05 * np.arange(200)
    mass = np.array([[0.0, 1.0], [0.0, 0.0]])
    for A, n_u, n_y in ((rng.standard_normal((4, 4)), 2, 3), (-np.eye(1), 1, 1), (mass, 1, 2)):
        with subtests.test(states=len(A)):
            B = rng.standard_normal((len(A), n_u))
            C = rng.standard_normal((n_y, len(A)))
            D = rng.standard_normal((n_y, n_u))
            u = rng.standard_normal((len(t), n_u))
            x0 = rng.standard_normal(len(A))
            _, y, _ = lsim((A, B, C, D), u, t, X0=x0)
            found = simulate_lines((A, B, C, D), u, t, x0)
            np.testing.assert_allclose(found, y, rtol=0, atol=1e-12 * np.abs(y).max())
            assert found.shape == y.shape
