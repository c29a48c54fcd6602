"""The paper's example as data: its system and its exact disturbance."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.theory.plants.descriptor import DescriptorSystem, ReducedSystem

DELAYS = (1.0, 2.0, 3.0)
THETA = (-0.1, -0.3)


def academic() -> DescriptorSystem:
    """Return the system of the example."""
    return DescriptorSystem.partitioned(
        A=np.array([[0, 1, 1], [0, -2, 1], [1, 0, 1]]),
        Bu=np.array([[0], [2], [1]]),
        Bd=np.array([[1], [0], [0]]),
        C=np.array([[2, 0, 1]]),
        n_a=2,
    )


def ordinary(A, B, C) -> DescriptorSystem:
    """Return a system without algebraic states and inputs: `x' = A x + B delta, y = C x`."""
    A = np.array(A)
    return DescriptorSystem.partitioned(
        A=A, Bu=np.zeros((len(A), 0)), Bd=np.array(B), C=np.array(C), n_a=len(A)
    )


def alpha(t: Vector) -> Matrix:
    """Return (alpha_1, alpha_2) of (31) at the times t, last axis 2."""
    return np.stack([1.35 + 0.25 * np.sin(1.7 * t), 1.1 + 0.2 * np.cos(2.3 * t)], axis=-1)


def delta(t: Vector) -> Vector:
    """Return the disturbance (31) at the times t."""
    return (alpha(t) * np.exp(np.multiply.outer(t, THETA))).sum(axis=-1)


def delayed(t: Vector) -> tuple[Matrix, Matrix]:
    """Return `delta(t - D_j)`, shape (N, 3), and `alpha(t - D_j)`, shape (N, 3, 2)."""
    times = np.subtract.outer(np.atleast_1d(t), DELAYS)
    return delta(times), alpha(times)


def algebraic_state(reduced: ReducedSystem, x_a: Vector, *, u: Vector, delta: Vector) -> Vector:
    """Compute the algebraic states `x_b` (8), shape ``(n_b,)``.

    With the initial values of x_a, u and delta this is the consistent initial value of x_b.
    """
    from_x_a = reduced.Kx @ x_a
    from_u = reduced.Ku @ u
    from_delta = reduced.Kd @ delta
    x_b: Vector = from_x_a + from_u + from_delta
    return x_b
