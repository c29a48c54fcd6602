"""The scenario that a log carries."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.run import SCENARIO_FILE
from cosim.core.recording import CompleteRecording
from cosim.errors import LogError, command
from cosim.log.contents.metadata import json_table
from cosim.scenario.building.build import parse
from cosim.scenario.building.parsing import read
from cosim.scenario.document.document import Document
from cosim.scenario.kinds import KINDS
from cosim.scenario.record import component_metadata, component_record, run_metadata


def recorded_document(log: CompleteRecording) -> Document:
    """Return the scenario of a log.

    Raises
    ------
    LogError
        If the log carries none.
    """
    edits = run_metadata(log).get("edits")
    if SCENARIO_FILE not in log.attachments or edits is None:
        raise LogError(
            f"the log has no {SCENARIO_FILE}; expected a log written by {command('run')}"
        )
    try:
        text = log.attachment(SCENARIO_FILE).decode()
        document = Document.recorded(text, edits, Path.cwd())
        return replace(document, foreign_kinds=_foreign_kinds(log))
    except ValueError as error:
        raise LogError(f"{log.label}: its scenario cannot be understood: {error}") from error


def _foreign_kinds(log: CompleteRecording) -> frozenset[str]:
    """Return the kinds of a log that are not cosim's: those of its components of a user's class.

    The packages that declared them need not be installed where the log is read.
    """
    kinds = set()
    for name in declared_channels(log.channels):
        texts = component_metadata(log, name)
        # the texts of thousands of components take long to be checked
        if '"code"' in texts.get("metadata", "") and component_record(log, name).code is not None:
            table = json_table(texts.get("table", "{}"))
            kinds.add(str(table.get("kind")))
    return frozenset(kinds.difference(KINDS))


def recorded_stop(log: CompleteRecording) -> float:
    """Return where the scenario of a log ends [s], which its run need not have reached.

    Raises
    ------
    LogError
        If the log carries none.
    ScenarioError
        If that is no TOML.
    """
    scenario, _ = read(recorded_document(log), parse)
    return scenario.file.scenario.stop
