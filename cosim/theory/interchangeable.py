"""Terms that are interchangeable, and one order of them.

Terms are interchangeable that are of one family, enter the plant in the same way, and have the same
alpha and bounds: every order of them is the same model. So are the signs of parameters whose
negatives make the same signals, such as rates. Of all these theta one is reported: signs positive,
and interchangeable terms by their last parameter, the largest first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cosim.arrays import Vector
from cosim.native.estimation.output_error import Generators
from cosim.theory.disturbed_plant import DisturbedPlant


def interchangeable(
    generators: Generators,
    plant: DisturbedPlant,
    same_alpha: Callable[[int, int], bool],
    bounds: Mapping[int, tuple[float, float]],
) -> tuple[int, ...]:
    """Return for every term the last one before it that is interchangeable with it, or -1.

    Parameters
    ----------
    generators : Generators
        Of the terms.
    plant : DisturbedPlant
    same_alpha : callable
        Whether two terms have the same alpha.
    bounds : mapping of index to (lower, upper)
        Of theta.
    """
    each = generators.each

    def alike(i: int, k: int) -> bool:
        term = each[i]
        other = each[k]
        pairs = (
            (term.c, other.c),
            (term.G0, other.G0),
            (term.G1, other.G1),
            (plant.Bd[:, i], plant.Bd[:, k]),
            (plant.Dd[:, i], plant.Dd[:, k]),
        )
        if not all(np.array_equal(a, b) for a, b in pairs):
            return False
        places = zip(_places(term.theta), _places(other.theta), strict=True)
        return all(bounds.get(a) == bounds.get(b) for a, b in places) and same_alpha(i, k)

    before = []
    for i in range(len(each)):
        earlier = [k for k in range(i) if alike(i, k)]
        before.append(earlier[-1] if earlier else -1)
    return tuple(before)


def groups_of(alike: Sequence[int]) -> list[list[int]]:
    """Return the terms that are interchangeable with one another."""
    groups: dict[int, list[int]] = {}
    first = list(range(len(alike)))
    for i, before in enumerate(alike):
        if before >= 0:
            first[i] = first[before]
        groups.setdefault(first[i], []).append(i)
    return list(groups.values())


def in_order(
    theta: Vector, generators: Generators, alike: Sequence[int], even: Sequence[bool]
) -> Vector:
    """Return the theta that is reported of all those of the same model, shape ``(P,)``.

    Parameters
    ----------
    theta : Vector, shape (P,)
    generators : Generators
    alike : sequence of int
        As of :func:`interchangeable`.
    even : sequence of bool
        For each parameter, whether its negative makes the same signals.
    """
    ordered = np.where(np.array(even, np.bool_), np.abs(theta), theta)
    each = generators.each
    for group in groups_of(alike):
        own = [ordered[each[i].theta].copy() for i in group if generators.count[i]]
        own.sort(key=lambda values: float(values[-1]), reverse=True)
        for i, values in zip(group, own, strict=False):
            ordered[each[i].theta] = values
    return ordered


def _places(part: slice) -> range:
    return range(part.start, part.stop)
