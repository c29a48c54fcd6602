"""Plan a study: everything that can be wrong with it is found before a member runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from cosim.digests import sha256_of
from cosim.errors import UsageError, option
from cosim.scenario.parsing import Scenario
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.contracts import MemberOutcome, MetricValue, StudyMember, StudySubject
from cosim.studies.dataset.columns import (
    StudyColumn,
    metric_column,
    parameter_column,
    result_columns,
)
from cosim.studies.dataset.identity import StudyIdentity, digest_of
from cosim.studies.design.checking import check_design
from cosim.studies.design.planning import plan_design
from cosim.studies.design.study_design import StudyDesign
from cosim.studies.document.scenario_of_study import load_scenario
from cosim.studies.document.study_file import STUDY, StudyFile
from cosim.studies.members.inspector import CODE, DESIGNS, FILE, REFUSED
from cosim.studies.metrics.metrics import parse_metrics
from cosim.studies.running.inspection import inspect_members, inspected_members
from cosim.studies.running.recorded_study import RecordedStudy

RUNNER: Final = "cosim.studies.members.runner:open_runner"
RECORD: Final = "record"  # the table of a scenario, and the first word of its keys


@dataclass(frozen=True)
class StudyPlan:
    """A study that can run.

    Parameters
    ----------
    study : StudyFile
    scenario : Scenario
        As its file says, with the edits that all members have.
    design : StudyDesign
    sources : mapping of str to str
        SHA-256 of every file that members read, behind ``file``, and of the classes of users.
    designs : str
        As of StudySubject.
    trial : StudyMember
        One that can be built; its values need not be those of one member.
    replay_designs : tuple of (str, str)
        As of StudySubject.
    notices : tuple of str
        What is noteworthy: which members will fail.
    """

    study: StudyFile
    scenario: Scenario
    design: StudyDesign
    sources: Mapping[str, str]
    designs: str
    trial: StudyMember
    replay_designs: tuple[tuple[str, str], ...] = ()
    notices: tuple[str, ...] = ()

    @property
    def subject(self) -> StudySubject:
        """What all members have in common."""
        subject = self.study.subject
        return replace(subject, designs=self.designs, replay_designs=self.replay_designs)

    @property
    def files(self) -> dict[str, str]:
        """SHA-256 by absolute path of the files that members read, the scenario's among them."""
        files = {}
        scenario = Path(self.study.scenario)
        if scenario.is_file():
            files[str(scenario.resolve())] = sha256_of(scenario)
        for name, digest in self.sources.items():
            if name.startswith(FILE):
                files[name.removeprefix(FILE)] = digest
        return files

    def identity(self, results: Mapping[str, MetricValue]) -> StudyIdentity:
        """Return whose dataset it is.

        Parameters
        ----------
        results : mapping of name to value
            Of the result of a run, where those are kept beside the metrics.
        """
        recorded = RecordedStudy(self.study, StudyLayout.of(self.design))
        digests = {
            "the scenario": digest_of(_base(self.scenario, with_record=self.subject.with_results)),
            "the metrics": digest_of([dict(self.study.metrics), self.subject.with_results]),
        }
        if _is_edited_later(self.study):
            settings = self.study.settings
            edits = [_own_edits(self.subject), dict(settings.swap), dict(settings.map)]
            digests["what all members have"] = digest_of([*edits, settings.allow_code])
        folder = self.scenario.document.folder
        for name, digest in self.sources.items():
            digests[_source_label(name, folder)] = digest
        return StudyIdentity(
            self.study.name,
            recorded.to_text(),
            digests,
            self._columns(results),
            len(self.design),
            designs=self.designs,
            replay_designs=self.replay_designs,
        )

    def with_designs(self, identity: StudyIdentity) -> StudyPlan:
        """Return the plan with the designs that a dataset was begun with, wherever that was."""
        return replace(self, designs=identity.designs, replay_designs=identity.replay_designs)

    def _columns(self, results: Mapping[str, MetricValue]) -> tuple[StudyColumn, ...]:
        columns = []
        for name in self.design.names:
            columns.append(parameter_column(name, self.design.column(name)))
        for name, text in self.study.metrics.items():
            columns.append(metric_column(name, text))
        taken = [column.name for column in columns]
        return (*columns, *result_columns(results, taken))


def plan_study(study: StudyFile) -> StudyPlan:
    """Plan a study.

    Members are built for that: one of all, and one for each file or log that is varied. Where they
    run the code of others, that is done in another process.

    Raises
    ------
    CosimError
        If a parameter, a distribution, a metric, or a file is wrong.
    """
    parse_metrics(study.metrics)
    scenario = load_scenario(study.scenario)
    design = plan_design(study, scenario)
    _check_kept(study, design)
    return plan_members(study, scenario, design)


def plan_members(
    study: StudyFile,
    scenario: Scenario,
    design: StudyDesign,
    *,
    refused: Callable[[StudyMember, str], str] | None = None,
) -> StudyPlan:
    """Plan a study whose design and metrics are there.

    Parameters
    ----------
    study : StudyFile
    scenario : Scenario
        As its file says.
    design : StudyDesign
    refused : callable, optional
        Returns what to say of a member that cannot be built, given the reason; left out: its number
        and that.

    Raises
    ------
    CosimError
        If a parameter, a metric, or a file is wrong.
    """
    checked = check_design(design, scenario, allow_code=study.subject.allow_code)
    inspected = inspected_members(design, checked)
    sources = _swapped_files(inspected)
    designs: dict[str | None, str] = {}
    recordings = {member.number: member.recording for member in inspected}
    inspection = inspect_members(study, scenario, design, inspected)
    for outcome in inspection.outcomes:
        sources |= _sources_of(design.member(outcome.number), outcome, refused or _refused)
        text = sources.pop(DESIGNS, "")
        if text:
            designs[recordings[outcome.number]] = text
    of_scenario = designs.pop(None, "")
    of_replays = tuple((path, text) for path, text in designs.items() if path)
    settings = study.settings
    edited = scenario
    if not _is_edited_later(study):
        edited = scenario.edit(swap=settings.swap, map=dict(settings.map), set=settings.set)
    return StudyPlan(
        study,
        edited,
        design,
        sources,
        of_scenario,
        inspection.trial,
        of_replays,
        (*map(str, checked.refused), *inspection.notices),
    )


def _is_edited_later(study: StudyFile) -> bool:
    """Return whether the edits of all members need not fit the scenario, but a log or a case."""
    return study.settings.replay is not None or study.settings.cases is not None


def _check_kept(study: StudyFile, design: StudyDesign) -> None:
    """Check that the members whose logs are kept by number are there.

    Raises
    ------
    UsageError
        If one is not.
    """
    for number in study.kept_logs.numbers:
        if number >= len(design):
            raise UsageError(
                f"{option('keep')}: there is no member {number}; there are {len(design)}, "
                "numbered from 0"
            )


def _swapped_files(members: Iterable[StudyMember]) -> dict[str, str]:
    """Return the files that take the places of components, also where they cannot be loaded."""
    files = {}
    for member in members:
        for text in member.swap.values():
            path = Path(text)
            if not path.is_file():
                path = Path(text.rpartition("#")[0])
            files[f"{FILE}{path.resolve()}"] = sha256_of(path)
    return files


def _refused(member: StudyMember, reason: str) -> str:
    return f"member {member.number}: {reason}"


def _sources_of(
    member: StudyMember, outcome: MemberOutcome, refused: Callable[[StudyMember, str], str]
) -> dict[str, str]:
    """Return what a member is made of; what is lost with its process fails in its run, too.

    Raises
    ------
    UsageError
        If the member is refused.
    """
    if REFUSED in outcome.metrics:
        raise UsageError(refused(member, str(outcome.metrics[REFUSED])))
    return {name: str(digest) for name, digest in outcome.metrics.items()}


def _base(scenario: Scenario, *, with_record: bool) -> dict[str, Any]:
    """Return the tables of a scenario that outcomes rest on: results do on what is recorded."""
    others = {STUDY} if with_record else {STUDY, RECORD}
    return {name: table for name, table in scenario.tree.items() if name not in others}


def _own_edits(subject: StudySubject) -> dict[str, Any]:
    """Return the edits of all members that outcomes rest on."""
    if subject.with_results:
        return dict(subject.set)
    return {key: value for key, value in subject.set.items() if not key.startswith(f"{RECORD}.")}


def _source_label(name: str, folder: Path) -> str:
    """Return how a source is named in messages: files by their path from the scenario's folder."""
    if name.startswith(CODE):
        return name
    path = Path(name.removeprefix(FILE))
    kinds: Mapping[str, str] = {".fmu": "FMU", ".mcap": "log", ".csv": "table", ".parquet": "table"}
    kind = kinds.get(path.suffix.lower(), "file")
    return f"{kind} {path.relative_to(folder) if path.is_relative_to(folder) else path}"
