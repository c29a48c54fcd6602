"""Derivatives by central differences, extrapolated to the step zero, with an estimate of their error.

For the steps ``h_k = h_0 / 4^k``::

    T[k, 0] = (f(z + h_k) - f(z - h_k)) / 2 h_k
    T[k, i] = (16^i T[k, i-1] - T[k-1, i-1]) / (16^i - 1)

Every column removes one more even power of the step from the truncation error (Richardson), and how far an entry lies from the
two it was made of bounds what is left of it (Ridders, 1982). The error of f itself, rounding or the tolerance of a solver inside,
moves the quotients by ``noise / h_k``: the last of them, whose truncation is gone, show how large it is. Of all entries the one
with the smallest sum of both is taken, for each component of f by itself: so the step is chosen by the error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from cosim.arrays import Vector

FIRST: Final = 0.125  # the largest step, relative to the scale of the argument; a power of two: z + h is mostly exact
STEPS: Final = 12  # down to 3e-8 of the scale
ROUNDING: Final = 2.0 * np.finfo(np.float64).eps  # of f, at the least
LAST: Final = 2  # quotients that show the noise


def differentiate(
    f: Callable[[float], Vector], z: float, *, scale: float, room: float = np.inf
) -> tuple[Vector, Vector]:
    """Give df/dz at ``z`` and an estimate of its error, each of the shape of f; infinite where f is nowhere finite.

    Parameters
    ----------
    f : callable
    z : float
    scale : float
        Over which f may be expected to change, positive.
    room : float
        Largest step that is allowed, positive.
    """
    steps = (min(FIRST * scale, room) * 0.25 ** np.arange(STEPS))[:, np.newaxis]
    high, low = (np.array([f(z + sign * h) for h in steps[:, 0]]) for sign in (1.0, -1.0))
    with np.errstate(
        invalid="ignore", over="ignore"
    ):  # a large step may lead where f is not defined
        row = (high - low) / ((z + steps) - (z - steps))
        seen = np.abs(np.diff(row, axis=0)[-LAST:]) * steps[-LAST:]
        noise = 2.0 * np.maximum(seen.max(axis=0), ROUNDING * np.maximum(np.abs(high), np.abs(low)))
        found, errors = [row[1:]], [np.abs(np.diff(row, axis=0))]
        for i in range(1, STEPS):
            better = row[1:] + np.diff(row, axis=0) / (16.0**i - 1.0)
            found.append(better)
            errors.append(np.maximum(np.abs(better - row[1:]), np.abs(better - row[:-1])))
            row = better
        error = np.concatenate([one + (noise / steps)[-len(one) :] for one in errors])
    error[np.isnan(error)] = np.inf
    best = error.argmin(axis=0)[np.newaxis]
    return np.take_along_axis(np.concatenate(found), best, axis=0)[0], np.take_along_axis(
        error, best, axis=0
    )[0]
