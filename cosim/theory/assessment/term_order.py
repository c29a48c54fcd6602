"""Terms that are interchangeable, and the order in which their parameters are told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.arrays import Vector
from cosim.theory.disturbance import Family
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant


def ordered_like(
    theta: Vector,
    other: Vector,
    data: Sequence[DataSet],
    plant: DisturbedPlant,
    families: Sequence[Family],
    bounds: Mapping[int, tuple[float, float]],
) -> Vector:
    """Return theta with interchangeable terms in the order of another one.

    Terms are interchangeable that are of one family, enter the plant in the same way, and have the
    same alphas and bounds: every order of them is the same model.

    Parameters
    ----------
    theta, other : Vector, shape (P,)
        NaN in ``other``: anything fits there.
    data : sequence of DataSet
    plant : DisturbedPlant
    families : sequence of Family
    bounds : mapping of index to (lower, upper)
    """
    from scipy.optimize import linear_sum_assignment  # takes long to import

    places = _parameter_places(families)
    known = np.where(np.isfinite(other), other, np.nan)
    ordered = theta.copy()
    for group in _groups(data, plant, families, bounds):
        of_terms = [places[i] for i in group]
        costs = np.zeros((len(group), len(group)))
        for row, wanted in enumerate(of_terms):
            for column, own in enumerate(of_terms):
                distances = np.abs(theta[own] - known[wanted])
                costs[row, column] = np.nansum(distances)
        for row, column in zip(*linear_sum_assignment(costs), strict=True):
            ordered[of_terms[row]] = theta[of_terms[column]]
    return ordered


def _parameter_places(families: Sequence[Family]) -> list[slice]:
    """Return where the parameters of each term are in theta."""
    places = []
    first = 0
    for family in families:
        count = len(family.parameters)
        places.append(slice(first, first + count))
        first += count
    return places


def _groups(
    data: Sequence[DataSet],
    plant: DisturbedPlant,
    families: Sequence[Family],
    bounds: Mapping[int, tuple[float, float]],
) -> list[list[int]]:
    """Return the terms that are interchangeable with one another."""
    places = _parameter_places(families)

    def alike(i: int, k: int) -> bool:
        of_i = [bounds.get(j) for j in range(places[i].start, places[i].stop)]
        of_k = [bounds.get(j) for j in range(places[k].start, places[k].stop)]
        return (
            families[i] == families[k]
            and of_i == of_k
            and np.array_equal(plant.Bd[:, i], plant.Bd[:, k])
            and np.array_equal(plant.Dd[:, i], plant.Dd[:, k])
            and all(np.array_equal(one.alpha[:, i], one.alpha[:, k]) for one in data)
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
