"""Why a term of the disturbance does not show in a fit, where noise is not the cause.

**Silent** terms have no response at all: their alpha is zero at every sample, or the plant does not
pass them on to the output. **Hidden** terms show as soon as others are left out, and the data are
explained without these as well: two terms of one alpha and family, of which one is there, share its
amplitude in every way, so that neither is larger than its error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.theory.disturbance import Family, generators
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, NoiseModel
from cosim.theory.estimators.output_error import (
    FALSE_PRESENCE,
    OutputErrorFit,
    fit_output_error,
    least_squares_at,
    presence_threshold,
)
from cosim.theory.estimators.start_grid import search_start
from cosim.theory.quantiles import chi_square_above


def silent_terms(
    fit: OutputErrorFit, data: Sequence[DataSet], families: Sequence[Family]
) -> dict[int, str]:
    """Return the terms without any effect on the output, and why they have none.

    Parameters
    ----------
    fit : OutputErrorFit
    data : sequence of DataSet
    families : sequence of Family
        Of the terms.
    """
    reasons = {}
    responses = [record.make(fit.theta) for record in fit.records]
    first = 0
    for i, family in enumerate(families):
        columns = slice(first, first + family.v)
        first += family.v
        if not any(one.alpha[:, i].any() for one in data):
            reasons[i] = f"alpha of terms[{i}] is 0 at every sample"
        elif not any(R[:, columns].any() for R in responses):
            reasons[i] = f"terms[{i}] does not reach y"
    return reasons


def hidden_terms(
    fit: OutputErrorFit,
    terms: Terms,
    *,
    absent: Mask,
) -> dict[int, tuple[int, ...]]:
    """Return the absent terms that are there without others, and these.

    Parameters
    ----------
    fit : OutputErrorFit
        Of all terms.
    terms : Terms
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
        smaller = fit
        for k in every:
            if k == i:
                continue
            trial = terms.fitted([term for term in kept if term != k], fit, smaller)
            if trial is not None:
                kept.remove(k)
                smaller = trial
        left_out = tuple(k for k in every if k not in kept)
        if left_out and terms.is_present(smaller, kept, i):
            hidden[i] = left_out
    return hidden


@dataclass(frozen=True, eq=False, kw_only=True)
class Terms:
    """The terms of a disturbance, of which some are fitted to data.

    Parameters
    ----------
    data : sequence of DataSet
    plant : DisturbedPlant
    families : sequence of Family
    noise : NoiseModel
        As in the fit of all.
    offset : bool
    bounds : mapping of index to (lower, upper)
    """

    data: Sequence[DataSet]
    plant: DisturbedPlant
    families: Sequence[Family]
    noise: NoiseModel
    offset: bool
    bounds: Mapping[int, tuple[float, float]]

    def fitted(
        self, kept: Sequence[int], whole: OutputErrorFit, larger: OutputErrorFit
    ) -> OutputErrorFit | None:
        """Fit some terms; return None where they explain less than the larger fit does.

        Parameters
        ----------
        kept : sequence of int
        whole : OutputErrorFit
            Of all terms: the start, and the variance of the noise.
        larger : OutputErrorFit
            Of one term more.
        """
        matrices = generators(self.families)
        unknowns = max(matrices.size) * len(self.data) + max(matrices.count)
        allowed = chi_square_above(FALSE_PRESENCE, unknowns) * whole.deviation**2
        least = _squares(larger)
        own = self._some(kept)
        for start in (whole.theta[self._parameters(kept)], None):
            fit = own.fit_from(start)
            if fit.converged and _squares(fit) - least <= allowed:
                return fit
        return None

    def is_present(self, fit: OutputErrorFit, kept: Sequence[int], term: int) -> bool:
        """Return whether a term is larger than noise makes it in a fit of some."""
        sizes = [self.families[i].v for i in kept]
        place = kept.index(term)
        threshold = presence_threshold(sizes, len(self.data))[place]
        return bool(fit.presence[place] > threshold)

    def fit_from(self, start: Vector | None) -> OutputErrorFit:
        """Fit all of them from a start; None: search one."""
        if start is None:
            start = search_start(
                self.data,
                self.plant,
                self.families,
                offset=self.offset,
                bounds=self.bounds,
                noise=replace(self.noise, a=self.noise.a[:, :0]),
            )
        return fit_output_error(
            self.data,
            self.plant,
            self.families,
            start,
            noise=self.noise,
            offset=self.offset,
            bounds=self.bounds,
        )

    def _some(self, kept: Sequence[int]) -> Terms:
        data = [replace(one, alpha=one.alpha[:, kept]) for one in self.data]
        plant = replace(self.plant, Bd=self.plant.Bd[:, kept], Dd=self.plant.Dd[:, kept])
        bounds = {}
        for place, j in enumerate(self._parameters(kept)):
            if j in self.bounds:
                bounds[place] = self.bounds[j]
        families = [self.families[i] for i in kept]
        return replace(self, data=data, plant=plant, families=families, bounds=bounds)

    def _parameters(self, kept: Sequence[int]) -> list[int]:
        """Return the places in theta of the parameters of some terms."""
        places: list[int] = []
        first = 0
        for i, family in enumerate(self.families):
            count = len(family.parameters)
            if i in kept:
                places += range(first, first + count)
            first += count
        return places


def _squares(fit: OutputErrorFit) -> float:
    return sum(least_squares_at(record, fit.theta) for record in fit.records)
