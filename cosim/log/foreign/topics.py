"""The topics of an MCAP file of another tool, and its messages in one pass."""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from isal import isal_zlib
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from cosim.errors import LogError
from cosim.log.foreign.record_stream import check_magic, read_records, records_in
from cosim.log.mcap_file.compression import MOST_BYTES
from cosim.log.mcap_file.paths import open_file
from cosim.log.mcap_file.records import FOOTER_SIZE, HEADER, MAGIC

OWN_LIBRARY: Final = "cosim/"
OWN_METADATA: Final = "cosim.run"
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_MALFORMED: Final = (McapError, ValueError, KeyError, TypeError, OverflowError, struct.error)


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
    """Schemas and channels as they are read, each id with one meaning."""

    def __init__(self, path: Path) -> None:
        self.channels: dict[int, ForeignChannel] = {}
        self._path = path
        self._schemas: dict[int, ForeignSchema] = {}

    def add(self, opcode: int, content: bytes) -> None:
        """Take the content of a schema or channel record.

        Raises
        ------
        LogError
            If it is damaged, or has the id of another one.
        """
        stream = _stream_of(content)
        try:
            if opcode == Opcode.SCHEMA:
                self._add_schema(records.Schema.read(stream))
            else:
                self._add_channel(records.Channel.read(stream))
        except _MALFORMED as error:
            reason = f"a schema or channel cannot be read: {error}"
            raise LogError(f"{self._path} is damaged: {reason}") from error

    def _add_schema(self, record: records.Schema) -> None:
        schema = ForeignSchema(record.name, record.encoding, bytes(record.data))
        known = self._schemas.setdefault(record.id, schema)
        if known != schema:
            raise ValueError(f"schema {record.id} is defined twice")

    def _add_channel(self, record: records.Channel) -> None:
        schema = None
        if record.schema_id:
            if record.schema_id not in self._schemas:
                raise ValueError(f"there is no schema {record.schema_id} of {record.topic!r}")
            schema = self._schemas[record.schema_id]
        channel = ForeignChannel(record.id, record.topic, record.message_encoding, schema)
        known = self.channels.setdefault(record.id, channel)
        if known != channel:
            raise ValueError(f"channel {record.id} is defined twice")


def read_channels(path: Path) -> list[ForeignChannel]:
    """Return the channels of a file: those of its summary, or else of a pass over it.

    Raises
    ------
    LogError
        If it cannot be read, is not MCAP, truncated or damaged.
    """
    table = _ChannelTable(path)
    try:
        with open_file(path) as stream:
            check_magic(path, stream, os.fstat(stream.fileno()).st_size)
            for opcode, content in _summary_records(stream):
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    table.add(opcode, content)
    except (LogError, *_MALFORMED):
        table = _ChannelTable(path)  # the data say what is wrong, or are right without it
    if not table.channels:
        with open_file(path) as stream:
            for opcode, block, begin, stop in read_records(path, stream):
                if opcode != Opcode.MESSAGE:
                    table.add(opcode, block[begin:stop])
    return list(table.channels.values())


def is_foreign(path: Path) -> bool:
    """Return whether a file is an MCAP that another tool has written, as far as can be seen.

    A log of a run that another tool has copied still lists the metadata of the run.
    """
    try:
        with open_file(path) as stream:
            check_magic(path, stream, os.fstat(stream.fileno()).st_size)
            if _library(stream).startswith(OWN_LIBRARY):
                return False
            for opcode, content in _summary_records(stream):
                if opcode == Opcode.METADATA_INDEX:
                    index = records.MetadataIndex.read(_stream_of(content))
                    if index.name == OWN_METADATA:
                        return False
    except (LogError, OSError, *_MALFORMED):
        return False  # whoever reads it says what is wrong
    return True


def _library(stream: BinaryIO) -> str:
    """Return what wrote a file, by the record after its first bytes."""
    opcode, length = struct.unpack("<BQ", stream.read(HEADER))
    if opcode != Opcode.HEADER or length > MOST_BYTES:
        raise ValueError("the file does not begin with a header")
    return str(records.Header.read(_stream_of(stream.read(length))).library)


def _stream_of(content: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


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
    table = _ChannelTable(path)
    is_wanted: dict[int, bool] = {}
    with open_file(path) as stream:
        for opcode, block, begin, stop in read_records(path, stream):
            if opcode != Opcode.MESSAGE:
                table.add(opcode, block[begin:stop])
                continue
            if stop - begin < _MESSAGE.size:
                raise LogError(f"{path} is damaged: a message of {stop - begin} bytes")
            number, _, log_time, publish_time = _MESSAGE.unpack_from(block, begin)
            if number not in is_wanted:
                if number not in table.channels:
                    raise LogError(
                        f"{path} is damaged: a message of the undeclared channel {number}"
                    )
                is_wanted[number] = wanted(table.channels[number])
            if not is_wanted[number]:
                if skipped is not None:
                    skipped(log_time, publish_time)
            else:
                data = block[begin + _MESSAGE.size : stop]
                yield ForeignMessage(table.channels[number], log_time, publish_time, data)


def _summary_records(stream: BinaryIO) -> list[tuple[int, bytes]]:
    """Return opcode and content of the records in the summary; none where there is no summary.

    Raises
    ------
    ValueError, struct.error
        If it is damaged.
    """
    size = os.fstat(stream.fileno()).st_size
    footer_start = size - FOOTER_SIZE - len(MAGIC)
    if footer_start < len(MAGIC):
        return []
    stream.seek(footer_start)
    footer = stream.read(FOOTER_SIZE)
    start, _, declared = struct.unpack_from("<QQI", footer, HEADER)
    if footer[0] != Opcode.FOOTER or not start:
        return []
    if not len(MAGIC) < start <= footer_start or footer_start - start > MOST_BYTES:
        raise ValueError(f"invalid start of the summary: byte {start}")
    stream.seek(start)
    content = stream.read(footer_start - start)
    if declared and isal_zlib.crc32(footer[:-4], isal_zlib.crc32(content)) != declared:
        raise ValueError("the CRC of the summary does not match its content")
    return [(opcode, content[begin:stop]) for opcode, begin, stop in records_in(content)]
