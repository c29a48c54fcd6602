"""A study as users write it: a file, or a scenario or a log with options; read, with its scenario.

Keys of [vary] may be dotted (``"plant.x_a0[0]"``), or tables (``[vary.plant]``); inside, all are
dotted. Paths are absolute inside: those of a file are taken from its folder, those of options from
the working folder.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

from pydantic import Field, ValidationError

from cosim.arguments import mapping_argument, swap_argument
from cosim.errors import UsageError, nearest, option, quoted
from cosim.files import expanded, file_type
from cosim.log.foreign.topics import is_foreign
from cosim.log.reading.reader import open_log
from cosim.scenario.document.document import Document, find, shipped
from cosim.scenario.document.edits import COMPONENTS, plain, short
from cosim.scenario.document.lines import key_lines
from cosim.scenario.document.places import Places
from cosim.scenario.document.problems import Key, Problem, TableProblems, problems_of
from cosim.scenario.document.schema import LARGEST_SEED, Flag, Number, TomlTable, Whole
from cosim.scenario.document.schema import Name as NameOfStudy
from cosim.scenario.parsing import Scenario, read
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
SamplingMethod: TypeAlias = Literal["random", "latin-hypercube", "sobol", "saltelli"]
_IsEntry: TypeAlias = Callable[[Any, int], bool]
MOST_DRAWN: Final = 10_000_000  # samples, and seeds


class StudySettings(TomlTable):
    """The table [study]."""

    name: NameOfStudy | None = Field(
        None, description="name of the study; default: that of its file or scenario"
    )
    scenario: str | None = Field(
        None,
        description="scenario to run: the name of a shipped one, or a path relative to this file; "
        "of a log: its scenario, as a replay",
    )
    set: dict[str, Any] = Field(
        {}, description='values of all members: { "observer.filter_rate" = 300.0 }'
    )
    swap: dict[str, str] = Field({}, description="swaps of all members")
    map: dict[str, str | list[str]] = Field({}, description="ports of swapped components")
    replay: str | tuple[str, ...] | None = Field(
        None, description='logs that each member replays, such as ["field-*.mcap"]'
    )
    allow_code: Flag | None = Field(
        None,
        description="whether replays also compute components of user classes; this runs the code "
        "that the logs name",
    )
    cases: str | None = Field(
        None,
        description="table of members (.csv, .xlsx, ...): a column for each key, a row per case",
    )
    sampling: SamplingMethod | None = Field(
        None,
        description='how distributions are drawn: "random" (default), "latin-hypercube", "sobol", '
        'or "saltelli" for Sobol indices',
    )
    samples: Annotated[Whole, Field(ge=1, le=MOST_DRAWN)] | None = Field(
        None, description="number of draws from all distributions"
    )
    seed: Annotated[Whole, Field(ge=0, le=LARGEST_SEED)] = Field(
        0, description="seed of all random numbers of the study"
    )
    seeds: Annotated[Whole, Field(ge=1, le=MOST_DRAWN)] | None = Field(
        None, description="number of seeds for each noise source; default: only its own"
    )
    timeout: Annotated[Number, Field(gt=0.0)] | None = Field(
        None,
        description="wall time limit of a member [s]; default: ten times the longest of the first "
        "ones, at least 60 s; one hour until a member completes",
    )
    keep: str | tuple[Whole, ...] | None = Field(
        None,
        description='members whose logs are kept: "failed", "all", "worst 5 of METRIC", '
        '"best 5 of METRIC", or their numbers',
    )
    results: Flag | None = Field(
        None,
        description="also keep the results of each run (estimates, errors, verdicts); default: "
        "only if there are no metrics",
    )


class StudyTables(TomlTable):
    """The tables of a study."""

    study: StudySettings
    vary: dict[str, Any] = Field({}, description="what is varied, by dotted key")
    metrics: dict[str, str] = Field({}, description="expressions over signals, by name")


# --- which logs are kept ---


@dataclass(frozen=True, slots=True)
class KeptLogs:
    """Which members' logs are kept: ``count`` by a metric, or those of some ``numbers``."""

    which: Literal["none", "failed", "all", "worst", "best", "numbers"] = "none"
    count: int = 0
    metric: str = ""
    numbers: tuple[int, ...] = ()


def read_keep(value: str | tuple[int, ...] | None) -> KeptLogs:
    """Read which logs are kept.

    Raises
    ------
    UsageError
        If it says something else.
    """
    if value is None:
        return KeptLogs()
    needed = (
        'expected "failed", "all", "worst 5 of METRIC", "best 5 of METRIC", or a list of numbers'
    )
    if not isinstance(value, str):
        if not value or min(value) < 0:
            raise UsageError(f"{needed} from 0, got {quoted(list(value))}")
        return KeptLogs("numbers", numbers=tuple(sorted(set(value))))
    match value.strip().split(maxsplit=3):
        case ["failed" | "all" as which]:
            return KeptLogs(which)
        case ["worst" | "best" as which, count, "of", metric] if re.fullmatch(
            "[1-9][0-9]{0,6}", count
        ):
            return KeptLogs(which, int(count), metric)
    raise UsageError(f"{needed}, got {quoted(value)}")


# --- a study ---


@dataclass(frozen=True, slots=True)
class StudyFile:
    """A study that was read: its tables, checked.

    Parameters
    ----------
    name : str
    source : str
        Where it was read, for messages.
    settings : StudySettings
    variations : tuple of Variation
        In the order in which they are written.
    metrics : mapping of name to expression
    kept_logs : KeptLogs
    tables : mapping
        With dotted keys and absolute paths; :func:`study_of` reads them again.
    """

    name: str
    source: str
    settings: StudySettings
    variations: tuple[Variation, ...]
    metrics: Mapping[str, str]
    kept_logs: KeptLogs
    tables: Mapping[str, Any]

    @property
    def scenario(self) -> str:
        """Path, or name of a shipped scenario."""
        return self.settings.scenario or ""

    @property
    def grid(self) -> tuple[GridVariation, ...]:
        """What is varied by each of some values."""
        return tuple(item for item in self.variations if isinstance(item, GridVariation))

    @property
    def sampled(self) -> tuple[SampledVariation, ...]:
        """What is drawn."""
        return tuple(item for item in self.variations if isinstance(item, SampledVariation))

    @property
    def subject(self) -> StudySubject:
        """What all members have in common."""
        settings = self.settings
        return StudySubject(
            self.scenario,
            set=settings.set,
            swap=settings.swap,
            map=settings.map,
            metrics=self.metrics,
            with_results=not self.metrics if settings.results is None else settings.results,
            allow_code=bool(settings.allow_code),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the tables as plain values."""
        return deepcopy(dict(self.tables))

    def with_options(
        self,
        *,
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
    ) -> StudyFile:
        """Return the study with options in addition, or instead of what the file says.

        Parameters
        ----------
        vary, metrics, set, swap, map : mapping, optional
            By key, in addition to those of the file.
        replay, allow_code, cases, sampling, samples, seed, seeds, timeout, keep, results : optional
            As in the table [study]; None: as the file says.

        Raises
        ------
        UsageError
            With everything that is wrong with them.
        """
        settings = {
            "replay": replay if replay is None or isinstance(replay, str) else list(replay),
            "allow_code": allow_code,
            "cases": None if cases is None else str(cases),
            "sampling": sampling,
            "samples": samples,
            "seed": seed,
            "seeds": seeds,
            "timeout": timeout,
            "keep": keep if keep is None or isinstance(keep, str) else list(keep),
            "results": results,
        }
        given: dict[str, Any] = {key: item for key, item in settings.items() if item is not None}
        for name, value in (("set", set), ("swap", swap_argument(swap)), ("map", map)):
            entries = mapping_argument(name, value)
            if entries:
                given[name] = _plain_entries(name, entries)
        varied = _plain_entries(VARY, mapping_argument(VARY, vary))
        named = dict(mapping_argument(METRICS, metrics))
        try:
            options, _ = normal_tables({STUDY: given, VARY: varied, METRICS: named})
        except TableProblems as error:
            raise _wrong_options(error.problems) from error
        options = _with_absolute_paths(options, Path.cwd())
        merged = self.to_dict()
        for name in (VARY, METRICS):
            merged[name] = {**merged.get(name, {}), **options[name]}
        for key, value in options[STUDY].items():
            before = merged[STUDY].get(key)
            both = isinstance(value, dict) and isinstance(before, dict)
            merged[STUDY][key] = {**before, **value} if both else value
        study, problems = study_of(merged, self.source)
        if study is None:
            raise _wrong_options(problems)
        return study


def _plain_entries(name: str, entries: Mapping[str, Any]) -> dict[str, Any]:
    found = {}
    for key, value in entries.items():
        try:
            found[key] = str(value) if isinstance(value, Path) else plain(value)
        except UsageError as error:
            raise UsageError(f"{option(name, key)}: {error}") from error
    return found


def _wrong_options(problems: Iterable[Problem]) -> UsageError:
    return UsageError("\n".join(dict.fromkeys(f"{_label(key)}: {text}" for key, text in problems)))


def _label(key: Key) -> str:
    """Return the name of the option that a key of the tables comes from."""
    match key:
        case ("study", "set" | "swap" | "map" as name, entry, *inner):
            label = option(name, str(entry))
        case ("study", name, *inner):
            label = option(str(name))
        case ("vary" | "metrics" as name, entry, *inner):
            label = option(name, str(entry).removeprefix(SWAP))
        case _:
            return ".".join(map(str, key))
    return ": ".join([label, *map(str, inner)])


def study_of(
    tables: Mapping[str, Any], source: str, name: str = ""
) -> tuple[StudyFile | None, list[Problem]]:
    """Return the study of normal tables, or everything that is wrong with them."""
    problems: list[Problem] = []
    content = None
    try:
        content = StudyTables.model_validate(tables)
    except ValidationError as error:
        problems += problems_of(error, StudyTables, tables, ())
    variations: list[Variation] = []
    vary = tables.get(VARY, {})
    for key, value in vary.items() if isinstance(vary, Mapping) else ():
        try:
            variations.append(read_variation(key, value))
        except TableProblems as error:
            problems += [((VARY, key, *inner), text) for inner, text in error.problems]
    if content is None:
        return None, problems
    settings, metrics = content.study, content.metrics
    kept = KeptLogs()
    try:
        kept = read_keep(settings.keep)
    except UsageError as error:
        problems.append(((STUDY, "keep"), str(error)))
    has_results = not metrics if settings.results is None else settings.results
    if kept.metric and kept.metric not in metrics and not has_results:
        text = f"no metric {kept.metric!r}; {nearest(kept.metric, metrics)}"
        problems.append(((STUDY, "keep"), text))
    common = {*map(short, settings.set), *(f"{SWAP}{component}" for component in settings.swap)}
    for item in variations:
        if item.key in common:
            text = "it is varied, so it cannot also have one value for all members; use one of both"
            problems.append(((VARY, item.key), text))
    if problems:
        return None, problems
    own_name = settings.name or name
    named = {**tables, STUDY: {**tables[STUDY], "name": own_name}}
    return StudyFile(own_name, source, settings, tuple(variations), metrics, kept, named), []


# --- keys and paths ---


def varied_key(key: str) -> str:
    """Return the key of [vary] in its normal form; one without a dot is a component to swap."""
    key = short(key)
    name = key.removeprefix(f"{COMPONENTS}.")
    return key if "." in name else f"{SWAP}{name}"


def normal_tables(tables: Mapping[str, Any]) -> tuple[dict[str, Any], dict[Key, Key]]:
    """Return tables with dotted keys, and how each entry was written."""
    places: dict[Key, Key] = {}

    def flat(table: Any, place: Key, form: Callable[[str], str], is_entry: _IsEntry) -> Any:
        found: dict[str, Any] = {}
        for path, value in _entries(table, is_entry) if isinstance(table, Mapping) else ():
            key = form(".".join(map(str, path)))
            if key in found:
                before = ".".join(map(str, places[*place, key][len(place) :]))
                text = f"it is given twice, also as {before!r}; expected each key once"
                raise TableProblems([((*place, *path), text)])
            is_nested = isinstance(value, list) and len(value) == 1 and isinstance(value[0], list)
            found[key] = value[0] if key.startswith(SWAP) and is_nested else value  # of paths
            places[*place, key] = (*place, *path)
        return found if isinstance(table, Mapping) else table

    normal = dict(tables)
    settings = tables.get(STUDY)
    if VARY in tables:
        normal[VARY] = flat(tables[VARY], (VARY,), varied_key, _is_varied)
    if isinstance(settings, Mapping) and "set" in settings:
        entries = flat(settings["set"], (STUDY, "set"), short, lambda _, level: level == 1)
        normal[STUDY] = {**settings, "set": entries}
    return normal, places


def _entries(
    table: Mapping[str, Any], is_entry: _IsEntry, path: Key = ()
) -> Iterator[tuple[Key, Any]]:
    """Return the entries of nested tables by their paths; a dotted key is a whole one."""
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


def absolute(text: Any, folder: Path) -> Any:
    """Return an absolute path; what is no text stays as it is."""
    return os.path.normpath(folder / expanded(text)) if isinstance(text, str) and text else text


def _with_absolute_paths(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    def each(value: Any) -> Any:
        match value:
            case dict():
                return {name: each(inner) for name, inner in value.items()}
            case list() | tuple():
                return [each(inner) for inner in value]
        return absolute(value, folder)

    def is_path(name: str, value: Any) -> bool:
        is_swap = name == "swap" or name.startswith(SWAP)
        return (is_swap and not isinstance(value, str)) or name in ("cases", "replay")

    changed = dict(tables)
    for table in (STUDY, VARY):
        if isinstance(tables.get(table), dict):
            entries = tables[table].items()
            changed[table] = {key: each(v) if is_path(key, v) else v for key, v in entries}
    return changed


# --- reading ---


def is_log(scenario: str) -> bool:
    """Return whether the scenario of a study is that of a log."""
    return file_type(scenario) == "log"


def load_scenario(scenario: str) -> Scenario:
    """Load a scenario, or that of a log.

    Raises
    ------
    UsageError
        If there is none, or it is wrong.
    """
    if not is_log(scenario):
        return load(scenario)
    if is_foreign(Path(scenario)):
        raise UsageError(
            f"{scenario} was written by another tool and carries no scenario; expected a study or "
            "a scenario; replay the log with it"
        )
    return _read_recorded(recorded_document(open_log(scenario)))


def _read_recorded(document: Document) -> Scenario:
    scenario, problems = read(document, _read_recorded)
    if problems:
        raise document.report(problems)
    return scenario


def read_study(name: str | Path) -> StudyFile:
    """Read a study file, or the study of a scenario or of a log.

    Raises
    ------
    UsageError
        With everything that is wrong with it, by lines.
    """
    if is_log(str(name)):
        path = str(expanded(name).absolute())
        tables = {STUDY: {"scenario": path, "replay": [path]}}
        study, problems = study_of(tables, path, load_scenario(path).name)
        assert study is not None, problems
        return study
    document = find(name)
    tree, _ = document.tree()
    is_scenario = "components" in tree or isinstance(tree.get("scenario"), Mapping)
    try:
        return _of_scenario(document, tree) if is_scenario else _of_file(document, tree)
    except TableProblems as error:
        places: dict[Key, Key] = {(VARY,): (STUDY, VARY)} if is_scenario else {}
        raise UsageError(_report(document, places, error.problems)) from error


def _of_file(document: Document, tree: Mapping[str, Any]) -> StudyFile:
    tables, places = normal_tables(tree)
    problems: list[Problem] = []
    settings = tables.get(STUDY)
    if settings is None:
        raise UsageError(
            f"{document.source}: neither a study nor a scenario; expected the table [study], or "
            "[scenario] and [components]"
        )
    if isinstance(settings, Mapping):
        scenario = settings.get("scenario")
        own: dict[str, Any] = {}
        if scenario is None:
            text = (
                "'scenario' is missing; expected the name of a shipped scenario, or a path to a "
                "scenario or a log"
            )
            problems.append(((STUDY,), text))
        elif isinstance(scenario, str):
            own = {"replay": scenario} if is_log(scenario) else {}
            is_shipped = file_type(scenario) is None and scenario in shipped()
            scenario = scenario if is_shipped else absolute(scenario, document.folder)
        tables[STUDY] = {**own, **settings, "scenario": scenario}
    return _checked(document, tables, places, problems, Path(document.source).stem)


def _of_scenario(document: Document, tree: Mapping[str, Any]) -> StudyFile:
    inside = tree.get(STUDY, {})
    if not isinstance(inside, Mapping):
        text = f"expected a table, got {quoted(inside)}"
        raise UsageError(_report(document, {}, [((STUDY,), text)]))
    settings = dict(inside)
    tables = {name: settings.pop(name) for name in (VARY, METRICS) if name in settings}
    problems: list[Problem] = []
    if "scenario" in settings:
        problems.append(((STUDY, "scenario"), "it is the scenario of this file; remove this key"))
    source = document.source
    settings["scenario"] = str(Path(source).absolute()) if Path(source).is_file() else source
    normal, places = normal_tables({**tables, STUDY: settings})
    for name in (VARY, METRICS):  # which stand behind [study]
        places[name,] = (STUDY, name)
        entries = normal.get(name)
        for key in entries if isinstance(entries, Mapping) else ():
            places[name, key] = (STUDY, *places.get((name, key), (name, key)))
    own = tree.get("scenario")
    name = str(own.get("name", "")) if isinstance(own, Mapping) else ""
    return _checked(document, normal, places, problems, name)


def _checked(
    document: Document,
    tables: Mapping[str, Any],
    places: Mapping[Key, Key],
    problems: list[Problem],
    name: str,
) -> StudyFile:
    tables = _with_absolute_paths(tables, document.folder)
    study, own_problems = study_of(tables, document.source, name)
    if study is None or problems:
        raise UsageError(_report(document, places, [*problems, *own_problems]))
    return study


def _report(document: Document, places: Mapping[Key, Key], problems: Sequence[Problem]) -> str:
    """Return problems by the lines where their keys are written."""
    written: list[Problem] = []
    for key, text in problems:
        for length in range(len(key), 0, -1):
            if key[:length] in places:
                key = (*places[key[:length]], *key[length:])
                break
        written.append((key, text))
    lines = key_lines(document.text)
    return Places(document.source, lines, changes=(), swaps=(), maps=(), swapped=()).report(written)
