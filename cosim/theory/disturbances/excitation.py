"""Excitation of the regression: the information matrix of (34), described.

The q directions are those of the **regression coefficients** eta (26). The regressor m is
*persistently exciting* where the information, the integral of m m', has full rank q. The parameters
theta are fewer than eta and follow from it by (35): full rank is sufficient for theta, but no
statement about its error.
"""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix, Vector

# prior over information from which on the prior decides a direction as much as the data do
COMPARABLE = 0.1


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
    first = m[0]
    last = m[-1]
    ends = np.outer(first, first) + np.outer(last, last)
    total = m.T @ m - ends / 2.0
    matrix: Matrix = dt * total
    return matrix


def describe_excitation(eigenvalues: Vector, prior: float | None) -> str:
    """Describe in one sentence, with numbers, what the data determine of eta (26).

    Parameters
    ----------
    eigenvalues : Vector
        Eigenvalues of the information matrix in any order, shape ``(q,)``.
    prior : float or None
        `1/P0` of (34); None or 0 for no prior.
    """
    q = len(eigenvalues)
    values = np.asarray(eigenvalues)
    smallest = float(values.min())
    largest = float(values.max())
    epsilon = np.finfo(np.float64).eps
    rounding = q * epsilon * max(largest, 0.0)
    if smallest <= rounding:
        above_rounding = values > rounding
        rank = int(above_rounding.sum())
        decided_by_prior = "; the prior alone decides it" if prior else ""
        return (
            f"the regressor is not persistently exciting (rank {rank} of {q}): the smallest "
            f"information eigenvalue {smallest:.3g} is zero to rounding beside the largest "
            f"{largest:.3g}; some combination of the regression coefficients leaves no trace in "
            f"the data{decided_by_prior}"
        )
    exciting = f"the regressor is persistently exciting (rank {q} of {q})"
    condition = f"condition {largest / smallest:.3g}"
    if not prior:
        return f"{exciting}, smallest information eigenvalue {smallest:.3g}, {condition}"
    ratio = prior / smallest
    compared = (
        f"the prior 1/P0 = {prior:.3g} is {ratio:.2g} of the smallest information eigenvalue "
        f"{smallest:.3g}"
    )
    if ratio < COMPARABLE:
        return f"{compared}: {exciting}, {condition}"
    weight = ratio / (1.0 + ratio)
    affected = prior >= COMPARABLE * values
    n_affected = int(affected.sum())
    return (
        f"{compared}: the estimate in that direction is the prior's, not the data's (weight of the "
        f"prior {weight:.2g}); {n_affected} of {q} directions are affected, {condition}; raise P0 "
        "or leave it out"
    )
