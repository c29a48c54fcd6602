"""Plan a study: everything that can be wrong with it is found before a member runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cosim.digests import digest_of
from cosim.errors import UsageError, listing, option
from cosim.scenario.parsing import Scenario
from cosim.scenario.recordings.replaying import texts_in
from cosim.studies.analysis.columns import count_text
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.contracts import MetricValue, StudyMember, StudySubject
from cosim.studies.dataset.columns import (
    StudyColumn,
    metric_column,
    parameter_column,
    result_columns,
)
from cosim.studies.dataset.identity import OF_METRICS, StudyIdentity, scenario_digests
from cosim.studies.design.checking import check_design
from cosim.studies.design.columns import SampleColumn, plain_values
from cosim.studies.design.planning import plan_design
from cosim.studies.design.study_design import StudyDesign
from cosim.studies.document.scenario_of_study import load_scenario
from cosim.studies.document.study_file import STUDY, StudyFile
from cosim.studies.members.sources import common_texts
from cosim.studies.metrics import parse_metrics
from cosim.studies.running.inspection import inspect_members, inspected_members
from cosim.studies.running.recorded_study import RecordedStudy, own_environment
from cosim.studies.running.sources import (
    StudySources,
    found_sources,
    named_files,
    scenario_digest,
)

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
    sources : StudySources
    trial : StudyMember
        One that can be built; its values need not be those of one member.
    notices : tuple of str
        What is noteworthy: which members will fail.
    """

    study: StudyFile
    scenario: Scenario
    design: StudyDesign
    sources: StudySources
    trial: StudyMember
    notices: tuple[str, ...] = ()

    @property
    def subject(self) -> StudySubject:
        """What all members have in common."""
        return self.sources.given_to(self.study.subject)

    @property
    def files(self) -> dict[str, str]:
        """SHA-256 by absolute path of the files that members read, the scenario's among them."""
        return self.sources.movable(self.scenario.document.folder)

    def identity(self, results: Mapping[str, MetricValue]) -> StudyIdentity:
        """Return whose dataset it is.

        Parameters
        ----------
        results : mapping of name to value
            Of the result of a run, where those are kept beside the metrics.
        """
        layout = StudyLayout.of(self.design)
        recorded = RecordedStudy(
            self.study, layout, own_environment(), warnings=self.sources.warnings
        )
        digests = {
            **scenario_digests(_base(self.scenario, with_record=self.subject.with_results)),
            OF_METRICS: digest_of([dict(self.study.metrics), self.subject.with_results]),
        }
        if _is_edited_later(self.study):
            settings = self.study.settings
            edits = [_own_edits(self.subject), dict(settings.swap), dict(settings.map)]
            digests["what all members have"] = digest_of([*edits, settings.allow_code])
        folder = self.scenario.document.folder
        digests |= self.sources.digests(self.study.scenario, folder)
        return StudyIdentity(
            self.study.name,
            recorded.to_text(),
            digests,
            self._columns(results),
            len(self.design),
            designs=self.sources.designs,
            replay_designs=self.sources.replay_designs,
        )

    def with_designs(self, identity: StudyIdentity) -> StudyPlan:
        """Return the plan with the designs that a dataset was begun with, wherever that was."""
        sources = replace(
            self.sources, designs=identity.designs, replay_designs=identity.replay_designs
        )
        return replace(self, sources=sources)

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
    files = scenario_digest(study.subject)
    scenario = load_scenario(study.scenario)
    design = plan_design(study, scenario)
    _check_kept(study, design)
    return plan_members(study, scenario, design, files=files)


def plan_members(
    study: StudyFile,
    scenario: Scenario,
    design: StudyDesign,
    *,
    files: Mapping[str, str],
    refused: Callable[[StudyMember, str], str] | None = None,
) -> StudyPlan:
    """Plan a study whose design and metrics are there.

    Parameters
    ----------
    study : StudyFile
    scenario : Scenario
        As its file says.
    design : StudyDesign
    files : mapping of path to SHA-256
        That of the scenario, from before it was read.
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
    named = named_files(_texts(design, scenario), scenario.document.folder)
    inspection = inspect_members(study, scenario, design, inspected)
    members = {member.number: member for member in inspected}
    sources = found_sources(
        {**named, **files}, inspection.outcomes, members, refused=refused or _refused
    )
    warnings = [f"warning: {text}" for text in sources.warnings]
    settings = study.settings
    edited = scenario
    if not _is_edited_later(study):
        edited = scenario.edit(swap=settings.swap, map=dict(settings.map), set=settings.set)
    return StudyPlan(
        study,
        edited,
        design,
        sources,
        inspection.trial,
        (*map(str, checked.refused), *_empty_cells(design), *inspection.notices, *warnings),
    )


def _empty_cells(design: StudyDesign) -> list[str]:
    """Notice the empty cells of a table of cases."""
    columns = [c.values for c in design.columns.values() if isinstance(c, SampleColumn)]
    if design.kind != "cases" or all(isinstance(values, np.ndarray) for values in columns):
        return []
    rows = list(zip(*map(plain_values, columns), strict=True))
    count = sum(value is None for row in rows for value in row)
    if not count:
        return []
    empty = [number for number, row in enumerate(rows, 1) if all(value is None for value in row)]
    text = (
        f"file {str(design.study.settings.cases)!r}: {count_text(count, 'empty cell')}, where "
        "members have the scenario's own value"
    )
    if empty:
        are = "is row" if len(empty) == 1 else "are rows"
        text += f"; all empty {are} {listing(list(map(str, empty)), 5)}"
    return [text]


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
                f"{option('keep')}: no member {number}; the study has {len(design)}, numbered "
                "from 0"
            )


def _texts(design: StudyDesign, scenario: Scenario) -> set[str]:
    """Return the texts that may name what members read.

    A replay takes from its log what the scenario names.
    """
    subject = design.study.subject
    edits = texts_in([dict(subject.set), dict(subject.swap)])
    is_replay = design.study.settings.replay is not None
    common = set() if is_replay else common_texts(scenario, subject)
    return design.texts() | edits | common


def _refused(member: StudyMember, reason: str) -> str:
    return f"member {member.number}: {reason}"


def _base(scenario: Scenario, *, with_record: bool) -> dict[str, Any]:
    """Return the tables of a scenario that outcomes rest on: results do on what is recorded."""
    others = {STUDY} if with_record else {STUDY, RECORD}
    return {name: table for name, table in scenario.tree.items() if name not in others}


def _own_edits(subject: StudySubject) -> dict[str, Any]:
    """Return the edits of all members that outcomes rest on."""
    if subject.with_results:
        return dict(subject.set)
    return {key: value for key, value in subject.set.items() if not key.startswith(f"{RECORD}.")}
