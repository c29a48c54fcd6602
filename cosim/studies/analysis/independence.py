"""Which members of a study were drawn independently: what every interval of a mean rests on.

Members are drawn in units: the members of one sample share its values, those of one seed its
noise. Units are independent of each other, the members of one are not.

* Random samples are independent.
* Without samples the seeds are: over a grid, or over cases, that was chosen and not drawn, the
  mean over all its points is one value for each seed.
* A Latin hypercube: the variance of its mean is at most n / (n - 1) times that of n independent
  samples, for every metric of finite variance (Owen, "Monte Carlo variance of scrambled net
  quadrature", SIAM J. Numer. Anal. 34, 1997). So the interval with this factor is conservative.
* A scrambled Sobol sequence: mostly the variance is far smaller than that of independent samples,
  for smooth metrics of few parameters by orders of magnitude; it can be larger, by the gain
  coefficients of the sequence (Owen, 1997). So the interval of independent samples is mostly far
  too wide, and guarantees nothing. One that holds takes the means of several studies with other
  seeds as independent values (L'Ecuyer, Nakayama, Owen and Tuffin, "Confidence intervals for
  randomized quasi-Monte Carlo estimators", Winter Simulation Conference, 2023):
  ``mean_interval`` of these means.
* A grid, or cases, without seeds: chosen, not drawn. There is no interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np

from cosim.studies.analysis.columns import MemberColumns, MemberNumbers

DesignKind: TypeAlias = Literal["grid", "cases", "random", "latin-hypercube", "sobol", "saltelli"]

_BASIS: Final = {
    "random": "samples drawn independently",
    "latin-hypercube": "Latin hypercube: conservative, at least 95 % of many members",
    "sobol": "as if Sobol points were independent: mostly far too wide, not guaranteed",
    "saltelli": "as if Sobol points were independent: mostly far too wide, not guaranteed",
}


@dataclass(frozen=True)
class StudyLayout:
    """How the members of a study are numbered: ((sample or case) * seeds + seed) * grid + point.

    Parameters
    ----------
    kind : DesignKind
    seeds : int
        Seeds of each sample, case or point of the grid.
    grid : int
        Points of the grid.
    parameters : tuple of str
        Of ``saltelli``: those of its columns, in their order.
    samples : int
        Or cases; 1 where there is a grid alone.
    """

    kind: DesignKind
    seeds: int = 1
    grid: int = 1
    parameters: tuple[str, ...] = ()
    samples: int = 1

    def samples_of(self, numbers: MemberNumbers) -> MemberNumbers:
        """Return the samples, or cases, of members."""
        return numbers // (self.seeds * self.grid)

    def seeds_of(self, numbers: MemberNumbers) -> MemberNumbers:
        """Return which seed of their sample members have."""
        return numbers // self.grid % self.seeds

    @property
    def base_samples(self) -> int:
        """Of ``saltelli``: the base points, of which each has a member in every matrix."""
        return self.samples // (len(self.parameters) + 2)


@dataclass(frozen=True)
class Independence:
    """What was drawn independently.

    Parameters
    ----------
    layout : StudyLayout
    basis : str
        In words; with ``is_drawn`` False why there is no interval.
    is_drawn : bool
        Whether anything was drawn, so that there are intervals.
    """

    layout: StudyLayout
    basis: str
    is_drawn: bool = True

    def units_of(self, numbers: MemberNumbers) -> MemberNumbers | None:
        """Return the unit that each member belongs to; None: each is one."""
        layout = self.layout
        if layout.kind in ("grid", "cases"):
            return layout.seeds_of(numbers) if layout.grid * layout.samples > 1 else None
        return layout.samples_of(numbers) if layout.seeds * layout.grid > 1 else None

    def variance_factor(self, numbers: MemberNumbers) -> float:
        """Return by what the variance of a mean of members may exceed that of independent ones."""
        if self.layout.kind != "latin-hypercube" or len(numbers) < 2:
            return 1.0
        units = self.units_of(numbers)
        count = len(numbers if units is None else np.unique(units))
        return count / (count - 1.0) if count > 1 else 1.0


def independence_of(layout: StudyLayout) -> Independence:
    """Return what of a study was drawn independently."""
    if layout.kind in ("grid", "cases"):
        if layout.seeds == 1:
            return Independence(layout, "none: members were chosen, not drawn", is_drawn=False)
        return Independence(layout, f"{layout.seeds} seeds drawn independently")
    basis = _BASIS[layout.kind]
    together = layout.seeds * layout.grid
    if together > 1:
        basis += f"; the {together} members of a sample count together"
    return Independence(layout, basis)


def drawn_members(columns: MemberColumns, layout: StudyLayout) -> MemberColumns:
    """Return the members that statistics are of: of ``saltelli`` those of its matrices A and B.

    Its other members repeat their values.
    """
    if layout.kind != "saltelli":
        return columns
    rows = layout.samples_of(columns.numbers) < 2 * layout.base_samples
    return columns.only(np.asarray(rows, np.bool_))
