"""Terms that are interchangeable, and the order in which their parameters are told."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.arrays import Vector
from cosim.theory.assessment.problem import OutputErrorProblem


def ordered_like(
    theta: Vector,
    other: Vector,
    problem: OutputErrorProblem,
) -> Vector:
    """Return theta with interchangeable terms in the order of another one.

    Terms are interchangeable that are of one family, enter the plant in the same way, and have the
    same alphas and bounds: every order of them is the same model.

    Parameters
    ----------
    theta, other : Vector, shape (P,)
        NaN in ``other``: anything fits there.
    problem : OutputErrorProblem
    """
    places = [problem.parameters_of([i]) for i in range(len(problem.families))]
    known = np.where(np.isfinite(other), other, np.nan)
    ordered = theta.copy()
    groups = [group for group in _groups(problem, places) if len(group) > 1]
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


def _groups(problem: OutputErrorProblem, places: Sequence[Sequence[int]]) -> list[list[int]]:
    """Return the terms that are interchangeable with one another.

    Parameters
    ----------
    problem : OutputErrorProblem
    places : sequence of sequence of int
        Where the parameters of each term are in theta.
    """
    families = problem.families
    plant = problem.plant

    def alike(i: int, k: int) -> bool:
        of_i = [problem.bounds.get(j) for j in places[i]]
        of_k = [problem.bounds.get(j) for j in places[k]]
        return (
            families[i] == families[k]
            and of_i == of_k
            and np.array_equal(plant.Bd[:, i], plant.Bd[:, k])
            and np.array_equal(plant.Dd[:, i], plant.Dd[:, k])
            and all(np.array_equal(data.alpha[:, i], data.alpha[:, k]) for data in problem.data)
        )

    groups: list[list[int]] = []
    for i in range(len(families)):
        for group in groups:
            if alike(group[0], i):
                group.append(i)
                break
        else:
            groups.append([i])
    return groups
