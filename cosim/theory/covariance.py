"""What a covariance is: a symmetric positive definite matrix of finite numbers."""

from __future__ import annotations

from typing import Final

import numpy as np

from cosim.arrays import Matrix

SYMMETRY: Final = 1e-9  # relative difference of entries that are one number


def is_covariance(matrix: Matrix) -> bool:
    """Return whether a square matrix is symmetric and positive definite, whatever its units."""
    if not np.isfinite(matrix).all():
        return False
    variances = np.diag(matrix)
    if not (variances > 0.0).all():
        return False
    scale = np.sqrt(variances)
    correlations = matrix / scale[:, np.newaxis] / scale
    if not (np.abs(correlations - correlations.T) <= SYMMETRY).all():
        return False
    smallest = np.linalg.eigvalsh(correlations).min()
    rounding = np.finfo(np.float64).eps * len(matrix)
    return bool(smallest > rounding)
