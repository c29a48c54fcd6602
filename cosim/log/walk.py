"""Walk an MCAP file from record to record by their lengths, and note where its pieces stand.

A truncated file is told from a damaged one, with the byte.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from cosim.errors import LogError
from cosim.log.layout import HEADER

_SPAN_BYTES = 2**22  # of messages outside chunks that are taken as one piece


@dataclass(frozen=True, slots=True)
class RecordSpan:
    """Where a record, or a span of messages outside chunks, stands: from ``start`` to ``stop``, headers included."""

    opcode: int
    start: int
    stop: int


@dataclass(slots=True)
class FileContents:
    """What a file holds, in the order of the file."""

    data: list[RecordSpan] = field(default_factory=list)  # chunks and spans of messages
    channels: list[RecordSpan] = field(default_factory=list)  # outside chunks
    metadata: list[RecordSpan] = field(default_factory=list)
    attachments: list[RecordSpan] = field(default_factory=list)
    data_end: int = 0
    data_crc: int = 0
    footer: int = 0


def walk(path: Path, stream: BinaryIO) -> FileContents:
    """Go from record to record up to the footer.

    Raises
    ------
    LogError
        If the file is no MCAP, truncated or damaged.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    magic = stream.read(len(MCAP0_MAGIC))
    if magic != MCAP0_MAGIC:
        raise LogError(f"{path} is no MCAP file: it begins with {magic!r}, needed {MCAP0_MAGIC!r}")
    contents, at, opcode = FileContents(), len(MCAP0_MAGIC), 0
    while opcode != Opcode.FOOTER:
        stream.seek(at)
        head = stream.read(HEADER)
        stop = at + HEADER + int.from_bytes(head[1:], "little")
        if len(head) < HEADER or stop > size:
            raise _cut(path, stream, contents, (at, size))
        opcode = head[0]
        _sort(contents, RecordSpan(opcode, at, stop))
        if opcode == Opcode.DATA_END and not contents.data_end:
            contents.data_end, contents.data_crc = at, int.from_bytes(stream.read(4), "little")
        at = stop
    stream.seek(at)
    if stream.read(len(MCAP0_MAGIC) + 1) != MCAP0_MAGIC:
        raise _cut(path, stream, contents, (at, size))
    return contents


def _cut(path: Path, stream: BinaryIO, contents: FileContents, end: tuple[int, int]) -> LogError:
    """Make the error of a file without its end, of which what stands before the first byte of ``end`` is whole."""
    at, size = end
    stream.seek(max(size - len(MCAP0_MAGIC), 0))
    if stream.read() == MCAP0_MAGIC:
        return damage(path, at, "no whole record begins there")
    return LogError(
        f"{path} is truncated at byte {size}: the run was killed before it could close the log, or still goes on, and there is no"
        f" complete summary; {_whole(stream, contents)}"
    )


def _whole(stream: BinaryIO, contents: FileContents) -> str:
    """Say how much is there, and what to do."""
    chunks = [place for place in contents.data if place.opcode == Opcode.CHUNK]
    if not chunks:
        return "no row is whole: run it again"
    stream.seek(chunks[-1].start + HEADER + 8)  # behind the time of its first message
    end_ns = int.from_bytes(stream.read(8), "little")
    return f"it is whole up to t = {end_ns / 1e9} s: run it again, or save that with 'mcap recover'"


def damage(path: Path, offset: int, reason: str) -> LogError:
    """Make the error that says where a file is damaged."""
    return LogError(f"{path} is damaged at byte {offset}: {reason}")


def _sort(contents: FileContents, place: RecordSpan) -> None:
    """Put a record where it belongs."""
    if place.opcode == Opcode.FOOTER:
        contents.footer = place.start
    elif contents.data_end:
        return  # the summary repeats what was there
    elif place.opcode == Opcode.CHUNK:
        contents.data.append(place)
    elif place.opcode == Opcode.METADATA:
        contents.metadata.append(place)
    elif place.opcode == Opcode.ATTACHMENT:
        contents.attachments.append(place)
    elif place.opcode == Opcode.CHANNEL:
        contents.channels.append(place)
    elif place.opcode == Opcode.MESSAGE:
        last = contents.data[-1] if contents.data else None
        if (
            last
            and last.opcode == Opcode.MESSAGE
            and last.stop == place.start
            and place.stop - last.start <= _SPAN_BYTES
        ):
            place = RecordSpan(Opcode.MESSAGE, contents.data.pop().start, place.stop)
        contents.data.append(place)
