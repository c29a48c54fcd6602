"""The trials of a tuning as members of a study: run in workers, kept in a dataset.

A point that the dataset has is taken from there, whatever its number: that is how a tuning which
was stopped goes on. New ones take the lowest free numbers, so that a tuning that was killed in the
middle of a batch numbers its members as an undisturbed one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final, cast, final

from cosim.errors import UsageError, option
from cosim.studies.contracts import COMPLETE, MemberOutcome, StudyMember
from cosim.studies.dataset.columns import StudyColumn
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.document.variations import SWAP
from cosim.studies.running.local import MembersDone
from cosim.studies.tuning.points import point_name
from cosim.studies.tuning.trials import SearchEnded
from cosim.studies.workers.pool import WorkerPool

_OUTCOME: Final = ("member", "status", "reason", "steps")


@final
class TrialMembers:
    """Evaluates points as members; :data:`cosim.studies.tuning.trials.Evaluate`.

    Parameters
    ----------
    pool : WorkerPool
    dataset : StudyDataset or None
        None: nothing is kept.
    members : int
        How many there may be.
    progress : callable or None
        Called with how many members are done, of how many, and how many of these failed.
    """

    def __init__(
        self,
        pool: WorkerPool,
        dataset: StudyDataset | None,
        members: int,
        progress: MembersDone | None = None,
    ) -> None:
        self._pool = pool
        self._dataset = dataset
        self._members = members
        self._progress = progress
        self._done: dict[int, bool] = {}  # whether it failed, by member
        self._recorded = {} if dataset is None else _recorded(dataset)
        self._numbers = {outcome.number for outcome in self._recorded.values()}
        self._next = 0

    def __call__(self, points: Sequence[Mapping[str, Any]]) -> list[MemberOutcome]:
        """Return the outcomes of points, in their order.

        Raises
        ------
        SearchEnded
            If the dataset has no place for more members.
        UsageError
            If the first member of all fails.
        RunError
            If workers cannot be started.
        """
        names = [point_name(point) for point in points]
        new = {}
        for name, point in zip(names, points, strict=True):
            if name not in self._recorded:
                number = self._take_number()
                new[number] = (name, member_of(number, point))
        for outcome in self._pool.run([member for _, member in new.values()]):
            name, member = new[outcome.number]
            if self._dataset is not None:
                self._dataset.add(member, outcome)
            self._recorded[name] = outcome
            self._note(outcome)
        outcomes = [self._recorded[name] for name in names]
        for outcome in outcomes:
            self._note(outcome)
        return outcomes

    def _take_number(self) -> int:
        while self._next in self._numbers:
            self._next += 1
        if self._dataset is not None and self._next >= self._dataset.layout.total:
            raise SearchEnded("all members of the dataset were used")
        self._numbers.add(self._next)
        return self._next

    def _note(self, outcome: MemberOutcome) -> None:
        if outcome.number == 0 and outcome.status != COMPLETE:
            raise UsageError(
                f"the first member fails, nothing was tuned: {outcome.reason}\nneeded a metric of "
                f"the run, and first values with which it runs, such as by {option('set')}"
            )
        self._done[outcome.number] = outcome.status != COMPLETE
        if self._progress is not None:
            self._progress(len(self._done), self._members, sum(self._done.values()))


def member_of(number: int, point: Mapping[str, Any]) -> StudyMember:
    """Return the member that tries a point."""
    changes = {key: value for key, value in point.items() if not key.startswith(SWAP)}
    swaps = {
        key.removeprefix(SWAP): str(value) for key, value in point.items() if key.startswith(SWAP)
    }
    return StudyMember(number, changes, swaps)


def _recorded(dataset: StudyDataset) -> dict[str, MemberOutcome]:
    """Return what a dataset has, by the names of points."""
    parameters = [column for column in dataset.columns if column.role == "parameter"]
    metrics = [column.name for column in dataset.columns if column.role == "metric"]
    names = [*_OUTCOME, *(column.name for column in parameters), *metrics]
    found = {}
    for row in dataset.read(names).to_pylist():
        point = {column.name: _value(column, row[column.name]) for column in parameters}
        found[point_name(point)] = MemberOutcome(
            row["member"],
            row["status"],
            reason=row["reason"] or "",
            steps=cast("int", row["steps"]),
            metrics={name: row[name] for name in metrics},
        )
    return found


def _value(column: StudyColumn, value: Any) -> Any:
    return json.loads(value) if column.type == "json" and value is not None else value
