"""Subspaces of a linear system `x' = A x + B u, y = C x + D u`, by singular values.

The **output-nulling subspace** V is the largest one in which the state can be kept, by some u, while y = 0::

    V_0 = R^n,    V_k+1 = {x : [A; C] x  in  [V_k; 0] + im [B; D]}

It shrinks at every step or has arrived, so at most n steps are made. Without inputs it is the unobservable subspace of (A, C).
On V there are X and U with `[A; C] V = [V; 0] X + [B; D] U`; the eigenvalues of X are the invariant zeros where X is unique.
A row of (C, D), a column of (B, D) or the unit of time may be scaled without changing V, so all are normalized before any rank is
decided: one relative tolerance then serves every unit.
"""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix

RANK_TOLERANCE = 1e-9  # of singular values, relative to matrices normalized to one


def rank(matrix: Matrix, rtol: float = RANK_TOLERANCE) -> int:
    """Count the singular values above ``rtol`` times the largest one; 0 for an empty matrix."""
    return int(np.linalg.matrix_rank(matrix, rtol=rtol)) if matrix.size else 0


def without_rounding(sums: Matrix, magnitudes: Matrix, condition: float = 1.0) -> Matrix:
    """Set to zero what is smaller than the rounding error of a sum whose terms have these magnitudes in all."""
    return np.where(
        np.abs(sums) > 8.0 * np.finfo(np.float64).eps * condition * magnitudes, sums, 0.0
    )


def null_space(matrix: Matrix, tolerance: float = RANK_TOLERANCE) -> Matrix:
    """Give an orthonormal basis ``(n, k)`` of the vectors that ``matrix`` ``(m, n)`` shortens below ``tolerance``."""
    values, rows = np.linalg.svd(matrix, full_matrices=True)[1:]
    return np.ascontiguousarray(rows[int((values > tolerance).sum()) :].T)


def orthogonal_complement(basis: Matrix) -> Matrix:
    """Give an orthonormal basis of everything orthogonal to the orthonormal columns of ``basis`` ``(n, k)``: ``(n, n - k)``."""
    return null_space(basis.T) if basis.shape[1] else np.eye(basis.shape[0])


def output_nulling(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> Matrix:
    """Give an orthonormal basis of the output-nulling subspace of (A, B, C, D).

    Parameters
    ----------
    A, B, C, D : Matrix
        Shapes ``(n, n)``, ``(n, m)``, ``(p, n)``, ``(p, m)``; ``m = 0`` gives the unobservable subspace of (A, C).

    Returns
    -------
    Matrix
        Shape ``(n, k)``.
    """
    n, p = A.shape[0], C.shape[0]
    rate = np.linalg.norm(A) or 1.0
    bottom = _unit(np.hstack([C, D]), axis=1)
    states = np.vstack([A / rate, bottom[:, :n]])
    inputs = _unit(np.vstack([B / rate, bottom[:, n:]]), axis=0)
    V = np.eye(n)
    while True:
        reachable = np.hstack([np.vstack([V, np.zeros((p, V.shape[1]))]), inputs])
        basis, values = np.linalg.svd(reachable, full_matrices=True)[:2]
        outside = basis[:, int((values > RANK_TOLERANCE).sum()) :]
        smaller = null_space(outside.T @ states)
        if smaller.shape[1] == V.shape[1]:
            return smaller
        V = smaller


def _unit(matrix: Matrix, axis: int) -> Matrix:
    lengths = np.linalg.norm(matrix, axis=axis, keepdims=True)
    return matrix / np.where(lengths > 0.0, lengths, 1.0)
