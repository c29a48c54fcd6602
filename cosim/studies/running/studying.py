"""Run a study: what is missing of it, into its dataset."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from cosim.arguments import truth_argument, whole_argument
from cosim.errors import UsageError, option, warn
from cosim.studies.cluster.cluster_run import run_on_cluster
from cosim.studies.cluster.connection import connect
from cosim.studies.contracts import COMPLETE, MetricValue
from cosim.studies.dataset.study import Study, open_study
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.document.reading import read_study
from cosim.studies.document.study_file import StudyFile
from cosim.studies.running.keeping import keep_logs
from cosim.studies.running.kept_members import check_kept_metric
from cosim.studies.running.local import MembersDone, default_workers, run_locally
from cosim.studies.running.plan import RUNNER, StudyPlan, plan_study
from cosim.studies.statistics import grouped, warning_lines
from cosim.studies.workers.pool import WorkerPool

if TYPE_CHECKING:
    from distributed import Client

MOST_TRIED: Final = 10  # members, until one is completed that shows what a result says


def study(
    source: str | Path | StudyFile,
    *,
    out: str | Path | None = None,
    vary: Mapping[str, Any] | None = None,
    metrics: Mapping[str, str] | None = None,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, str | list[str]] | None = None,
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
        :meth:`cosim.studies.document.study_file.StudyFile.with_options`.
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
    new = truth_argument("new", new)
    count = worker_count(workers)
    file = source if isinstance(source, StudyFile) else read_study(source)
    file = file.with_options(
        vary=vary,
        metrics=metrics,
        set=set,
        swap=swap,
        map=map,
        replay=replay,
        allow_code=allow_code,
        cases=cases,
        sampling=sampling,
        samples=samples,
        seed=seed,
        seeds=seeds,
        timeout=timeout,
        keep=keep,
        results=results,
    )
    place = default_place(file) if out is None else out
    plan = plan_study(file)
    if notice is None:
        warn(text.removeprefix("warning: ") for text in plan.notices)
        notice = _ignore
    else:
        for text in plan.notices:
            notice(text)
    with ExitStack() as resources:
        # before the dataset that is there is removed
        client = None if scheduler is None else resources.enter_context(connect(scheduler))
        dataset = resources.enter_context(open_dataset(plan, place, new=new))
        plan = plan.with_designs(dataset.identity)
        if client is None:
            run_locally(plan, dataset, workers=count, progress=progress)
        else:
            run_on_cluster(
                client,
                plan.subject,
                plan.design,
                dataset,
                str(place),
                files=plan.files,
                timeout=file.settings.timeout,
                progress=progress,
                notice=notice,
                trial=plan.trial,
            )
        keep_logs(
            plan,
            dataset,
            workers=count,
            notice=notice,
            progress=keep_progress,
            client=client,
        )
    done = open_study(place)
    pairs = [(number, line) for number, lines in done.warnings.items() for line in lines]
    warn(warning_lines(grouped(pairs), len(done)))
    return done


def worker_count(workers: int | None) -> int:
    """Return how many workers a study has; left out: one for each processor of this process.

    Raises
    ------
    UsageError
        If it is no whole number from 1 on.
    """
    count = whole_argument("workers", workers)
    if count is None:
        return default_workers()
    if count < 1:
        raise UsageError(f"{option('workers')}: expected 1 or more, got {count}")
    return count


def default_place(file: StudyFile) -> Path:
    """Return where the dataset of a study is, unless it is said."""
    return Path("logs") / f"{file.name}-study"


def open_dataset(plan: StudyPlan, place: str | Path, *, new: bool) -> StudyDataset:
    """Open the dataset of a study for writing, or make it.

    Raises
    ------
    DatasetError
        If there is another study's.
    UsageError
        If logs are kept by a metric that is no number.
    """
    results: Mapping[str, MetricValue] = {}
    if plan.subject.with_results and (new or not StudyDataset.is_at(place)):
        results = _example_results(plan)
    identity = plan.identity(results)
    is_known = bool(results) or not plan.subject.with_results
    columns = identity.columns if is_known else StudyDataset.open(place).columns
    check_kept_metric(plan.study.kept_logs, columns)
    return StudyDataset.open_or_create(place, identity, design=plan.design, new=new)


def check_place(plan: StudyPlan, place: str | Path) -> None:
    """Check that a study goes on in the dataset that is there, if there is one; change nothing.

    Raises
    ------
    DatasetError
        If it is another study's, or damaged.
    """
    if StudyDataset.is_at(place):
        StudyDataset.check(place, plan.identity({}), design=plan.design)


def _example_results(plan: StudyPlan) -> Mapping[str, MetricValue]:
    """Return the results of the first member that is completed: their names are columns.

    Raises
    ------
    UsageError
        If none of the first is.
    """
    tried = plan.design.members(0, MOST_TRIED)
    reasons = []
    with WorkerPool(RUNNER, plan.subject, 1, timeout=plan.study.settings.timeout) as pool:
        for _, outcome in pool.run(tried):
            if outcome.status == COMPLETE:
                return outcome.metrics
            reasons.append(f"member {outcome.number}: {outcome.reason}")
    raise UsageError(
        f"none of the first {len(tried)} members completed, so the names of the results are "
        f"unknown; expected {option('metrics')}, or members that run: {'; '.join(reasons)}"
    )


def _ignore(_: str) -> None:
    """Do nothing."""
