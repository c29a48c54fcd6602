"""Read a study: a file of its own, tables in a scenario, or a scenario without any."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosim.errors import UsageError, quoted
from cosim.files import expanded
from cosim.scenario.document.document import Document, find
from cosim.scenario.document.lines import key_lines
from cosim.scenario.document.places import Places
from cosim.scenario.document.problems import Key, Problem
from cosim.studies.document.paths import scenario_path, with_absolute_paths
from cosim.studies.document.scenario_of_study import is_log, load_scenario
from cosim.studies.document.study_file import (
    METRICS,
    STUDY,
    VARY,
    StudyFile,
    normal_tables,
    study_of,
)


def read_study(name: str | Path) -> StudyFile:
    """Read a study.

    Parameters
    ----------
    name : str or Path
        A .toml file with [study], [vary] and [metrics]; or a scenario, by its path or the name of
        a shipped one, with [study], [study.vary] and [study.metrics] inside, or without: then
        nothing is varied yet. Or a log, whose replay nothing is varied in yet.

    Raises
    ------
    UsageError
        With every problem of the tables, each with its line; if there is no such file.
    """
    if is_log(str(name)):
        return _of_log(str(expanded(name).absolute()))
    document = find(name)
    tree, _ = document.tree()
    if "components" in tree or isinstance(tree.get("scenario"), Mapping):
        return _of_scenario(document, tree)
    return _of_file(document, tree)


def _of_log(path: str) -> StudyFile:
    """Return the study of the replay of a log."""
    settings = {"scenario": path, "replay": [path]}
    study, problems = study_of({STUDY: settings}, path, load_scenario(path).name)
    assert study is not None, problems
    return study


def _of_file(document: Document, tree: Mapping[str, Any]) -> StudyFile:
    tables, places = normal_tables(tree)
    problems: list[Problem] = []
    settings = tables.get(STUDY)
    if isinstance(settings, Mapping):
        scenario = settings.get("scenario")
        if scenario is None:
            text = (
                "'scenario' is missing; expected the name of a shipped scenario, or a path to a "
                "scenario or a log"
            )
            problems.append(((STUDY,), text))
        own = {"replay": scenario} if isinstance(scenario, str) and is_log(scenario) else {}
        tables[STUDY] = {
            **own,
            **settings,
            "scenario": scenario_path(scenario, document.folder),
        }
    elif settings is None:
        raise UsageError(
            f"{document.source}: neither a study nor a scenario; expected the table [study], or "
            "[scenario] and [components]"
        )
    return _read(document, tables, places, problems=problems, name=Path(document.source).stem)


def _of_scenario(document: Document, tree: Mapping[str, Any]) -> StudyFile:
    """Return the study in a scenario; its keys are those of a file behind ``study``."""
    inside = tree.get(STUDY, {})
    if not isinstance(inside, Mapping):
        text = f"expected a table, got {quoted(inside)}"
        raise UsageError(_report(document, {}, [((STUDY,), text)]))
    settings = dict(inside)
    tables: dict[str, Any] = {}
    problems: list[Problem] = []
    for name in (VARY, METRICS):
        if name in settings:
            tables[name] = settings.pop(name)
    if "scenario" in settings:
        problems.append(((STUDY, "scenario"), "it is the scenario of this file; remove this key"))
    source = document.source
    is_file = Path(source).is_file()
    settings["scenario"] = str(Path(source).absolute()) if is_file else source
    tables[STUDY] = settings
    tables, places = normal_tables(tables)
    for name in (VARY, METRICS):
        places |= _behind_study(tables, name, places)
    own_name = tree.get("scenario")
    name = own_name.get("name", "") if isinstance(own_name, Mapping) else ""
    return _read(document, tables, places, problems=problems, name=str(name))


def _behind_study(
    tables: Mapping[str, Any], name: str, places: Mapping[Key, Key]
) -> dict[Key, Key]:
    """Return where the entries of a table stand that is inside [study]."""
    entries = tables.get(name, {})
    behind: dict[Key, Key] = {(name,): (STUDY, name)}
    for key in entries if isinstance(entries, Mapping) else ():
        behind[(name, key)] = (STUDY, *places.get((name, key), (name, key)))
    return behind


def _read(
    document: Document,
    tables: Mapping[str, Any],
    places: Mapping[Key, Key],
    *,
    problems: list[Problem],
    name: str,
) -> StudyFile:
    """Return the study of some tables, whose entries stand at other places in the text."""
    study, own_problems = study_of(
        with_absolute_paths(tables, document.folder), document.source, name
    )
    problems += own_problems
    if study is None or problems:
        raise UsageError(_report(document, places, problems))
    return study


def _report(document: Document, places: Mapping[Key, Key], problems: list[Problem]) -> str:
    """Return every problem at its place in the text."""
    written: list[Problem] = []
    for key, text in problems:
        for length in range(len(key), 0, -1):
            place = places.get(key[:length])
            if place is not None:
                key = (*place, *key[length:])
                break
        written.append((key, text))
    lines = key_lines(document.text)
    return Places(document.source, lines, changes=(), swaps=(), maps=(), swapped=()).report(written)
