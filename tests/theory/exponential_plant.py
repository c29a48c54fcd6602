"""A plant under exponentials, as a function of p = (theta, amplitudes, x(0)): for bounds on theta.

Its arithmetic is its own: the modes of the plant, each a recursion of first order or a power.
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

    @cached_property
    def modes(self):
        """Return the poles of a step, what each end of it adds to a mode, and what y shows."""
        Ad, begin, end = self.hold
        values, vectors = np.linalg.eig(Ad)
        ends = np.linalg.solve(vectors, np.stack([begin, end], axis=1))
        return values, ends, self.C @ vectors

    def respond(self, deltas: Matrix) -> Matrix:
        """Return y from rest for every column of delta, shape (N, n_y, columns)."""
        values, ends, outputs = self.modes
        y = self.Dd[:, 0, np.newaxis] * deltas[:, np.newaxis].astype(complex)
        for value, (begin, end), output in zip(values, ends, outputs.T, strict=True):
            forced = np.zeros(deltas.shape, complex)
            forced[1:] = begin * deltas[:-1] + end * deltas[1:]
            mode = lfilter([1.0], [1.0, -value], forced, axis=0)
            y += output[:, np.newaxis] * mode[:, np.newaxis]
        return y.real

    def __call__(self, p: Vector) -> Prediction:
        components = self.alphas.shape[1]
        theta = p[:components]
        c = p[components : 2 * components]
        basis = self.alphas * np.exp(np.outer(self.t, theta))
        slopes = c * self.t[:, np.newaxis] * basis
        responses = self.respond(np.hstack([slopes, basis]))
        jacobian = np.concatenate([responses, self.free], axis=-1)
        return Prediction(jacobian[:, :, components:] @ p[components:], jacobian)

    @cached_property
    def free(self):
        """Return what every state makes of y by itself, shape (N, n_y, n)."""
        Ad, _, _ = self.hold
        values, vectors = np.linalg.eig(Ad)
        powers = values ** np.arange(len(self.alphas))[:, np.newaxis]
        starts = np.linalg.inv(vectors)
        return np.einsum("oi,ki,ij->koj", self.C @ vectors, powers, starts).real

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
