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
_KeyForm: TypeAlias = Callable[[str], str]
_IsEntry: TypeAlias = Callable[[Any, int], bool]
SamplingMethod: TypeAlias = Literal["random", "latin-hypercube", "sobol", "saltelli"]
_Drawn: TypeAlias = Annotated[Whole, Field(ge=1, le=10_000_000)]


class StudySettings(TomlTable):
    """The table [study]."""

    name: NameOfStudy | None = None  # left out: that of its file or scenario
    scenario: str | None = None  # a shipped one, a path relative to the file, or a log to replay
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
    keep: str | tuple[Whole, ...] | None = None  # members whose logs are kept
    results: Flag | None = None  # keep what a run says; left out: only without metrics


class StudyTables(TomlTable):
    """The tables of a study."""

    study: StudySettings
    vary: dict[str, Any] = Field({})  # by dotted key
    metrics: dict[str, str] = Field({})  # expressions over signals, by name


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
    words = value.strip().split(maxsplit=3) if isinstance(value, str) else []
    match words:
        case ["failed" | "all" as which]:
            return KeptLogs(which)
        case ["worst" | "best" as which, count, "of", metric] if re.fullmatch(
            "[1-9][0-9]{0,6}", count
        ):
            return KeptLogs(which, int(count), metric)
    if value is None:
        return KeptLogs()
    if not isinstance(value, str) and value and min(value) >= 0:
        return KeptLogs("numbers", numbers=tuple(sorted(set(value))))
    raise UsageError(
        'expected "failed", "all", "worst 5 of METRIC", "best 5 of METRIC", or a list of numbers '
        f"from 0, got {quoted(value if isinstance(value, str) else list(value))}"
    )


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
        given = {
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
            "set": _plain("set", set) or None,
            "swap": _plain("swap", swap_argument(swap)) or None,
            "map": _plain("map", map) or None,
        }
        options = {
            STUDY: {key: value for key, value in given.items() if value is not None},
            VARY: _plain(VARY, vary),
            METRICS: dict(mapping_argument(METRICS, metrics)),
        }
        options, _, twice = normal_tables(options, Path.cwd())
        merged = self.to_dict()
        for key, value in options[STUDY].items():
            before = merged[STUDY].get(key)
            both = isinstance(value, dict) and isinstance(before, dict)
            merged[STUDY][key] = {**before, **value} if both else value
        for name in (VARY, METRICS):
            merged[name] = {**merged.get(name, {}), **options[name]}
        study, problems = study_of(merged, self.source)
        problems = [*twice, *problems]
        if study is None or problems:
            raise UsageError("\n".join(dict.fromkeys(f"{_label(k)}: {t}" for k, t in problems)))
        return study


def _plain(name: str, argument: object) -> dict[str, Any]:
    found = {}
    for key, value in mapping_argument(name, argument).items():
        try:
            found[key] = str(value) if isinstance(value, Path) else plain(value)
        except UsageError as error:
            raise UsageError(f"{option(name, key)}: {error}") from error
    return found


def _label(key: Key) -> str:
    """Return the name of the option that a key of the tables comes from."""
    name, *inner = map(str, key[key[0] == STUDY :] or key)
    label = option(name)
    if inner and name in ("set", "swap", "map", VARY, METRICS):
        label = option(name, inner.pop(0).removeprefix(SWAP if name == VARY else ""))
    return ": ".join([label, *inner])


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


def normal_tables(
    tables: Mapping[str, Any], folder: Path
) -> tuple[dict[str, Any], dict[Key, Key], list[Problem]]:
    """Return tables with dotted keys and absolute paths, how each was written, and which twice."""
    normal = deepcopy(dict(tables))
    places: dict[Key, Key] = {}
    twice: list[Problem] = []

    def flat(table: Mapping[str, Any], place: Key, form: _KeyForm, is_entry: _IsEntry) -> Any:
        found: dict[str, Any] = {}
        for path, value in _entries(table, is_entry):
            key = form(".".join(map(str, path)))
            if key in found:
                before = ".".join(map(str, places[*place, key][len(place) :]))
                text = f"it is given twice, also as {before!r}; expected each key once"
                twice.append(((*place, *path), text))
            found[key] = value
            places[*place, key] = (*place, *path)
        return found

    vary, settings = normal.get(VARY), normal.get(STUDY)
    if isinstance(vary, dict):
        entries = flat(vary, (VARY,), varied_key, _is_varied)
        normal[VARY] = {
            key: absolute(_paths(value), folder) if key.startswith(SWAP) else value
            for key, value in entries.items()
        }
    if isinstance(settings, dict):
        paths = {name: settings[name] for name in ("cases", "replay", "swap") if name in settings}
        settings |= absolute(paths, folder)
        if isinstance(settings.get("set"), dict):
            settings["set"] = flat(settings["set"], (STUDY, "set"), short, _is_set)
    return normal, places, twice


def _entries(
    table: Mapping[str, Any], is_entry: _IsEntry, path: Key = ()
) -> Iterator[tuple[Key, Any]]:
    """Yield the entries of nested tables by their paths; a key with dots is a whole one."""
    for name, value in table.items():
        is_whole = not path and "." in name
        if isinstance(value, Mapping) and not is_whole and not is_entry(value, len(path)):
            yield from _entries(value, is_entry, (*path, name))
        else:
            yield (*path, name), value


def _is_set(_: Any, level: int) -> bool:
    """Return whether a table is a value, not one of keys of a component."""
    return level == 1


def _is_varied(value: Any, _: int) -> bool:
    """Return whether a table is a variation, not one of keys that are varied."""
    entries = [value[name] for name in FORMS if name in value]
    return any(not isinstance(entry, Mapping) and entry is not None for entry in entries)


def _paths(value: Any) -> Any:
    """Return a list of paths that may be the only value of a list."""
    is_nested = isinstance(value, list) and len(value) == 1 and isinstance(value[0], list)
    return value[0] if is_nested else value


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
        log = {STUDY: {"scenario": path, "replay": [path]}}
        study, found = study_of(log, path, load_scenario(path).name)
        assert study is not None, found
        return study
    document = find(name)
    tree, _ = document.tree()
    is_inside = "components" in tree or isinstance(tree.get("scenario"), Mapping)
    tables = {STUDY: tree.get(STUDY, {})} if is_inside else dict(tree)
    if STUDY not in tables:
        raise UsageError(
            f"{document.source}: neither a study nor a scenario; expected the table [study], or "
            "[scenario] and [components]"
        )
    problems: list[Problem] = []
    if isinstance(tables[STUDY], Mapping):
        settings = dict(tables[STUDY])
        if is_inside:
            tables |= {key: settings.pop(key) for key in (VARY, METRICS) if key in settings}
            problems += _of_this_file(settings, document)
        else:
            problems += _of_another_file(settings, document)
        tables[STUDY] = settings
    own = tree.get("scenario") if is_inside else {"name": Path(document.source).stem}
    own_name = str(own.get("name", "")) if isinstance(own, Mapping) else ""
    normal, places, twice = normal_tables(tables, document.folder)
    problems += twice
    study, found = study_of(normal, document.source, own_name)
    if study is None or problems:
        written = [(_written(key, places, is_inside), text) for key, text in (*problems, *found)]
        lines = key_lines(document.text)
        report = Places(document.source, lines, changes=(), swaps=(), maps=(), swapped=()).report
        raise UsageError(report(written))
    return study


def _of_this_file(settings: dict[str, Any], document: Document) -> list[Problem]:
    """Set the scenario of a study that is written inside of it."""
    problem = ((STUDY, "scenario"), "it is the scenario of this file; remove this key")
    problems: list[Problem] = [problem] if "scenario" in settings else []
    path = Path(document.source)
    settings["scenario"] = str(path.absolute()) if path.is_file() else document.source
    return problems


def _of_another_file(settings: dict[str, Any], document: Document) -> list[Problem]:
    """Make the path of the scenario absolute; a log is also replayed."""
    scenario = settings.get("scenario")
    if scenario is None:
        return [
            (
                (STUDY,),
                "'scenario' is missing; expected the name of a shipped scenario, or a path to a "
                "scenario or a log",
            )
        ]
    if isinstance(scenario, str):
        if is_log(scenario):
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
