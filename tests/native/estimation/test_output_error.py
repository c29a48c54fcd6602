"""The matrices of the components of a disturbance, as the kernel of output error has them."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from cosim.theory.disturbances.families import Exponential, Polynomial, Sine, generators


def test_each_component_takes_its_own_part_of_the_basis_and_of_theta():
    """A ramp, a sine and an exponential: each is ``c' expm(G t) beta``, its closed form."""
    matrices = generators([Polynomial(1), Sine(), Exponential()])
    beta = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    theta = np.array([0.7, -0.2])
    t = 1.5
    found = []
    for component in matrices.each:
        G = component.matrix(theta[component.theta])
        found.append(component.c @ expm(G * t) @ beta[component.basis])
    expected = [
        1.0 + 2.0 * t,
        3.0 * np.cos(0.7 * t) + 4.0 * np.sin(0.7 * t),
        5.0 * np.exp(-0.2 * t),
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    assert (matrices.order, matrices.parameters) == (5, 2)
