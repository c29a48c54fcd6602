"""Rayleigh nonlinear least squares: theta from the regression (25), its noise compensated.

The rows ``mu`` hold delayed samples of delta, so noise of variance ``sigma^2`` in delta makes
``S = sum mu mu'`` grow by ``sigma^2 N``, with N the sum of products of the known alphas: terms that
share a delayed sample share its noise. The chi of the true theta minimizes the quotient

    chi(theta)' S chi(theta) / chi(theta)' N chi(theta),

whose minimum estimates sigma^2. Neither a prior nor a normalizer is needed, and theta is estimated,
not eta. Its basin is large, which makes it the start of the estimators that are efficient.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from cosim.native.estimation.rayleigh import RayleighConstants
from cosim.theory.disturbances.families import (
    AlphaGroup,
    Family,
    SearchBox,
    generators,
    search_box,
)
from cosim.theory.disturbances.regression import Term
from cosim.theory.estimators.start_grid import grid_points


def rayleigh_constants(
    families: Sequence[Family],
    groups: Sequence[AlphaGroup],
    terms: Sequence[Term],
    delays: Sequence[float],
) -> RayleighConstants:
    """Return the numbers of the kernel.

    Parameters
    ----------
    families : sequence of Family
        The components of the disturbance, in their order.
    groups : sequence of AlphaGroup
        Them by alpha.
    terms : sequence of Term
        ``expand`` of the sizes of the groups.
    delays : sequence of float
        D_j [s].

    Raises
    ------
    AssumptionError
        If there are more terms, delays or parameters than the kernel holds.
    """
    matrices = generators(families)
    box = rayleigh_box(families, delays)
    group_of = [0] * len(families)
    for b, group in enumerate(groups):
        for component in group.components:
            group_of[component] = b
    parts = []
    for term in terms:
        rows = chain.from_iterable(term.parts)
        parts.append(list(rows))
    return RayleighConstants(
        generators=matrices,
        group=tuple(group_of),
        delays=tuple(delays),
        parts=np.array(parts, np.int32),
        lower=box.lower,
        upper=box.upper,
        points=grid_points(matrices.parameters),
    )


def rayleigh_box(families: Sequence[Family], delays: Sequence[float]) -> SearchBox:
    """Return where theta is searched: what the delays can tell apart, and all that is slower.

    It does not depend on how long the record is, or will be.
    """
    shortest = shortest_delay(delays)
    over_delays = search_box(families, span=max(delays) - min(delays), shortest=shortest)
    slow = search_box(families, span=math.inf, shortest=shortest)
    return replace(
        slow,
        lower=np.minimum(over_delays.lower, slow.lower),
        upper=np.maximum(over_delays.upper, slow.upper),
    )


def shortest_delay(delays: Sequence[float]) -> float:
    """Return the smallest difference of two delays [s]."""
    gaps = np.diff(np.sort(np.asarray(delays, np.float64)))
    return float(gaps.min())
