"""The members of a study as columns, how they are numbered, and which were drawn together.

A study is read whole: a column of a million members takes 8 MB. A member is in every column; of a
metric those that failed, have no value (null, NaN) or an infinite one are named, never dropped
silently.

What was drawn independently decides how wide intervals are. Samples of a distribution are drawn,
points of a grid and cases are chosen. The seeds and grid points of one sample have its values in
common: they are one *unit*. Without samples, seeds are drawn, each with all points of the grid.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeAlias, final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cosim.arrays import Mask, Vector
from cosim.errors import UsageError, nearest
from cosim.studies.contracts import FAILED, MOST_MEMBERS
from cosim.units import with_unit

if TYPE_CHECKING:
    from cosim.studies.study import Study

SampleKind: TypeAlias = Literal["grid", "cases", "random", "latin-hypercube", "sobol", "saltelli"]
_Count: TypeAlias = Annotated[int, Field(ge=1, le=MOST_MEMBERS)]  # where it is read from a file
NumberColumn: TypeAlias = NDArray[np.int64]  # of members, shape (N,)
VariedValues: TypeAlias = NDArray[Any]  # float64, int64 or object; shape (N,)
_CHOSEN: Final = ("grid", "cases")
_BASIS: Final = {
    "random": "samples drawn independently",
    "latin-hypercube": "Latin hypercube samples: conservative for many members",
    "sobol": "Sobol points, treated as independent: usually far too wide, not guaranteed",
    "saltelli": "samples of matrices A and B, treated as independent: usually far too wide, not "
    "guaranteed",
}


@dataclass(frozen=True)
class MetricColumn:
    """A metric: its finite values and whose they are, and the members that have none.

    Parameters
    ----------
    name : str
    values : Vector, shape (n,)
    numbers : NumberColumn, shape (n,)
        The members that have them.
    failed, without_value, infinite : NumberColumn
        The members that have no finite value.
    texts : mapping of str to int
        How many members have which text, the most frequent first.
    """

    name: str
    values: Vector
    numbers: NumberColumn
    failed: NumberColumn
    without_value: NumberColumn
    infinite: NumberColumn
    texts: Mapping[str, int]


@dataclass(frozen=True)
class MemberColumns:
    """What is recorded of each member, by ascending number.

    Parameters
    ----------
    numbers : NumberColumn, shape (N,)
    failed : Mask, shape (N,)
    reasons : array of str, shape (N,)
    parameters : mapping of str to VariedValues, shape (N,)
    raw_metrics : mapping of str to array, shape (N,)
        float64, or objects: texts and None.
    warnings : array of str, shape (N,)
        A line each.
    """

    numbers: NumberColumn
    failed: Mask
    reasons: NDArray[Any]
    parameters: Mapping[str, VariedValues]
    raw_metrics: Mapping[str, NDArray[Any]]
    warnings: NDArray[Any]

    @cached_property
    def metrics(self) -> dict[str, MetricColumn]:
        """Each metric by name."""
        found = {}
        for name, raw in self.raw_metrics.items():
            values, has_value = self.numeric(name), self.has_value(name)
            finite = np.isfinite(values)
            found[name] = MetricColumn(
                name,
                values=values[finite],
                numbers=self.numbers[finite],
                failed=self.numbers[self.failed],
                without_value=self.numbers[~has_value & ~self.failed],
                infinite=self.numbers[np.isinf(values)],
                texts=dict(Counter(raw[has_value & np.isnan(values)]).most_common()),
            )
        return found

    def metric(self, name: str) -> MetricColumn:
        """Return a metric; UsageError if there is none of this name, or its values are texts."""
        self.check_metric(name)
        if self.metrics[name].texts:
            raise UsageError(f"metric {name!r}: expected numbers, got texts")
        return self.metrics[name]

    def check_metric(self, name: str) -> None:
        """Raise a UsageError if there is no metric of this name."""
        if name not in self.raw_metrics:
            raise UsageError(f"the study has no metric {name!r}; {nearest(name, self.raw_metrics)}")

    def rows_of(self, numbers: NumberColumn) -> NDArray[np.intp]:
        """Return the rows of members that there are."""
        return np.searchsorted(self.numbers, numbers)

    def only(self, rows: Mask | NDArray[np.intp]) -> MemberColumns:
        """Return some of the members: a mask, or ascending rows."""
        return MemberColumns(
            self.numbers[rows],
            self.failed[rows],
            self.reasons[rows],
            {key: values[rows] for key, values in self.parameters.items()},
            {name: values[rows] for name, values in self.raw_metrics.items()},
            self.warnings[rows],
        )

    def numeric(self, name: str) -> Vector:
        """Return a metric as numbers; NaN: failed, no value, a text."""
        raw = self.raw_metrics[name]
        return np.where(self.failed | (raw.dtype == object), np.nan, raw).astype(np.float64)

    def has_value(self, name: str) -> Mask:
        """Return which members have a value of a metric."""
        raw = self.raw_metrics[name]
        is_empty = [one is None for one in raw] if raw.dtype == object else np.isnan(raw)
        return np.asarray(~self.failed & ~np.array(is_empty, np.bool_))


@final
@dataclass(frozen=True)
class StudyLayout:
    """How the members of a study are numbered, and what of them was drawn.

    Members are numbered by sample (or case), then by seed of the noise, then by point of the grid.

    Parameters
    ----------
    kind : {"grid", "cases", "random", "latin-hypercube", "sobol", "saltelli"}
        How samples came about.
    parameters : tuple of str
        Keys that are drawn, in the order of their dimensions.
    noise_seeds : tuple of str
        Keys of the seeds of noise sources.
    samples, seeds, grid : int
        How many there are.
    """

    kind: SampleKind
    parameters: tuple[str, ...] = ()
    noise_seeds: tuple[str, ...] = ()
    _: KW_ONLY
    samples: _Count = 1
    seeds: _Count = 1
    grid: _Count = 1

    @property
    def members(self) -> int:
        """How many there are."""
        return self.samples * self.seeds * self.grid

    @property
    def matrices(self) -> int:
        """Of Saltelli's design: A, B, and A with each column of B."""
        return len(self.parameters) + 2

    @property
    def base_points(self) -> int:
        """Of Saltelli's design: rows of each matrix."""
        return self.samples // self.matrices

    def samples_of(self, numbers: NumberColumn) -> NumberColumn:
        """Return the samples of members."""
        return numbers // (self.grid * self.seeds)

    @property
    def is_drawn(self) -> bool:
        """Members were drawn, not chosen, so that there are intervals."""
        return self.kind not in _CHOSEN or self.seeds > 1

    @property
    def basis(self) -> str:
        """What intervals rest on, in words."""
        if self.kind in _CHOSEN:
            drawn = f"{self.seeds} seeds drawn independently"
            return drawn if self.is_drawn else "none (the members were chosen, not drawn)"
        together = self.seeds * self.grid
        more = f"; the {together} members of a sample count as one" if together > 1 else ""
        return _BASIS[self.kind] + more

    def units_of(self, numbers: NumberColumn) -> NumberColumn | None:
        """Return the unit of each member; None: each is one of its own.

        Members that were chosen are all in one unit, so that nothing has an interval.
        """
        if self.kind in _CHOSEN:
            return None if 1 < self.seeds == self.members else numbers // self.grid % self.seeds
        if self.kind == "saltelli" and self.noise_seeds:
            return self.samples_of(numbers) % self.base_points
        return self.samples_of(numbers) if self.seeds * self.grid > 1 else None

    def variance_factor(self, numbers: NumberColumn) -> float:
        """Return n / (n - 1) of a Latin hypercube: its variance is at most so many times larger.

        Than that of n independent samples (Owen, 1997, SIAM J. Numer. Anal. 34).
        """
        units = self.units_of(numbers)
        count = len(numbers if units is None else np.unique(units))
        is_latin = self.kind == "latin-hypercube" and count > 1
        return count / (count - 1.0) if is_latin else 1.0

    @property
    def text(self) -> str:
        """The design in a line: ``random: 8 samples x grid of 3``."""
        samples = {
            "grid": "",
            "cases": count_text(self.samples, "case"),
            "saltelli": f"{count_text(self.base_points, 'base point')} x {self.matrices}",
        }.get(self.kind, count_text(self.samples, "sample"))
        has_grid = self.grid > 1 or (self.kind == "grid" and self.seeds == 1)
        grid = f"grid of {self.grid}" if has_grid else ""
        seeds = f"{self.seeds} seeds" if self.seeds > 1 else ""
        own = "" if self.kind in _CHOSEN else f"{self.kind}: "
        return own + " x ".join(filter(None, (samples, grid, seeds)))


@dataclass(frozen=True)
class StudyResults:
    """All that is read of a study.

    Parameters
    ----------
    name : str
    planned : int
        Members that it has, done or not.
    layout : StudyLayout
    columns : MemberColumns
        Of the members that are done.
    units : mapping of str to str
        Of columns that have one.
    wall_times : Vector, shape (N,)
        [s]
    """

    name: str
    planned: int
    layout: StudyLayout
    columns: MemberColumns
    units: Mapping[str, str]
    wall_times: Vector

    @property
    def done(self) -> int:
        """How many members are done, failed ones included."""
        return len(self.columns.numbers)

    @property
    def failed(self) -> int:
        """How many members failed."""
        return int(self.columns.failed.sum())

    @property
    def missing(self) -> NumberColumn:
        """The members that are not done."""
        return np.setdiff1d(np.arange(self.planned), self.columns.numbers, assume_unique=True)

    def with_unit(self, column: str) -> str:
        """Return the name of a column with its unit."""
        return with_unit(column, self.units.get(column))


def drawn_members(columns: MemberColumns, layout: StudyLayout) -> MemberColumns:
    """Return the members that represent the distributions: of Saltelli's design A and B."""
    if layout.kind != "saltelli":
        return columns
    return columns.only(layout.samples_of(columns.numbers) < 2 * layout.base_points)


def results_of_study(study: Study, layout: StudyLayout) -> StudyResults:
    """Read the results of a study, also while it runs."""
    parameters = [name for name in study.parameters if name not in layout.noise_seeds]
    outcome = ("member", "status", "reason", "warnings", "wall_time")
    table = study.table(dict.fromkeys([*outcome, *parameters, *study.metrics]))
    columns = MemberColumns(
        numbers=table["member"].to_numpy().astype(np.int64),
        failed=_array(table["status"]) == FAILED,
        reasons=_array(table["reason"].fill_null("")),
        parameters={name: _array(table[name]) for name in parameters},
        raw_metrics={name: _array(table[name]) for name in study.metrics},
        warnings=_array(table["warnings"].fill_null("")),
    )
    wall_times = table["wall_time"].to_numpy().astype(np.float64)
    return StudyResults(study.name, study.planned, layout, columns, study.units, wall_times)


def _array(column: Any) -> NDArray[Any]:
    if str(column.type) in ("double", "int64"):
        array: NDArray[Any] = column.to_numpy()
        return array
    values = np.empty(len(column), object)
    values[:] = column.to_pylist()
    return values


def count_text(count: int, noun: str = "member") -> str:
    """Return a count in words: ``1 member``, ``5 members``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def numbers_of(values: VariedValues) -> Vector | None:
    """Return the values of a parameter as numbers; None: they are texts or switches."""
    return None if values.dtype == object else values.astype(np.float64)
