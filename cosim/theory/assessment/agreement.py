"""Whether several data sets are of one theta, where they are not explained together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.theory.assessment.assessing import assess
from cosim.theory.assessment.verdicts import Assessment


def each_alone(assessment: Assessment) -> tuple[Assessment, ...]:
    """Assess each of several data sets alone; none where they are consistent together.

    Raises
    ------
    AssumptionError
        As from :func:`cosim.theory.assessment.assessing.assess`.
    """
    problem = assessment.problem
    if len(problem.data) == 1 or (assessment.fit.converged and assessment.consistency.passed):
        return ()
    theta = assessment.fit.theta
    return tuple(assess(problem.of_data([data]), theta) for data in problem.data)


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
    parameters = range(len(alone[0].parameters))
    return texts + list(filter(None, (_disagreement(j, alone, names) for j in parameters)))


def _disagreement(j: int, alone: Sequence[Assessment], names: Sequence[str]) -> str:
    """Return which two data sets have another theta[j] beyond their errors; empty: none have."""
    values = np.array([own.fit.theta[j] for own in alone])
    widths = np.array([own.half_width[j] for own in alone])
    known = [own.parameters[j].verdict.has_interval for own in alone]
    places = np.flatnonzero(np.array(known) & np.isfinite(widths))
    if len(places) < 2:
        return ""
    low = places[int(values[places].argmin())]
    high = places[int(values[places].argmax())]
    if not values[high] - values[low] > np.hypot(widths[high], widths[low]):
        return ""
    return (
        f"theta[{j}] of {names[low]} alone is {values[low]:.6g} +- {widths[low]:.2g}, of "
        f"{names[high]} alone {values[high]:.6g} +- {widths[high]:.2g}: not of one theta"
    )
