"""What is intact in a damaged log, written to a new log, and which rows are lost.

Rows that are found twice are recognized by their times.
"""

from __future__ import annotations

import mmap
import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final, final

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

from cosim.arrays import Mask, Nanoseconds
from cosim.core.recorded.run import SCENARIO_FILE
from cosim.errors import LogError
from cosim.instants import NANOSECONDS, Grid
from cosim.log.chunks import CHUNK_HEAD, MOST_BYTES, decompressed, read_chunk_header
from cosim.log.container import Container
from cosim.log.files import UnfinishedLog, check_not_read, log_path
from cosim.log.mcap_records import HEADER, RECORD_HEADER
from cosim.log.metadata import PREFIX, verify_checksum
from cosim.log.pieces import LogPieces, gathered, write_log
from cosim.log.places import (
    ATTACHMENT_TIMES,
    MALFORMED,
    MOST_ATTACHED,
    Places,
    check_attachment,
    parsed,
)
from cosim.log.preamble import PARTIAL_STATUS, RESULT
from cosim.log.reader import Log


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
    lost_records : int
        Metadata records and attachments that are lost; 0 also where the file does not say any more
        how many there were.
    """

    log: Log
    rows: Mapping[str, RecoveredRows]
    end_ns: int
    end_is_known: bool
    has_all_messages: bool
    lost_records: int

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
            **({"lost_records": self.lost_records} if self.lost_records else {}),
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
    check_not_read(out, [path])
    target = UnfinishedLog(out, force=force)
    file = Container(path, find=searched)
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
    return RecoveredLog(log, rows, end_ns, end_is_known, has_all_messages, _lost_records(file))


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


def _lost_records(file: Container) -> int:
    """Return how many metadata records and attachments are lost, by the statistics of the file."""
    statistics = file.summary.statistics
    if statistics is None:
        return 0
    others = file.places.others
    metadata: int = statistics.metadata_count - len(others[Opcode.METADATA])
    attachments: int = statistics.attachment_count - len(others[Opcode.ATTACHMENT])
    return max(metadata, 0) + max(attachments, 0)


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


# --- the intact records of a damaged file ---

# Opcodes of what is looked for, and lengths below 2**40: other records have these bytes by chance
# now and then, and are refused by their content.
_CANDIDATE: Final = re.compile(rb"[\x03\x04\x06\x09\x0b\x0c].{5}\x00\x00\x00", re.DOTALL)
_MOST_FACTS: Final = 2**24  # bytes of a schema, a channel or metadata
_LARGEST: Final = {Opcode.CHUNK: MOST_BYTES, Opcode.ATTACHMENT: MOST_ATTACHED}
_OF_CHANNELS: Final = "cosim.channel"  # what their metadata have a checksum as


def searched(path: Path, stream: BinaryIO) -> Places:
    """Return where the intact records of a damaged log stand.

    A record is intact if its content proves it: a chunk by the CRC of its decompressed records, an
    attachment by its CRC, metadata and channels of cosim by their checksums, a schema if it can be
    read to its last byte. What lies between is searched byte by byte, so that a wrong length or a
    lost page costs no more than the records that it is in. The holes, slots and pads of an
    unfinished file are searched, too: chunks there that were replaced by later ones have rows of
    the run. Of all statistics those of most messages are the summary.

    Raises
    ------
    LogError
        If the file is empty.
    """
    places = Places()
    try:
        content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except ValueError as error:
        raise LogError(f"{path} is empty; expected an MCAP file") from error
    with content:
        position = 0
        while True:
            match = _CANDIDATE.search(content, position)
            if match is None:
                return places
            position = match.start()
            del match  # it holds the mapping
            position = _intact_end(places, content, position) or position + 1


def _intact_end(places: Places, content: mmap.mmap, start: int) -> int:
    """Add the record that begins at ``start``; return its end, 0: there is no intact one."""
    opcode, length = RECORD_HEADER.unpack_from(content, start)
    stop: int = start + HEADER + length
    if stop > len(content) or length > _LARGEST.get(opcode, _MOST_FACTS):
        return 0
    try:
        # cheap, before anything is copied
        if opcode == Opcode.CHUNK:
            header = read_chunk_header(content[start : start + CHUNK_HEAD], stop - start)
            if header.first_ns > header.last_ns or header.data_stop != stop - start:
                return 0
        if opcode == Opcode.ATTACHMENT and not _is_attachment(content, start + HEADER, stop):
            return 0
        _check_intact(opcode, content[start:stop])
    except (*MALFORMED, EOFError, AssertionError):
        return 0
    if opcode == Opcode.STATISTICS:
        found = parsed(records.Statistics, content[start + HEADER : stop])
        known = places.summary.statistics
        if known is None or found.message_count > known.message_count:
            places.summary.statistics = found
    else:
        places.add(opcode, start, stop)
    return stop


def _is_attachment(content: mmap.mmap, start: int, stop: int) -> bool:
    """Return whether the sizes in what may be an attachment fit together."""
    position = start + ATTACHMENT_TIMES
    for _ in range(2):  # its name and its type
        if position + 4 > stop:
            return False
        position += 4 + int.from_bytes(content[position : position + 4], "little")
    if position + 8 > stop:
        return False
    size = int.from_bytes(content[position : position + 8], "little")
    return bool(position + 8 + size + 4 == stop)


def _check_intact(opcode: int, record: bytes) -> None:
    """Check that a record is intact, as its content proves.

    Raises
    ------
    ValueError
        If it is not; or another of what is malformed.
    """
    match opcode:
        case Opcode.CHUNK:
            if not read_chunk_header(record, len(record)).crc:
                raise ValueError("a chunk without a CRC")
            decompressed(record)
            is_ours = True
        case Opcode.ATTACHMENT:
            check_attachment(record, needs_crc=True)
            parsed(records.Attachment, record[HEADER:])
            is_ours = True
        case Opcode.METADATA:
            item = _whole(records.Metadata, record)
            verify_checksum(item.name, item.metadata)
            is_ours = bool(item.name)
        case Opcode.SCHEMA:  # some bytes look like a record of nothing
            schema = _whole(records.Schema, record)
            is_ours = schema.encoding == "protobuf" and schema.name and schema.data
        case Opcode.CHANNEL:
            channel = _whole(records.Channel, record)
            is_ours = channel.message_encoding == "protobuf" and channel.topic.startswith("/")
            if any(key.startswith(PREFIX) for key in channel.metadata):
                verify_checksum(_OF_CHANNELS, channel.metadata)
        case _:  # nothing vouches for statistics but that they add up
            found = _whole(records.Statistics, record)
            counts = found.channel_message_counts.values()
            is_ours = found.message_count and sum(counts) == found.message_count
    if not is_ours:
        raise ValueError("a record of another kind")


def _whole(kind: Any, record: bytes) -> Any:
    """Read a record to its last byte."""
    content = BytesIO(record[HEADER:])
    value = kind.read(ReadDataStream(content))
    if content.tell() != len(record) - HEADER:
        raise ValueError("a record of another length")
    return value
