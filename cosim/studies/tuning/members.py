"""The trials of a tuning as members of a study: run in workers, kept in a dataset.

A point that the dataset has is taken from there, whatever its number: that is how a tuning which
was stopped goes on. New ones take the lowest free numbers, so that a tuning that was killed in the
middle of a batch numbers its members as an undisturbed one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol, TypeAlias, final

from cosim.errors import UsageError, option
from cosim.studies.contracts import COMPLETE, MemberOutcome, MemberResult, StudyMember
from cosim.studies.running.local import MembersDone
from cosim.studies.tuning.points import point_name
from cosim.studies.tuning.recorded import TuningDataset
from cosim.studies.tuning.trials import SearchEnded

MemberOf: TypeAlias = Callable[[int, Mapping[str, Any]], StudyMember]

TakeOutcome: TypeAlias = Callable[[StudyMember, MemberOutcome], None]


class RunTrials(Protocol):
    """Runs members: those of a batch at a time, as far as that goes."""

    def __call__(self, members: Sequence[StudyMember], take: TakeOutcome) -> None:
        """Run members, and have each outcome taken as it comes."""
        ...


class MemberPool(Protocol):
    """What a worker pool does."""

    def run(self, members: Iterable[StudyMember]) -> Iterator[MemberResult]:
        """Yield members with their outcomes, as they come."""
        ...


def in_pool(pool: MemberPool) -> RunTrials:
    """Return what runs trials in a pool."""

    def run(members: Sequence[StudyMember], take: TakeOutcome) -> None:
        for member, outcome in pool.run(members):
            take(member, outcome)

    return run


@final
class TrialMembers:
    """Evaluates points as members; :data:`cosim.studies.tuning.trials.Evaluate`.

    Parameters
    ----------
    run : RunTrials
    run_first : RunTrials
        Runs the first member of all.
    member_of : callable
        Returns the member of a number that tries a point.
    dataset : TuningDataset
    members : int
        How many there may be.
    progress : callable or None
        Called with how many members are done, of how many, and how many of these failed.
    """

    def __init__(
        self,
        run: RunTrials,
        run_first: RunTrials,
        member_of: MemberOf,
        dataset: TuningDataset,
        *,
        members: int,
        progress: MembersDone | None = None,
    ) -> None:
        self._run = run
        self._run_first = run_first
        self._member_of = member_of
        self._dataset = dataset
        self._members = members
        self._progress = progress
        self._done: dict[int, bool] = {}  # whether it failed, by member
        self._recorded = dataset.outcomes()
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
        if not self._recorded:
            self._try(points[:1], self._run_first)  # alone: nothing is kept where it fails
        self._try(points, self._run)
        outcomes = [self._recorded[point_name(point)] for point in points]
        for outcome in outcomes:
            self._note(outcome)
        return outcomes

    def _try(self, points: Sequence[Mapping[str, Any]], run: RunTrials) -> None:
        """Run the points that are not recorded."""
        new = {}
        for point in points:
            name = point_name(point)
            if name not in self._recorded:
                number = self._take_number()
                new[number] = (name, self._member_of(number, point))
        if not new:
            return

        def take(member: StudyMember, outcome: MemberOutcome) -> None:
            _check_first(outcome)
            self._dataset.add(member, outcome)
            self._recorded[new[member.number][0]] = outcome
            self._note(outcome)

        run([member for _, member in new.values()], take)

    def _take_number(self) -> int:
        while self._next in self._numbers:
            self._next += 1
        if self._next >= self._dataset.places:
            raise SearchEnded("all members of the dataset were used")
        self._numbers.add(self._next)
        return self._next

    def _note(self, outcome: MemberOutcome) -> None:
        _check_first(outcome)
        self._done[outcome.number] = outcome.status != COMPLETE
        if self._progress is not None:
            self._progress(len(self._done), self._members, sum(self._done.values()))


def _check_first(outcome: MemberOutcome) -> None:
    """Check that the first member of all is complete.

    Raises
    ------
    UsageError
        If it has failed: the others would, too.
    """
    if outcome.number == 0 and outcome.status != COMPLETE:
        raise UsageError(
            f"the first member fails, so nothing was tuned: {outcome.reason}\nexpected a metric of "
            f"the run, and initial values with which it runs, for example by {option('set')}"
        )
