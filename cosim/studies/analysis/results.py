"""The dataset of a study as columns, with how its members are numbered."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.studies.analysis.columns import MemberColumns, NumberColumn
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.contracts import FAILED
from cosim.units import with_unit

_OUTCOME = ("member", "status", "reason", "warnings", "wall_time")


class StudyTable(Protocol):
    """What is read of a study: that of :func:`cosim.open_study`."""

    @property
    def name(self) -> str:
        """Return its name."""
        ...

    @property
    def planned(self) -> int:
        """Return how many members it has in all."""
        ...

    @property
    def parameters(self) -> tuple[str, ...]:
        """Return the names of the columns of what is varied."""
        ...

    @property
    def metrics(self) -> tuple[str, ...]:
        """Return the names of the columns of metrics."""
        ...

    @property
    def units(self) -> dict[str, str]:
        """Return the units of the columns that have one."""
        ...

    def table(self, columns: Iterable[str] | None = None) -> Any:
        """Return a ``pyarrow.Table`` with a row for each member that is done."""
        ...


@dataclass(frozen=True)
class StudyResults:
    """What the members of a study came to.

    Parameters
    ----------
    name : str
    planned : int
        Members in all.
    layout : StudyLayout
    columns : MemberColumns
        Of those that are done.
    units : mapping of column to str
    wall_times : Vector, shape (N,)
        [s].
    """

    name: str
    planned: int
    layout: StudyLayout
    columns: MemberColumns
    units: Mapping[str, str]
    wall_times: Vector

    @property
    def done(self) -> int:
        """How many members are done."""
        return len(self.columns.numbers)

    @property
    def failed(self) -> int:
        """How many of them failed."""
        return int(self.columns.failed.sum())

    @property
    def missing(self) -> NumberColumn:
        """The members that are not done, of the study as it is planned."""
        is_done = np.zeros(max(self.planned, 1 + self._last), np.bool_)
        is_done[self.columns.numbers] = True
        return np.flatnonzero(~is_done).astype(np.int64)

    @property
    def _last(self) -> int:
        return int(self.columns.numbers[-1]) if self.done else -1

    def with_unit(self, column: str) -> str:
        """Return the name of a column with its unit: ``rms [m]``."""
        return with_unit(column, self.units.get(column))


def results_of_study(study: StudyTable, layout: StudyLayout) -> StudyResults:
    """Read what the members of a study came to.

    Raises
    ------
    DatasetError
        If a file is damaged.
    """
    parameters = [name for name in study.parameters if name not in layout.noise_seeds]
    names = [*_OUTCOME, *parameters, *study.metrics]
    table = study.table(dict.fromkeys(names))
    columns = MemberColumns(
        numbers=table["member"].to_numpy().astype(np.int64),
        failed=np.array(table["status"].to_pylist(), object) == FAILED,
        reasons=[reason or "" for reason in table["reason"].to_pylist()],
        parameters={name: _array(table[name]) for name in parameters},
        raw_metrics={name: _array(table[name]) for name in study.metrics},
        warnings=[lines or "" for lines in table["warnings"].to_pylist()],
    )
    wall_times = table["wall_time"].to_numpy().astype(np.float64)
    return StudyResults(study.name, study.planned, layout, columns, study.units, wall_times)


def _array(column: Any) -> NDArray[Any]:
    """Return a column as numbers, where null is NaN, or as objects, where it is None."""
    if str(column.type) in ("double", "int64"):
        array: NDArray[Any] = column.to_numpy()
        return array
    values = np.empty(len(column), object)
    values[:] = column.to_pylist()
    return values
