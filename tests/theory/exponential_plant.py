"""A plant under exponentials, as a function of p = (theta, amplitudes, x(0)): for bounds on theta.

Its arithmetic is its own: the modes of the plant, each a recursion of first order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from cosim.arrays import Matrix, Vector
from cosim.theory.bounded.worst_case import (
    BoundedDisturbance,
    IrregularResponse,
    Prediction,
    irregular_response,
)
from tests.theory.academic import alpha


@dataclass(frozen=True, eq=False)
class ExponentialPlant:
    """`x' = A x + Bd sum_i c_i alpha_i exp(theta_i t)`, `y = C x + Dd sum_i ...`, every h [s]."""

    A: Matrix
    Bd: Matrix
    C: Matrix
    Dd: Matrix
    h: float
    alphas: Matrix

    @cached_property
    def t(self) -> Vector:
        return np.arange(len(self.alphas)) * self.h

    @cached_property
    def hold(self):
        """Return the effects of the state and of the disturbance at both ends of a step."""
        n = len(self.A)
        block = np.zeros((n + 2, n + 2))
        block[:n, :n] = self.A * self.h
        block[:n, n] = self.Bd[:, 0] * self.h
        block[n, n + 1] = 1.0
        power = expm(block)
        end = power[:n, n + 1]
        return power[:n, :n], power[:n, n] - end, end

    def respond(self, delta: Vector, x0: Vector) -> Matrix:
        """Return y, shape (N, n_y)."""
        Ad, begin, end = self.hold
        values, vectors = np.linalg.eig(Ad)
        forced = np.outer(delta[:-1], begin) + np.outer(delta[1:], end)
        rows = np.concatenate([x0[np.newaxis], forced]).astype(complex)
        modes = np.linalg.solve(vectors, rows.T)
        for i, value in enumerate(values):
            modes[i] = lfilter([1.0], [1.0, -value], modes[i])
        x = (vectors @ modes).real.T
        return x @ self.C.T + np.outer(delta, self.Dd[:, 0])

    def __call__(self, p: Vector) -> Prediction:
        components = self.alphas.shape[1]
        theta = p[:components]
        c = p[components : 2 * components]
        rest = np.zeros(len(self.A))
        basis = self.alphas * np.exp(np.outer(self.t, theta))
        slopes = [c[i] * self.respond(self.t * basis[:, i], rest) for i in range(components)]
        responses = [self.respond(column, rest) for column in basis.T]
        columns = [*slopes, *responses, *self.free]
        jacobian = np.stack(columns, axis=-1)
        return Prediction(jacobian[:, :, components:] @ p[components:], jacobian)

    @cached_property
    def free(self):
        return [self.respond(0.0 * self.t, unit) for unit in np.eye(len(self.A))]

    @property
    def irregular(self) -> IrregularResponse:
        return irregular_response(self.A, self.Bd, self.C, self.Dd, self.h)

    def problem(self, bound: float) -> BoundedDisturbance:
        n_y = len(self.C)
        components = self.alphas.shape[1]
        return BoundedDisturbance(self, self.irregular, np.array([bound]), np.eye(n_y), components)


TRUTH = np.array([-0.1, -0.3, 1.0, 1.0, 1.0, -1.0])  # theta, amplitudes, x(0) of the example


def example(h: float) -> ExponentialPlant:
    """Return the paper's example, reduced, without its known input, over 40 s."""
    t = np.arange(round(40.0 / h) + 1) * h
    return ExponentialPlant(
        A=np.array([[-1.0, 1.0], [-1.0, -2.0]]),
        Bd=np.array([[1.0], [0.0]]),
        C=np.array([[1.0, 0.0]]),
        Dd=np.zeros((1, 1)),
        h=h,
        alphas=alpha(t),
    )


def direct(samples: int, h: float) -> ExponentialPlant:
    """Return a sensor of the disturbance itself, without any state."""
    return ExponentialPlant(
        A=np.zeros((0, 0)),
        Bd=np.zeros((0, 1)),
        C=np.zeros((1, 0)),
        Dd=np.ones((1, 1)),
        h=h,
        alphas=np.ones((samples, 1)),
    )
