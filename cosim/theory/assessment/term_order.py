"""Terms that are interchangeable, and the order in which their parameters are reported."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Vector
from cosim.theory.estimators.output_error import OutputErrorProblem
from cosim.theory.interchangeable import groups_of


def ordered_like(
    theta: Vector,
    other: Vector,
    problem: OutputErrorProblem,
) -> Vector:
    """Return theta with interchangeable terms in the order of another one.

    Parameters
    ----------
    theta, other : Vector, shape (P,)
        NaN in ``other``: anything fits there.
    problem : OutputErrorProblem
    """
    places = [problem.parameters_of([i]) for i in range(len(problem.families))]
    alike = problem.interchangeable
    known = np.where(np.isfinite(other), other, np.nan)
    ordered = theta.copy()
    groups = [group for group in groups_of(alike) if len(group) > 1]
    if not groups:
        return ordered
    from scipy.optimize import linear_sum_assignment  # takes long to import

    for group in groups:
        of_terms = [places[i] for i in group]
        costs = np.zeros((len(group), len(group)))
        for row, wanted in enumerate(of_terms):
            for column, own in enumerate(of_terms):
                distances = np.abs(theta[own] - known[wanted])
                costs[row, column] = np.nansum(distances)
        for row, column in zip(*linear_sum_assignment(costs), strict=True):
            ordered[of_terms[row]] = theta[of_terms[column]]
    return ordered
