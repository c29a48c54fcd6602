"""A study as its file and its options say: what is run, what is varied, what is kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from cosim.arguments import mapping_argument, swap_argument
from cosim.errors import UsageError, nearest, option
from cosim.scenario.document.edits import plain, short
from cosim.scenario.document.problems import Key, Problem, TableProblems, problems_of
from cosim.studies.contracts import SWAP, StudySubject
from cosim.studies.document.keep import KeptLogs, read_keep
from cosim.studies.document.nested import flat_edits, flat_variations
from cosim.studies.document.paths import with_absolute_paths
from cosim.studies.document.schema import StudySettings, StudyTables
from cosim.studies.document.variations import (
    GridVariation,
    SampledVariation,
    Variation,
    read_variation,
)

STUDY: Final = "study"
VARY: Final = "vary"
METRICS: Final = "metrics"


@dataclass(frozen=True, slots=True)
class StudyFile:
    """A study: a scenario, what is varied, and what is kept.

    Parameters
    ----------
    name : str
    source : str
        The file, or the name of a shipped scenario.
    settings : StudySettings
        Its scenario is there; paths are absolute.
    variations : tuple of Variation
        In the order of the file, of options behind them.
    metrics : mapping of name to expression
    kept_logs : KeptLogs
    tables : mapping
        All of it as plain tables, as a file would have them.
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
        """Path of the scenario, or the name of a shipped one."""
        return self.settings.scenario or ""

    @property
    def grid(self) -> tuple[GridVariation, ...]:
        """What is varied by each of some values, the first one slowest."""
        return tuple(item for item in self.variations if isinstance(item, GridVariation))

    @property
    def sampled(self) -> tuple[SampledVariation, ...]:
        """What is drawn from distributions."""
        return tuple(item for item in self.variations if isinstance(item, SampledVariation))

    @property
    def subject(self) -> StudySubject:
        """What all members have in common."""
        settings = self.settings
        with_results = not self.metrics if settings.results is None else settings.results
        return StudySubject(
            self.scenario,
            set=settings.set,
            swap=settings.swap,
            map=settings.map,
            metrics=self.metrics,
            with_results=with_results,
            allow_code=bool(settings.allow_code),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON: the tables of a file that means the same."""
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
        """Return the study with options added; those that it has already are replaced.

        Parameters
        ----------
        vary : mapping of dotted key to list or table, optional
            As the entries of [vary], such as ``{"observer.filter_rate": {"log": [10.0, 1e4],
            "points": 25}}``. A key without a dot is a component: its list has paths for a swap.
        metrics : mapping of name to expression, optional
        set, swap, map : mapping, optional
            What all members have, as of :func:`cosim.run`.
        replay, allow_code, cases, sampling, samples, seed, seeds, timeout, keep, results : optional
            As the keys of [study]. Paths are taken from the working directory.

        Raises
        ------
        UsageError
            With everything that is wrong with them; names the options.
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
        swaps = swap_argument(swap)
        for name, value in (("set", set), ("swap", swaps), ("map", map)):
            entries = mapping_argument(name, value)
            if entries:
                given[name] = {key: _plain(name, key, item) for key, item in entries.items()}
        variations = mapping_argument(VARY, vary)
        options = {
            STUDY: given,
            VARY: {key: _plain(VARY, key, item) for key, item in variations.items()},
            METRICS: dict(mapping_argument(METRICS, metrics)),
        }
        options, _ = normal_tables(options)
        merged = _merged(self.tables, with_absolute_paths(options, Path.cwd()))
        study, problems = study_of(merged, self.source)
        if study is None:
            lines = dict.fromkeys(f"{_label(key)}: {text}" for key, text in problems)
            raise UsageError("\n".join(lines))
        return study


def _plain(name: str, key: str, value: Any) -> Any:
    try:
        return str(value) if isinstance(value, Path) else plain(value)
    except UsageError as error:
        raise UsageError(f"{option(name, key)}: {error}") from error


def _merged(tables: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return tables with options; what these give again takes the place of what was there."""
    merged = deepcopy(dict(tables))
    for name in (VARY, METRICS):
        merged[name] = {**merged.get(name, {}), **options[name]}
    settings = dict(merged[STUDY])
    for key, value in options[STUDY].items():
        is_table = isinstance(value, dict) and isinstance(settings.get(key), dict)
        settings[key] = {**settings[key], **value} if is_table else value
    merged[STUDY] = settings
    return merged


def _label(key: Key) -> str:
    """Return the option that a problem is with."""
    match key:
        case ("study", "set" | "swap" | "map" as name, entry, *inner):
            label = option(name, str(entry))
        case ("study", name, *inner):
            label = option(str(name))
        case ("vary" | "metrics" as name, entry, *inner):
            label = option(name, str(entry))
        case _:
            return ".".join(map(str, key))
    return ": ".join([label, *map(str, inner)])


# --- from tables ---


def normal_tables(tables: Mapping[str, Any]) -> tuple[dict[str, Any], dict[Key, Key]]:
    """Return tables with one dotted key for each entry, and where those were written.

    ``observer.filter_rate = ...`` and ``"observer.filter_rate" = ...`` mean the same, and so do
    ``plant = ["a.fmu"]`` and ``"swap.plant" = ["a.fmu"]`` in [vary].
    """
    normal = dict(tables)
    places: dict[Key, Key] = {}
    if isinstance(tables.get(VARY), Mapping):
        normal[VARY], written = flat_variations(tables[VARY])
        places |= {(VARY, key): (VARY, *path) for key, path in written.items()}
    settings = tables.get(STUDY)
    if isinstance(settings, Mapping) and isinstance(settings.get("set"), Mapping):
        entries, written = flat_edits(settings["set"])
        normal[STUDY] = {**settings, "set": entries}
        places |= {(STUDY, "set", key): (STUDY, "set", *path) for key, path in written.items()}
    return normal, places


def study_of(
    tables: Mapping[str, Any], source: str, name: str = ""
) -> tuple[StudyFile | None, list[Problem]]:
    """Return a study and no problems, or None and the problems of its tables.

    Parameters
    ----------
    tables : mapping
        With one dotted key for each entry, absolute paths, and a scenario.
    source : str
    name : str
        Of the study, where its tables have none.
    """
    problems: list[Problem] = []
    try:
        content = StudyTables.model_validate(tables)
    except ValidationError as error:
        problems += problems_of(error, StudyTables, tables, ())
        content = None
    vary = tables.get(VARY, {})
    variations, own_problems = _variations(vary if isinstance(vary, Mapping) else {})
    problems += own_problems
    if content is None:
        return None, problems
    settings = content.study
    kept_logs = KeptLogs()
    try:
        kept_logs = read_keep(settings.keep)
    except UsageError as error:
        problems.append(((STUDY, "keep"), str(error)))
    problems += _metric_problems(kept_logs, settings, content.metrics)
    problems += _both_problems(settings, variations)
    if problems:
        return None, problems
    own_name = settings.name or name
    named = dict(tables)
    named[STUDY] = {**tables[STUDY], "name": own_name}
    study = StudyFile(
        own_name, source, settings, tuple(variations), content.metrics, kept_logs, named
    )
    return study, []


def _variations(tables: Mapping[str, Any]) -> tuple[list[Variation], list[Problem]]:
    variations: list[Variation] = []
    problems: list[Problem] = []
    for key, value in tables.items():
        try:
            variations.append(read_variation(key, value))
        except TableProblems as error:
            problems += [((VARY, key, *inner), text) for inner, text in error.problems]
    return variations, problems


def _metric_problems(
    kept_logs: KeptLogs, settings: StudySettings, metrics: Mapping[str, str]
) -> list[Problem]:
    """Return what is wrong with the metric that logs are kept by."""
    has_results = settings.results or (settings.results is None and not metrics)
    if not kept_logs.metric or kept_logs.metric in metrics or has_results:
        return []
    text = f"no metric {kept_logs.metric!r}; {nearest(kept_logs.metric, metrics)}"
    return [((STUDY, "keep"), text)]


def _both_problems(settings: StudySettings, variations: Sequence[Variation]) -> list[Problem]:
    """Return which keys are both set for all members and varied."""
    known = {short(key) for key in settings.set} | {f"{SWAP}{name}" for name in settings.swap}
    problems: list[Problem] = []
    for variation in variations:
        if variation.key in known:
            text = (
                "it is varied, so it cannot also have one value for all members; use one of the two"
            )
            problems.append(((VARY, variation.key), text))
    return problems
