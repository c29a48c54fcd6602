"""The topics of an MCAP file of another tool, and its messages in one pass.

The times of the messages of a topic: their order, repeated instants, and the largest gap.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cosim.errors import LogError
from cosim.instants import NANOSECONDS
from cosim.log.container import Container
from cosim.log.files import open_file
from cosim.log.places import (
    MALFORMED,
    OWN_LIBRARY,
    library_of,
    parsed,
    read_summary,
    records_in,
)

Instants = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Spacing:
    """Messages in time.

    Parameters
    ----------
    count : int
    first_ns, last_ns : int
        Earliest and latest time.
    late : int
        Messages that stand after one of a later time.
    repeated : int
        Messages of an instant that a later one in the file has, too.
    median_ns, largest_ns : int
        Distances of instants that follow each other; 0: there is one instant.
    largest_at_ns : int
        Where the largest distance begins, the first of several.
    """

    count: int
    first_ns: int
    last_ns: int
    late: int
    repeated: int
    median_ns: int
    largest_ns: int
    largest_at_ns: int

    @property
    def rate(self) -> float | None:
        """Messages per second at the median distance [Hz]; None: there is one instant."""
        return NANOSECONDS / self.median_ns if self.median_ns else None

    def disorder_text(self) -> str:
        """Return what is wrong with the order of the messages; empty: nothing is."""
        texts = []
        if self.late:
            texts.append(f"{self.late} of {self.count} messages out of order, sorted by time")
        if self.repeated:
            texts.append(
                f"{self.repeated} of {self.count} messages dropped: a later one in the file has "
                "the same time"
            )
        return "; ".join(texts)


def spacing_of(stamps: Instants) -> Spacing:
    """Return how messages lie in time.

    Parameters
    ----------
    stamps : Instants, shape (N,)
        Their times in the order of the file [ns], at least one.
    """
    late = int(np.count_nonzero(stamps < np.maximum.accumulate(stamps)))
    instants = np.unique(stamps)
    repeated = len(stamps) - len(instants)
    # unsigned: between the ends of int64 lie more than it has
    gaps = np.diff(instants.view(np.uint64))
    place = int(gaps.argmax()) if len(gaps) else 0
    return Spacing(
        len(stamps),
        int(instants[0]),
        int(instants[-1]),
        late,
        repeated,
        int(np.median(gaps)) if len(gaps) else 0,
        int(gaps[place]) if len(gaps) else 0,
        int(instants[place]),
    )


OWN_METADATA: Final = "cosim.run"
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


@dataclass(frozen=True, slots=True)
class ForeignSchema:
    """What the messages of a channel are made of, as the file says it."""

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class ForeignChannel:
    """A channel of messages; several may have one topic.

    Parameters
    ----------
    id : int
    topic : str
    encoding : str
        Of the messages.
    schema : ForeignSchema or None
    """

    id: int
    topic: str
    encoding: str
    schema: ForeignSchema | None


class ForeignMessage(NamedTuple):
    """A message, and its two times [ns]."""

    channel: ForeignChannel
    log_time: int
    publish_time: int
    data: bytes


class _ChannelTable:
    """Schemas and channels of a file, each id with one meaning.

    Raises
    ------
    LogError
        If one is damaged, or has the id of another one.
    """

    def __init__(self, file: Container) -> None:
        self.channels: dict[int, ForeignChannel] = {}
        self._path = file.path
        self._schemas: dict[int, ForeignSchema] = {}
        for record in (*file.schemas().values(), *file.channels().values()):
            self._add(record)

    def take(self, opcode: int, content: memoryview) -> None:
        """Take the content of a record that stands among the messages."""
        kinds = {Opcode.SCHEMA: records.Schema, Opcode.CHANNEL: records.Channel}
        if opcode in kinds:
            try:
                record = parsed(kinds[Opcode(opcode)], content)
            except MALFORMED as error:
                reason = f"a schema or channel cannot be read: {error}"
                raise LogError(f"{self._path} is damaged: {reason}") from error
            self._add(record)

    def _add(self, record: records.Schema | records.Channel) -> None:
        problem = ""
        if isinstance(record, records.Schema):
            schema = ForeignSchema(record.name, record.encoding, bytes(record.data))
            if self._schemas.setdefault(record.id, schema) != schema:
                problem = f"schema {record.id} is defined twice"
        elif record.schema_id and record.schema_id not in self._schemas:
            problem = f"there is no schema {record.schema_id} of {record.topic!r}"
        else:
            own = self._schemas.get(record.schema_id)
            channel = ForeignChannel(record.id, record.topic, record.message_encoding, own)
            if self.channels.setdefault(record.id, channel) != channel:
                problem = f"channel {record.id} is defined twice"
        if problem:
            raise LogError(f"{self._path} is damaged: {problem}")


def read_channels(path: Path) -> list[ForeignChannel]:
    """Return the channels of a file: those of its summary, or else of a pass over it.

    Raises
    ------
    LogError
        If it cannot be read, is not MCAP, truncated or damaged.
    """
    return list(_ChannelTable(Container(path)).channels.values())


def is_foreign(path: Path) -> bool:
    """Return whether a file is an MCAP that another tool has written, as far as can be seen.

    A log of a run that another tool has copied still lists the metadata of the run.
    """
    try:
        with open_file(path) as stream:
            library = library_of(stream)
            if library is None or library.startswith(OWN_LIBRARY):
                return False
            indexes = read_summary(path, stream).metadata_indexes
            return all(index.name != OWN_METADATA for index in indexes)
    except (LogError, OSError):
        return False  # whoever reads it says what is wrong


def read_messages(
    path: Path,
    wanted: Callable[[ForeignChannel], bool],
    skipped: Callable[[int, int], object] | None = None,
) -> Iterator[ForeignMessage]:
    """Yield the messages of the wanted channels in the order of the file.

    ``skipped`` is called with the two times of each other message.

    Raises
    ------
    LogError
        If the file cannot be read, is not MCAP, truncated or damaged.
    """
    file = Container(path)
    table = _ChannelTable(file)
    is_wanted: dict[int, bool] = {}
    try:
        for block in file.blocks():
            for opcode, begin, stop in records_in(block):
                if opcode != Opcode.MESSAGE:
                    table.take(opcode, block[begin:stop])
                    continue
                number, _, log_time, publish_time = _MESSAGE.unpack_from(block, begin)
                if number not in is_wanted:
                    if number not in table.channels:
                        raise ValueError(f"a message of the undeclared channel {number}")
                    is_wanted[number] = wanted(table.channels[number])
                if is_wanted[number]:
                    data = bytes(block[begin + _MESSAGE.size : stop])
                    yield ForeignMessage(table.channels[number], log_time, publish_time, data)
                elif skipped is not None:
                    skipped(log_time, publish_time)
    except (ValueError, struct.error) as error:
        raise LogError(f"{path} is damaged: {error}") from error
