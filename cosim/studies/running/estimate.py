"""What a study will take, from members that are timed: ``cosim study --dry-run``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from cosim.errors import UsageError
from cosim.studies.contracts import FAILED, MemberOutcome, MetricValue
from cosim.studies.dataset.columns import RowMaker, all_columns
from cosim.studies.running.keeping import LOGGING_RUNNER
from cosim.studies.running.kept_members import kept_count
from cosim.studies.running.plan import RUNNER, StudyPlan
from cosim.studies.workers.pool import WorkerPool
from cosim.temporary import TemporaryFolder

TIMED: Final = 3  # members: the first of a worker also builds what all have in common
MOST_TIMED: Final = 10  # members, where some of them fail
_NUMBER_BYTES: Final = 8


@dataclass(frozen=True)
class StudyEstimate:
    """What a study will take.

    Parameters
    ----------
    members : int
    workers : int
    first_time, member_time : float
        Wall time of the first member of a worker, and of the one that was timed after it [s].
    study_time : float
        Of all members, and of the second runs of those whose logs are kept, on these workers [s].
    dataset_bytes : int
        About, without the heads of its parts, and before compression.
    log_bytes : int or None
        Of the logs that are kept, each as large as that of one that was timed; None: how many
        members fail is not known.
    """

    members: int
    workers: int
    first_time: float
    member_time: float
    study_time: float
    dataset_bytes: int
    log_bytes: int | None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


def estimate_study(plan: StudyPlan, workers: int) -> StudyEstimate:
    """Run a few members of a study, record nothing, and return what all will take.

    Raises
    ------
    UsageError
        If all of them fail.
    """
    outcomes = _timed(plan)
    total = len(plan.design)
    first = outcomes[0].wall_time
    other = outcomes[-1].wall_time
    each = -(-total // workers)
    log_bytes, log_time = _kept_logs(plan, outcomes[-1].number, workers)
    return StudyEstimate(
        total,
        workers,
        first,
        other,
        first + (each - 1) * other + log_time,
        dataset_bytes=total * _row_bytes(plan, outcomes[-1]),
        log_bytes=log_bytes,
    )


def _timed(plan: StudyPlan) -> list[MemberOutcome]:
    """Run members until some are completed."""
    members = plan.design.members(0, MOST_TIMED)
    completed: list[MemberOutcome] = []
    failed: list[MemberOutcome] = []
    with WorkerPool(RUNNER, plan.subject, 1, timeout=plan.study.settings.timeout) as pool:
        for _, outcome in pool.run(members):
            (failed if outcome.status == FAILED else completed).append(outcome)
            if len(completed) == TIMED:
                break
    if not completed:
        which = (
            "the only member" if len(failed) == 1 else f"each of the first {len(failed)} members"
        )
        raise UsageError(
            f"{which} failed, so the others cannot be timed; member {failed[0].number}: "
            f"{failed[0].reason}"
        )
    return completed


def _row_bytes(plan: StudyPlan, outcome: MemberOutcome) -> int:
    """Return how many bytes the row of a member has, before compression."""
    results: Mapping[str, MetricValue] = outcome.metrics if plan.subject.with_results else {}
    columns = all_columns(plan.identity(results).columns)
    row = RowMaker(columns).row(plan.design.member(outcome.number), outcome)
    return sum(map(_value_bytes, row))


def _value_bytes(value: Any) -> int:
    if isinstance(value, str):
        return len(value.encode())
    if isinstance(value, list | tuple):
        return _NUMBER_BYTES * len(value)
    return _NUMBER_BYTES


def _kept_logs(plan: StudyPlan, number: int, workers: int) -> tuple[int | None, float]:
    """Return how large the kept logs are, and how long they take to make [s], by one member.

    None: how many are kept is not known.
    """
    count = kept_count(plan.study.kept_logs, len(plan.design))
    if not count:
        return count, 0.0
    with TemporaryFolder("estimate") as folder:
        subject = replace(plan.subject, logs=str(folder))
        # without the timeout of the study: the end of a log may take longer than a run
        with WorkerPool(LOGGING_RUNNER, subject, 1) as pool:
            ((_, outcome),) = pool.run([plan.design.member(number)])
        size = sum(path.stat().st_size for path in folder.glob("*.mcap"))
        return count * size, -(-count // workers) * outcome.wall_time
