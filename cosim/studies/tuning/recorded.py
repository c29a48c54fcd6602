"""The dataset of a tuning: made when its first member has run, so that a wrong one leaves none."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final, cast, final

from cosim.studies.contracts import RECORDING, MemberOutcome, StudyMember
from cosim.studies.dataset import StudyColumn, StudyDataset, StudyIdentity, json_value, pyarrow
from cosim.studies.tuning.points import point_name

_OUTCOME: Final = ("member", "status", "reason", "warnings", "steps")


@final
class TuningDataset:
    """The outcomes of a tuning.

    Parameters
    ----------
    place : str, Path or None
        Its folder, or a URL; None: nothing is kept.
    identity : StudyIdentity
    new : bool
        What is there is removed, when the first member is added.

    Raises
    ------
    DatasetError
        If another study's is there, it is damaged, or another process writes there.
    """

    def __init__(
        self, place: str | Path | None, identity: StudyIdentity, *, new: bool = False
    ) -> None:
        self._place = place
        self._identity = identity
        self._new = new
        self._dataset: StudyDataset | None = None
        if place is None:
            return
        pyarrow()
        if not new and StudyDataset.is_at(place):
            self._dataset = StudyDataset.open_or_create(place, identity)

    def close(self) -> None:
        """Close the dataset, if there is one."""
        if self._dataset is not None:
            self._dataset.close()

    @property
    def identity(self) -> StudyIdentity:
        """Whose dataset it is, as it was begun."""
        return self._identity if self._dataset is None else self._dataset.identity

    @property
    def places(self) -> int:
        """How many members it has place for."""
        if self._place is None:
            return sys.maxsize
        return self._identity.members if self._dataset is None else self._dataset.layout.total

    def add(self, member: StudyMember, outcome: MemberOutcome) -> None:
        """Record an outcome."""
        if self._place is None:
            return
        if self._dataset is None:
            self._dataset = StudyDataset.open_or_create(self._place, self._identity, new=self._new)
        self._dataset.add(member, outcome)

    def outcomes(self) -> dict[str, MemberOutcome]:
        """Return what is recorded, by the names of points."""
        if self._dataset is None:
            return {}
        columns = self._dataset.columns
        keys = [each for each in columns if each.role == "parameter" and each.name != RECORDING]
        metrics = [column.name for column in columns if column.role == "metric"]
        names = [*_OUTCOME, *(column.name for column in keys), *metrics]
        found = {}
        for row in self._dataset.read(names).to_pylist():
            point = {column.name: _value(column, row[column.name]) for column in keys}
            found[point_name(point)] = MemberOutcome(
                row["member"],
                row["status"],
                reason=row["reason"] or "",
                steps=cast("int", row["steps"]),
                metrics={name: row[name] for name in metrics},
                warnings=(row["warnings"] or "").splitlines(),
            )
        return found


def _value(column: StudyColumn, value: Any) -> Any:
    return json_value(value) if column.type == "json" and value is not None else value
