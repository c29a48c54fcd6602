"""Plan a tuning: everything that can be wrong with it is found before a trial runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

from cosim.digests import digest_of
from cosim.errors import UsageError, listing, option, quoted
from cosim.log.foreign.topics import is_foreign
from cosim.scenario.parsing import Scenario
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.contracts import RECORDING, SWAP, StudyMember
from cosim.studies.dataset.columns import metric_column, parameter_column
from cosim.studies.dataset.identity import OF_METRICS, StudyIdentity
from cosim.studies.design.columns import DesignColumn, MemberLayout, SampleColumn
from cosim.studies.design.commands import run_command
from cosim.studies.design.own_values import own_value
from cosim.studies.design.planning import edited_scenario
from cosim.studies.design.recordings import find_recordings
from cosim.studies.design.study_design import StudyDesign
from cosim.studies.document.scenario_of_study import load_scenario
from cosim.studies.document.study_file import StudyFile
from cosim.studies.metrics import parse_metrics
from cosim.studies.running.plan import StudyPlan, plan_members
from cosim.studies.running.recorded_study import (
    RecordedSearch,
    RecordedStudy,
    own_environment,
)
from cosim.studies.running.sources import scenario_digest
from cosim.studies.tuning.searching import TuningMethod, TuningSearch, check_search
from cosim.studies.tuning.space import BoundedKey, ChoiceKey, SearchSpace, key_of
from cosim.studies.tuning.task import OBJECTIVE, TuningTask, is_rms


@dataclass(frozen=True)
class TuningPlan:
    """A tuning that can run.

    Parameters
    ----------
    task : TuningTask
    study : StudyPlan
        Its members are values of all keys that were checked, not those that will be tried.
    search : TuningSearch
        With what was not known before: objective, first values.
    recording : str or None
        The log that every trial replays.
    """

    task: TuningTask
    study: StudyPlan
    search: TuningSearch
    recording: str | None

    def member(self, number: int, point: Mapping[str, Any]) -> StudyMember:
        """Return the member that tries a point."""
        changes = {key: value for key, value in point.items() if not key.startswith(SWAP)}
        swaps = {
            key.removeprefix(SWAP): str(value)
            for key, value in point.items()
            if key.startswith(SWAP)
        }
        return StudyMember(number, changes, swaps, self.recording)

    def command(self, point: Mapping[str, Any]) -> str:
        """Return the line for a shell that runs a point alone, bit for bit."""
        return run_command(self.member(0, point), self.study.study)

    def identity(self) -> StudyIdentity:
        """Return whose dataset it is: that of the same search, however many members it may have."""
        search = self.search
        keys = search.space.keys
        planned = self.study.identity({})
        digests = {name: digest for name, digest in planned.digests.items() if name != OF_METRICS}
        digests["the objective"] = digest_of(self.task.expression)
        digests |= _search_digests(search)
        columns = [] if self.recording is None else [parameter_column(RECORDING, [self.recording])]
        columns += [parameter_column(key.key, _typical(key)) for key in keys]
        columns += [metric_column(name, text) for name, text in self.task.metrics.items()]
        return StudyIdentity(
            name=f"tuning of {self.study.scenario.name}",
            text=self._recorded().to_text(),
            digests=digests,
            columns=tuple(columns),
            members=search.members,
            designs=planned.designs,
            replay_designs=planned.replay_designs,
        )

    def _recorded(self) -> RecordedStudy:
        """Return what the dataset says of the tuning; its members are cases."""
        search = self.search
        chosen_by = RecordedSearch(
            OBJECTIVE,
            self.task.expression,
            maximize=search.maximize,
            method=search.method,
            members=search.members,
            starts=search.starts,
            seed=search.seed,
            keys=[asdict(key) for key in search.space.keys],
        )
        layout = StudyLayout("cases", samples=search.members)
        warnings = self.study.sources.warnings
        return RecordedStudy(
            self.study.study, layout, own_environment(), search=chosen_by, warnings=warnings
        )


def plan_tuning(task: TuningTask) -> TuningPlan:
    """Plan a tuning; the first trial is built, as is one with each file that may be swapped.

    Raises
    ------
    CosimError
        If the scenario, a key, the metric, a log or a number is wrong.
    """
    check_search(replace(task.search, is_rms=is_rms(task.expression)))
    name = option("maximize" if task.search.maximize else "minimize")
    try:
        parse_metrics(task.metrics)
    except UsageError as error:
        raise UsageError(_of_objective(str(error), name)) from error
    study = task.study()
    recording = _recording(study)
    search = replace(
        task.search,
        objective=OBJECTIVE,
        first=_own_values(task.search.space, study, recording),
        is_rms=is_rms(task.expression),
    )
    design = _checked_points(study, search, recording)

    def refused(member: StudyMember, reason: str) -> str:
        swaps = [f"{SWAP}{key} = {quoted(path)}: " for key, path in member.swap.items()]
        return f"{''.join(swaps)}{_of_objective(reason, name)}"

    files = scenario_digest(study.subject)
    scenario = load_scenario(study.scenario)
    _check_bounds(search.space, study, scenario)
    planned = plan_members(study, scenario, design, files=files, refused=refused)
    return TuningPlan(task, planned, search, recording)


def plan_recorded(study: StudyFile, search: RecordedSearch) -> TuningPlan:
    """Plan a tuning as its dataset records it; errors as of :func:`plan_tuning`."""
    settings = study.settings
    again = TuningSearch(
        SearchSpace(tuple(map(key_of, search.keys))),
        search.metric,
        maximize=search.maximize,
        method=cast("TuningMethod", search.method),
        members=search.members,
        starts=search.starts,
        seed=search.seed,
    )
    task = TuningTask(
        study.scenario,
        search.expression,
        again,
        set=settings.set,
        swap=settings.swap,
        map=settings.map,
        replay=settings.replay,
        allow_code=bool(settings.allow_code),
        timeout=settings.timeout,
    )
    return plan_tuning(task)


def _of_objective(text: str, name: str) -> str:
    """Return what is wrong with the metrics by the option that they follow from, each once."""
    lines = []
    for line in text.splitlines():
        begin, _, rest = line.partition(": ")
        lines.append(f"{name}: {rest}" if begin.startswith("metrics.") else line)
    return "\n".join(dict.fromkeys(lines))


def _recording(study: StudyFile) -> str | None:
    """Return the log that every trial replays; None: the scenario is run.

    Raises
    ------
    UsageError
        If there are several.
    """
    found = find_recordings(study.settings.replay)
    if len(found) > 1:
        raise UsageError(
            f"{option('replay')}: expected one log, which every trial replays, got {len(found)} "
            f"({listing(found, 3)})"
        )
    return found[0] if found else None


def _own_values(space: SearchSpace, study: StudyFile, recording: str | None) -> dict[str, Any]:
    """Return the values that the scenario has, or the run that was recorded, where it has one."""
    if recording is None or is_foreign(Path(recording)):
        own = edited_scenario(study, load_scenario(study.scenario), {})
    else:
        own = load_scenario(recording)
    set_ = study.settings.set
    values = {key.key: set_.get(key.key, own_value(own, key.key)) for key in space.keys}
    return {key: value for key, value in values.items() if value is not None}


def _check_bounds(space: SearchSpace, study: StudyFile, scenario: Scenario) -> None:
    """Check that the tables of a scenario take the bounds.

    They need not run there: a trial that fails is none of the best.

    Raises
    ------
    UsageError
        If they do not.
    """
    for key in space.bounded:
        for value in (key.lower, key.upper):
            try:
                edited_scenario(study, scenario, {}, {key.key: value})
            except UsageError as error:
                text = str(error).removeprefix(f"{option('set', key.key)}: ")
                raise UsageError(f"{key.key} = {quoted(value)}: {text}") from error


def _search_digests(search: TuningSearch) -> dict[str, str]:
    """Return the SHA-256 of what a search rests on, by names for messages."""
    keys = search.space.keys
    digests = {
        "whether it is minimized or maximized": digest_of(search.maximize),
        "the method": digest_of(search.method),
        "the starts": digest_of(search.starts),
        "the seed": digest_of(search.seed),
        "the order of the keys": digest_of([key.key for key in keys]),
    }
    for key in keys:
        digests[f"the range of {key.key}"] = digest_of(asdict(key))
    return digests


def _checked_points(study: StudyFile, search: TuningSearch, recording: str | None) -> StudyDesign:
    """Return a design that has the first point, and the values of every list."""
    is_replay = recording is not None
    lists = [_built(key, search, is_replay=is_replay) for key in search.space.keys]
    count = max(map(len, lists))
    columns: dict[str, DesignColumn] = {}
    if recording is not None:
        columns[RECORDING] = SampleColumn([recording] * count)
    for key, values in zip(search.space.keys, lists, strict=True):
        repeated = [values[number % len(values)] for number in range(count)]
        columns[key.key] = SampleColumn(repeated)
    layout = MemberLayout(samples=count)
    return StudyDesign(study, "cases", layout, columns)


def _built(key: BoundedKey | ChoiceKey, search: TuningSearch, *, is_replay: bool) -> list[Any]:
    """Return the values of a key that are built."""
    if isinstance(key, ChoiceKey):
        return list(key.choices)
    middle = key.value(0.5)
    first = search.inside().get(key.key, middle)
    # a replay refuses what is recorded only where it changes
    return [first, middle] if is_replay else [first]


def _typical(key: BoundedKey | ChoiceKey) -> list[Any]:
    """Return values of a key that tell the type of its column."""
    return [key.lower] if isinstance(key, BoundedKey) else list(key.choices)
