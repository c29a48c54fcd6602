"""Descriptor systems in coordinates and equations that hide their form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from cosim.arrays import Matrix
from cosim.errors import AssumptionError
from cosim.theory.observers.observer import design
from cosim.theory.plants.descriptor import DescriptorSystem, ReducedSystem


@dataclass(frozen=True)
class Matrices:
    """E, A, B of u and delta, C, D of u and delta."""

    E: Matrix
    A: Matrix
    Bu: Matrix
    Bd: Matrix
    C: Matrix
    Du: Matrix
    Dd: Matrix

    def scrambled(self, rng: np.random.Generator) -> Matrices:
        """Mix equations and states, by matrices of condition 10."""
        n = len(self.E)
        P = mixing(n, rng)
        Q = mixing(n, rng)
        E = P @ self.E @ Q
        A = P @ self.A @ Q
        return Matrices(E, A, P @ self.Bu, P @ self.Bd, self.C @ Q, self.Du, self.Dd)

    def in_other_units(self, rng: np.random.Generator) -> Matrices:
        """Scale every equation, state, input and output by up to 1e6 either way."""
        n, n_u = self.Bu.shape
        rows = factors(n, rng)[:, np.newaxis]
        states = factors(n, rng)
        u = factors(n_u, rng)
        delta = factors(self.Bd.shape[1], rng)
        y = factors(len(self.C), rng)[:, np.newaxis]
        E = rows * self.E * states
        A = rows * self.A * states
        Bu = rows * self.Bu * u
        Bd = rows * self.Bd * delta
        return Matrices(E, A, Bu, Bd, y * self.C * states, y * self.Du * u, y * self.Dd * delta)

    @property
    def system(self) -> DescriptorSystem:
        """The system in the general form."""
        return DescriptorSystem.general(
            E=self.E, A=self.A, Bu=self.Bu, Bd=self.Bd, C=self.C, Du=self.Du, Dd=self.Dd
        )

    def states_at(self, s: complex) -> np.ndarray:
        """Return (s E - A)^-1 B: the states that answer each input exp(s t)."""
        return np.linalg.solve(s * self.E - self.A, np.hstack([self.Bu, self.Bd]))

    def transfer(self, s: complex) -> np.ndarray:
        """Return the transfer matrix from u and delta to y, by the pencil."""
        return self.C @ self.states_at(s) + np.hstack([self.Du, self.Dd])

    def finite_eigenvalues(self, count: int) -> np.ndarray:
        """Return the finite eigenvalues of s E - A, by the generalized eigenvalue problem."""
        values = scipy.linalg.eigvals(self.A, self.E)
        order = np.argsort(np.abs(values))
        return np.sort_complex(values[order][:count])


def mixing(n: int, rng: np.random.Generator) -> Matrix:
    """Return a random matrix of condition 10."""
    left = np.linalg.qr(rng.normal(size=(n, n)))[0]
    right = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return left * np.geomspace(0.3, 3.0, n) @ right


def factors(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return numbers from 1e-6 to 1e6."""
    return 10.0 ** rng.integers(-6, 7, size=n)


def index_one(
    rng: np.random.Generator, *, n: int, n_a: int, n_u: int = 1, n_d: int = 1, n_y: int = 2
) -> Matrices:
    """Return a random partitioned system of index 1 whose disturbances do not reach y directly."""
    E = np.diag(np.repeat([1.0, 0.0], [n_a, n - n_a]))
    A = rng.normal(size=(n, n))
    A[n_a:, n_a:] += 4.0 * np.eye(n - n_a)
    Bd = rng.normal(size=(n, n_d))
    Bd[n_a:] = 0.0
    return Matrices(
        E=E,
        A=A,
        Bu=rng.normal(size=(n, n_u)),
        Bd=Bd,
        C=rng.normal(size=(n_y, n)),
        Du=rng.normal(size=(n_y, n_u)),
        Dd=np.zeros((n_y, n_d)),
    )


def movable(reduced: ReducedSystem) -> int:
    """Return how many poles of an observer can be placed, as the message for none says."""
    try:
        design(reduced, poles=[])
    except AssumptionError as error:
        return int(str(error).split("expected ")[1].split(" poles")[0])
    return 0
