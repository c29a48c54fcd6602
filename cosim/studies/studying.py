"""Run a study: ``cosim.study``, and what it will take."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from cosim.arguments import setting_arguments, truth_argument, whole_argument
from cosim.errors import UsageError, option, warn
from cosim.studies.contracts import COMPLETE, FAILED, MemberOutcome, MetricValue
from cosim.studies.dataset import StudyDataset
from cosim.studies.kept_logs import (
    MembersDone,
    check_kept_metric,
    keep_logs,
    kept_count,
    log_member,
)
from cosim.studies.plan import StudyPlan, plan_study
from cosim.studies.statistics import grouped, warning_lines
from cosim.studies.study import Study, open_study
from cosim.studies.study_file import StudyFile, StudyOptions, read_study
from cosim.studies.workers import LocalExecutor
from cosim.temporary import TemporaryFolder

if TYPE_CHECKING:
    from distributed import Client

    from cosim.studies.cluster import ClusterExecutor

    MemberExecutor: TypeAlias = LocalExecutor | ClusterExecutor

_TRIED: Final = 10  # members, until one is completed
_TIMED: Final = 3  # members: the first of a worker also opens what all have in common
_CHUNK: Final = 1000  # members that are planned at a time


def study(
    source: str | Path | StudyFile,
    *,
    out: str | Path | None = None,
    vary: Mapping[str, Any] | None = None,
    metrics: Mapping[str, str] | None = None,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, str | list[str]] | None = None,
    stop: float | None = None,
    replay: str | Sequence[str] | None = None,
    allow_code: bool | None = None,
    cases: str | Path | None = None,
    sampling: str | None = None,
    samples: int | None = None,
    seed: int | None = None,
    seeds: int | None = None,
    timeout: float | None = None,
    keep: str | Sequence[int] | None = None,
    results: bool | None = None,
    workers: int | None = None,
    scheduler: str | Client | None = None,
    new: bool = False,
    progress: MembersDone | None = None,
    keep_progress: MembersDone | None = None,
    notice: Callable[[str], None] | None = None,
) -> Study:
    """Run a study, or what is missing of it; return what its members came to.

    Parameters
    ----------
    source : str, Path or StudyFile
        A study file, a scenario, the name of a shipped one, a log to replay, or what
        ``read_study`` returned.
    out : str or Path, optional
        Folder of its dataset, or a URL of fsspec; left out: ``logs/<name>-study``.
    vary, metrics, set, swap, map, replay, allow_code, cases, sampling, samples, seed, seeds, \
timeout, keep, results : optional
        In addition to what the file says; see
        :class:`cosim.studies.study_file.StudyOptions`.
    stop : float, optional
        End of all members [s], as ``set={"scenario.stop": ...}``.
    workers : int, optional
        Processes at a time; left out: one a processor.
    scheduler : str or distributed.Client, optional
        Of a cluster of dask.distributed, such as ``"tcp://host:8786"``: members run there instead
        of on this machine.
    new : bool
        Remove the dataset that is there, and begin anew.
    progress : callable, optional
        Called with how many members are done, of how many, and how many of these failed.
    keep_progress : callable, optional
        Called with how many logs are kept, of how many, and how many cannot be.
    notice : callable, optional
        Called with what is noteworthy about the run.

    Raises
    ------
    CosimError
        UsageError before a member runs; DatasetError if ``out`` holds another study's dataset.
        What fails in a member is in its row.

    Warns
    -----
    CosimWarning
        How many members warn of what; without ``notice`` also what is noteworthy about the run.
    """
    given = locals()
    new = truth_argument("new", new)
    count = worker_count(workers)
    notice = notice or (lambda text: warn([text.removeprefix("warning: ")]))
    with ExitStack() as resources:
        given["set"] = resources.enter_context(setting_arguments(set, stop=stop))
        file = source if isinstance(source, StudyFile) else read_study(source)
        options = {each.name: given[each.name] for each in fields(StudyOptions)}
        file = file.with_options(StudyOptions(**options))
        place = default_place(file) if out is None else out
        plan = plan_study(file)
        for text in plan.notices:
            notice(text)
        executor = executor_of(plan, count, scheduler, notice)
        resources.enter_context(executor)  # before the dataset that is there is removed
        dataset = resources.enter_context(open_dataset(plan, place, new=new))
        chunks = (
            plan.design.members(begin, min(begin + _CHUNK, numbers.stop))
            for numbers in dataset.missing()
            for begin in numbers[::_CHUNK]
        )
        status = dataset.tables(["status"])
        failed = sum(table["status"].to_pylist().count(FAILED) for table in status)
        for member, outcome in executor.run(chain.from_iterable(chunks)):
            dataset.add(member, outcome)
            failed += outcome.status == FAILED
            if progress is not None:
                progress(len(dataset), len(plan.design), failed)
        keep_logs(plan, dataset, workers=count, notice=notice, progress=keep_progress)
    done = open_study(place)
    pairs = [(number, line) for number, lines in done.warnings.items() for line in lines]
    warn(warning_lines(grouped(pairs), len(done)))
    return done


def executor_of(
    plan: StudyPlan,
    workers: int,
    scheduler: str | Client | None,
    notice: Callable[[str], None],
) -> MemberExecutor:
    """Return what runs the members of a study: processes of this machine, or a cluster."""
    timeout = plan.study.settings.timeout
    if scheduler is None:
        return LocalExecutor(plan.subject, workers, timeout=timeout)
    from cosim.studies.cluster import ClusterExecutor

    return ClusterExecutor(
        scheduler, plan.subject, plan.trial, plan.files, timeout=timeout, notice=notice
    )


def worker_count(workers: int | None) -> int:
    """Return how many workers a study has; left out: one for each processor of this process."""
    count = whole_argument("workers", workers)
    if count is None:
        has_affinity = hasattr(os, "sched_getaffinity")
        return len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    if count < 1:
        raise UsageError(f"{option('workers')}: expected 1 or more, got {count}")
    return count


def default_place(file: StudyFile) -> Path:
    """Return where the dataset of a study is, unless it is said."""
    return Path("logs") / f"{file.name}-study"


def open_dataset(plan: StudyPlan, place: str | Path, *, new: bool) -> StudyDataset:
    """Open the dataset of a study for writing, or make it."""
    results: Mapping[str, MetricValue] = {}
    columns = None
    if plan.subject.with_results:  # their names are columns
        if new or not StudyDataset.is_at(place):
            results = _timed(plan, 1)[0].metrics
        else:
            columns = StudyDataset.open(place).columns
    identity = plan.identity(results)
    check_kept_metric(plan.study.settings.keep, columns or identity.columns)
    return StudyDataset.open_or_create(place, identity, planned=plan.design.column, new=new)


def check_place(plan: StudyPlan, place: str | Path | None) -> None:
    """Check the columns of a study, and that it goes on in a dataset that is there, if one is."""
    identity = plan.identity({})
    if place is not None and StudyDataset.is_at(place):
        StudyDataset.open(place).grown(identity, plan.design.column)


def _timed(plan: StudyPlan, count: int) -> list[MemberOutcome]:
    """Return the first outcomes that are complete, all of one worker.

    Raises
    ------
    UsageError
        If none of the first members is.
    """
    tried = plan.design.members(0, _TRIED)
    complete: list[MemberOutcome] = []
    reasons = []
    with LocalExecutor(plan.subject, 1, timeout=plan.study.settings.timeout) as executor:
        for member, outcome in executor.run(tried):
            if outcome.status == COMPLETE:
                complete.append(outcome)
            else:
                reasons.append(f"member {member.number}: {outcome.reason}")
            if len(complete) == count:
                break
    if not complete:
        raise UsageError(
            f"none of the first {len(tried)} members completed, so that neither the others can be "
            f"timed nor the names of their results be known: {'; '.join(reasons)}"
        )
    return complete


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
        If none of the first members is completed.
    """
    outcomes = _timed(plan, _TIMED)
    total = len(plan.design)
    first, last = outcomes[0].wall_time, outcomes[-1]
    member = plan.design.member(last.number)
    log_bytes = kept_count(plan.study.settings.keep, total)
    log_time = 0.0
    if log_bytes:
        with TemporaryFolder("estimate") as folder, LocalExecutor(plan.subject, 1) as executor:
            ((_, logged),) = executor.run([member], partial(log_member, folder))
            log_time = -(-log_bytes // workers) * logged.wall_time
            log_bytes *= sum(path.stat().st_size for path in folder.glob("*.mcap"))
    texts = (last.status, last.reason, "\n".join(last.warnings), last.worker)
    values = (*member.set.values(), *member.swap.values(), *last.metrics.values(), *texts)
    row_bytes = 4 * 8  # of number, steps, wall time, other results
    for value in values:
        row_bytes += len(value.encode()) if isinstance(value, str) and value else 8 * np.size(value)
    each = -(-total // workers)
    return StudyEstimate(
        total,
        workers,
        first,
        last.wall_time,
        first + (each - 1) * last.wall_time + log_time,
        dataset_bytes=total * row_bytes,
        log_bytes=log_bytes,
    )
