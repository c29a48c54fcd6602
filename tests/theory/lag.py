"""A lag, `x' = -x + b u + delta`, solved in closed form from sample to sample."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant

FAMILY = (Exponential(),)
RATE = -0.1  # theta


def lag(gain: float = 1.0, sensors: tuple[float, ...] = (1.0,)) -> DisturbedPlant:
    """Return the lag with the gain b of its input, and with sensors of given gains."""
    C = np.array(sensors)[:, np.newaxis]
    return DisturbedPlant(
        A=[[-1.0]], B=[[gain]], Bd=[[1.0]], C=C, D=np.zeros(C.shape), Dd=np.zeros(C.shape)
    )


def alpha(t: Vector) -> Vector:
    """Return the known factor of the disturbance."""
    return 1.35 + 0.25 * np.sin(1.7 * t)


def states(t: Vector, u: Vector, *, amplitude: float = 1.0, held: bool = False) -> Vector:
    """Solve for x from rest; the disturbance, and u where it is not held, are straight lines."""
    delta = amplitude * alpha(t) * np.exp(RATE * t)
    h = np.diff(t)
    decay = np.exp(-h)
    constant = 1.0 - decay
    ramp = 1.0 - constant / h
    forced = constant * (u + delta)[:-1] + ramp * np.diff(delta)
    if not held:
        forced += ramp * np.diff(u)
    x = [0.0]
    for factor, added in zip(decay.tolist(), forced.tolist(), strict=True):
        x.append(factor * x[-1] + added)
    return np.array(x)


def record(
    t: Vector,
    u: Vector,
    y: Matrix,
    *,
    held: bool = False,
    sigma: float = 0.0,
    seed: int = 0,
) -> DataSet:
    """Return outputs as a data set, with white noise."""
    noise = sigma * np.random.default_rng(seed).standard_normal(y.shape)
    mask = np.array([held])
    return DataSet(t, y + noise, u[:, np.newaxis], alpha(t)[:, np.newaxis], mask)


def staircase(samples: int, seed: int, *, of: int = 5) -> Vector:
    """Return an input that keeps each of its random values for some samples."""
    levels = 3.0 * np.random.default_rng(seed).standard_normal(samples // of + 1)
    return np.repeat(levels, of)[:samples]
