"""Write what is intact in a damaged log to a new log."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from cosim.arrays import Mask, Nanoseconds
from cosim.core.recorded.run import SCENARIO_FILE
from cosim.errors import GraphError, LogError
from cosim.instants import NANOSECONDS, Grid
from cosim.log.contents.result import PARTIAL_STATUS, RESULT
from cosim.log.editing.batches import gathered
from cosim.log.editing.copying import PartEnd, write_log
from cosim.log.editing.lost import RecoveredRows, is_beginning, missing_rows
from cosim.log.editing.pieces import OF_THE_END, LogPieces
from cosim.log.editing.salvage import Salvage, intact_blocks, salvage
from cosim.log.mcap_file.paths import log_path
from cosim.log.mcap_file.unfinished import UnfinishedLog
from cosim.log.reading.container import MALFORMED
from cosim.log.reading.reader import Log


@dataclass(frozen=True, slots=True)
class RecoveredLog:
    """What was recovered of a log.

    Parameters
    ----------
    log : Log
        The new one.
    rows : mapping of component name to RecoveredRows
    end_ns : int
        Up to which time rows are known to be missing [ns]: the end of the run, where the file still
        says it, or else the last row of all.
    end_is_known : bool
        Whether that is the end of the run.
    has_all_messages : bool
        Whether all that is beside rows is there: messages, events, substeps. No: some are lost, or
        the file does not say any more how many there were.
    """

    log: Log
    rows: Mapping[str, RecoveredRows]
    end_ns: int
    end_is_known: bool
    has_all_messages: bool

    @property
    def whole_until_ns(self) -> int | None:
        """The last communication point up to which no row is lost [ns]; None: there is none."""
        losses = [own.lost[0].first_ns for own in self.rows.values() if own.lost]
        if not losses:
            return self.log.end_ns
        grid = self.log.grid
        last = grid.stamp(grid.number(min(losses)) - 1)
        return last if last >= grid.start_ns else None

    @property
    def has_scenario(self) -> bool:
        """Whether the scenario of the run is intact."""
        return SCENARIO_FILE in self.log.attachments

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        components = {}
        for name, own in self.rows.items():
            lost = []
            for interval in own.lost:
                first = interval.first_ns / NANOSECONDS
                last = interval.last_ns / NANOSECONDS
                lost.append({"from": first, "to": last, "rows": interval.count})
            components[name] = {"rows": own.count, "lost": lost}
        return {
            "log": str(self.log.path),
            "status": self.log.status,
            "reason": self.log.reason,
            "end": self.end_ns / NANOSECONDS,
            "end_is_known": self.end_is_known,
            "has_all_messages": self.has_all_messages,
            "has_scenario": self.has_scenario,
            "components": components,
        }


def recover(path: Path, out: Path, *, force: bool = False) -> RecoveredLog:
    """Write all rows and messages of the intact chunks of a file to a log that can be opened.

    Parameters
    ----------
    path : Path
        Of a damaged or truncated log of cosim.
    out : Path
    force : bool
        Replace an existing file.

    Raises
    ------
    LogError
        If nothing in the file says what rows are, or none is intact; if the file cannot be read, or
        ``out`` cannot be written, or is that file.
    """
    path = log_path(path)
    target = UnfinishedLog(out, force=force)
    target.check_not_read([path])
    found = salvage(path)
    declared = _pieces(path, found)
    pieces = _complete_components(declared)
    times, counts = _times(path, found, pieces)
    if not any(len(time_ns) for time_ns in times.values()):
        raise LogError(f"{path}: no intact row; run it again")
    selection = _Selection(pieces, times)
    rows, end_ns, end_is_known = _missing(declared, times)
    end = _end(path, pieces, rows, times)
    has_all_messages = _has_all_messages(found, pieces, counts)
    if not has_all_messages:  # without them it is not the log of the run, whatever its hash is
        kept = {name: items for name, items in pieces.metadata.items() if name not in OF_THE_END}
        pieces = replace(pieces, metadata=kept)
    batches = gathered(intact_blocks(path, found), pieces.dtypes, selection.wanted)
    log = write_log(target, pieces, batches, lambda _: end)
    return RecoveredLog(log, rows, end_ns, end_is_known, has_all_messages)


def _pieces(path: Path, found: Salvage) -> LogPieces:
    """Return the pieces that are intact, of components that are complete.

    Raises
    ------
    LogError
        If none says what the rows are.
    """
    channels = []
    for channel in found.channels.values():
        if channel.schema_id in found.schemas:
            channels.append(channel)
    channels.sort(key=lambda channel: channel.id)
    used = {channel.schema_id for channel in channels}
    schemas = [schema for number, schema in sorted(found.schemas.items()) if number in used]
    attachments = list(found.attachments.values())
    pieces = LogPieces(schemas, channels, found.metadata, attachments)
    try:
        has_components = bool(pieces.parts)
    except (*MALFORMED, GraphError) as error:
        raise LogError(f"{path}: its channels cannot be parsed: {error}") from error
    if not has_components:
        raise LogError(
            f"{path}: no intact channel of a component, neither in the head of the file nor in "
            "its summary, so the rows cannot be interpreted"
        )
    return pieces


def _complete_components(pieces: LogPieces) -> LogPieces:
    """Return the pieces without components that have lost a channel: no row is whole there."""
    sizes: dict[str, int] = {}
    for part in pieces.parts.values():
        name = part.channel.name
        sizes[name] = sizes.get(name, 0) + part.size
    lost = set()
    for number, part in pieces.parts.items():
        width = part.channel.columns.stop - part.channel.start
        if sizes[part.channel.name] != width:
            lost.add(number)
    return replace(pieces, channels=[own for own in pieces.channels if own.id not in lost])


def _has_all_messages(found: Salvage, pieces: LogPieces, counts: Mapping[int, int]) -> bool:
    """Return whether nothing beside rows is lost, by the statistics of the file."""
    others = found.counts.keys() - pieces.parts.keys()
    return bool(found.counts) and all(
        counts.get(number, 0) >= found.counts[number] for number in others
    )


def _times(
    path: Path, found: Salvage, pieces: LogPieces
) -> tuple[dict[str, Nanoseconds], dict[int, int]]:
    """Return when all parts of a component have rows, by its name, and how many messages there are.

    The instants ascend; the messages are those that are not rows, by their channels, each once.
    """
    messages: dict[int, set[bytes]] = defaultdict(set)
    known: dict[int, list[Nanoseconds]] = {number: [] for number in pieces.parts}

    def keep_times(number: int, time_ns: Nanoseconds, contents: list[bytes] | None) -> Mask:
        if contents is None:
            known[number].append(time_ns)
        else:
            messages[number].update(contents)
        return np.zeros(len(time_ns), np.bool_)

    try:
        for _ in gathered(intact_blocks(path, found), pieces.dtypes, keep_times):
            pass
    except MALFORMED as error:
        raise LogError(f"{path}: an intact chunk cannot be parsed: {error}") from error
    times: dict[str, Nanoseconds] = {}
    for number, part in pieces.parts.items():
        own = np.unique(np.concatenate([np.empty(0, np.int64), *known[number]]))
        name = part.channel.name
        times[name] = np.intersect1d(times[name], own) if name in times else own
    return times, {number: len(own) for number, own in messages.items()}


@final
class _Selection:
    """Says of the messages of intact chunks, in their order, which are to be written.

    Each row once, and only where all parts of its component have one; of messages that are not rows
    each once.
    """

    def __init__(self, pieces: LogPieces, times: Mapping[str, Nanoseconds]) -> None:
        self._names = {number: part.channel.name for number, part in pieces.parts.items()}
        self._times = times
        self._known = {channel.id for channel in pieces.channels}
        self._taken = {
            number: np.zeros(len(times[name]), np.bool_) for number, name in self._names.items()
        }
        self._messages: set[tuple[int, bytes]] = set()

    def wanted(self, number: int, time_ns: Nanoseconds, contents: list[bytes] | None) -> Mask:
        """Return which of some messages of a channel are wanted."""
        if number not in self._known:
            return np.zeros(len(time_ns), np.bool_)
        if contents is None:
            return self._wanted_rows(number, time_ns)
        return self._wanted_messages(number, contents)

    def _wanted_rows(self, number: int, time_ns: Nanoseconds) -> Mask:
        all_times = self._times[self._names[number]]
        taken = self._taken[number]
        wanted: Mask = np.zeros(len(time_ns), np.bool_)
        if not len(all_times):
            return wanted
        places = np.searchsorted(all_times, time_ns)
        places[places == len(all_times)] = 0
        # First: a row that is not wanted has the place of the next one that is.
        possible = np.flatnonzero((all_times[places] == time_ns) & ~taken[places])
        _, firsts = np.unique(places[possible], return_index=True)
        wanted[possible[firsts]] = True
        taken[places[wanted]] = True
        return wanted

    def _wanted_messages(self, number: int, contents: Iterable[bytes]) -> Mask:
        wanted = []
        for content in contents:
            key = number, content
            wanted.append(key not in self._messages)
            self._messages.add(key)
        return np.array(wanted, np.bool_)


def _missing(
    pieces: LogPieces, times: Mapping[str, Nanoseconds]
) -> tuple[dict[str, RecoveredRows], int, bool]:
    """Return the missing rows of each component, up to when, and whether that is the end."""
    last_row = max(int(own[-1]) for own in times.values() if len(own))
    of_file = pieces.metadata.get(RESULT, {})
    known_end = of_file.get("end_ns", "")
    end_ns = int(known_end) if known_end.isdecimal() else last_row
    first_row = min(int(own[0]) for own in times.values() if len(own))
    # The file of a part of a run has never had the rows before it.
    is_part = of_file.get("status") == PARTIAL_STATUS
    start_ns = first_row if is_part else min(pieces.start_ns, first_row)
    rows = {}
    for part in pieces.parts.values():
        name = part.channel.name
        grid = Grid(start_ns, part.step_ns)
        own = times.get(name, np.empty(0, np.int64))
        rows[name] = missing_rows(own, grid, part.channel.period, max(end_ns, last_row))
    return rows, end_ns, known_end.isdecimal()


def _end(
    path: Path,
    pieces: LogPieces,
    rows: Mapping[str, RecoveredRows],
    times: Mapping[str, Nanoseconds],
) -> PartEnd:
    """Return how the recovered log ends: a run without holes was interrupted at its last row."""
    last_row = max(int(own[-1]) for own in times.values() if len(own))
    first_row = min(int(own[0]) for own in times.values() if len(own))
    begins = first_row == pieces.start_ns and is_beginning(rows)
    status = "interrupted" if begins else PARTIAL_STATUS
    text = f"recovered from {path.name}"
    return PartEnd(status, text, pieces.steps_to(last_row), last_row)
