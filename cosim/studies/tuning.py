"""Tune a scenario: search the values of some keys by members of a study."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.arguments import (
    mapping_argument,
    path_argument,
    setting_arguments,
    truth_argument,
    whole_argument,
)
from cosim.digests import digest_of
from cosim.errors import UsageError, listing, option, quoted, warn
from cosim.files import file_type
from cosim.log.foreign.topics import is_foreign
from cosim.scenario.document.document import find, plain
from cosim.studies.cases import packed
from cosim.studies.contracts import COMPLETE, RECORDING, SWAP, MemberOutcome, StudyMember, member_of
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
    RecordedStudy,
    StudyPlan,
    own_environment,
    plan_members,
    run_command,
    scenario_digest,
)
from cosim.studies.residual import residual_at
from cosim.studies.search import (
    BATCHES,
    OBJECTIVE,
    SAMPLES,
    BoundedKey,
    ChoiceKey,
    Point,
    RunPoints,
    Search,
    SearchKey,
)
from cosim.studies.standard_errors import moved_points
from cosim.studies.study import Study
from cosim.studies.study_file import (
    STUDY,
    StudyFile,
    StudyOptions,
    absolute,
    load_scenario,
    read_study,
    study_of,
    varied_key,
)
from cosim.studies.studying import executor_of, worker_count
from cosim.studies.tuning_result import TuningResult, search_best, with_residual

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
    stop: float | None = None,
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
    set, swap, map, stop
        What all members have, as of :func:`cosim.run`.
    progress : callable, optional
        Called with how many members are done, of how many, and how many of these failed.
    notice : callable, optional
        Called with what is noteworthy about the run; left out: warnings say it.

    Raises
    ------
    CosimError
        UsageError before a trial runs, and if the first one fails; DatasetError if ``out`` holds
        another dataset. What fails in a later trial is in the result.
    """
    expression = minimize if maximize is None else maximize
    if (minimize is not None and maximize is not None) or not isinstance(expression, str):
        names = f"{option('minimize')} and {option('maximize')}"
        given = [quoted(one) for one in (minimize, maximize) if one is not None]
        found = " and ".join(given) or "neither"
        raise UsageError(f"{names}: expected a metric for one of them, got {found}")
    keys = tuple(_read_key(key, each) for key, each in mapping_argument("vary", vary).items())
    search = Search(
        OBJECTIVE,
        expression,
        maximize=maximize is not None,
        method=method,
        members=whole_argument("members", members) or 0,
        starts=whole_argument("starts", starts) or 0,
        seed=whole_argument("seed", seed) or 0,
        keys=keys,
    )
    with_errors = truth_argument("standard_errors", standard_errors)
    samples = whole_argument("samples", samples)
    new = truth_argument("new", new)
    count = worker_count(workers)
    if scheduler is not None and method not in BATCHES:
        one = f"the method {method!r} runs one member at a time"
        available = f"available with a cluster: {', '.join(BATCHES)}"
        raise UsageError(f"{option('scheduler')}: {one}; {available}")
    search.check(with_errors=with_errors, samples=samples)
    metrics = {OBJECTIVE: expression}
    if search.is_rms:
        metrics[SAMPLES] = f"count{expression.strip().removeprefix('rms')}"
    with _objective_named(search):
        parse_metrics(metrics)
    with setting_arguments(set, stop=stop) as changes:
        options = StudyOptions(
            metrics=metrics,
            set=changes,
            swap=swap,
            map=map,
            replay=replay,
            allow_code=truth_argument("allow_code", allow_code) or None,
            timeout=timeout,
        )
        study = _base(str(path_argument("scenario", scenario))).with_options(options)
        plan = plan_tuning(study, search)
    notice = notice or (lambda text: warn([text.removeprefix("warning: ")]))
    for text in plan.study.warnings:
        notice(f"warning: {text}")
    with _members(plan, out, new, count, scheduler, notice) as (run, recorded):
        result = search_best(
            run,
            search,
            plan.first,
            with_errors=with_errors,
            samples=samples,
            recorded=recorded,
            progress=progress,
        )
    warn(result.warnings)
    best = result.best
    if best is None:
        return result
    result = replace(result, command=run_command(plan.member(0, best.point), study))
    if result.errors is None:
        return result
    points, units = moved_points(result.errors, search, best.point)
    chosen = [plan.member(number, point) for number, point in enumerate([best.point, *points])]
    residual, moves = residual_at(plan.study.subject, chosen, timeout=study.settings.timeout)
    return with_residual(result, residual, None if moves is None else moves / units, samples)


@contextmanager
def _members(
    plan: TuningPlan,
    out: str | Path | None,
    new: bool,
    workers: int,
    scheduler: str | Client | None,
    notice: Callable[[str], None],
) -> Iterator[tuple[RunPoints, list[tuple[Point, MemberOutcome]]]]:
    """Give what runs members, and records them, and those that are recorded."""
    dataset: StudyDataset | None = None
    with ExitStack() as resources:
        if out is not None and StudyDataset.is_at(out) and not new:
            there = StudyDataset.open_or_create(out, plan.identity())
            dataset = resources.enter_context(there)
        # before the dataset that is there is removed
        local = executor = executor_of(plan.study, workers, None, notice)
        resources.enter_context(local)
        if scheduler is not None:
            executor = executor_of(plan.study, workers, scheduler, notice)
            resources.enter_context(executor)

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

        yield run, [] if dataset is None else _recorded(Study(dataset))


def _recorded(study: Study) -> list[tuple[Point, MemberOutcome]]:
    """Return the points that a dataset has, with their outcomes."""
    found: list[tuple[Point, MemberOutcome]] = []
    rows = study.table(
        ["member", "status", "reason", "steps", "warnings", *study.metrics]
    ).to_pylist()
    for row, member in zip(rows, study.members([row["member"] for row in rows]), strict=True):
        swaps = {f"{SWAP}{name}": path for name, path in member.swap.items()}
        outcome = MemberOutcome(
            member.number,
            row["status"],
            row["reason"] or "",
            row["steps"],
            {name: row[name] for name in study.metrics},
            warnings=(row["warnings"] or "").splitlines(),
        )
        found.append(({**member.set, **swaps}, outcome))
    return found


# --- planning ---


@dataclass(frozen=True)
class TuningPlan:
    """A tuning that can run.

    Parameters
    ----------
    study : StudyPlan
        Its members are values of all keys that were checked, not those that will be tried.
    search : Search
    first : mapping of key to value
        Of the scenario; left out: it cannot be tried.
    recording : str or None
        The log that every trial replays.
    """

    study: StudyPlan
    search: Search
    first: Point
    recording: str | None

    def member(self, number: int, point: Point) -> StudyMember:
        """Return the member that tries a point."""
        return member_of(number, {**point, RECORDING: self.recording})

    def identity(self) -> StudyIdentity:
        """Return whose dataset it is: that of the same search, however many members it may have."""
        search = self.search
        planned = self.study.identity({})
        layout = StudyLayout("cases", samples=search.members)
        recorded = RecordedStudy(
            self.study.study, layout, own_environment(), search, self.study.warnings
        )
        chosen = {
            "the objective": search.expression,
            "whether it is minimized or maximized": search.maximize,
            "the method": search.method,
            "the starts": search.starts,
            "the seed": search.seed,
            "the order of the keys": [key.key for key in search.keys],
            **{f"the range of {key.key}": asdict(key) for key in search.keys},
        }
        digests = {name: digest for name, digest in planned.digests.items() if name != OF_METRICS}
        digests |= {name: digest_of(value) for name, value in chosen.items()}
        return replace(
            planned,
            name=f"tuning of {self.study.scenario.name}",
            text=recorded.to_text(),
            digests=digests,
            members=search.members,
        )


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
        expected = "expected one log, which every trial replays"
        raise UsageError(f"{option('replay')}: {expected}, {found}")
    recording = logs[0] if logs else None
    files = scenario_digest(study.subject)
    scenario = load_scenario(study.scenario)
    if recording is None or is_foreign(Path(recording)):
        own = edited_scenario(study, scenario, {})
    else:
        own = load_scenario(recording)
    first: dict[str, Any] = {}
    columns = {} if recording is None else {RECORDING: ValueColumn(packed([recording]))}
    count = max([1 if recording is None else 2, *(len(key.choices) for key in search.choices)])
    for key in search.keys:  # what is built: the first values, and one with each choice
        value = study.settings.set.get(key.key, own_value(own, key.key))
        if key.has(value):
            first[key.key] = float(value) if isinstance(key, BoundedKey) else value
        if isinstance(key, ChoiceKey):
            columns[key.key] = ValueColumn(packed(key.choices))
            continue
        for bound in (key.lower, key.upper):
            try:
                edited_scenario(study, scenario, {}, {key.key: bound})
            except UsageError as error:
                text = str(error).removeprefix(f"{option('set', key.key)}: ")
                raise UsageError(f"{key.key} = {quoted(bound)}: {text}") from error
        middle = key.value(0.5)
        tried = [first.get(key.key, middle), middle]
        columns[key.key] = ValueColumn(packed(tried[: 1 if recording is None else 2]))
    design = StudyDesign(study, StudyLayout("cases", samples=count), columns)
    with _objective_named(search):
        planned = plan_members(study, scenario, design, files=files)
    return TuningPlan(planned, search, first, recording)


@contextmanager
def _objective_named(search: Search) -> Iterator[None]:
    """Raise problems of the metrics as those of the objective, each once."""
    try:
        yield
    except UsageError as error:
        name = option("maximize" if search.maximize else "minimize")
        lines = [re.sub(r"\bmetrics\.\w+: ", f"{name}: ", line) for line in str(error).splitlines()]
        raise UsageError("\n".join(dict.fromkeys(lines))) from error


def _base(scenario: str) -> StudyFile:
    """Return the study of a scenario, without what its file says of one, or of a log."""
    if file_type(scenario) == "log":
        return read_study(scenario)
    source = find(scenario).source
    path = str(Path(source).absolute()) if Path(source).is_file() else source
    return study_of({STUDY: {"scenario": path}}, source, "tuning")


def _read_key(key: str, value: Any) -> SearchKey:
    """Read an entry of ``vary`` of Python and the command line."""
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
