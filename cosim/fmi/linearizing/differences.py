"""Derivatives by central differences, extrapolated to the step zero, with an estimate of error.

For the steps ``h_k = h_0 / 4^k``::

    T[k, 0] = (f(z + h_k) - f(z - h_k)) / 2 h_k
    T[k, i] = (16^i T[k, i-1] - T[k-1, i-1]) / (16^i - 1)

Every column removes one more even power of the step from the truncation error (Richardson), and how
far an entry lies from the two it was computed from bounds what is left of it (Ridders, 1982). The
error of f itself, rounding or the tolerance of a solver inside, moves the quotients by
``noise / h_k``: the last of them, whose truncation error is gone, show how large it is. Of all
entries the one with the smallest sum of both is taken, for each component of f by itself: so the
step is chosen by the error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from cosim.arrays import Vector

# the largest step, relative to the scale of the argument; a power of two: z + h is mostly exact
FIRST: Final = 0.125
STEPS: Final = 12  # down to 3e-8 of the scale
ROUNDING: Final = 2.0 * np.finfo(np.float64).eps  # of f, at the least
LAST: Final = 2  # quotients that show the noise


def differentiate(
    f: Callable[[float], Vector], z: float, *, scale: float, room: float = np.inf
) -> tuple[Vector, Vector]:
    """Return df/dz at ``z`` and an estimate of its error, each of the shape of f.

    The error is infinite where f is nowhere finite.

    Parameters
    ----------
    f : callable
    z : float
    scale : float
        Over which f may be expected to change, positive.
    room : float
        Largest step that is allowed, positive.
    """
    largest = min(FIRST * scale, room)
    steps = np.ldexp(largest, -2 * np.arange(STEPS))  # a power would be the C library's
    high = np.array([f(z + h) for h in steps])
    low = np.array([f(z - h) for h in steps])
    h = steps[:, np.newaxis]
    # a large step may lead where f is not defined
    with np.errstate(invalid="ignore", over="ignore"):
        widths = (z + h) - (z - h)
        column = (high - low) / widths
        changes = np.abs(np.diff(column, axis=0))
        last_changes = changes[-LAST:] * h[-LAST:]
        largest_change = last_changes.max(axis=0)
        largest_value = np.maximum(np.abs(high), np.abs(low))
        noise = 2.0 * np.maximum(largest_change, ROUNDING * largest_value)
        entries = [column[1:]]
        truncation_errors = [changes]
        for i in range(1, STEPS):
            finer = column[1:]
            coarser = column[:-1]
            factor = float(16**i - 1)
            extrapolated = finer + np.diff(column, axis=0) / factor
            from_finer = np.abs(extrapolated - finer)
            from_coarser = np.abs(extrapolated - coarser)
            entries.append(extrapolated)
            truncation_errors.append(np.maximum(from_finer, from_coarser))
            column = extrapolated
        noise_errors = noise / h
        errors = [part + noise_errors[-len(part) :] for part in truncation_errors]
    error = np.concatenate(errors)
    error[np.isnan(error)] = np.inf
    best = error.argmin(axis=0)[np.newaxis]
    derivative = np.take_along_axis(np.concatenate(entries), best, axis=0)
    least_error = np.take_along_axis(error, best, axis=0)
    return derivative[0], least_error[0]
