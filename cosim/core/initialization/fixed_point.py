"""Solve ``w(v) = v`` for a few unknowns, where w is costly and its derivative unknown.

Sums run in a fixed order, without BLAS, so that equal functions give equal bits on every processor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from cosim.arrays import Matrix, Vector

Function: TypeAlias = Callable[[Vector], Vector]

RELATIVE: Final = 1e-9  # largest residual of a solution, relative to the values
ROUNDING: Final = 64 * float(np.finfo(np.float64).eps)  # relative to the largest value involved
STEPS: Final = 50  # of Newton's method
DIFFERENCE: Final = -20  # power of two, relative: rounding leaves errors of 2^-32 in a derivative
SINGULAR: Final = 1e-8  # smallest pivot
TINY: Final = float(np.finfo(np.float64).tiny)


class SingularError(Exception):
    """``1 - w'`` cannot be inverted: there is no solution, or more than one."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A candidate v, and the element where its residual is worst for its tolerance.

    Parameters
    ----------
    v : Vector
    element : int
        Where the residual ``|w(v) - v|`` is worst for what is allowed.
    residual, tolerance : float
        Both there.
    """

    v: Vector
    element: int = 0
    residual: float = np.inf
    tolerance: float = 0.0

    @property
    def excess(self) -> float:
        """The worst residual in units of its tolerance: 1 or less is a solution."""
        if self.residual == 0.0:
            return 0.0
        if self.tolerance == 0.0:
            return np.inf
        return self.residual / self.tolerance


def measure(v: Vector, w: Vector, largest: float) -> Candidate:
    """Return v with its residual; ``largest``: the largest value involved in computing w."""
    residual = np.abs(w - v)
    size = np.maximum(np.abs(v), np.abs(w))
    tolerance = RELATIVE * size + ROUNDING * largest
    ratio = residual / np.maximum(tolerance, TINY)
    excess = np.where(residual == 0.0, 0.0, ratio)
    finite = np.isfinite(excess)
    if not finite.all():
        first = int(np.argmin(finite))
        return Candidate(v, first)
    worst = int(np.argmax(excess))
    return Candidate(v, worst, float(residual[worst]), float(tolerance[worst]))


def iterate(function: Function, v: Vector, limit: int) -> Vector | None:
    """Return the fixed point by fixed-point iteration, to the last bit.

    None: it was not reached.
    """
    for _ in range(limit):
        w = function(v)
        if v.tobytes() == w.tobytes():
            return v
        if np.isinf(w).any():
            break
        v = w
    return None


def newton(function: Function, v: Vector, largest: Callable[[], float]) -> Candidate:
    """Return the best candidate of Newton's method; it goes on while the residual falls.

    Raises
    ------
    SingularError
        If a matrix on the way is singular.
    """
    best = Candidate(v)
    for _ in range(STEPS):
        w = function(v)
        candidate = measure(v, w, largest())
        if not np.isfinite(candidate.excess):
            break
        at_rounding = best.excess <= 1.0 and candidate.excess >= 0.5 * best.excess
        if at_rounding:
            break
        if candidate.excess < best.excess:
            best = candidate
        if candidate.excess == 0.0:
            break
        v = v + newton_step(function, v, w)
    return best


def newton_step(function: Function, v: Vector, w: Vector) -> Vector:
    """Solve ``(1 - w') step = w - v`` with differences for w', in units of each element's value.

    Raises
    ------
    SingularError
        If the matrix is singular.
    """
    size = np.maximum(np.abs(v), np.abs(w))
    # Powers of two: scaling then changes no bit of the mantissas.
    exponent = np.frexp(size)[1]
    scale = np.where(size > 0.0, np.ldexp(1.0, exponent), 1.0)
    matrix = np.eye(len(v))
    for j in range(len(v)):
        difference = np.ldexp(scale[j], DIFFERENCE)
        shifted = v.copy()
        shifted[j] += np.copysign(difference, v[j])
        taken = shifted[j] - v[j]  # the difference to the last bit
        slope = (function(shifted) - w) / taken
        matrix[:, j] -= slope * scale[j] / scale
    scaled = eliminate(matrix, (w - v) / scale)
    step: Vector = scaled * scale
    return step


def eliminate(matrix: Matrix, right: Vector) -> Vector:
    """Solve ``matrix x = right`` by Gauss-Jordan elimination with partial pivoting.

    Raises
    ------
    SingularError
        If a pivot is below ``SINGULAR`` times the largest element of its row, or 1.
    """
    n = len(right)
    rows = np.column_stack([matrix, right])
    largest = np.abs(matrix).max(axis=1)
    rows /= np.maximum(1.0, largest)[:, np.newaxis]
    for k in range(n):
        column = np.abs(rows[k:, k])
        pivot = k + int(np.argmax(column))
        rows[[k, pivot]] = rows[[pivot, k]]
        if not abs(rows[k, k]) > SINGULAR:
            raise SingularError
        for i in range(n):
            if i != k:
                factor = rows[i, k] / rows[k, k]
                rows[i] -= factor * rows[k]
    x: Vector = rows[:, n] / np.diagonal(rows)
    return x
