"""The noise of y as a scenario states it: a deviation, one an output, or a covariance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError
from cosim.theory.covariance import is_covariance


def stated_covariance(
    deviation: float | Sequence[float] | None,
    covariance: Sequence[Sequence[float]] | None,
    outputs: int,
) -> Matrix | None:
    """Return the covariance of the noise of y, shape (n_y, n_y); None: nothing is stated.

    Raises
    ------
    UsageError
        If both are given, or they are no deviations or covariance of so many outputs.
    """
    if deviation is not None and covariance is not None:
        raise UsageError("expected at most one of deviation and covariance, got both")
    if deviation is not None:
        return np.diag(_deviations(deviation, outputs) ** 2)
    return None if covariance is None else _checked(covariance, outputs)


def _checked(covariance: Sequence[Sequence[float]], outputs: int) -> Matrix:
    """Return a covariance, after a check of its shape, symmetry and sign."""
    if any(len(row) != outputs for row in covariance) or len(covariance) != outputs:
        raise UsageError(
            f"covariance: expected {outputs} rows of {outputs} numbers, got "
            f"{[list(row) for row in covariance]}"
        )
    matrix = np.array(covariance, np.float64)
    if not is_covariance(matrix):
        raise UsageError(
            f"covariance: expected a symmetric positive definite matrix, got {matrix.tolist()}"
        )
    return matrix


def _deviations(deviation: float | Sequence[float], outputs: int) -> Vector:
    deviations = np.array(deviation, np.float64)
    if deviations.ndim and deviations.shape != (outputs,):
        raise UsageError(
            f"deviation: expected one number, or one per output ({outputs}), got {deviations.size}"
        )
    if not ((deviations > 0.0) & (deviations < np.inf)).all():
        raise UsageError(f"deviation: expected positive finite numbers, got {deviation}")
    return np.broadcast_to(deviations, outputs)
