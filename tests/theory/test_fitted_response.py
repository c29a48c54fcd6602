"""The response of a fit: transitions at many instants."""

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.theory.fitted_response import transitions

ROTATION = np.array([[0.0, 1.3], [-1.3, 0.0]])
CHAIN = np.array([[-0.2, 1.0, 0.0], [0.0, -0.2, 1.0], [0.0, 0.0, 0.3]])


@pytest.mark.parametrize("G", [ROTATION, CHAIN, np.zeros((2, 2))], ids=["sine", "chain", "zero"])
def test_transitions_are_matrix_exponentials(G):
    """Those of scipy at every instant, 0 among them.

    Every squaring doubles the rounding, and their number is that of the last instant.
    """
    t = np.concatenate([[0.0, 1e-9], np.geomspace(1e-3, 40.0, 30)])
    found = transitions(G, t)
    allowed = 2.0**-50 * (1.0 + 2.0 * np.abs(G).sum() * t[-1])
    for instant, one in zip(t, found, strict=True):
        expected = expm(G * instant)
        np.testing.assert_allclose(one, expected, rtol=0.0, atol=allowed * np.abs(expected).max())
