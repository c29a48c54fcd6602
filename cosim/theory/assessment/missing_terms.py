"""Why a term of the disturbance does not show in a fit, where noise is not the cause.

**Silent** terms have no response at all: their alpha is zero at every sample, or the plant does not
pass them on to the output. **Hidden** terms show as soon as others are left out, and the data are
explained without these as well: two terms of one alpha and family, of which one is there, share its
amplitude in every way, so that neither is larger than its error.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.arrays import Mask
from cosim.theory.assessment.fitted_model import FittedModel
from cosim.theory.estimators.output_error import (
    FALSE_PRESENCE,
    OutputErrorFit,
    presence_threshold,
)
from cosim.theory.estimators.start_grid import search_start
from cosim.theory.quantiles import chi_square_above


def silent_terms(fitted: FittedModel) -> dict[int, str]:
    """Return the terms without any effect on the output, and why they have none."""
    reasons = {}
    fit = fitted.fit
    first = 0
    for i, family in enumerate(fitted.problem.families):
        columns = slice(first, first + family.v)
        first += family.v
        if not any(data.alpha[:, i].any() for data in fitted.problem.data):
            reasons[i] = f"alpha of terms[{i}] is 0 at every sample"
        elif not any(R[:, columns].any() for R in fit.triangles):
            reasons[i] = f"terms[{i}] does not reach y"
    return reasons


def hidden_terms(fitted: FittedModel, absent: Mask) -> dict[int, tuple[int, ...]]:
    """Return the absent terms that are there without others, and these.

    Parameters
    ----------
    fitted : FittedModel
        With all terms.
    absent : Mask, shape (components,)
        Which of them are not larger than noise makes them.

    Raises
    ------
    AssumptionError
        As from :func:`cosim.theory.estimators.output_error.fit_output_error`.
    """
    hidden = {}
    every = range(len(absent))
    for i in np.flatnonzero(absent).tolist():
        kept = list(every)
        smaller = fitted.fit
        for k in every:
            if k == i:
                continue
            trial = _explained_by([term for term in kept if term != k], fitted, smaller)
            if trial is not None:
                kept.remove(k)
                smaller = trial
        left_out = tuple(k for k in every if k not in kept)
        if left_out and _is_present(smaller, kept, i, fitted):
            hidden[i] = left_out
    return hidden


def _explained_by(
    kept: Sequence[int], whole: FittedModel, larger: OutputErrorFit
) -> OutputErrorFit | None:
    """Fit some terms; return None where they explain less than the larger fit does.

    Parameters
    ----------
    kept : sequence of int
    whole : FittedModel
        Of all terms: the start, and the variance of the noise.
    larger : OutputErrorFit
        Of one term more.
    """
    problem = whole.problem
    matrices = problem.generators
    unknowns = max(matrices.size) * len(problem.data) + max(matrices.count)
    allowed = chi_square_above(FALSE_PRESENCE, unknowns) * whole.fit.deviation**2
    own = problem.of_terms(kept)
    fit = own.fit(whole.fit.theta[problem.parameters_of(kept)], whole.noise)
    if not _explains(fit, larger.squares + allowed):
        fit = own.fit(search_start(own, whole.noise), whole.noise)
    return fit if _explains(fit, larger.squares + allowed) else None


def _explains(fit: OutputErrorFit, most: float) -> bool:
    return fit.converged and fit.squares <= most


def _is_present(fit: OutputErrorFit, kept: Sequence[int], term: int, whole: FittedModel) -> bool:
    """Return whether a term is larger than noise makes it in a fit of some."""
    problem = whole.problem
    sizes = [problem.families[i].v for i in kept]
    place = kept.index(term)
    threshold = presence_threshold(sizes, len(problem.data))[place]
    return bool(fit.presence[place] > threshold)
