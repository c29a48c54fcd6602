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
from cosim.native.numerics.linear import matrix_exponential
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
    course = disturbance.course
    initial, *_ = np.linalg.lstsq(rows, course, rcond=None)
    misfit = np.abs(rows @ initial - course).max()
    largest = np.abs(course).max()
    U = _input_of_modes(plant, S, Q)
    if U is None or misfit > MISFIT * largest:
        return None
    u = np.empty((count, len(U)))
    v = initial
    for k in range(count):
        u[k] = U @ v
        v = transition @ v
    return u


def _exosystem(disturbance: KnownDisturbance) -> tuple[Matrix, Vector]:
    """Return S and the row Q of all components together."""
    families = disturbance.families
    n = sum(family.v for family in families)
    S = np.zeros((n, n))
    begin = 0
    for family, theta in zip(families, disturbance.theta, strict=True):
        end = begin + family.v
        block = slice(begin, end)
        S[block, block] = family.G(theta)
        begin = end
    rows = [family.c for family in families]
    return S, np.concatenate(rows)


def _input_of_modes(plant: RegulatedPlant, S: Matrix, Q: Vector) -> Matrix | None:
    """Solve for U, shape ``(n_u, len(S))``; of several solutions the smallest."""
    n, n_u = plant.B.shape
    m = len(S)
    static = plant.static_equations
    derivative = np.zeros_like(static)
    derivative[:n, :n] = np.eye(n)
    # of the columns of [X; U], stacked
    of_static = np.kron(np.eye(m), static)
    of_rates = np.kron(S.T, derivative)
    equations = of_static - of_rates
    of_delta = np.vstack([plant.Bd, plant.Dd])
    driven = np.outer(Q, of_delta[:, 0])
    right = -driven.ravel()
    solution, *_ = np.linalg.lstsq(equations, right, rcond=None)
    residual = np.abs(equations @ solution - right)
    of_solution = np.abs(equations) @ np.abs(solution)
    size = of_solution + np.abs(right)
    if residual.max() > MISFIT * size.max():
        return None
    columns = solution.reshape(m, n + n_u)
    U = columns[:, n:].T
    return np.asarray(U, np.float64)
