"""Make the logs that a study keeps on the workers of a cluster, where these reach the dataset."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, final

from cosim.studies.cluster.cluster_run import open_cluster_run
from cosim.studies.cluster.storing import STORING_OPENER, kept_place
from cosim.studies.contracts import MemberOutcome, StudyMember
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.running.plan import StudyPlan

if TYPE_CHECKING:
    from distributed import Client

OutcomeWithRow = Callable[[MemberOutcome, dict[str, Any]], None]


def any_reaches(client: Client, dataset: StudyDataset) -> bool:
    """Return whether a worker that is there reaches a dataset."""
    from cosim.studies.cluster.worker_functions import reaches

    place = kept_place(dataset.label, dataset.sha256)
    answers: Mapping[str, object] = client.run(reaches, place, on_error="return")
    return any(answer is True for answer in answers.values())


def log_on_cluster(
    client: Client,
    plan: StudyPlan,
    dataset: StudyDataset,
    numbers: Sequence[int],
    *,
    limit: float,
    take: OutcomeWithRow,
    notice: Callable[[str], None],
) -> None:
    """Run members with logs on a cluster.

    Parameters
    ----------
    client : Client
    plan : StudyPlan
    dataset : StudyDataset
        Some worker reaches it.
    numbers : sequence of int
    limit : float
        Wall time after which a member hangs [s].
    take : callable
        Called with each outcome, and the row of its member.
    notice : callable
        Called for each worker that is not used.

    Raises
    ------
    CosimError
        As of :func:`cosim.studies.cluster.cluster_run.run_on_cluster`.
    """
    chosen = ChosenMembers(plan, dataset, numbers)
    place = dataset.label
    subject = replace(plan.subject, logs=kept_place(place, dataset.sha256))
    with open_cluster_run(
        client,
        subject,
        chosen.members(0, 1)[0],
        LoggedMembers(dataset, len(numbers), take),
        place,
        files=plan.files,
        timeout=limit,
        notice=notice,
        opener=STORING_OPENER,
    ) as run:
        run.complete(chosen, _ignore)


@final
class ChosenMembers:
    """Some members of a study, by their place among the chosen ones.

    Parameters
    ----------
    plan : StudyPlan
    dataset : StudyDataset
        Has their rows.
    numbers : sequence of int
        In order.
    """

    def __init__(self, plan: StudyPlan, dataset: StudyDataset, numbers: Sequence[int]) -> None:
        self._plan = plan
        self._dataset = dataset
        self._numbers = numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def members(self, begin: int = 0, end: int | None = None) -> list[StudyMember]:
        """Return those from one place to another (not included)."""
        numbers = self._numbers[begin:end]
        columns = self._dataset.read(["member", "designs"], numbers).to_pylist()
        designs = {row["member"]: row["designs"] or "" for row in columns}
        design = self._plan.design
        return [replace(design.member(number), designs=designs[number]) for number in numbers]


@final
class LoggedMembers:
    """Takes the outcomes of members that ran for their logs; the rows of their part stay.

    Parameters
    ----------
    dataset : StudyDataset
    count : int
        Of the members.
    take : callable
        Called with each outcome, and the row of its member.
    """

    def __init__(self, dataset: StudyDataset, count: int, take: OutcomeWithRow) -> None:
        self._dataset = dataset
        self._count = count
        self._take = take
        self._done = 0
        self.sha256 = dataset.sha256
        self.failed = 0

    def __len__(self) -> int:
        return self._done

    def missing(self, total: int | None = None) -> list[range]:
        """Return the places of all: this is asked once."""
        return [range(self._count)]

    def empty_parts(self) -> list[range]:
        """Return nothing: outcomes come back one by one."""
        return []

    def add(self, member: StudyMember, outcome: MemberOutcome) -> None:
        """Take an outcome."""
        (row,) = self._dataset.read(members=[member.number]).to_pylist()
        self._take(outcome, row)
        self._done += 1

    def write_part(self, first: int, outcomes: object) -> None:
        """Do nothing: there are no parts."""

    def note_part(self, first: int) -> None:
        """Do nothing: there are no parts."""


def _ignore(*_: int) -> None:
    """Do nothing: who takes the outcomes counts them."""
