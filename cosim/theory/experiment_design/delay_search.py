"""The delays of the least predicted error, among all of whole samples up to a longest one.

One delay is 0: the rows of a set that is shifted are those of the set that is not, less the last
ones. A grid over the others, coarse enough for few sets, is followed by steps along single delays,
half as long whenever none is an improvement, down to a thousandth of the longest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

from cosim.errors import AssumptionError

_GRID_SETS: Final = 45  # at most, of the coarse grid
_STARTS: Final = 2  # sets of the grid that are improved
_RESOLUTION: Final = 1e-3  # of the longest delay
_WORTHWHILE: Final = 1e-3  # relative to the error: a gain that is none


@dataclass(frozen=True)
class FoundDelays:
    """The best delays that were found.

    Parameters
    ----------
    steps : tuple of int
        In samples, ascending.
    error : float
        What was to be smallest.
    tried : int
        Sets of delays that were compared.
    """

    steps: tuple[int, ...]
    error: float
    tried: int


def search_delays(
    error: Callable[[tuple[int, ...]], float],
    *,
    count: int,
    longest: int,
    starts: Sequence[tuple[int, ...]] = (),
) -> FoundDelays:
    """Search the delays of the least error.

    Parameters
    ----------
    error : callable
        Of a set of delays in samples, ascending; infinite where there is no estimate.
    count : int
        How many delays, at least 2.
    longest : int
        Samples.
    starts : sequence of tuple of int
        Delays that are tried too.

    Raises
    ------
    AssumptionError
        If there are not so many delays, or none of them gives an estimate.
    """
    if count < 2 or longest < count - 1:
        raise AssumptionError(
            f"expected at least 2 distinct delays of whole samples, and room for them from 0 to "
            f"{longest}, got {count}"
        )
    known: dict[tuple[int, ...], float] = {}

    def of(steps: tuple[int, ...]) -> float:
        if steps not in known:
            known[steps] = error(steps)
        return known[steps]

    spacing = _grid_spacing(count, longest)
    places = range(spacing, longest + 1, spacing)
    candidates = [(0, *others) for others in combinations(places, count - 1)]
    for start in starts:
        first = min(start)
        shifted = tuple(sorted(steps - first for steps in start))
        if max(shifted) <= longest:
            candidates.append(shifted)
    candidates.sort(key=of)
    coarse = max(1, spacing // 4)
    improved = [
        _improved(of, steps, spacing // 2, coarse, longest) for steps in candidates[:_STARTS]
    ]
    finest = max(1, math.floor(_RESOLUTION * longest))
    best = _improved(of, min(improved, key=of), coarse, finest, longest)
    if not math.isfinite(of(best)):
        raise AssumptionError(
            f"none of {len(known)} sets of {count} delays up to {longest} samples gives an estimate"
        )
    return FoundDelays(best, of(best), len(known))


def _improved(
    of: Callable[[tuple[int, ...]], float],
    best: tuple[int, ...],
    stride: int,
    finest: int,
    longest: int,
) -> tuple[int, ...]:
    """Move single delays as long as that is an improvement, by strides down to the finest."""
    while stride >= finest and math.isfinite(of(best)):
        nearby = min(_neighbors(best, stride, longest), key=of, default=best)
        if of(nearby) < (1.0 - _WORTHWHILE) * of(best):
            best = nearby
        else:
            stride //= 2
    return best


def _grid_spacing(count: int, longest: int) -> int:
    """Return the finest spacing of a grid of at most so many sets."""
    points = count - 1
    while points < longest and math.comb(points + 1, count - 1) <= _GRID_SETS:
        points += 1
    return longest // points


def _neighbors(steps: tuple[int, ...], stride: int, longest: int) -> list[tuple[int, ...]]:
    """Return the sets in which one delay other than the first is moved by ``stride``."""
    neighbors = []
    for place in range(1, len(steps)):
        for moved in (steps[place] - stride, steps[place] + stride):
            others = set(steps[:place] + steps[place + 1 :])
            if 0 < moved <= longest and moved not in others:
                neighbors.append(tuple(sorted(others | {moved})))
    return neighbors
