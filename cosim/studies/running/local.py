"""Run the missing members of a study in worker processes of this machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from typing import Final, TypeAlias

from cosim.studies.contracts import FAILED, StudyMember
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.running.plan import RUNNER, StudyPlan
from cosim.studies.workers.pool import WorkerPool

# called with how many members are done, of how many, and how many of these failed
MembersDone: TypeAlias = Callable[[int, int, int], None]

_CHUNK: Final = 1000  # members that are planned at a time


def default_workers() -> int:
    """Return how many workers a study has: one for each processor that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_locally(
    plan: StudyPlan,
    dataset: StudyDataset,
    *,
    workers: int,
    progress: MembersDone | None = None,
) -> None:
    """Run what a dataset is missing; each outcome is recorded as it comes.

    Parameters
    ----------
    plan : StudyPlan
    dataset : StudyDataset
    workers : int
    progress : callable, optional
    """
    missing = dataset.missing()
    left = sum(map(len, missing))
    total = len(plan.design)
    if not left:
        return
    failed = dataset.failed
    timeout = plan.study.settings.timeout
    with WorkerPool(RUNNER, plan.subject, min(workers, left), timeout=timeout) as pool:
        for member, outcome in pool.run(_members(plan, missing)):
            dataset.add(member, outcome)
            left -= 1
            failed += outcome.status == FAILED
            if progress is not None:
                progress(total - left, total, failed)


def _members(plan: StudyPlan, missing: Sequence[range]) -> Iterator[StudyMember]:
    """Yield missing members, planned as they are taken."""
    for numbers in missing:
        for begin in range(numbers.start, numbers.stop, _CHUNK):
            yield from plan.design.members(begin, min(begin + _CHUNK, numbers.stop))
