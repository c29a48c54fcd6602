"""The spectral radius of a map, also where eigenvalues coincide.

m eigenvalues that coincide are computed with an error near the m-th root of the rounding: of the
three of a triple integrator, all 1, one is found at 1 + 1e-5, which would grow tenfold in 2e5
steps. Their mean has an error near the rounding (T. Kato, Perturbation theory for linear operators,
1966, section II.2). So it stands for those that are no further apart than their own condition
explains: 1/abs(y* x) of left and right eigenvectors y and x, large only where they do coincide.
Nor are m of them further apart than some times the m-th root.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector

Complex: TypeAlias = NDArray[np.complex128]

MARGIN: Final = 100.0  # times the error that condition and rounding explain
ROOT_MARGIN: Final = 1.0  # times the root of the rounding
SWEEPS: Final = 20  # of balancing
GOOD: Final = 0.95  # of the sum of a row and its column: balancing more is not worth it


def spectral_radius(M: Matrix) -> float:
    """Return the largest absolute value of an eigenvalue; infinite where M is not finite."""
    if not np.isfinite(M).all():
        return float("inf")
    if not len(M):
        return 0.0
    balanced = _balanced(M)
    scale = float(np.linalg.norm(balanced))
    rounding = float(np.finfo(np.float64).eps)
    eigenvalues, left_vectors, vectors = _decomposed(balanced, 0.1 * rounding * scale)
    rounding *= len(M)
    conditions = np.linalg.norm(left_vectors, axis=1) * np.linalg.norm(vectors, axis=0)
    errors = rounding * scale * conditions
    left = np.ones(len(eigenvalues), np.bool_)
    largest = 0.0
    for i in np.argsort(-np.abs(eigenvalues)):
        if left[i]:
            distances = np.where(left, np.abs(eigenvalues - eigenvalues[i]), np.inf)
            near = distances <= MARGIN * np.minimum(errors[i], errors)
            near[i] = True
            members = _coinciding(distances, near, rounding, scale)
            left[members] = False
            largest = max(largest, float(abs(eigenvalues[members].mean())))
    return largest


def _decomposed(M: Matrix, change: float) -> tuple[Complex, Complex, Complex]:
    """Return eigenvalues, left eigenvectors as rows, and right ones as columns, of M changed a bit.

    Where eigenvalues coincide to the last bit there are too few eigenvectors to see that by. So M
    is changed, by more where that leaves none more.
    """
    unlike = np.random.default_rng(0).standard_normal(M.shape)
    while True:
        eigenvalues, vectors = np.linalg.eig(M + change * unlike)
        try:
            return eigenvalues, np.linalg.inv(vectors), vectors
        except np.linalg.LinAlgError:
            change *= 2.0


def _coinciding(distances: Vector, near: Mask, rounding: float, scale: float) -> NDArray[np.intp]:
    """Return the most of near eigenvalues that may coincide: m within the m-th root of rounding."""
    by_distance = np.flatnonzero(near)[np.argsort(distances[near])]
    for count in range(len(by_distance), 1, -1):
        if distances[by_distance[count - 1]] <= ROOT_MARGIN * scale * rounding ** (1.0 / count):
            return by_distance[:count]
    return by_distance[:1]


def _balanced(M: Matrix) -> Matrix:
    """Return a similar matrix whose rows are about as large as their columns.

    By powers of two, so without rounding: B. N. Parlett and C. Reinsch, Numer. Math. 13, 1969.
    """
    balanced = M.copy()
    for _ in range(SWEEPS):
        is_done = True
        for i in range(len(M)):
            diagonal = abs(balanced[i, i])
            column = float(np.abs(balanced[:, i]).sum() - diagonal)
            row = float(np.abs(balanced[i]).sum() - diagonal)
            if column == 0.0 or row == 0.0:
                continue
            factor = 2.0 ** round(0.5 * float(np.log2(row / column)))
            if column * factor + row / factor < GOOD * (column + row):
                balanced[:, i] *= factor
                balanced[i] /= factor
                is_done = False
        if is_done:
            break
    return balanced
