"""Subspaces of a linear system `x' = A x + B u, y = C x + D u`, by singular values.

The **output-nulling subspace** V is the largest one in which the state can be kept, by some u,
while y = 0::

    V_0 = R^n,    V_k+1 = {x : [A; C] x  in  [V_k; 0] + im [B; D]}

It shrinks at every step until it stays the same, so at most n steps are made. Without inputs it is
the unobservable subspace of (A, C). On V there are X and U with `[A; C] V = [V; 0] X + [B; D] U`;
the eigenvalues of X are the invariant zeros where X is unique.

A row of (C, D), a column of (B, D) or the unit of time may be scaled without changing V, so all are
normalized before any rank is decided: one relative tolerance then serves every unit.
"""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix

RANK_TOLERANCE = 1e-9  # of singular values, relative to matrices normalized to one


def rank(matrix: Matrix, rtol: float = RANK_TOLERANCE) -> int:
    """Count the singular values above ``rtol`` times the largest one; 0 for an empty matrix."""
    if not matrix.size:
        return 0
    return int(np.linalg.matrix_rank(matrix, rtol=rtol))


def without_rounding(sums: Matrix, magnitudes: Matrix, condition: float = 1.0) -> Matrix:
    """Return ``sums`` with zeros in place of entries that may be nothing but rounding error.

    Parameters
    ----------
    sums : Matrix
        Computed sums, any shape.
    magnitudes : Matrix
        For each of them the sum of the absolute values of its terms, the same shape.
    condition : float
        Condition number of the matrix that was solved with, if any.
    """
    epsilon = np.finfo(np.float64).eps
    bound = 8.0 * epsilon * condition * magnitudes
    significant = np.abs(sums) > bound
    return np.where(significant, sums, 0.0)


def null_space(matrix: Matrix, tolerance: float = RANK_TOLERANCE) -> Matrix:
    """Compute an orthonormal basis of the vectors that ``matrix`` shortens below ``tolerance``.

    The shape is ``(n, k)`` for a ``matrix`` of shape ``(m, n)``.
    """
    _, values, rows = np.linalg.svd(matrix, full_matrices=True)
    significant = values > tolerance
    numerical_rank = int(significant.sum())
    remaining = rows[numerical_rank:]
    return np.ascontiguousarray(remaining.T)


def orthogonal_complement(basis: Matrix) -> Matrix:
    """Compute an orthonormal basis, shape ``(n, n - k)``, of the complement of a subspace.

    The subspace is given by its orthonormal ``basis``, shape ``(n, k)``.
    """
    n, k = basis.shape
    if k == 0:
        return np.eye(n)
    return null_space(basis.T)


def output_nulling(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> Matrix:
    """Compute an orthonormal basis of the output-nulling subspace of (A, B, C, D).

    Parameters
    ----------
    A, B, C, D : Matrix
        Shapes ``(n, n)``, ``(n, m)``, ``(p, n)``, ``(p, m)``; with ``m = 0`` the result is the
        unobservable subspace of (A, C).

    Returns
    -------
    Matrix
        Shape ``(n, k)``.
    """
    n = A.shape[0]
    p = C.shape[0]
    rate = np.linalg.norm(A) or 1.0
    outputs = normalized(np.hstack([C, D]), axis=1)
    C_scaled = outputs[:, :n]
    D_scaled = outputs[:, n:]
    from_states = np.vstack([A / rate, C_scaled])
    from_inputs = np.vstack([B / rate, D_scaled])
    from_inputs = normalized(from_inputs, axis=0)
    V = np.eye(n)
    while True:
        k = V.shape[1]
        no_output = np.zeros((p, k))
        inside = np.vstack([V, no_output])
        reachable = np.hstack([inside, from_inputs])
        basis, values, _ = np.linalg.svd(reachable, full_matrices=True)
        significant = values > RANK_TOLERANCE
        dimension = int(significant.sum())
        outside = basis[:, dimension:]
        smaller = null_space(outside.T @ from_states)
        if smaller.shape[1] == k:
            return smaller
        V = smaller


def normalized(matrix: Matrix, axis: int) -> Matrix:
    """Scale rows (axis 1) or columns (axis 0) to length one; those of zeros stay zero."""
    lengths = np.linalg.norm(matrix, axis=axis, keepdims=True)
    divisors = np.where(lengths > 0.0, lengths, 1.0)
    return matrix / divisors
