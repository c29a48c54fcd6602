"""Check that the logs of a study are of its scenario: a replay runs that of its log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

from cosim.errors import UsageError, command, listing, quoted
from cosim.log.reading.reader import open_log
from cosim.scenario.document.document import Document
from cosim.scenario.parsing import Scenario
from cosim.scenario.recordings.recorded_scenario import recorded_document
from cosim.studies.document.study_file import STUDY

MOST_NAMED: Final = 3  # keys


def check_is_of_scenario(path: str, scenario: Scenario) -> None:
    """Check that a log is of a scenario: with its tables, whatever was set and swapped in the run.

    Raises
    ------
    UsageError
        If it is of another one, or one that has been changed since.
    LogError
        If the log cannot be read, or carries no scenario.
    """
    recorded = _tables(recorded_document(open_log(path)))
    named = _tables(scenario.document)
    if recorded == named:
        return
    found = quoted(_name(recorded))
    if _name(recorded) == _name(named):
        keys = listing(list(_differing(recorded, named)), MOST_NAMED)
        problem = (
            f"the log is of another {found} than {scenario.document.source} is now: they differ "
            f"in {keys}"
        )
    else:
        problem = f"the log is of {found}, and the study is of {quoted(_name(named))}"
    raise UsageError(
        f"{path}: {problem}; a replay runs the scenario of its log: use a log of this scenario, "
        f"or run {command('study')} on the log itself"
    )


def _tables(document: Document) -> dict[str, Any]:
    """Return the tables as they were written, without edits."""
    tree, _ = replace(document, swaps={}, maps={}, changes={}).tree()
    return {name: table for name, table in tree.items() if name != STUDY}


def _name(tables: Mapping[str, Any]) -> Any:
    settings = tables.get("scenario")
    return settings.get("name") if isinstance(settings, Mapping) else None


def _differing(one: Mapping[str, Any], two: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield the dotted keys of what two tables have not alike."""
    for key in dict.fromkeys([*one, *two]):
        inner_one = one.get(key)
        inner_two = two.get(key)
        if isinstance(inner_one, Mapping) and isinstance(inner_two, Mapping):
            yield from _differing(inner_one, inner_two, f"{prefix}{key}.")
        elif inner_one != inner_two:
            yield f"{prefix}{key}"
