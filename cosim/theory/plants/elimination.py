"""Elimination of the algebraic states of a partitioned system (8), with a bound of its rounding.

Data are known up to an error that is relative to the sizes of row and column
(:class:`cosim.theory.plants.scaling.Scales`). To the first order x_b = K (x_a, u, delta) errs by::

    dK <= |A22^-1| (d[A21 B2] + dA22 |K|)

and the feedthrough D + C2 K by ``dD + dC2 |K| + |C2| dK``. Of these, what may be nothing but its
error is zero. Other coefficients are zero only where the sum that they are may be rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.theory.plants.geometry import without_rounding
from cosim.theory.plants.pencil import EPSILON
from cosim.theory.plants.scaling import Scales

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


@dataclass(frozen=True, eq=False)
class _AlgebraicGain:
    """K of ``x_b = K (x_a, u, delta)``, the size of its terms, and bounds of errors.

    ``equations`` are the sizes of the algebraic equations, ``columns`` those of the columns of K in
    a row of data whose size is one; ``inverse`` is A22^-1. ``error`` bounds that of K;
    ``per_column`` is the error that every column has in such a row: its own, and by way of x_b.
    """

    K: Matrix
    magnitudes: Matrix
    inverse: Matrix
    error: Matrix
    equations: Vector
    columns: Vector
    per_column: Vector
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
    A12 = matrices.A[:n_a, n_a:]
    C2 = matrices.C[:, n_a:]
    B_u, B_delta = matrices.B
    D_u, D_delta = matrices.D
    gain = _algebraic_gain(matrices, scales, growth)
    own_error = np.outer(scales.outputs, gain.per_column)
    output_error = own_error + np.abs(C2) @ gain.error

    def substituted(direct: Matrix, left: Matrix, columns: slice) -> Matrix:
        """Return ``direct + left K``, a coefficient after x_b was replaced by (8)."""
        total = direct + left @ gain.K[:, columns]
        of_terms = np.abs(left) @ gain.magnitudes[:, columns]
        return without_rounding(total, np.abs(direct) + of_terms)

    def feedthrough(direct: Matrix, columns: slice) -> Matrix:
        total = direct + C2 @ gain.K[:, columns]
        significant = np.abs(total) > output_error[:, columns]
        return np.where(significant, total, 0.0)

    end_of_u = n_a + B_u.shape[1]
    state = slice(0, n_a)
    u = slice(n_a, end_of_u)
    delta = slice(end_of_u, None)
    of_u = substituted(B_u[:n_a], A12, u)
    of_delta = substituted(B_delta[:n_a], A12, delta)
    A = substituted(matrices.A[:n_a, :n_a], A12, state)
    C = substituted(matrices.C[:, :n_a], C2, state)
    D = (feedthrough(D_u, u), feedthrough(D_delta, delta))
    of_rates = _amplification(
        np.hstack([A, of_u, of_delta]), A12 @ gain.inverse, gain, scales.equations[:n_a]
    )
    of_outputs = _amplification(np.hstack([C, *D]), C2 @ gain.inverse, gain, scales.outputs)
    return Eliminated(
        A=A,
        B=(of_u, of_delta),
        C=C,
        D=D,
        K=gain.K[:, state],
        Kv=(gain.K[:, u], gain.K[:, delta]),
        Kv_error=(gain.error[:, u], gain.error[:, delta]),
        amplification=max(gain.amplification, of_rates, of_outputs),
    )


def _amplification(left: Matrix, of_equations: Matrix, gain: _AlgebraicGain, rows: Vector) -> float:
    """Return how many times errors of the data grow in what is left of rows of such sizes.

    They are relative to what is left where that is larger than the data: where large terms cancel,
    it is no larger, but its errors are.
    """
    own_and_algebraic = rows + np.abs(of_equations) @ gain.equations
    by_row = own_and_algebraic / rows
    by_column = gain.per_column / gain.columns
    errors = np.outer(by_row, by_column)
    sizes = np.outer(rows, gain.columns)
    relative = np.abs(left) / sizes
    largest_error = float(errors.max(initial=0.0))
    largest = float(relative.max(initial=1.0))
    return largest_error / (DATA * largest)


def _algebraic_gain(matrices: PartitionedMatrices, scales: Scales, growth: float) -> _AlgebraicGain:
    """Solve ``A22 K = -[A21 B2]`` (8); what may be nothing but error is zero."""
    n_a = matrices.n_a
    A22 = matrices.A[n_a:, n_a:]
    B_u, B_delta = matrices.B
    right = np.hstack([matrices.A[n_a:, :n_a], B_u[n_a:], B_delta[n_a:]])
    solution = np.linalg.solve(A22, right)
    K: Matrix = (0.0 - solution).astype(np.float64)  # not -solution: no negative zeros
    inverse: Matrix = np.linalg.inv(A22).astype(np.float64)
    inverse_sizes = np.abs(inverse)
    terms = np.abs(A22) @ np.abs(K) + np.abs(right)
    own = np.concatenate([1.0 / scales.states[:n_a], 1.0 / scales.inputs])
    by_x_b = (1.0 / scales.states[n_a:]) @ np.abs(K)
    per_column = DATA * growth * (own + by_x_b)
    equations = scales.equations[n_a:]
    error = np.outer(inverse_sizes @ equations, per_column)
    significant = np.abs(K) > error
    scaled_inverse = inverse_sizes * equations / scales.states[n_a:, np.newaxis]
    largest = float(scaled_inverse.sum(axis=1).max(initial=0.0))
    return _AlgebraicGain(
        K=np.where(significant, K, 0.0),
        magnitudes=inverse_sizes @ terms,
        inverse=inverse,
        error=error,
        equations=equations,
        columns=own,
        per_column=per_column,
        amplification=growth * (1.0 + largest),
    )
