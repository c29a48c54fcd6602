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

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, final

import numpy as np

from cosim.studies.analysis.columns import MemberColumns, NumberColumn, count_text
from cosim.studies.design.columns import MemberNumbering, NoiseSeedColumn
from cosim.studies.design.study_design import SampleKind, StudyDesign

_BASIS: Final = {
    "random": "samples drawn independently",
    "latin-hypercube": "Latin hypercube samples: conservative for many members",
    "sobol": "Sobol points, treated as independent: usually far too wide, not guaranteed",
    "saltelli": "samples of matrices A and B, treated as independent: usually far too wide, not "
    "guaranteed",
}


@final
@dataclass(frozen=True)
class StudyLayout(MemberNumbering):
    """How the members of a study are numbered, and what of them was drawn.

    Parameters
    ----------
    kind : SampleKind
    parameters : tuple of str
        What is drawn, in the order of the dimensions.
    noise_seeds : tuple of str
        Columns that are seeds of noise sources: no parameters that a metric could depend on.
    """

    kind: SampleKind
    parameters: tuple[str, ...] = ()
    noise_seeds: tuple[str, ...] = ()

    @classmethod
    def of(cls, design: StudyDesign) -> StudyLayout:
        """Return the layout of a design."""
        seeds = [
            name for name, column in design.columns.items() if isinstance(column, NoiseSeedColumn)
        ]
        return cls(
            design.kind,
            seeds=design.layout.seeds,
            grid=design.layout.grid,
            parameters=design.sampled,
            samples=design.layout.samples,
            noise_seeds=tuple(seeds),
        )

    @property
    def matrices(self) -> int:
        """Of ``saltelli``: A, B, AB_1, ..., AB_d, one behind the other."""
        return len(self.parameters) + 2

    @property
    def base_points(self) -> int:
        """Of ``saltelli``: the rows of each matrix."""
        return self.samples // self.matrices

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        content = asdict(self)
        return {key: list(one) if isinstance(one, tuple) else one for key, one in content.items()}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> StudyLayout:
        """Return the layout of :meth:`to_dict`."""
        tuples = {key: tuple(one) for key, one in content.items() if isinstance(one, list)}
        return cls(**{**content, **tuples})

    @property
    def text(self) -> str:
        """The design in words."""
        factors = []
        if self.kind == "saltelli":
            factors.append(f"{count_text(self.base_points, 'base point')} x {self.matrices}")
        elif self.kind == "cases":
            factors.append(count_text(self.samples, "case"))
        elif self.kind != "grid":
            factors.append(count_text(self.samples, "sample"))
        if self.grid > 1 or (self.kind == "grid" and self.seeds == 1):
            factors.append(f"grid of {self.grid}")
        if self.seeds > 1:
            factors.append(f"{self.seeds} seeds")
        own = "" if self.kind in ("grid", "cases") else f"{self.kind}: "
        return own + " x ".join(factors)


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

    def units_of(self, numbers: NumberColumn) -> NumberColumn | None:
        """Return the unit that each member belongs to; None: each is one."""
        layout = self.layout
        if layout.kind == "saltelli" and layout.noise_seeds:
            # the members of a base point have the same noise
            return layout.samples_of(numbers) % layout.base_points
        if layout.kind in ("grid", "cases"):
            return layout.seeds_of(numbers) if layout.grid * layout.samples > 1 else None
        return layout.samples_of(numbers) if layout.seeds * layout.grid > 1 else None

    def variance_factor(self, numbers: NumberColumn) -> float:
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
            return Independence(layout, "none (the members were chosen, not drawn)", is_drawn=False)
        return Independence(layout, f"{layout.seeds} seeds drawn independently")
    basis = _BASIS[layout.kind]
    together = layout.seeds * layout.grid
    if together > 1:
        basis += f"; the {together} members of a sample count as one"
    return Independence(layout, basis)


def drawn_members(columns: MemberColumns, layout: StudyLayout) -> MemberColumns:
    """Return the members that statistics are of: of ``saltelli`` those of its matrices A and B.

    Its other members repeat their values.
    """
    if layout.kind != "saltelli":
        return columns
    matrices = layout.samples_of(columns.numbers) // layout.base_points
    return columns.only(np.asarray(matrices < 2, np.bool_))
