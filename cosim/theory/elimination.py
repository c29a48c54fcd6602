"""Elimination of the algebraic states of a partitioned system (8), with a bound of its rounding.

Data are known up to an error that is relative to the sizes of row and column
(:class:`cosim.theory.scaling.Scales`). To the first order x_b = K (x_a, u, delta) then errs by::

    dK <= |A22^-1| (d[A21 B2] + dA22 |K|)

and the feedthrough D + C2 K by ``dD + dC2 |K| + |C2| dK``. Of these, what may be nothing but its
error is zero. Other coefficients are zero only where the sum that they are may be rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix
from cosim.theory.geometry import without_rounding
from cosim.theory.pencil import EPSILON
from cosim.theory.scaling import Scales

DATA: float = 8.0 * EPSILON  # relative error of data


@dataclass(frozen=True, eq=False)
class PartitionedMatrices:
    """A, B of u or delta, C, and D of the same; the first ``n_a`` states are dynamic."""

    A: Matrix
    B: tuple[Matrix, Matrix]
    C: Matrix
    D: tuple[Matrix, Matrix]
    n_a: int


@dataclass(frozen=True, eq=False)
class Eliminated:
    """What is left: ``x_a' = A x_a + B v, y = C x_a + D v, x_b = K x_a + Kv v``, v = u, delta.

    ``Kv_error`` bounds the error of Kv; ``amplification`` is how many times errors of the data grow
    on the way, where the system is of size one.
    """

    A: Matrix
    B: tuple[Matrix, Matrix]
    C: Matrix
    D: tuple[Matrix, Matrix]
    K: Matrix
    Kv: tuple[Matrix, Matrix]
    Kv_error: tuple[Matrix, Matrix]
    amplification: float


def eliminate(matrices: PartitionedMatrices, scales: Scales, growth: float) -> Eliminated:
    """Eliminate x_b; A22 is regular.

    Parameters
    ----------
    matrices : PartitionedMatrices
    scales : Scales
        Of these matrices; inputs are u, then delta.
    growth : float
        How many times larger the errors of the data are.
    """
    n_a = matrices.n_a
    A = matrices.A
    A11 = A[:n_a, :n_a]
    A12 = A[:n_a, n_a:]
    A21 = A[n_a:, :n_a]
    A22 = A[n_a:, n_a:]
    C1 = matrices.C[:, :n_a]
    C2 = matrices.C[:, n_a:]
    of_u, of_delta = matrices.B
    n_u = of_u.shape[1]
    right = np.hstack([A21, of_u[n_a:], of_delta[n_a:]])
    solution = np.linalg.solve(A22, right)
    gain: Matrix = (0.0 - solution).astype(np.float64)  # not -solution: no negative zeros
    inverse: Matrix = np.abs(np.linalg.inv(A22)).astype(np.float64)
    terms = np.abs(A22) @ np.abs(gain) + np.abs(right)
    magnitudes = inverse @ terms  # of the terms that x_b is made of
    error = DATA * growth
    per_column = np.concatenate([1.0 / scales.states[:n_a], 1.0 / scales.inputs])
    known_up_to = per_column + (1.0 / scales.states[n_a:]) @ np.abs(gain)
    gain_error = error * np.outer(inverse @ scales.equations[n_a:], known_up_to)
    gain = np.where(np.abs(gain) > gain_error, gain, 0.0)
    output_error = error * np.outer(scales.outputs, known_up_to) + np.abs(C2) @ gain_error

    def substituted(direct: Matrix, left: Matrix, columns: slice) -> Matrix:
        """Return ``direct + left K``, a coefficient after x_b was replaced by (8)."""
        total = direct + left @ gain[:, columns]
        return without_rounding(total, np.abs(direct) + np.abs(left) @ magnitudes[:, columns])

    def feedthrough(direct: Matrix, columns: slice) -> Matrix:
        total = direct + C2 @ gain[:, columns]
        return np.where(np.abs(total) > output_error[:, columns], total, 0.0)

    scaled_inverse = inverse * scales.equations[n_a:] / scales.states[n_a:, np.newaxis]
    state = slice(0, n_a)
    u = slice(n_a, n_a + n_u)
    delta = slice(n_a + n_u, None)
    D_u, D_delta = matrices.D
    return Eliminated(
        A=substituted(A11, A12, state),
        B=(substituted(of_u[:n_a], A12, u), substituted(of_delta[:n_a], A12, delta)),
        C=substituted(C1, C2, state),
        D=(feedthrough(D_u, u), feedthrough(D_delta, delta)),
        K=gain[:, state],
        Kv=(gain[:, u], gain[:, delta]),
        Kv_error=(gain_error[:, u], gain_error[:, delta]),
        amplification=growth * (1.0 + scaled_inverse.sum(axis=1).max(initial=0.0)),
    )
