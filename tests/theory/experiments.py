"""Experiments with the example, right and wrong ones, computed apart from the package."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import lfilter

from cosim.arrays import Matrix, Vector
from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, disturbed_plant
from cosim.theory.plants.descriptor import reduce
from tests.theory.academic import THETA, academic, alpha

FAMILIES = (Exponential(), Exponential())
COARSE = 1e-2  # s: a tenth of the samples, for tests that run every time
A = np.array([[0, 1, 1], [0, -2, 1], [1, 0, 1.0]])
BU = np.array([[0], [2], [1.0]])
BD = np.array([[1], [0], [0.0]])
C = np.array([[2, 0, 1.0]])
# Cramer-Rao bound over the deviation of the noise, 40 s at 1 ms, of theta, with amplitudes and x(0)
# unknown, and with an offset too; from a numeric Jacobian of the exact solution
BOUND = np.array([7.0863e-3, 6.2226e-2])


def times(h: float = 1e-3) -> Vector:
    """Return the instants of 40 s."""
    return np.arange(round(40.0 / h) + 1) * h


def design() -> DisturbedPlant:
    """Return the design model."""
    return disturbed_plant(reduce(academic()), [0, 0])


def simulate(
    t: Vector,
    disturbance: Vector,
    *,
    matrix: Matrix = A,
    gain: float = 1.0,
    x0: tuple[float, float] = (1.0, -1.0),
) -> Matrix:
    """Simulate the plant for straight lines between samples, by a matrix exponential of its own."""
    a, b = slice(0, 2), slice(2, 3)
    inverse = 1.0 / matrix[2, 2]
    by_u = np.hstack([BU, BD])
    reduced = matrix[a, a] - inverse * matrix[a, b] @ matrix[b, a]
    forcing = by_u[a] - inverse * matrix[a, b] @ by_u[b]
    output = C[:, a] - inverse * C[:, b] @ matrix[b, a]
    direct = -inverse * C[:, b] @ by_u[b]
    h = t[1] - t[0]
    block = np.zeros((6, 6))
    block[:2, :2] = h * reduced
    block[:2, 2:4] = h * forcing
    block[2:4, 4:6] = np.eye(2)
    power = expm(block)
    end = power[:2, 4:6]
    begin = power[:2, 2:4] - end
    u = np.stack([np.sin(t), disturbance], axis=1)
    forced = u[:-1] @ begin.T + u[1:] @ end.T
    values, vectors = np.linalg.eig(power[:2, :2])
    modal = np.linalg.solve(vectors, np.vstack([x0, forced]).T.astype(complex))
    modes = [lfilter([1.0], [1.0, -values[i]], modal[i]) for i in range(2)]
    states = (vectors @ np.array(modes)).real
    return gain * ((output @ states).T + u @ direct.T)


def delta(t: Vector, rates: tuple[float, float] = (1.7, 2.3)) -> Matrix:
    """Return both terms of the disturbance, with other rates in the alphas if wanted."""
    first = 1.35 + 0.25 * np.sin(rates[0] * t)
    second = 1.1 + 0.2 * np.cos(rates[1] * t)
    return np.stack([first, second], axis=1) * np.exp(np.outer(t, THETA))


@cache
def solved(h: float = 1e-3) -> Matrix:
    """Solve the plant every h [s], to 1e-12."""
    t = times(h)
    reduced = reduce(academic())

    def rate(t: float, x: Vector) -> Vector:
        forced = reduced.B_1a[:, 0] * np.sin(t) + reduced.B_2a[:, 0] * delta(np.array([t])).sum()
        return reduced.A_a @ x + forced

    solution = solve_ivp(
        rate, (0.0, t[-1]), [1.0, -1.0], method="DOP853", rtol=1e-12, atol=1e-13, t_eval=t
    )
    return (reduced.C3 @ solution.y).T + np.outer(np.sin(t), reduced.C4[0])


@cache
def exact(case: str, h: float = 1e-3) -> Matrix:
    """Return the output of a case without noise."""
    t = times(h)
    both = delta(t)
    total = both.sum(axis=1)
    match case:
        case "good":
            return simulate(t, total)
        case "alpha times 1.05":
            return simulate(t, 1.05 * total)
        case "constant delta":
            return simulate(t, total + 0.02)
        case "sensor gain":
            return simulate(t, total, gain=1.05)
        case "rate of alpha 1":
            return simulate(t, delta(t, (1.7 * 1.05, 2.3)).sum(axis=1))
        case "rate of alpha 2":
            return simulate(t, delta(t, (1.7, 2.3 * 1.05)).sum(axis=1))
        case "zero disturbance":
            return simulate(t, np.zeros(len(t)))
        case "first alone":
            return simulate(t, both[:, 0])
        case "second alone":
            return simulate(t, both[:, 1])
    row, column = int(case[1]), int(case[2])
    changed = A.copy()
    changed[row, column] *= 1.05
    return simulate(t, total, matrix=changed)


WRONG_ENTRIES = tuple(
    f"A{i}{j}" for i, j in itertools.product(range(3), range(3)) if A[i, j] != 0.0
)
WRONG_MODELS = (
    "constant delta",
    "sensor gain",
    "rate of alpha 1",
    "rate of alpha 2",
    *WRONG_ENTRIES,
)


def record(y: Matrix, h: float = 1e-3) -> DataSet:
    """Return samples as a data set."""
    t = times(h)
    return DataSet(t, y, np.sin(t)[:, np.newaxis], alpha(t))


def noisy(case: str, sigma: float, seed: int, h: float = 1e-3) -> DataSet:
    """Return a case with white noise."""
    y = exact(case, h)
    return record(y + sigma * np.random.default_rng(seed).standard_normal(y.shape), h)
