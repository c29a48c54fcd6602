"""The scenario that a log carries, and whether the log has the rows that a replay goes through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from cosim.core.clock import Clock
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.run import SCENARIO_FILE
from cosim.core.recording import CompleteRecording
from cosim.errors import LogError, command
from cosim.instants import Grid
from cosim.log import Log
from cosim.log.contents.metadata import json_table
from cosim.log.contents.result import PARTIAL_STATUS
from cosim.scenario.building.build import read
from cosim.scenario.document.document import Document
from cosim.scenario.kinds import KINDS
from cosim.scenario.record import (
    component_metadata,
    component_record,
    recorded_window,
    replay_origin,
    run_metadata,
)

_DOUBLE: Final = 8  # bytes
_MOST_LOADED: Final = 2**25  # bytes of rows that are read before they are needed


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
        what = f"{log.label}: its scenario"
        document = Document.recorded(text, edits, Path.cwd(), what)
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
            kinds.add(str(json_table(texts.get("table", "{}")).get("kind")))
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
    return read(recorded_document(log)).file.scenario.stop


def check_whole(source: CompleteRecording) -> None:
    """Check that a log has all rows up to its end: nothing can be computed without those before.

    Raises
    ------
    LogError
        If it is a window of a replay, or a part of a log that leaves rows out.
    """
    if source.status == PARTIAL_STATUS:
        start_ns = source.grid.start_ns
        for name, channel in source.channels.items():
            times = source.time_ns(name)
            if len(times) != source.steps // channel.period + 1 or int(times[0]) != start_ns:
                raise LogError(
                    f"{source.label} is partial, {source.reason}; a replay requires all rows from "
                    "the start of the run: 'cosim merge' joins parts, 'cosim cut --to' keeps what "
                    "is complete"
                )
    window = recorded_window(source)
    if window is not None:
        raise LogError(
            f"{source.label}: a replay that starts at {window[0]} s and ends at {window[1]} s "
            f"only; expected a log from the start of its run, such as {replay_origin(source).log}"
        )


def check_end(source: CompleteRecording) -> None:
    """Check that the recorded end is that of the rows: a replay would go on to it.

    Raises
    ------
    LogError
        If there is no step in the log, or its rows end elsewhere.
    """
    end_ns = source.end_ns
    if source.steps == 0:
        raise LogError("the log has no step to replay; it has no more than its initial row")
    channel = next(iter(source.channels.values()))
    ends = [time_ns[[0, -1]] for time_ns, _ in source.blocks(channel.name) if len(time_ns)]
    first_ns, last_ns = (int(ends[0][0]), int(ends[-1][1])) if ends else (0, 0)
    is_last = 0 <= end_ns - last_ns < channel.period * source.step_ns
    if end_ns != Grid(first_ns, source.step_ns).stamp(source.steps) or not is_last:
        raise LogError(
            f"{source.label}: recorded end {end_ns / 1e9} s after {source.steps} steps, but the "
            f"rows of {channel.name!r} end at {last_ns / 1e9} s"
        )


def check_clock(clock: Clock, source: CompleteRecording) -> None:
    """Check that a scenario has the communication points of the rows in its log.

    Raises
    ------
    LogError
        If it has not.
    """
    if clock.grid != source.grid:
        raise LogError(
            f"{source.label}: the scenario has steps of {clock.step_ns} ns from {clock.start_ns} "
            f"ns on, but the rows have steps of {source.step_ns} ns from {source.grid.start_ns} "
            "ns on"
        )


def load_rows(source: CompleteRecording, components: Sequence[str]) -> None:
    """Read the rows of components in one pass over the file.

    Where they are many, only those are read that share chunks with others: of them every part would
    take all of its chunks.
    """
    size = 0
    for name in components:
        channel = source.channels[name]
        width = channel.columns.stop - channel.start
        size += (source.steps // channel.period + 1) * (width + 1) * _DOUBLE
    if size > _MOST_LOADED and isinstance(source, Log):
        components = [name for name in components if source.shares_chunks(name)]
    if components:  # none would be all
        source.load(*components)
