"""Find the intact records of a damaged MCAP file by their content, wherever they are.

A record counts as intact if its content proves it: a chunk by the CRC of its decompressed records,
an attachment by its CRC, metadata and channels of cosim by their checksums, a schema if it can be
read to its last byte. What lies between intact records is searched byte by byte, so that a wrong
length or a lost page costs no more than the records that it is in. The holes, slots and pads of an
unfinished file are searched, too: chunks there that were replaced by later ones have rows of the
run; rows that are found twice are recognized by their times.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, Final

from isal import isal_zlib
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

from cosim.errors import LogError
from cosim.log.contents.metadata import PREFIX, verify_checksum
from cosim.log.mcap_file.compression import MOST_BYTES, decompress
from cosim.log.mcap_file.paths import open_file
from cosim.log.mcap_file.records import HEADER, RECORD_HEADER
from cosim.log.reading.container import MALFORMED, MOST_ATTACHED

_CHUNK: Final = struct.Struct("<QQQII")  # first and last time, size, CRC, length of the name
_MOST_NAME: Final = 16  # of a compression
# Opcodes of what is looked for, and lengths below 2**40: other records have these bytes by chance
# now and then, and are refused by their content.
_CANDIDATE: Final = re.compile(rb"[\x03\x04\x06\x09\x0b\x0c].{5}\x00\x00\x00", re.DOTALL)
_MOST_FACTS: Final = 2**24  # bytes of a schema, a channel or metadata
_LARGEST: Final = {Opcode.CHUNK: MOST_BYTES, Opcode.ATTACHMENT: MOST_ATTACHED}
_ATTACHMENT_TIMES: Final = 16  # bytes
_OF_CHANNELS: Final = "cosim.channel"  # what their metadata have a checksum as


@dataclass(slots=True)
class Salvage:
    """What is intact in a file.

    Attributes
    ----------
    chunks : list of (int, int)
        Where they begin and end.
    counts : mapping of channel id to int
        How many messages the file had, of its last statistics; empty: there are none.
    """

    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, records.Attachment] = field(default_factory=dict)
    chunks: list[tuple[int, int]] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)


def salvage(path: Path) -> Salvage:
    """Find all intact records of a file.

    Raises
    ------
    LogError
        If the file cannot be read, or is empty.
    """
    found = Salvage()
    with open_file(path) as stream:
        try:
            content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        except ValueError as error:
            raise LogError(f"{path} is empty") from error
        with content:
            position = 0
            while True:
                match = _CANDIDATE.search(content, position)
                if match is None:
                    break
                start = match.start()
                del match  # it holds the mapping
                stop = _keep(found, content, start)
                position = start + 1 if stop is None else stop
    return found


def intact_blocks(path: Path, found: Salvage) -> Iterator[bytes]:
    """Yield the records of the intact chunks, in the order of the file."""
    with open_file(path) as stream:
        for start, stop in found.chunks:
            stream.seek(start)
            yield _chunk(stream.read(stop - start)[HEADER:])


def _keep(found: Salvage, content: mmap.mmap, start: int) -> int | None:
    """Keep the record that begins at ``start``; return its end, None: there is no intact one."""
    opcode, length = RECORD_HEADER.unpack_from(content, start)
    stop: int = start + HEADER + length
    if stop > len(content) or length > _LARGEST.get(opcode, _MOST_FACTS):
        return None
    # Cheap, before anything is copied.
    fits = _SIZES_FIT.get(opcode)
    if fits is not None and not fits(content, start + HEADER, stop):
        return None
    try:
        data = content[start + HEADER : stop]
        match opcode:
            case Opcode.CHUNK:
                _chunk(data)
                found.chunks.append((start, stop))
            case Opcode.SCHEMA:
                schema = _whole(records.Schema, data)
                _check_schema(schema)
                found.schemas.setdefault(schema.id, schema)
            case Opcode.CHANNEL:
                channel = _whole(records.Channel, data)
                _check_channel(channel)
                found.channels.setdefault(channel.id, channel)
            case Opcode.METADATA:
                item = _whole(records.Metadata, data)
                if not item.name:
                    raise ValueError("metadata without a name")
                verify_checksum(item.name, item.metadata)
                found.metadata[item.name] = item.metadata
            case Opcode.STATISTICS:
                found.counts = max(found.counts, _message_counts(data), key=_total)
            case _:
                attachment = _attachment(data)
                found.attachments[attachment.name] = attachment
    except (*MALFORMED, EOFError, AssertionError):
        return None
    return stop


def _total(counts: Mapping[int, int]) -> int:
    return sum(counts.values())


def _message_counts(data: bytes) -> dict[int, int]:
    """Return the messages of each channel, of statistics.

    Raises
    ------
    ValueError
        If nothing vouches for them: no CRC does.
    """
    statistics = _whole(records.Statistics, data)
    counts: dict[int, int] = statistics.channel_message_counts
    if not counts or _total(counts) != statistics.message_count:
        raise ValueError("statistics that do not add up")
    return counts


def _is_chunk(content: mmap.mmap, start: int, stop: int) -> bool:
    """Return whether the sizes in what may be a chunk fit together."""
    if stop - start < _CHUNK.size + 8:
        return False
    first_ns, last_ns, size, _, name_length = _CHUNK.unpack_from(content, start)
    if first_ns > last_ns or size > MOST_BYTES or name_length > _MOST_NAME:
        return False
    data_start = start + _CHUNK.size + name_length + 8
    if data_start > stop:
        return False
    (data_length,) = struct.unpack_from("<Q", content, data_start - 8)
    return bool(data_start + data_length == stop)


def _chunk(data: bytes) -> bytes:
    """Return the records of a chunk.

    Raises
    ------
    ValueError
        If nothing vouches for them.
    """
    _, _, size, crc, name_length = _CHUNK.unpack_from(data)
    name_stop = _CHUNK.size + name_length
    compression = data[_CHUNK.size : name_stop].decode()
    if not crc:
        raise ValueError("a chunk without a CRC")
    return decompress(data[name_stop + 8 :], compression, size=size, crc=crc)


def _is_attachment(content: mmap.mmap, start: int, stop: int) -> bool:
    """Return whether the sizes in what may be an attachment fit together."""
    position = start + _ATTACHMENT_TIMES
    for _ in range(2):  # its name and its type
        if position + 4 > stop:
            return False
        position += 4 + int.from_bytes(content[position : position + 4], "little")
    if position + 8 > stop:
        return False
    size = int.from_bytes(content[position : position + 8], "little")
    return bool(position + 8 + size + 4 == stop)


_SIZES_FIT: Final = {Opcode.CHUNK: _is_chunk, Opcode.ATTACHMENT: _is_attachment}


def _whole(kind: Any, data: bytes) -> Any:
    """Read a record to its last byte."""
    stream = BytesIO(data)
    record = kind.read(ReadDataStream(stream))
    if stream.tell() != len(data):
        raise ValueError("a record of another length")
    return record


def _check_schema(schema: records.Schema) -> None:
    """Check that a schema is of protobuf: some bytes look like a record of nothing."""
    if schema.encoding != "protobuf" or not schema.name or not schema.data:
        raise ValueError("a schema of another kind")


def _check_channel(channel: records.Channel) -> None:
    """Check that a channel is one of cosim."""
    if channel.message_encoding != "protobuf" or not channel.topic.startswith("/"):
        raise ValueError("a channel of another kind")
    if any(key.startswith(PREFIX) for key in channel.metadata):
        verify_checksum(_OF_CHANNELS, channel.metadata)


def _attachment(data: bytes) -> records.Attachment:
    crc = int.from_bytes(data[-4:], "little")
    if not crc or isal_zlib.crc32(data[:-4]) != crc:
        raise ValueError("the CRC of an attachment does not match its content")
    return records.Attachment.read(ReadDataStream(BytesIO(data)))
