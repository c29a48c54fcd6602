"""Tune a scenario: search the values of some keys by members of a study."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from cosim.arguments import mapping_argument, path_argument, truth_argument, whole_argument
from cosim.digests import digest_of
from cosim.errors import UsageError, listing, option, quoted, warn
from cosim.files import file_type
from cosim.log.foreign.topics import is_foreign
from cosim.scenario.document.document import find
from cosim.scenario.document.edits import plain
from cosim.studies.cases import packed
from cosim.studies.contracts import COMPLETE, RECORDING, SWAP, MemberOutcome, StudyMember
from cosim.studies.dataset import StudyDataset
from cosim.studies.design import (
    StudyDesign,
    ValueColumn,
    edited_scenario,
    find_recordings,
    own_value,
)
from cosim.studies.identity import OF_METRICS, StudyIdentity
from cosim.studies.kept_logs import MembersDone
from cosim.studies.layout import StudyLayout
from cosim.studies.metrics import parse_metrics
from cosim.studies.plan import (
    RecordedSearch,
    RecordedStudy,
    StudyPlan,
    own_environment,
    plan_members,
    run_command,
    scenario_digest,
)
from cosim.studies.residual import check_residual, residual_at
from cosim.studies.search import (
    BATCHES,
    OBJECTIVE,
    SAMPLES,
    BoundedKey,
    ChoiceKey,
    Point,
    RunPoints,
    Search,
    SearchEnd,
    SearchEnded,
    SearchKey,
    SearchSpace,
    Trials,
    search_points,
)
from cosim.studies.standard_errors import (
    NoStandardErrors,
    StandardErrors,
    members_of_errors,
    moved_points,
)
from cosim.studies.standard_errors import standard_errors as errors_at
from cosim.studies.study_file import (
    STUDY,
    StudyFile,
    absolute,
    load_scenario,
    read_study,
    study_of,
    varied_key,
)
from cosim.studies.studying import executor_of, worker_count
from cosim.studies.tuning_result import TuningResult, converged_end, with_residual

if TYPE_CHECKING:
    from distributed import Client

_RECORDED: Final = ("expression", "maximize", "method", "members", "starts", "seed")


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
    expression = minimize if maximize is None else maximize
    if (minimize is not None and maximize is not None) or not isinstance(expression, str):
        names = f"{option('minimize')} and {option('maximize')}"
        found = f"got {quoted(minimize)} and {quoted(maximize)}"
        raise UsageError(f"{names}: expected a metric for one of them, {found}")
    search = Search(
        read_space(vary),
        expression,
        maximize=maximize is not None,
        method=method,
        members=whole_argument("members", members) or 0,
        starts=whole_argument("starts", starts) or 0,
        seed=whole_argument("seed", seed) or 0,
        is_rms=is_rms(expression),
        with_errors=truth_argument("standard_errors", standard_errors),
        samples=whole_argument("samples", samples),
    )
    new = truth_argument("new", new)
    count = worker_count(workers)
    if scheduler is not None and method not in BATCHES:
        one = f"the method {method!r} runs one member at a time"
        available = f"available with a cluster: {', '.join(BATCHES)}"
        raise UsageError(f"{option('scheduler')}: {one}; {available}")
    search.check()
    metrics = {OBJECTIVE: expression}
    if search.is_rms:
        metrics[SAMPLES] = f"count{expression.strip().removeprefix('rms')}"
    try:
        parse_metrics(metrics)
    except UsageError as error:
        raise UsageError(_of_objective(str(error), search)) from error
    study = _base(str(path_argument("scenario", scenario))).with_options(
        metrics=metrics,
        set=set,
        swap=swap,
        map=map,
        replay=replay,
        allow_code=truth_argument("allow_code", allow_code) or None,
        timeout=timeout,
    )
    plan = plan_tuning(study, search)
    warnings = plan.study.warnings
    if notice is None:
        warn(warnings)
        notice = _ignore
    for text in warnings:
        notice(f"warning: {text}")
    result = _searched(plan, out, count, scheduler, new=new, progress=progress, notice=notice)
    warn(result.warnings)
    return _completed(plan, result)


def _searched(
    plan: TuningPlan,
    out: str | Path | None,
    workers: int,
    scheduler: str | Client | None,
    *,
    new: bool,
    progress: MembersDone | None,
    notice: Callable[[str], None],
) -> TuningResult:
    """Run the members that the search asks for, and return what it found."""
    dataset: StudyDataset | None = None
    with ExitStack() as resources:
        if out is not None and StudyDataset.is_at(out) and not new:
            there = StudyDataset.open_or_create(out, plan.identity())
            dataset = resources.enter_context(there)
        local = executor_of(plan.study, workers, None, notice)
        executor = executor_of(plan.study, workers, scheduler, notice)
        for one in (local, executor):  # before the dataset that is there is removed
            resources.enter_context(one)

        def run(points: Mapping[int, Point]) -> Iterator[MemberOutcome]:
            nonlocal dataset
            members = [plan.member(number, point) for number, point in points.items()]
            where = local if 0 in points else executor
            for member, outcome in where.run(iter(members)):
                if member.number == 0 and outcome.status != COMPLETE:
                    fails = f"the first member fails, so nothing was tuned: {outcome.reason}"
                    expected = f"initial values with which it runs, such as by {option('set')}"
                    raise UsageError(f"{fails}\nexpected {expected}")
                if dataset is None and out is not None:
                    made = StudyDataset.open_or_create(out, plan.identity(), new=new)
                    dataset = resources.enter_context(made)
                if dataset is not None:
                    dataset.add(member, outcome)
                yield outcome

        recorded = () if dataset is None else _recorded(dataset)
        return search_best(run, plan.search, recorded=recorded, progress=progress)


def _recorded(dataset: StudyDataset) -> Iterator[tuple[Point, MemberOutcome]]:
    """Yield the points that a dataset has, with their outcomes."""
    metrics = [column.name for column in dataset.columns if column.role == "metric"]
    columns = [column for column in dataset.columns if column.role == "parameter"]
    keys = [column for column in columns if column.name != RECORDING]
    outcome = ("member", "status", "reason", "steps", "warnings")
    for row in dataset.read([*outcome, *metrics, *(key.name for key in keys)]).to_pylist():
        point = {key.name: key.value(row[key.name]) for key in keys}
        number, status, reason, steps, warnings = (row[name] for name in outcome)
        values = {name: row[name] for name in metrics}
        lines = (warnings or "").splitlines()
        yield point, MemberOutcome(number, status, reason or "", steps, values, warnings=lines)


def search_best(
    run: RunPoints,
    search: Search,
    *,
    recorded: Iterable[tuple[Point, MemberOutcome]] = (),
    progress: MembersDone | None = None,
) -> TuningResult:
    """Search the best point, and its standard errors; see :class:`Trials` for the parameters."""
    trials = Trials(run, search, recorded, progress)
    if search.with_errors:
        trials.members -= min(members_of_errors(len(search.space.keys)), search.members // 2)
    ends: list[SearchEnd] = []
    finished = False
    try:
        stop_reason = search_points(search, trials, ends)
        finished = True
    except SearchEnded as error:
        stop_reason = str(error)
    best_end = converged_end(search.space, trials.best, ends)
    trials.members = search.members
    errors = _errors(search, trials) if search.with_errors else (None, "")
    ended = (finished, stop_reason, tuple(ends), best_end)
    return TuningResult(search, trials.all, trials.best, *ended, *errors)


def _errors(search: Search, trials: Trials) -> tuple[StandardErrors | None, str]:
    """Return standard errors as if the rows were independent samples, or why there are none."""
    best = trials.best
    if best is None:
        return None, "no member has an objective"
    samples = best.samples if search.samples is None else search.samples
    try:
        return errors_at(search.space, trials, best.point, samples), ""
    except (NoStandardErrors, SearchEnded) as problem:
        return None, str(problem)


def _completed(plan: TuningPlan, result: TuningResult) -> TuningResult:
    """Return a result with its command, and with standard errors by the residual."""
    if result.best is None:
        return result
    point = result.best.point
    study = plan.study.study
    result = replace(result, command=run_command(plan.member(0, point), study))
    if result.errors is None:
        return result
    points, units = moved_points(result.errors, plan.search.space, point)
    members = [plan.member(number, each) for number, each in enumerate([point, *points])]
    found = residual_at(plan.study.subject, members, timeout=study.settings.timeout)
    if found is None:
        return result
    residual, differences = found
    moves = None if differences is None else differences / units
    return with_residual(result, check_residual(residual), moves)


# --- planning ---


@dataclass(frozen=True)
class TuningPlan:
    """A tuning that can run.

    Parameters
    ----------
    study : StudyPlan
        Its members are values of all keys that were checked, not those that will be tried.
    search : Search
    recording : str or None
        The log that every trial replays.
    """

    study: StudyPlan
    search: Search
    recording: str | None

    def member(self, number: int, point: Point) -> StudyMember:
        """Return the member that tries a point."""
        set_ = {key: value for key, value in point.items() if not key.startswith(SWAP)}
        swap = {key.removeprefix(SWAP): str(v) for key, v in point.items() if key not in set_}
        return StudyMember(number, set_, swap, self.recording)

    def identity(self) -> StudyIdentity:
        """Return whose dataset it is: that of the same search, however many members it may have."""
        search = self.search
        keys = search.space.keys
        planned = self.study.identity({})
        recorded = RecordedStudy(
            self.study.study,
            StudyLayout("cases", samples=search.members),
            own_environment(),
            RecordedSearch(
                OBJECTIVE,
                keys=[asdict(key) for key in keys],
                **{name: getattr(search, name) for name in _RECORDED},
            ),
            self.study.warnings,
        )
        chosen = {
            "the objective": search.expression,
            "whether it is minimized or maximized": search.maximize,
            "the method": search.method,
            "the starts": search.starts,
            "the seed": search.seed,
            "the order of the keys": [key.key for key in keys],
            **{f"the range of {key.key}": asdict(key) for key in keys},
        }
        digests = {name: digest for name, digest in planned.digests.items() if name != OF_METRICS}
        digests |= {name: digest_of(value) for name, value in chosen.items()}
        name = f"tuning of {self.study.scenario.name}"
        text = recorded.to_text()
        return replace(planned, name=name, text=text, digests=digests, members=search.members)


def plan_tuning(study: StudyFile, search: Search) -> TuningPlan:
    """Plan a tuning; the first trial is built, as is one with each file that may be swapped.

    Raises
    ------
    CosimError
        If the scenario, a key, a log or a number is wrong.
    """
    logs = find_recordings(study.settings.replay)
    if len(logs) > 1:
        found = f"got {len(logs)} ({listing(logs, 3)})"
        raise UsageError(
            f"{option('replay')}: expected one log, which every trial replays, {found}"
        )
    recording = logs[0] if logs else None
    files = scenario_digest(study.subject)
    scenario = load_scenario(study.scenario)
    if recording is None or is_foreign(Path(recording)):
        own = edited_scenario(study, scenario, {})
    else:
        own = load_scenario(recording)
    keys = search.space.keys
    set_ = study.settings.set
    values = {key.key: set_.get(key.key, own_value(own, key.key)) for key in keys}
    search = replace(search, first={k: value for k, value in values.items() if value is not None})
    for key in search.space.bounded:
        for value in (key.lower, key.upper):
            try:
                edited_scenario(study, scenario, {}, {key.key: value})
            except UsageError as error:
                text = str(error).removeprefix(f"{option('set', key.key)}: ")
                raise UsageError(f"{key.key} = {quoted(value)}: {text}") from error

    design = _checked_points(study, search, recording)
    try:
        planned = plan_members(study, scenario, design, files=files)
    except UsageError as error:
        raise UsageError(_of_objective(str(error), search)) from error
    return TuningPlan(planned, search, recording)


def plan_recorded(study: StudyFile, recorded: RecordedSearch) -> TuningPlan:
    """Plan a tuning that a dataset has again."""
    keys: list[SearchKey] = []
    for key in recorded.keys:
        is_list = "choices" in key
        keys.append(ChoiceKey(key["key"], tuple(key["choices"])) if is_list else BoundedKey(**key))
    options = {name: getattr(recorded, name) for name in _RECORDED}
    return plan_tuning(study, Search(SearchSpace(tuple(keys)), **options))


def _checked_points(study: StudyFile, search: Search, recording: str | None) -> StudyDesign:
    """Return the points that are built before any is tried: the first, and one with each choice."""
    lists: dict[str, list[Any]] = {} if recording is None else {RECORDING: [recording]}
    for key in search.space.keys:
        if isinstance(key, ChoiceKey):
            lists[key.key] = list(key.choices)
            continue
        middle = key.value(0.5)
        first = search.inside.get(key.key, middle)
        lists[key.key] = [first] if recording is None else [first, middle]
    count = max(map(len, lists.values()))
    repeated = {name: [v[n % len(v)] for n in range(count)] for name, v in lists.items()}
    columns = {name: ValueColumn(packed(values)) for name, values in repeated.items()}
    return StudyDesign(study, StudyLayout("cases", samples=count), columns)


def _of_objective(text: str, search: Search) -> str:
    """Return problems of the metrics as those of the objective, each once."""
    name = option("maximize" if search.maximize else "minimize")
    lines = [re.sub(r"\bmetrics\.\w+: ", f"{name}: ", line) for line in text.splitlines()]
    return "\n".join(dict.fromkeys(lines))


def _base(scenario: str) -> StudyFile:
    """Return the study of a scenario, without what its file says of one, or of a log."""
    if file_type(scenario) == "log":
        return read_study(scenario)
    source = find(scenario).source
    path = str(Path(source).absolute()) if Path(source).is_file() else source
    return study_of({STUDY: {"scenario": path}}, source, "tuning")


def is_rms(expression: str) -> bool:
    """Return whether a metric is the rms of one residual, and nothing else."""
    try:
        node = ast.parse(expression.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "rms"


def read_space(vary: object) -> SearchSpace:
    """Read ``vary`` of Python and the command line."""
    entries = mapping_argument("vary", vary)
    return SearchSpace(tuple(_read_key(key, value) for key, value in entries.items()))


def _read_key(key: str, value: Any) -> SearchKey:
    try:
        value = plain(value)
    except UsageError as error:
        raise UsageError(f"{option('vary', key)}: {error}") from error
    name = varied_key(key)
    is_table = isinstance(value, Mapping) and len(value) == 1
    match next(iter(value.items())) if is_table else ("values", value):
        case ("linear" | "log") as form, [int() | float() as lower, int() | float() as upper]:
            return BoundedKey(name, float(lower), float(upper), form == "log")
        case "values" | "choice", list() as values:
            paths = [absolute(path, Path.cwd()) for path in values]
            return ChoiceKey(name, tuple(paths if name.startswith(SWAP) else values))
    raise UsageError(
        f"{option('vary', key)}: expected bounds, such as {{'linear': [0.0, 1.0]}} or {{'log': "
        f"[10.0, 1e4]}}, or a list of values, got {quoted(value)}"
    )


def _ignore(_: str) -> None:
    """Do nothing."""
