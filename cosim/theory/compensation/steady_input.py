"""The input that rejects a disturbance: what u has to be for good, whatever the controller.

A disturbance of the class is the output of ``v' = S v``, ``delta = Q v``, with the families'
generators on the diagonal of S. The regulated outputs are zero for good with ``x = X v`` and
``u = U v`` where (Francis, 1977)::

    X S = A X + B U + Bd Q
      0 = C X + D U + Dd Q

The courses are those of v from its initial value, by steps of the exact solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.step import matrix_exponential
from cosim.theory.compensation.state_feedback import RegulatedPlant
from cosim.theory.disturbances.families import Family

MISFIT = 1e-6  # of the disturbance, and of the equations, relative to their size


@dataclass(frozen=True, eq=False)
class KnownDisturbance:
    """A disturbance of one element whose components and course are known.

    Parameters
    ----------
    families : sequence of Family
    theta : sequence of Vector
        Of each family.
    course : Vector, shape (N,)
        At equally spaced instants.
    spacing : float
        Of these [s].
    """

    families: Sequence[Family]
    theta: Sequence[Vector]
    course: Vector
    spacing: float


def steady_input(plant: RegulatedPlant, disturbance: KnownDisturbance) -> Matrix | None:
    """Return the course of u that rejects a disturbance, shape ``(N, n_u)``.

    None: the disturbance is not what its components make, or no u rejects it.
    """
    S, Q = _exosystem(disturbance)
    transition = matrix_exponential(S * disturbance.spacing)
    count = len(disturbance.course)
    rows = np.empty((count, len(S)))  # what v(0) makes of delta at each instant
    row = Q
    for k in range(count):
        rows[k] = row
        row = row @ transition
    initial = np.linalg.lstsq(rows, disturbance.course, rcond=None)[0]
    misfit = float(np.abs(rows @ initial - disturbance.course).max())
    U = _input_of_modes(plant, S, Q)
    if U is None or misfit > MISFIT * float(np.abs(disturbance.course).max()):
        return None
    u = np.empty((count, len(U)))
    v = initial
    for k in range(count):
        u[k] = U @ v
        v = transition @ v
    return u


def _exosystem(disturbance: KnownDisturbance) -> tuple[Matrix, Vector]:
    """Return S and the row Q of all components together."""
    sizes = [family.v for family in disturbance.families]
    S = np.zeros((sum(sizes), sum(sizes)))
    begin = 0
    for family, theta, size in zip(disturbance.families, disturbance.theta, sizes, strict=True):
        block = slice(begin, begin + size)
        S[block, block] = family.G(theta)
        begin += size
    return S, np.concatenate([family.c for family in disturbance.families])


def _input_of_modes(plant: RegulatedPlant, S: Matrix, Q: Vector) -> Matrix | None:
    """Solve for U, shape ``(n_u, len(S))``; of several solutions the smallest."""
    n, n_u = plant.B.shape
    of_modes = np.eye(len(S))
    static = plant.static_equations
    derivative = np.zeros(static.shape)
    derivative[:n, :n] = np.eye(n)
    # of the columns of [X; U], stacked
    equations = np.kron(of_modes, static) - np.kron(S.T, derivative)
    of_delta = np.vstack([plant.Bd, plant.Dd])
    right = -np.outer(Q, of_delta[:, 0]).ravel()
    solution = np.linalg.lstsq(equations, right, rcond=None)[0]
    residual = np.abs(equations @ solution - right).max()
    size = np.abs(equations) @ np.abs(solution) + np.abs(right)
    if residual > MISFIT * size.max():
        return None
    columns = solution.reshape(len(S), n + n_u)
    return np.asarray(columns[:, n:].T, np.float64)
