"""A study as users write it: a file, or a scenario or a log with options; read, with its scenario.

Keys of [vary] may be dotted (``"plant.x_a0[0]"``), or tables (``[vary.plant]``); inside, all are
dotted. Paths are absolute inside: those of a file are taken from its folder, those of options from
the working folder.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

from pydantic import Field, PlainValidator, ValidationError

from cosim.arguments import mapping_argument, swap_argument
from cosim.errors import UsageError, nearest, option, quoted
from cosim.files import expanded, file_type
from cosim.log.foreign.topics import is_foreign
from cosim.log.reader import open_log
from cosim.scenario.building.build import read
from cosim.scenario.document.document import (
    Document,
    find,
    plain,
    shipped,
    short,
)
from cosim.scenario.document.places import Key, Problem, report
from cosim.scenario.document.problems import TableProblems, problems_of
from cosim.scenario.document.schema import (
    COMPONENTS,
    LARGEST_SEED,
    Flag,
    Number,
    TomlTable,
    Whole,
)
from cosim.scenario.document.schema import Name as NameOfStudy
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.recordings.recorded_scenario import recorded_document
from cosim.scenario.running.execution import load
from cosim.studies.contracts import SWAP, StudySubject
from cosim.studies.variations import (
    FORMS,
    GridVariation,
    SampledVariation,
    Variation,
    read_variation,
)

STUDY: Final = "study"
VARY: Final = "vary"
METRICS: Final = "metrics"
_BY_KEY: Final = ("set", "swap", "map", VARY, METRICS)
SamplingMethod: TypeAlias = Literal["random", "latin-hypercube", "sobol", "saltelli"]
_Drawn: TypeAlias = Annotated[Whole, Field(ge=1, le=10_000_000)]


@dataclass(frozen=True, slots=True)
class KeptLogs:
    """Which members' logs are kept: ``count`` by a metric, or those of some ``numbers``."""

    which: Literal["none", "failed", "all", "worst", "best", "numbers"] = "none"
    count: int = 0
    metric: str = ""
    numbers: tuple[int, ...] = ()


def read_keep(value: object) -> KeptLogs:
    """Read which logs are kept: a text, a list of numbers, or None.

    Raises
    ------
    ValueError
        If it says something else.
    """
    match value.strip().split(maxsplit=3) if isinstance(value, str) else ():
        case ["failed" | "all" as which]:
            return KeptLogs(which)
        case ["worst" | "best" as which, count, "of", metric] if re.fullmatch(
            "[1-9][0-9]{0,6}", count
        ):
            return KeptLogs(which, int(count), metric)
    if value is None:
        return KeptLogs()
    if isinstance(value, list | tuple) and value and all(type(n) is int and n >= 0 for n in value):
        return KeptLogs("numbers", numbers=tuple(sorted(set(value))))
    raise ValueError(
        'expected "failed", "all", "worst 5 of METRIC", "best 5 of METRIC", or a list of numbers '
        f"from 0, got {quoted(value)}"
    )


class StudySettings(TomlTable):
    """The table [study]."""

    name: NameOfStudy = ""  # left out: that of its file or scenario
    scenario: str = ""  # a shipped one, a path relative to the file, or a log to replay
    set: dict[str, Any] = Field({})  # of all members, as the next two
    swap: dict[str, str] = Field({})
    map: dict[str, str | list[str]] = Field({})
    replay: str | tuple[str, ...] | None = None  # logs and patterns of logs
    allow_code: Flag | None = None  # replays compute components of user classes, too
    cases: str | None = None  # table with a column for each key and a row for each case
    sampling: SamplingMethod | None = None  # left out: random
    samples: _Drawn | None = None  # draws from all distributions
    seed: Annotated[Whole, Field(ge=0, le=LARGEST_SEED)] = 0  # of all random numbers of the study
    seeds: _Drawn | None = None  # of each noise source; left out: only its own
    timeout: Annotated[Number, Field(gt=0.0)] | None = None  # wall time of a member [s]
    keep: Annotated[KeptLogs, PlainValidator(read_keep)] = KeptLogs()  # members whose logs are kept
    results: Flag | None = None  # keep what a run says; left out: only without metrics


class StudyTables(TomlTable):
    """The tables of a study."""

    study: StudySettings
    vary: dict[str, Any] = Field({})  # by dotted key
    metrics: dict[str, str] = Field({})  # expressions over signals, by name


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """What is said of a study beside its file.

    Parameters
    ----------
    vary, metrics, set, swap, map : mapping, optional
        By key, in addition to those of the file.
    replay, allow_code, cases, sampling, samples, seed, seeds, timeout, keep, results : optional
        As in the table [study]; None: as the file says.
    """

    vary: Mapping[str, Any] | None = None
    metrics: Mapping[str, str] | None = None
    set: Mapping[str, Any] | None = None
    swap: Mapping[str, str | Path] | None = None
    map: Mapping[str, str | list[str]] | None = None
    replay: str | Sequence[str] | None = None
    allow_code: bool | None = None
    cases: str | Path | None = None
    sampling: str | None = None
    samples: int | None = None
    seed: int | None = None
    seeds: int | None = None
    timeout: float | None = None
    keep: str | Sequence[int] | None = None
    results: bool | None = None


@dataclass(frozen=True, slots=True)
class StudyFile:
    """A study that was read: its tables, checked.

    Parameters
    ----------
    source : str
        Where it was read, for messages.
    settings : StudySettings
    variations : tuple of Variation
        In the order in which they are written.
    metrics : mapping of name to expression
    tables : mapping
        With dotted keys and absolute paths; :func:`study_of` reads them again.
    """

    source: str
    settings: StudySettings
    variations: tuple[Variation, ...]
    metrics: Mapping[str, str]
    tables: Mapping[str, Any]

    @property
    def name(self) -> str:
        """That of the file or the scenario, unless it says another one."""
        return self.settings.name

    @property
    def scenario(self) -> str:
        """Path, or name of a shipped scenario."""
        return self.settings.scenario

    @property
    def grid(self) -> tuple[GridVariation, ...]:
        """What is varied by each of some values."""
        return tuple(item for item in self.variations if isinstance(item, GridVariation))

    @property
    def sampled(self) -> tuple[SampledVariation, ...]:
        """What is drawn."""
        return tuple(item for item in self.variations if isinstance(item, SampledVariation))

    @property
    def may_replay(self) -> bool:
        """Whether members may replay logs, so that edits of all are made to what a log has."""
        return self.settings.replay is not None or self.settings.cases is not None

    @property
    def subject(self) -> StudySubject:
        """What all members have in common."""
        settings = self.settings
        return StudySubject(
            settings.scenario,
            settings.set,
            settings.swap,
            settings.map,
            self.metrics,
            with_results=not self.metrics if settings.results is None else settings.results,
            allow_code=bool(settings.allow_code),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the tables as plain values."""
        return deepcopy(dict(self.tables))

    def with_options(self, given: StudyOptions) -> StudyFile:
        """Return the study with options in addition, or instead of what the file says.

        Raises
        ------
        UsageError
            With everything that is wrong with them.
        """
        given = replace(given, swap=swap_argument(given.swap))
        options: dict[str, Any] = {STUDY: {}, VARY: {}, METRICS: {}}
        for name, value in vars(given).items():
            if name in _BY_KEY:
                entries = mapping_argument(name, value).items()
                value = {key: _plain(option(name, key), item) for key, item in entries} or None
            if value is not None:
                table = options if name in options else options[STUDY]
                table[name] = value if name in _BY_KEY else _plain(option(name), value)
        options, _, problems = normal_tables(options, Path.cwd())
        tables = self.to_dict()
        for name, value in {**options.pop(STUDY), **options}.items():
            table = tables if name in options else tables[STUDY]
            table[name] = {**table.get(name, {}), **value} if name in _BY_KEY else value
        try:
            return study_of(tables, self.source, problems=problems)
        except TableProblems as error:
            lines = [f"{_label(key)}: {text}" for key, text in error.problems]
            raise UsageError("\n".join(dict.fromkeys(lines))) from error


def _plain(label: str, value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    try:
        return plain(list(value) if isinstance(value, range) else value)
    except UsageError as error:
        raise UsageError(f"{label}: {error}") from error


def _label(key: Key) -> str:
    """Return the name of the option that a key of the tables comes from."""
    name, *inner = map(str, key[key[0] == STUDY :] or key)
    label = option(name)
    if inner and name in _BY_KEY:
        label = option(name, inner.pop(0).removeprefix(SWAP if name == VARY else ""))
    return ": ".join([label, *inner])


def study_of(
    tables: Mapping[str, Any], source: str, name: str = "", problems: Sequence[Problem] = ()
) -> StudyFile:
    """Return the study of normal tables.

    Parameters
    ----------
    tables : mapping
    source : str
        Where they were read, for messages.
    name : str
        Of the study, if it does not say its own.
    problems : sequence of Problem
        That are known before.

    Raises
    ------
    TableProblems
        With everything that is wrong with them.
    """
    settings = tables[STUDY]
    if name and isinstance(settings, Mapping):
        tables = {**tables, STUDY: {**settings, "name": settings.get("name", name)}}
    problems = list(problems)
    content = None
    try:
        content = StudyTables.model_validate(tables)
    except ValidationError as error:
        problems += problems_of(error, StudyTables, tables, ())
    variations: list[Variation] = []
    vary = tables.get(VARY)
    for key, value in vary.items() if isinstance(vary, Mapping) else ():
        try:
            variations.append(read_variation(key, value))
        except TableProblems as error:
            problems += [((VARY, key, *inner), text) for inner, text in error.problems]
    if content is None:
        raise TableProblems(problems)
    study = StudyFile(source, content.study, tuple(variations), content.metrics, tables)
    metric = content.study.keep.metric
    if metric and metric not in study.metrics and not study.subject.with_results:
        text = f"no metric {metric!r}; {nearest(metric, study.metrics)}"
        problems.append(((STUDY, "keep"), text))
    common = {*map(short, content.study.set), *(f"{SWAP}{name}" for name in content.study.swap)}
    text = "it is varied, so it cannot also have one value for all members; use one of both"
    problems += [((VARY, item.key), text) for item in variations if item.key in common]
    if problems:
        raise TableProblems(problems)
    return study


# --- keys and paths ---


def varied_key(key: str) -> str:
    """Return the key of [vary] in its normal form; one without a dot is a component to swap."""
    key = short(key)
    name = key.removeprefix(f"{COMPONENTS}.")
    return key if "." in name else f"{SWAP}{name}"


def normal_tables(
    tables: Mapping[str, Any], folder: Path
) -> tuple[dict[str, Any], dict[Key, Key], list[Problem]]:
    """Return tables with dotted keys and absolute paths, how each was written, and which twice."""
    normal = deepcopy(dict(tables))
    places: dict[Key, Key] = {}
    twice: list[Problem] = []
    study = normal.get(STUDY)
    settings = study if isinstance(study, dict) else {}
    for outer, place, form, is_entry in (
        (normal, (VARY,), varied_key, _is_varied),
        (settings, (STUDY, "set"), short, lambda _, level: level == 1),
    ):
        table = outer.get(place[-1])
        if not isinstance(table, dict):
            continue
        flat = outer[place[-1]] = {}
        for path, value in _entries(table, is_entry):
            key = form(".".join(map(str, path)))
            if key in flat:
                before = ".".join(map(str, places[*place, key][len(place) :]))
                text = f"it is given twice, also as {before!r}; expected each key once"
                twice.append(((*place, *path), text))
            flat[key] = value
            places[*place, key] = (*place, *path)
    vary = normal.get(VARY)
    vary = vary if isinstance(vary, dict) else {}
    for key, value in vary.items():
        vary[key] = absolute(value, folder) if key.startswith(SWAP) else value
    paths = {name: settings[name] for name in ("cases", "replay", "swap") if name in settings}
    settings |= absolute(paths, folder)
    return normal, places, twice


def _entries(
    table: Mapping[str, Any], is_entry: Callable[[Any, int], bool], path: Key = ()
) -> Iterator[tuple[Key, Any]]:
    """Yield the entries of nested tables by their paths; a key with dots is a whole one."""
    for name, value in table.items():
        is_whole = not path and "." in name
        if isinstance(value, Mapping) and not is_whole and not is_entry(value, len(path)):
            yield from _entries(value, is_entry, (*path, name))
        else:
            yield (*path, name), value


def _is_varied(value: Any, _: int) -> bool:
    """Return whether a table is a variation, not one of keys that are varied."""
    entries = [value[name] for name in FORMS if name in value]
    return any(not isinstance(entry, Mapping) and entry is not None for entry in entries)


def absolute(value: Any, folder: Path) -> Any:
    """Return a path, or those in lists and tables, absolute; what is no text stays as it is."""
    match value:
        case str():
            return os.path.normpath(folder / expanded(value)) if value else value
        case list() | tuple():
            return [absolute(item, folder) for item in value]
        case dict():
            return {key: absolute(item, folder) for key, item in value.items()}
    return value


# --- reading ---


def load_scenario(scenario: str) -> Scenario:
    """Load a scenario, or that of a log.

    Raises
    ------
    UsageError
        If there is none, or it is wrong.
    """
    if file_type(scenario) != "log":
        return load(scenario)
    if is_foreign(Path(scenario)):
        raise UsageError(
            f"{scenario} was written by another tool and carries no scenario; expected a study or "
            "a scenario; replay the log with it"
        )
    return _read_recorded(recorded_document(open_log(scenario)))


def _read_recorded(document: Document) -> Scenario:
    scenario, problems = read(document)
    if problems:
        raise document.report(problems)
    return replace(scenario, parse=_read_recorded)


def read_study(name: str | Path) -> StudyFile:
    """Read a study file, or the study of a scenario or of a log.

    Raises
    ------
    UsageError
        With everything that is wrong with it, by lines.
    """
    if file_type(str(name)) == "log":
        path = str(expanded(name).absolute())
        return study_of(
            {STUDY: {"scenario": path, "replay": [path]}}, path, load_scenario(path).name
        )
    document = find(name)
    tree = document.tables().tree
    own = tree.get("scenario")
    is_inside = "components" in tree or isinstance(own, Mapping)
    tables = {STUDY: tree.get(STUDY, {})} if is_inside else dict(tree)
    if STUDY not in tables:
        raise UsageError(
            f"{document.source}: neither a study nor a scenario; expected the table [study], or "
            "[scenario] and [components]"
        )
    problems: list[Problem] = []
    if isinstance(tables[STUDY], Mapping):
        settings = tables[STUDY] = dict(tables[STUDY])
        problems = _set_scenario(settings, document, is_inside)
        if is_inside:
            tables |= {key: settings.pop(key) for key in (VARY, METRICS) if key in settings}
    own_name = Path(document.source).stem
    if is_inside:
        own_name = str(own.get("name", "")) if isinstance(own, Mapping) else ""
    normal, places, twice = normal_tables(tables, document.folder)
    try:
        return study_of(normal, document.source, own_name, [*problems, *twice])
    except TableProblems as error:
        written = [(_written(key, places, is_inside), text) for key, text in error.problems]
        raise UsageError(report(written, document.source, document.text)) from error


def _set_scenario(settings: dict[str, Any], document: Document, is_inside: bool) -> list[Problem]:
    """Set the scenario of a study: its own file, or another one; a log is also replayed."""
    scenario = settings.get("scenario")
    if is_inside:
        path = Path(document.source)
        settings["scenario"] = str(path.absolute()) if path.is_file() else document.source
        problem = ((STUDY, "scenario"), "it is the scenario of this file; remove this key")
        return [] if scenario is None else [problem]
    if scenario is None:
        text = "expected the name of a shipped scenario, or a path to a scenario or a log"
        return [((STUDY,), f"'scenario' is missing; {text}")]
    if isinstance(scenario, str):
        if file_type(scenario) == "log":
            settings.setdefault("replay", scenario)
        is_shipped = file_type(scenario) is None and scenario in shipped()
        settings["scenario"] = scenario if is_shipped else absolute(scenario, document.folder)
    return []


def _written(key: Key, places: Mapping[Key, Key], is_inside: bool) -> Key:
    """Return how a key of the tables of a study is written in its file."""
    for length in range(len(key), 0, -1):
        if key[:length] in places:
            key = (*places[key[:length]], *key[length:])
            break
    return (STUDY, *key) if is_inside and key[0] != STUDY else key
