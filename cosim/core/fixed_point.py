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

RELATIVE: Final = 1e-9  # largest residual of a solution, of the values
ROUNDING: Final = 64 * float(np.finfo(np.float64).eps)  # and of the largest value that took part
STEPS: Final = 50  # of Newton's method
DIFFERENCE: Final = (
    -20
)  # power of two, of the value: rounding leaves errors of some 2^-32 in a derivative
SINGULAR: Final = 1e-8  # least pivot


class SingularError(Exception):
    """``1 - w'`` cannot be inverted: there is no solution, or more than one."""


@dataclass(frozen=True, slots=True)
class Found:
    """The best v, where its residual ``|w(v) - v|`` is worst for what is needed, and both there."""

    v: Vector
    element: int = 0
    residual: float = np.inf
    needed: float = 0.0

    @property
    def excess(self) -> float:
        """The worst residual in units of what is needed: 1 or less is a solution."""
        return (
            0.0 if self.residual == 0.0 else self.residual / self.needed if self.needed else np.inf
        )


def judge(v: Vector, w: Vector, largest: float) -> Found:
    """Hold the residual against the values; ``largest``: the largest value that took part in computing w."""
    residual, needed = (
        np.abs(w - v),
        RELATIVE * np.maximum(np.abs(v), np.abs(w)) + ROUNDING * largest,
    )
    excess = np.where(
        residual == 0.0, 0.0, residual / np.maximum(needed, np.finfo(np.float64).tiny)
    )
    if not np.isfinite(excess).all():
        return Found(v, int(np.argmin(np.isfinite(excess))))
    i = int(np.argmax(excess))
    return Found(v, i, float(residual[i]), float(needed[i]))


def settle(function: Function, v: Vector, sweeps: int) -> Vector | None:
    """Put w in the place of v until no bit changes; None where it does not come to that."""
    for _ in range(sweeps):
        w = function(v)
        if v.tobytes() == w.tobytes():
            return v
        if np.isinf(w).any():
            break
        v = w
    return None


def newton(function: Function, v: Vector, largest: Callable[[], float]) -> Found:
    """Take Newton's steps while the residual falls.

    Raises
    ------
    SingularError
        If a matrix on the way is singular.
    """
    best = Found(v)
    for _ in range(STEPS):
        w = function(v)
        found = judge(v, w, largest())
        if not np.isfinite(found.excess) or (
            best.excess <= 1.0 and found.excess >= 0.5 * best.excess
        ):
            break  # at the level of rounding
        best = found if found.excess < best.excess else best
        if found.excess == 0.0:
            break
        v = v + newton_step(function, v, w)
    return best


def newton_step(function: Function, v: Vector, w: Vector) -> Vector:
    """Solve ``(1 - w') step = w - v`` with differences for w', every element in units of its own value.

    Raises
    ------
    SingularError
        If the matrix is singular.
    """
    size = np.maximum(np.abs(v), np.abs(w))
    scale = np.array([np.ldexp(1.0, np.frexp(x)[1]) if x > 0.0 else 1.0 for x in size])
    matrix = np.eye(len(v))
    for j in range(len(v)):
        moved = v.copy()
        moved[j] += np.copysign(np.ldexp(scale[j], DIFFERENCE), v[j])
        slope = (function(moved) - w) / (moved[j] - v[j])
        matrix[:, j] -= slope * scale[j] / scale
    step: Vector = eliminate(matrix, (w - v) / scale) * scale
    return step


def eliminate(matrix: Matrix, right: Vector) -> Vector:
    """Solve ``matrix x = right`` by Gauss's elimination with partial pivoting.

    Raises
    ------
    SingularError
        If a pivot is below ``SINGULAR`` times the largest element of its row, or 1.
    """
    n, rows = len(right), np.column_stack([matrix, right])
    rows /= np.maximum(1.0, np.abs(matrix).max(axis=1))[:, np.newaxis]
    for k in range(n):
        pivot = k + int(np.argmax(np.abs(rows[k:, k])))
        rows[[k, pivot]] = rows[[pivot, k]]
        if not abs(rows[k, k]) > SINGULAR:
            raise SingularError
        for i in range(n):
            if i != k:
                rows[i] -= rows[i, k] / rows[k, k] * rows[k]
    x: Vector = rows[:, n] / np.diagonal(rows)
    return x
