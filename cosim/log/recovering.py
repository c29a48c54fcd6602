"""What is intact in a damaged log, written to a new log, and which rows are lost.

Rows that are found twice are recognized by their times.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from cosim.arrays import Mask, Nanoseconds
from cosim.core.recorded.run import SCENARIO_FILE
from cosim.errors import LogError
from cosim.instants import NANOSECONDS, Grid
from cosim.log.container import Container
from cosim.log.files import log_path
from cosim.log.pieces import LogPieces, gathered, write_log
from cosim.log.places import MALFORMED
from cosim.log.preamble import PARTIAL_STATUS, RESULT
from cosim.log.reader import Log
from cosim.log.unfinished import UnfinishedLog


@dataclass(frozen=True, slots=True)
class Interval:
    """Rows that are missing, one after the other.

    Parameters
    ----------
    first_ns, last_ns : int
        Instants of the first and the last of them [ns].
    count : int
        How many there are.
    """

    first_ns: int
    last_ns: int
    count: int


@dataclass(frozen=True, slots=True)
class RecoveredRows:
    """The rows of a component that are there, and the intervals without.

    Parameters
    ----------
    count : int
    lost : tuple of Interval
    """

    count: int
    lost: tuple[Interval, ...]


def missing_rows(time_ns: Nanoseconds, grid: Grid, period: int, end_ns: int) -> RecoveredRows:
    """Return which rows of a component are missing up to ``end_ns``.

    Parameters
    ----------
    time_ns : Nanoseconds, shape (n,)
        Of the rows that are there, ascending.
    grid : Grid
        The communication points of the run; the first row is at its start.
    period : int
        Communication steps between two rows.
    end_ns : int
    """
    # As if there were rows just outside: then every gap is between two.
    outside = np.array([-1, grid.number(end_ns) // period + 1])
    bounded = np.insert(outside, 1, grid.number(time_ns) // period)
    lost = []
    for gap in np.flatnonzero(np.diff(bounded) > 1).tolist():
        first = int(bounded[gap]) + 1
        last = int(bounded[gap + 1]) - 1
        stamps = (grid.stamp(first * period), grid.stamp(last * period))
        lost.append(Interval(*stamps, last - first + 1))
    return RecoveredRows(len(time_ns), tuple(lost))


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
    file = Container(path, is_damaged=True)
    declared = LogPieces.of(file)
    pieces = _complete_components(declared)
    times, counts = _times(file, pieces)
    if not any(len(time_ns) for time_ns in times.values()):
        raise LogError(f"{path}: no intact row; run it again")
    selection = _Selection(pieces, times)
    first_row = min(int(own[0]) for own in times.values() if len(own))
    last_row = max(int(own[-1]) for own in times.values() if len(own))
    of_run = declared.metadata.get(RESULT, {})
    known_end = of_run.get("end_ns", "")
    end_is_known = known_end.isdecimal()
    end_ns = int(known_end) if end_is_known else last_row
    # The file of a part of a run has never had the rows before it.
    is_part = of_run.get("status") == PARTIAL_STATUS
    start_ns = first_row if is_part else min(declared.start_ns, first_row)
    rows = {}
    for part in declared.parts.values():
        name = part.channel.name
        own = times.get(name, np.empty(0, np.int64))
        grid = Grid(start_ns, part.step_ns)
        rows[name] = missing_rows(own, grid, part.channel.period, max(end_ns, last_row))
    # A run without holes was interrupted at its last row.
    is_begun = first_row == pieces.start_ns and not any(own.lost for own in rows.values())
    status = "interrupted" if is_begun else PARTIAL_STATUS
    end = pieces.end_of(status, f"recovered from {path.name}", last_row)
    has_all_messages = _has_all_messages(file, pieces, counts)
    if not has_all_messages:  # without them it is not the log of the run, whatever its hash is
        pieces = replace(pieces, metadata=pieces.kept_metadata)
    batches = gathered(file.blocks(), pieces.dtypes, selection.wanted)
    log = write_log(target, pieces, batches, lambda _: end)
    return RecoveredLog(log, rows, end_ns, end_is_known, has_all_messages)


def _complete_components(pieces: LogPieces) -> LogPieces:
    """Return the pieces without components that have lost a channel: no row is whole there."""
    sizes: Counter[str] = Counter()
    for part in pieces.parts.values():
        sizes[part.channel.name] += part.size
    parts = {}
    for number, part in pieces.parts.items():
        if sizes[part.channel.name] == part.channel.columns.stop - part.channel.start:
            parts[number] = part
    lost = pieces.parts.keys() - parts.keys()
    channels = [own for own in pieces.channels if own.id not in lost]
    return replace(pieces, channels=channels, parts=parts)


def _has_all_messages(file: Container, pieces: LogPieces, counts: Mapping[int, int]) -> bool:
    """Return whether nothing beside rows is lost, by the statistics of the file."""
    statistics = file.summary.statistics
    if statistics is None:
        return False
    of_file = statistics.channel_message_counts
    return all(
        counts.get(number, 0) >= of_file[number] for number in of_file if number not in pieces.parts
    )


def _times(file: Container, pieces: LogPieces) -> tuple[dict[str, Nanoseconds], dict[int, int]]:
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
        for _ in gathered(file.blocks(), pieces.dtypes, keep_times):
            pass
    except MALFORMED as error:
        raise LogError(f"{file.path}: an intact chunk cannot be parsed: {error}") from error
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
        self._times = {number: times[part.channel.name] for number, part in pieces.parts.items()}
        self._taken = {number: np.zeros(len(own), np.bool_) for number, own in self._times.items()}
        self._known = {channel.id for channel in pieces.channels}
        self._messages: set[tuple[int, bytes]] = set()

    def wanted(self, number: int, time_ns: Nanoseconds, contents: list[bytes] | None) -> Mask:
        """Return which of some messages of a channel are wanted."""
        if number in self._taken:
            return self._wanted_rows(number, time_ns)
        wanted = np.zeros(len(time_ns), np.bool_)
        if number in self._known:
            for place, content in enumerate(contents or ()):
                wanted[place] = (number, content) not in self._messages
                self._messages.add((number, content))
        return wanted

    def _wanted_rows(self, number: int, time_ns: Nanoseconds) -> Mask:
        all_times = self._times[number]
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
