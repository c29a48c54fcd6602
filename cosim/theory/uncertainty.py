"""What the data can identify: the information of (34) and a verdict on it."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix, Vector

COMPARABLE = (
    0.1  # prior over information above which the prior decides a direction as much as the data do
)


def information(m: Matrix, dt: float) -> Matrix:
    """Integrate `m m'` (34) over time by the trapezoid rule.

    Parameters
    ----------
    m : Matrix
        Regressor (26) at equally spaced times, shape ``(N, q)``, N at least 2.
    dt : float
        Spacing [s].

    Returns
    -------
    Matrix
        Shape ``(q, q)``.
    """
    matrix: Matrix = dt * (m.T @ m - (np.outer(m[0], m[0]) + np.outer(m[-1], m[-1])) / 2.0)
    return matrix


def verdict(eigenvalues: Vector, prior: float | None) -> str:
    """Say what the data can identify, with numbers.

    Parameters
    ----------
    eigenvalues : Vector
        Eigenvalues of the information matrix in any order.
    prior : float or None
        `1/P0` of (34); None or 0 for no prior.
    """
    smallest, largest = float(np.min(eigenvalues)), float(np.max(eigenvalues))
    if smallest <= len(eigenvalues) * np.finfo(np.float64).eps * max(largest, 0.0):
        return (
            f"not identifiable: the smallest information eigenvalue {smallest:.3g} is zero to rounding beside the largest "
            f"{largest:.3g}; some combination of the unknowns leaves no trace in the data"
            + ("; the prior alone decides it" if prior else "")
        )
    condition = f"condition {largest / smallest:.3g}"
    if not prior:
        return f"the data decide all {len(eigenvalues)} directions, smallest information eigenvalue {smallest:.3g}, {condition}"
    ratio = prior / smallest
    compared = f"the prior 1/P0 = {prior:.3g} is {ratio:.2g} of the smallest information eigenvalue {smallest:.3g}"
    if ratio < COMPARABLE:
        return f"{compared}: the data decide all {len(eigenvalues)} directions, {condition}"
    directions = int((prior >= COMPARABLE * np.asarray(eigenvalues)).sum())
    return (
        f"{compared}: the estimate in that direction is the prior's, not the data's (weight of the prior "
        f"{ratio / (1.0 + ratio):.2g}); {directions} of {len(eigenvalues)} directions are affected, {condition}; raise P0 or "
        "leave it out"
    )
