"""The scenario of a study: a file, a shipped one, or that of a log that is replayed."""

from __future__ import annotations

from pathlib import Path

from cosim.errors import UsageError
from cosim.files import file_type
from cosim.log.foreign.topics import is_foreign
from cosim.log.reading.reader import open_log
from cosim.scenario.document.document import Document
from cosim.scenario.parsing import Scenario, read
from cosim.scenario.recordings.recorded_scenario import recorded_document
from cosim.scenario.running.execution import load


def is_log(scenario: str) -> bool:
    """Return whether the scenario of a study is the one that a log carries."""
    return file_type(scenario) == "log"


def load_scenario(scenario: str) -> Scenario:
    """Load the scenario of a study.

    Parameters
    ----------
    scenario : str
        Path, name of a shipped scenario, or path of a log: then it is that of its run.

    Raises
    ------
    UsageError
        If it is a recording of another tool, which carries none.
    ScenarioError
        If there is none, or with every problem of it.
    LogError
        If the log cannot be read.
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
    """Read the document of a log, of which nothing is built: that would open what it names.

    Raises
    ------
    ScenarioError
        With every problem that its text has.
    """
    scenario, problems = read(document, _read_recorded)
    if problems:
        raise document.report(problems)
    return scenario
