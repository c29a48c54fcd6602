"""Run the trials of a tuning on a cluster, batch by batch, as the search asks for them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Final, final

from cosim.errors import UsageError, option
from cosim.studies.cluster.cluster_run import ClusterRun, open_cluster_run
from cosim.studies.cluster.connection import connect
from cosim.studies.contracts import COMPLETE, MemberOutcome, MemberResult, StudyMember
from cosim.studies.tuning.members import TakeOutcome
from cosim.studies.tuning.planning import TuningPlan
from cosim.temporary import TemporaryFolder

if TYPE_CHECKING:
    from distributed import Client

BATCHES: Final = ("global", "optuna")  # methods that try many members at a time


def check_batches(method: str) -> None:
    """Check that a method has something to do for a cluster.

    Raises
    ------
    UsageError
        If it tries one member after the other.
    """
    if method not in BATCHES:
        raise UsageError(
            f"{option('scheduler')}: the method {method!r} runs one member at a time, so a "
            f"cluster would not be faster; use {option('method')} {' or '.join(BATCHES)}, or no "
            "scheduler"
        )


@contextmanager
def cluster_trials(
    scheduler: str | Client, plan: TuningPlan, notice: Callable[[str], None] | None
) -> Iterator[ClusterTrials]:
    """Connect to a cluster on which trials can run.

    Raises
    ------
    UsageError
        If there is no scheduler.
    """
    with connect(scheduler) as client, ExitStack() as resources:
        yield ClusterTrials(client, plan, notice, resources)


@final
class ClusterTrials:
    """Runs members as tasks of dask.distributed; the study is opened there with the first.

    Parameters
    ----------
    client : Client
    plan : TuningPlan
    notice : callable or None
        Takes a sentence for each worker that is not used.
    resources : ExitStack
        Ends the study on the cluster.
    """

    def __init__(
        self,
        client: Client,
        plan: TuningPlan,
        notice: Callable[[str], None] | None,
        resources: ExitStack,
    ) -> None:
        self._client = client
        self._plan = plan
        self._notice = notice
        self._resources = resources
        self._batch = TrialBatch()
        self._run: ClusterRun | None = None

    def __call__(self, members: Sequence[StudyMember], take: TakeOutcome) -> None:
        """Run members; each outcome is taken as it comes.

        Raises
        ------
        UsageError
            If no worker can run them.
        RunError
            If workers or scheduler are lost.
        """
        if self._run is None:
            self._run = self._open(members[0])
        self._batch.begin(members, take)
        self._run.complete(self._batch, _ignore)

    def _open(self, first: StudyMember) -> ClusterRun:
        study = self._plan.study
        folder = self._resources.enter_context(TemporaryFolder("tuning"))
        opened = open_cluster_run(
            self._client,
            study.subject,
            first,
            self._batch,
            str(folder),
            files=study.files,
            timeout=self._plan.task.timeout,
            notice=self._notice,
        )
        return self._resources.enter_context(opened)


@final
class TrialBatch:
    """Members that run at a time, and who takes their outcomes: no dataset has parts for them."""

    def __init__(self) -> None:
        self._members: dict[int, StudyMember] = {}
        self._missing: set[int] = set()
        self._take: TakeOutcome = _ignore
        self.failed = 0

    @property
    def sha256(self) -> str:
        """There is no dataset that workers write."""
        return ""

    def __len__(self) -> int:
        """Return up to which number there are members."""
        return max(self._members, default=-1) + 1

    def begin(self, members: Sequence[StudyMember], take: TakeOutcome) -> None:
        """Begin another batch."""
        self._members = {member.number: member for member in members}
        self._missing = set(self._members)
        self._take = take

    def members(self, begin: int = 0, end: int | None = None) -> list[StudyMember]:
        """Return the members from one number to another (not included)."""
        last = len(self) if end is None else end
        return [self._members[number] for number in range(begin, last)]

    def missing(self, total: int | None = None) -> list[range]:
        """Return the members without an outcome, as ranges in order."""
        ranges: list[range] = []
        for number in sorted(self._missing):
            if ranges and ranges[-1].stop == number:
                ranges[-1] = range(ranges[-1].start, number + 1)
            else:
                ranges.append(range(number, number + 1))
        return ranges

    def empty_parts(self) -> list[range]:
        """There are none."""
        return []

    def add(self, member: StudyMember, outcome: MemberOutcome) -> None:
        """Hand on an outcome."""
        self._missing.discard(member.number)
        self.failed += outcome.status != COMPLETE
        self._take(member, outcome)

    def write_part(self, first: int, results: Iterable[MemberResult]) -> None:
        """Hand on outcomes."""
        for member, outcome in results:
            self.add(member, outcome)

    def note_part(self, first: int) -> None:
        """Do nothing: no task is a part."""


def _ignore(*_: object) -> None:
    """Do nothing."""
