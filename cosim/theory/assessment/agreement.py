"""Whether several data sets are of one theta, where they are not explained together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.arrays import Matrix
from cosim.theory.assessment.assessing import assess_from
from cosim.theory.assessment.verdicts import Assessment
from cosim.theory.disturbance import Family
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import NO_BOUNDS


def each_alone(
    assessment: Assessment,
    data: Sequence[DataSet],
    plant: DisturbedPlant,
    families: Sequence[Family],
    *,
    stated: Matrix | None = None,
    offset: bool = False,
    bounds: Mapping[int, tuple[float, float]] = NO_BOUNDS,
) -> tuple[Assessment, ...]:
    """Assess each of several data sets alone; none where they are consistent together.

    Parameters
    ----------
    assessment : Assessment
        Of all of them.
    data, plant, families, stated, offset, bounds
        As for :func:`cosim.theory.assessment.assessing.assess`.

    Raises
    ------
    AssumptionError
        As from there.
    """
    if len(data) == 1 or (assessment.fit.converged and assessment.consistency.passed):
        return ()
    theta = assessment.fit.theta
    alone = []
    for one in data:
        found = assess_from(
            [one], plant, families, theta, stated=stated, offset=offset, bounds=bounds
        )
        alone.append(found)
    return tuple(alone)


def contradictions(alone: Sequence[Assessment], names: Sequence[str]) -> list[str]:
    """Return which data sets fail alone, and which have another theta than others.

    Parameters
    ----------
    alone : sequence of Assessment
        Of each; none: there is nothing to say.
    names : sequence of str
        Of each.
    """
    if not alone:
        return []
    texts = []
    for name, own in zip(names, alone, strict=True):
        if not (own.fit.converged and own.consistency.passed):
            texts.append(f"{name} alone: {own.parameters[0].reason}")
    for j in range(len(alone[0].parameters)):
        values = np.array([own.fit.theta[j] for own in alone])
        widths = np.array([own.half_width[j] for own in alone])
        known = [own.parameters[j].verdict.has_interval for own in alone]
        places = np.flatnonzero(np.array(known) & np.isfinite(widths))
        if len(places) < 2:
            continue
        low = places[int(values[places].argmin())]
        high = places[int(values[places].argmax())]
        if values[high] - values[low] > np.hypot(widths[high], widths[low]):
            texts.append(
                f"theta[{j}] of {names[low]} alone is {values[low]:.6g} +- {widths[low]:.2g}, of "
                f"{names[high]} alone {values[high]:.6g} +- {widths[high]:.2g}: not of one theta"
            )
    return texts
