"""Tune a scenario: find the values of some keys that minimize or maximize a metric."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from cosim.arguments import path_argument, truth_argument, whole_argument
from cosim.errors import UsageError, option, quoted, warn
from cosim.studies.plan import RUNNER
from cosim.studies.running.local import MembersDone
from cosim.studies.studying import worker_count
from cosim.studies.tuning.cluster_trials import check_batches, cluster_trials
from cosim.studies.tuning.keys import read_space
from cosim.studies.tuning.members import RunTrials, TrialMembers, in_pool
from cosim.studies.tuning.planning import TuningPlan, plan_tuning
from cosim.studies.tuning.recorded import TuningDataset
from cosim.studies.tuning.result import TuningResult, with_residual
from cosim.studies.tuning.searching import TuningMethod, TuningSearch, search_best
from cosim.studies.tuning.standard_errors import moved_points
from cosim.studies.tuning.task import OBJECTIVE, TuningTask
from cosim.studies.tuning.whiteness import check_residual, residual_at
from cosim.studies.workers.pool import WorkerPool

if TYPE_CHECKING:
    from distributed import Client


def tune(
    scenario: str | Path,
    *,
    minimize: str | None = None,
    maximize: str | None = None,
    vary: Mapping[str, Any] | None = None,
    members: int = 200,
    method: str = "cobyqa",
    starts: int = 4,
    seed: int = 1,
    standard_errors: bool = False,
    samples: int | None = None,
    replay: str | Sequence[str] | None = None,
    allow_code: bool = False,
    out: str | Path | None = None,
    new: bool = False,
    workers: int | None = None,
    scheduler: str | Client | None = None,
    timeout: float | None = None,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, str | list[str]] | None = None,
    progress: MembersDone | None = None,
    notice: Callable[[str], None] | None = None,
) -> TuningResult:
    """Search the values of some keys with the best metric.

    Parameters
    ----------
    scenario : str or Path
        A scenario, the name of a shipped one, or a log, which every trial replays.
    minimize, maximize : str, optional
        The metric, such as ``"rms(observer.delta - delta.y)"``: one of these.
    vary : mapping of dotted key to table or list
        Bounds, ``{"log": [10.0, 1e4]}`` or ``{"linear": [0.0, 1.0]}``; with optuna also lists of
        values, and of paths for the key of a component, which is swapped.
    members : int
        Runs at most.
    method : {"cobyqa", "nelder-mead", "global", "optuna"}
        The first two search locally from several starts, ``global`` by differential evolution,
        ``optuna`` by models of what was good.
    starts : int
        Of a local search.
    seed : int
        Of starts and random points.
    standard_errors : bool
        Find those of values fitted by the rms of a residual, too.
    samples : int, optional
        Independent samples of the residual; left out: all that it has, fewer where their noise is
        colored.
    replay : str, optional
        A log that every trial replays.
    allow_code : bool
        As of :func:`cosim.replay`.
    out : str or Path, optional
        Folder of the dataset of all runs, or a URL of fsspec; what it has is not run again. Left
        out: nothing is kept.
    new : bool
        Begin the dataset that is there anew.
    workers : int, optional
        Processes at a time; left out: one a processor.
    scheduler : str or distributed.Client, optional
        Of a cluster of dask.distributed, such as ``"tcp://host:8786"``, for methods that try many
        members at a time. The first member runs on this machine.
    timeout : float, optional
        Wall time that a run may take [s].
    set, swap, map
        What all members have, as of :func:`cosim.run`.
    progress : callable, optional
        Called with how many members are done, of how many, and how many of these failed.
    notice : callable, optional
        Called with what is noteworthy about the run.

    Raises
    ------
    CosimError
        UsageError before a trial runs, and if the first one fails; DatasetError if ``out`` holds
        another dataset. What fails in a later trial is in the result.
    """
    search = TuningSearch(
        space=read_space(vary),
        objective=OBJECTIVE,
        maximize=maximize is not None,
        method=cast("TuningMethod", method),  # checked with the search
        members=_whole("members", members),
        starts=_whole("starts", starts),
        seed=_whole("seed", seed),
        with_errors=truth_argument("standard_errors", standard_errors),
        samples=whole_argument("samples", samples),
    )
    task = TuningTask(
        scenario=str(path_argument("scenario", scenario)),
        expression=_expression(minimize, maximize),
        search=search,
        set=set or {},
        swap=swap or {},
        map=map or {},
        replay=replay,
        allow_code=truth_argument("allow_code", allow_code),
        timeout=timeout,
    )
    return tune_task(
        task,
        out=out,
        new=new,
        workers=workers,
        scheduler=scheduler,
        progress=progress,
        notice=notice,
    )


def tune_task(
    task: TuningTask,
    *,
    out: str | Path | None = None,
    new: bool = False,
    workers: int | None = None,
    scheduler: str | Client | None = None,
    progress: MembersDone | None = None,
    notice: Callable[[str], None] | None = None,
) -> TuningResult:
    """Tune a scenario; parameters and errors as of :func:`tune`."""
    new = truth_argument("new", new)
    count = worker_count(workers)
    if scheduler is not None:
        check_batches(task.search.method)
    plan = plan_tuning(task)
    if notice is None:
        warn(plan.study.sources.warnings)
    else:
        for warning in plan.study.sources.warnings:
            notice(f"warning: {warning}")
    with ExitStack() as resources:
        dataset = resources.enter_context(closing(TuningDataset(out, plan.identity(), new=new)))
        plan = replace(plan, study=plan.study.with_designs(dataset.identity))
        pool = WorkerPool(RUNNER, plan.study.subject, count, timeout=task.timeout)
        run: RunTrials = in_pool(pool)
        if scheduler is not None:  # before the dataset that is there is removed
            run = resources.enter_context(cluster_trials(scheduler, plan, notice))
        resources.enter_context(pool)
        trials = TrialMembers(
            run,
            in_pool(pool),
            plan.member,
            dataset,
            members=plan.search.members,
            progress=progress,
        )
        result = search_best(trials, plan.search)
    warn(result.warnings)
    return _completed(plan, result)


def _completed(plan: TuningPlan, result: TuningResult) -> TuningResult:
    """Return a result with what follows from the best values."""
    result = replace(result, expression=plan.task.expression)
    if result.best is None:
        return result
    point = result.best.point
    result = replace(result, command=plan.command(point))
    if result.errors is None:
        return result
    points, units = moved_points(result.errors, plan.search.space, point)
    found = residual_at(
        plan.study.subject,
        OBJECTIVE,
        [plan.member(number, each) for number, each in enumerate([point, *points])],
        timeout=plan.task.timeout,
    )
    if found is None:
        return result
    residual, differences = found
    moves = None if differences is None else differences / units
    result = replace(result, residual=check_residual(residual))
    return with_residual(result, moves, samples=plan.search.samples)


def _expression(minimize: str | None, maximize: str | None) -> str:
    """Return the metric.

    Raises
    ------
    UsageError
        If there is none, or two, or it is no text.
    """
    if (minimize is None) == (maximize is None):
        found = "neither" if minimize is None else "both"
        names = f"{option('minimize')} and {option('maximize')}"
        raise UsageError(f"expected one of {names}, got {found}")
    name = "minimize" if maximize is None else "maximize"
    expression = minimize if maximize is None else maximize
    if not isinstance(expression, str):
        raise UsageError(
            f"{option(name)}: expected a metric, such as 'rms(observer.delta - delta.y)', got "
            f"{quoted(expression)}"
        )
    return expression


def _whole(name: str, value: object) -> int:
    number = whole_argument(name, value)
    if number is None:
        raise UsageError(f"{option(name)}: expected a whole number, got None")
    return number
