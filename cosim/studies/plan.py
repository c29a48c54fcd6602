"""Plan a study: what its members are made of, what belongs to its dataset, and how that is read."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import InstanceOf, TypeAdapter

from cosim.digests import digest_of, sha256_of, source_digest
from cosim.errors import RunError, UsageError, listing, option
from cosim.files import file_type
from cosim.log.files import part_paths
from cosim.log.foreign.topics import is_foreign
from cosim.log.metadata import environment, read_json
from cosim.scenario.document.document import parse_value
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.recordings.replaying import texts_in
from cosim.studies.checking import Inspected, check_design
from cosim.studies.contracts import MemberOutcome, MetricValue, StudyMember, StudySubject
from cosim.studies.design import StudyDesign, plan_design
from cosim.studies.identity import (
    OF_METRICS,
    StudyIdentity,
    metric_column,
    parameter_column,
    result_columns,
    scenario_digests,
)
from cosim.studies.layout import StudyLayout, count_text
from cosim.studies.members import MemberSources
from cosim.studies.metrics import parse_metrics
from cosim.studies.search import Search
from cosim.studies.study import Study
from cosim.studies.study_file import STUDY, StudyFile, load_scenario, study_of
from cosim.version import __version__

RECORD: Final = "record"  # the table of a scenario, and the first word of its keys


@dataclass(frozen=True)
class StudyPlan:
    """A study that can be run.

    Parameters
    ----------
    study : StudyFile
    scenario : Scenario
        As all members have it.
    design : StudyDesign
    sources : MemberSources
        Of all members. Files are under their paths as they are named, and under their real ones.
    warnings : tuple of str
        What could not be found out of them.
    trial : StudyMember
        One that can be built.
    notices : tuple of str
        What is noteworthy before it runs.
    """

    study: StudyFile
    scenario: Scenario
    design: StudyDesign
    sources: MemberSources
    warnings: tuple[str, ...]
    trial: StudyMember
    notices: tuple[str, ...] = ()

    @property
    def subject(self) -> StudySubject:
        """What all members have in common; they are checked to read just these files."""
        sources = self.sources
        digests = {**sources.files, **sources.modules, **sources.codes}
        return replace(self.study.subject, digests=digests)

    @property
    def files(self) -> dict[str, str]:
        """The files that another machine needs, with their SHA-256."""
        folder = os.path.realpath(self.scenario.document.folder)
        modules = self.sources.modules.items()
        own = {path: digest for path, digest in modules if Path(path).is_relative_to(folder)}
        return {**self.sources.files, **own}

    def identity(self, results: Mapping[str, MetricValue]) -> StudyIdentity:
        """Return whose dataset it is; the names of the results of a member are columns."""
        study, subject = self.study, self.study.subject
        with_results = subject.with_results
        others = {STUDY} if with_results else {STUDY, RECORD}  # metrics are of all signals
        tree = {name: table for name, table in self.scenario.tree.items() if name not in others}
        digests = scenario_digests(tree)
        digests[OF_METRICS] = digest_of([dict(study.metrics), with_results])
        if study.may_replay:
            own = "" if with_results else f"{RECORD}."
            edits = {k: v for k, v in subject.set.items() if not own or not k.startswith(own)}
            common = [edits, dict(subject.swap), dict(subject.map), study.settings.allow_code]
            digests["what all members have"] = digest_of(common)
        columns = [parameter_column(n, self.design.column(n)) for n in self.design.columns]
        columns += [metric_column(name, text) for name, text in study.metrics.items()]
        columns += result_columns(results, [column.name for column in columns])
        layout = self.design.layout
        text = RecordedStudy(study, layout, own_environment(), warnings=self.warnings).to_text()
        digests |= self._file_digests()
        return StudyIdentity(study.name, text, digests, tuple(columns), len(self.design))

    def _file_digests(self) -> dict[str, str]:
        """Return the SHA-256 of everything but the scenario, by names for messages."""
        scenario, folder = self.study.scenario, self.scenario.document.folder
        own = "" if file_type(scenario) == "log" else os.path.realpath(scenario)
        found = {}
        for path, digest in self.sources.files.items():
            real = Path(os.path.realpath(path))
            if str(real) != own:
                kinds = {".fmu": "FMU", ".mcap": "log", ".csv": "table", ".parquet": "table"}
                kind = kinds.get(real.suffix.lower(), "file")
                place = real.relative_to(folder) if real.is_relative_to(folder) else real
                found[f"{kind} {place}"] = digest
        return {**found, **self.sources.codes}


def plan_study(study: StudyFile) -> StudyPlan:
    """Plan a study.

    Raises
    ------
    UsageError
        If something is wrong with it that can be known before a member runs.
    """
    parse_metrics(study.metrics)
    files = scenario_digest(study.subject)
    scenario = load_scenario(study.scenario)
    design = plan_design(study, scenario)
    last = max(study.settings.keep.numbers, default=0)
    if last >= len(design):
        text = f"no member {last}; the study has {len(design)}, numbered from 0"
        raise UsageError(f"{option('keep')}: {text}")
    return plan_members(study, scenario, design, files=files)


def plan_members(
    study: StudyFile, scenario: Scenario, design: StudyDesign, *, files: Mapping[str, str]
) -> StudyPlan:
    """Plan the members of a design.

    Parameters
    ----------
    study : StudyFile
    scenario : Scenario
        As it is without edits.
    design : StudyDesign
    files : mapping of path to SHA-256
        The scenario, as it was before it was read.

    Raises
    ------
    UsageError
        If a member cannot be built, or has not the signals of the metrics.
    """
    settings, subject = study.settings, study.subject
    texts = design.texts() | texts_in([dict(subject.set), dict(subject.swap)])
    if settings.replay is None:
        for tree in (scenario.tree, scenario.document.unswapped().tables().tree):
            texts |= texts_in({name: table for name, table in tree.items() if name != STUDY})
    named = _named_files(texts, scenario.document.folder)
    checked = check_design(design, scenario)
    sources, warnings = _sources({**named, **files}, checked.found)
    edited = scenario
    if not study.may_replay:
        edited = scenario.edit(swap=settings.swap, map=dict(settings.map), set=settings.set)
    told = [f"warning: {text}" for text in warnings]
    notices = (*checked.notices, *_empty_cells(design), *told)
    return StudyPlan(study, edited, design, sources, warnings, checked.trial, notices)


def _empty_cells(design: StudyDesign) -> list[str]:
    """Return a notice where a table of cases has empty cells."""
    columns = [column.values.tolist() for column in design.cases.values()]
    is_empty = np.array([[value is None for value in values] for values in columns])
    if not is_empty.any():
        return []
    text = (
        f"file {design.study.settings.cases!r}: {count_text(int(is_empty.sum()), 'empty cell')}, "
        "where members have the scenario's own value"
    )
    rows = [str(row + 1) for row in np.flatnonzero(is_empty.all(axis=0))]
    if rows:
        text += f"; all empty {'is row' if len(rows) == 1 else 'are rows'} {listing(rows, 5)}"
    return [text]


# --- files ---


def scenario_digest(subject: StudySubject) -> dict[str, str]:
    """Return the SHA-256 of the file of a scenario, before it is read."""
    path = subject.scenario
    if not os.path.isfile(path):
        return {}
    return dict.fromkeys((path, os.path.realpath(path)), sha256_of(path))


def _named_files(texts: Iterable[str], folder: Path) -> dict[str, str]:
    """Return the SHA-256 of the files that texts may name, under the paths that are opened."""
    files: dict[str, str] = {}
    for text in {*texts, *(text.rpartition("#")[0] for text in texts if "#" in text)}:
        path = os.path.join(folder, text)
        parts = map(str, part_paths(Path(path))) if file_type(path) == "log" else [path]
        for part in filter(os.path.isfile, parts):
            real = os.path.realpath(part)
            try:
                files[part] = files[real] = files.get(real) or sha256_of(part)
            except OSError as error:
                raise UsageError(
                    f"{part}: cannot be read ({error.strerror or error}); expected a readable file"
                ) from error
    return files


def _sources(
    files: Mapping[str, str], found: Iterable[tuple[int, Inspected]]
) -> tuple[MemberSources, tuple[str, ...]]:
    """Return what members are made of, all in all, and what could not be found out."""
    known = dict(files)
    modules: dict[str, str] = {}
    codes: dict[str, str] = {}
    lost: dict[str, list[str]] = {}
    for number, one in found:
        if isinstance(one, MemberOutcome):
            lost.setdefault(one.reason, []).append(str(number))
            continue
        modules |= one.modules
        codes |= one.codes
        for path, digest in one.files.items():
            if known.setdefault(path, digest) != digest:
                raise RunError(f"{path} has changed while the study was being planned; run again")
    warnings = [
        f"member{'s' if len(numbers) > 1 else ''} {listing(numbers, 5)} could not be built when "
        f"the study was planned: {reason}; the files that are named are known, but not whether "
        "more are read, and the metrics were not checked"
        for reason, numbers in lost.items()
    ]
    return MemberSources("", known, modules, codes), tuple(warnings)


# --- what a dataset says of its study ---


def own_environment() -> dict[str, str]:
    """Return versions and processor, as they are here."""
    return {**environment(), "source of cosim": source_digest()}


@dataclass(frozen=True)
class RecordedStudy:
    """A study as its dataset has it: what was planned, where, and what was not known."""

    study: InstanceOf[StudyFile]
    layout: StudyLayout
    environment: Mapping[str, str]
    search: Search | None = None
    warnings: tuple[str, ...] = ()

    def to_text(self) -> str:
        """Return it as JSON."""
        described = asdict(self) | {"tables": self.study.to_dict(), "source": self.study.source}
        del described["study"]
        return json.dumps(described, ensure_ascii=False)

    @classmethod
    def read(cls, text: str) -> RecordedStudy:
        """Read what :meth:`to_text` wrote.

        Raises
        ------
        UsageError
            If another version wrote it.
        """
        try:
            described = read_json(text)
            study = study_of(described.pop("tables"), str(described.pop("source")))
            return TypeAdapter(cls).validate_python({**described, "study": study})
        except (UsageError, ValueError, KeyError, TypeError, AttributeError) as error:
            problem = f"{type(error).__name__}: {error}".replace("\n", " ")
            raise UsageError(
                "the description of the study in the dataset cannot be read by cosim "
                f"{__version__} ({problem}); read it with the version that wrote it, or start the "
                "study over"
            ) from error

    def command_of(self, dataset: Study) -> Callable[[int], str]:
        """Return what gives the command that runs a member alone."""
        return lambda number: run_command(dataset.member(number), self.study)


def run_command(member: StudyMember, study: StudyFile) -> str:
    """Return the command that runs a member alone, with the same bits."""
    settings = study.settings
    words = ["cosim", "run", study.scenario]
    if member.recording is not None:
        words = ["cosim", "replay", member.recording]
        if is_foreign(Path(member.recording)):
            words += ["--scenario", study.scenario]
    for name, path in {**settings.swap, **member.swap}.items():
        words += ["--swap", f"{name}={path}"]
    for port, names in settings.map.items():
        text = names if isinstance(names, str) else f"[{','.join(names)}]"
        words += ["--map", f"{port}={text}"]
    for key, value in {**settings.set, **member.set}.items():
        is_plain = isinstance(value, str) and value and value == value.strip()
        is_plain = is_plain and parse_value(value) == value
        words += ["--set", f"{key}={value if is_plain else toml_text(value)}"]
    if settings.allow_code and member.recording is not None:
        words.append("--allow-code")
    return shlex.join(words)


def toml_text(value: Any) -> str:
    """Return a value as TOML has it, in one line."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case Mapping():
            entries = [f"{toml_text(key)} = {toml_text(item)}" for key, item in value.items()]
            return f"{{{', '.join(entries)}}}"
        case list() | tuple():
            return f"[{', '.join(map(toml_text, value))}]"
    return repr(value)
