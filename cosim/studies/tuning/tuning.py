"""Tune a scenario: find the values of some keys that minimize or maximize a metric."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from cosim.errors import UsageError, option, quoted
from cosim.scenario.parsing import Scenario
from cosim.scenario.preparing import build_experiment
from cosim.scenario.recordings.records import recorded_channels
from cosim.scenario.running.execution import load
from cosim.studies.contracts import StudySubject
from cosim.studies.dataset.columns import metric_column, parameter_column
from cosim.studies.dataset.identity import StudyIdentity, digest_of
from cosim.studies.dataset.study_dataset import StudyDataset
from cosim.studies.design.checking import is_own_code
from cosim.studies.design.own_values import own_value
from cosim.studies.metrics.metrics import parse_metrics
from cosim.studies.running.local import MembersDone, default_workers
from cosim.studies.running.plan import RUNNER
from cosim.studies.running.recorded_study import searched_text
from cosim.studies.tuning.digests import scenario_digests
from cosim.studies.tuning.members import TrialMembers, member_of
from cosim.studies.tuning.result import TuningResult
from cosim.studies.tuning.searching import TuningSearch, check_search, search_best
from cosim.studies.tuning.space import BoundedKey, SearchSpace
from cosim.studies.tuning.trials import SAMPLES
from cosim.studies.tuning.whiteness import residual_correlation
from cosim.studies.workers.pool import WorkerPool

OBJECTIVE: Final = "objective"  # the name of its column


@dataclass(frozen=True, slots=True)
class TuningTask:
    """What is to be tuned.

    Parameters
    ----------
    scenario : str
        Path, or name of a shipped scenario.
    expression : str
        The metric.
    search : TuningSearch
        Its objective, first values and whether it is an rms are found here.
    set, swap, map
        The edits that all members have, as of :func:`cosim.run`.
    """

    scenario: str
    expression: str
    search: TuningSearch
    set: Mapping[str, Any] = field(default_factory=dict)
    swap: Mapping[str, str] = field(default_factory=dict)
    map: Mapping[str, Any] = field(default_factory=dict)

    @property
    def metrics(self) -> dict[str, str]:
        """The metrics of a member: the objective; of an rms the number of samples, too."""
        if not is_rms(self.expression):
            return {OBJECTIVE: self.expression}
        counted = self.expression.strip().removeprefix("rms")
        return {OBJECTIVE: self.expression, SAMPLES: f"count{counted}"}

    @property
    def subject(self) -> StudySubject:
        """What all members have in common."""
        return StudySubject(self.scenario, self.set, self.swap, self.map, self.metrics)


def is_rms(expression: str) -> bool:
    """Return whether a metric is the rms of one expression, with nothing around it."""
    try:
        node = ast.parse(expression.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False
    is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    return is_call and node.func.id == "rms"  # type: ignore[attr-defined]


def tune_task(
    task: TuningTask,
    *,
    out: str | Path | None = None,
    new: bool = False,
    workers: int | None = None,
    timeout: float | None = None,
    progress: MembersDone | None = None,
) -> TuningResult:
    """Tune a scenario.

    Parameters
    ----------
    task : TuningTask
    out : str or Path, optional
        Folder or URL of the dataset of all members; what it has is not run again. Without it
        nothing is kept.
    new : bool
        Remove the dataset that is there first.
    workers : int, optional
        At a time; without it as many as there are processors.
    timeout : float, optional
        Wall time that a member may take [s], as of :class:`WorkerPool`.
    progress : callable, optional
        Called with how many members are done, of how many, and how many of these failed.

    Raises
    ------
    UsageError
        If the scenario, a key, the metric or a number is wrong, or the first member fails.
    DatasetError
        If the dataset is that of another study, or damaged.
    RunError
        If workers cannot be started.
    """
    scenario = load(task.scenario).edit(swap=task.swap, map=task.map, set=task.set)
    search = _completed(task, scenario)
    check_search(search)
    _check_metrics(task, scenario)
    count = default_workers() if workers is None else workers
    with ExitStack() as resources:
        dataset = None
        if out is not None:
            identity = _identity(task, search, scenario)
            dataset = resources.enter_context(StudyDataset.open_or_create(out, identity, new=new))
        pool = WorkerPool(RUNNER, task.subject, count, timeout=timeout)
        resources.enter_context(pool)
        result = search_best(TrialMembers(pool, dataset, search.members, progress), search)
    if result.errors is None or result.best is None:
        return result
    neighbours = residual_correlation(task.subject, OBJECTIVE, result.best.point)
    return replace(result, neighbours=neighbours)


def _completed(task: TuningTask, scenario: Scenario) -> TuningSearch:
    """Return the search with the values that the scenario has."""
    first = {}
    for key in task.search.space.keys:
        value = own_value(scenario, key.key)
        if value is not None and not isinstance(value, bool):
            first[key.key] = value
    return replace(task.search, objective=OBJECTIVE, first=first, is_rms=is_rms(task.expression))


def _check_metrics(task: TuningTask, scenario: Scenario) -> None:
    """Check the metric, and the keys, as far as it can be known without the code of others.

    Raises
    ------
    UsageError
        If the metric has an error or no signal of the run, or there is no such key.
    """
    metrics = parse_metrics(task.metrics)
    for key in task.search.space.keys:
        values = (key.lower, key.upper) if isinstance(key, BoundedKey) else key.choices
        for value in values:
            member = member_of(0, {key.key: value})
            try:
                edited = scenario.edit(set=member.set, swap=member.swap)
            except UsageError as error:
                raise UsageError(f"{key.key} = {quoted(value)}: {error}") from error
    if is_own_code(edited):
        with ExitStack() as resources:
            experiment = build_experiment(edited, resources, None)
            try:
                metrics.check(recorded_channels(experiment))
            except UsageError as error:
                name = "maximize" if task.search.maximize else "minimize"
                raise UsageError(f"{option(name)}: {error}") from error


def _identity(task: TuningTask, search: TuningSearch, scenario: Scenario) -> StudyIdentity:
    """Return whose dataset it is: that of the same search, however many members it may have."""
    space = search.space
    choices = [choice for key in space.choices for choice in key.choices]
    asked = [
        [asdict(key) for key in space.keys],
        search.method,
        search.maximize,
        search.starts,
        search.seed,
    ]
    digests = scenario_digests(scenario, choices)
    digests["the objective"] = digest_of(task.expression)
    digests["the search (its keys, bounds, method, starts and seed)"] = digest_of(asked)
    columns = [parameter_column(name, values) for name, values in _values(space).items()]
    columns += [metric_column(name, text) for name, text in task.metrics.items()]
    return StudyIdentity(
        name=f"tuning of {scenario.name}",
        text=_description(task),
        digests=digests,
        columns=tuple(columns),
        members=search.members,
    )


def _description(task: TuningTask) -> str:
    """Return the study of the dataset, as its readers know it: every member is a case."""
    study = {
        "name": "tuning",
        "scenario": task.scenario,
        "set": dict(task.set),
        "swap": dict(task.swap),
        "map": dict(task.map),
    }
    tables = {"study": study, "metrics": task.metrics}
    return searched_text(tables, task.search.members)


def _values(space: SearchSpace) -> dict[str, list[Any]]:
    """Return values of every key that tell the type of its column."""
    return {
        key.key: [float(key.lower)] if isinstance(key, BoundedKey) else list(key.choices)
        for key in space.keys
    }
