"""The topics of an MCAP file of another tool, and its messages in one pass.

The times of the messages of a topic: their order, repeated instants, and the largest gap.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
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


class ForeignSchema(NamedTuple):
    """What the messages of a channel are made of, as the file says it."""

    name: str
    encoding: str
    data: bytes


class ForeignChannel(NamedTuple):
    """Messages of one encoding and schema; several such may have one topic."""

    topic: str
    encoding: str
    schema: ForeignSchema | None


class ForeignMessage(NamedTuple):
    """A message, and its two times [ns]; its data until the next one is asked for."""

    channel: ForeignChannel
    log_time: int
    publish_time: int
    data: memoryview


class _Declared:
    """Schemas and channels of a file, each id with one meaning."""

    def __init__(self, file: Container) -> None:
        self.channels: dict[int, ForeignChannel] = {}
        self._schemas: dict[int, ForeignSchema] = {}
        try:
            for record in (*file.schemas().values(), *file.channels().values()):
                self.add(record)
        except ValueError as error:
            raise LogError(f"{file.path} is damaged: {error}") from error

    def add(self, record: records.Schema | records.Channel) -> None:
        """Add one; raise ValueError if it has the id of another one, or a schema of no id."""
        if isinstance(record, records.Schema):
            schema = ForeignSchema(record.name, record.encoding, bytes(record.data))
            if self._schemas.setdefault(record.id, schema) != schema:
                raise ValueError(f"schema {record.id} is defined twice")
            return
        if record.schema_id and record.schema_id not in self._schemas:
            raise ValueError(f"there is no schema {record.schema_id} of {record.topic!r}")
        own = self._schemas.get(record.schema_id)
        channel = ForeignChannel(record.topic, record.message_encoding, own)
        if self.channels.setdefault(record.id, channel) != channel:
            raise ValueError(f"channel {record.id} is defined twice")


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


class ForeignFile:
    """An MCAP file of another tool: its channels, and its messages in one pass.

    Raises
    ------
    LogError
        If it cannot be read, is not MCAP, truncated or damaged.
    """

    def __init__(self, path: Path) -> None:
        self._file = Container(path)
        self._declared = _Declared(self._file)

    @property
    def channels(self) -> list[ForeignChannel]:
        """Those of its summary, or else of a pass over it."""
        return list(self._declared.channels.values())

    def messages(self) -> Iterator[ForeignMessage]:
        """Yield the messages in the order of the file.

        Raises
        ------
        LogError
            If the file is truncated or damaged.
        """
        channels = self._declared.channels
        kinds = {Opcode.SCHEMA: records.Schema, Opcode.CHANNEL: records.Channel}
        try:
            for block in self._file.blocks():
                for opcode, begin, stop in records_in(block):
                    if opcode == Opcode.MESSAGE:
                        number, _, logged, published = _MESSAGE.unpack_from(block, begin)
                        if number not in channels:
                            raise ValueError(f"a message of the undeclared channel {number}")
                        data = block[begin + _MESSAGE.size : stop]
                        yield ForeignMessage(channels[number], logged, published, data)
                    elif opcode in kinds:
                        self._declared.add(parsed(kinds[Opcode(opcode)], block[begin:stop]))
        except MALFORMED as error:
            raise LogError(f"{self._file.path} is damaged: {error}") from error
