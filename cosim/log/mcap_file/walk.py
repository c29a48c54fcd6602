"""Walk an MCAP file from record to record by their lengths, and note where its pieces are.

The error of a truncated file differs from that of a damaged one; both name the byte.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from cosim.errors import LogError
from cosim.log.mcap_file.records import HEADER, MAGIC

_SPAN_BYTES = 2**22  # of messages outside chunks that are read as one piece


@dataclass(frozen=True, slots=True)
class RecordSpan:
    """Bytes ``start`` to ``stop`` of a record, or of messages outside chunks, headers included."""

    opcode: int
    start: int
    stop: int

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self.stop - self.start


@dataclass(slots=True)
class FileContents:
    """Where the pieces of a file are, in the order of the file."""

    data: list[RecordSpan] = field(default_factory=list)  # chunks and spans of messages
    channels: list[RecordSpan] = field(default_factory=list)  # outside chunks
    metadata: list[RecordSpan] = field(default_factory=list)
    attachments: list[RecordSpan] = field(default_factory=list)
    summary: list[RecordSpan] = field(default_factory=list)  # after the end of the data
    data_end: int = 0
    data_crc: int = 0
    footer: int = 0

    @property
    def chunks(self) -> list[RecordSpan]:
        """The chunks among the data."""
        return [span for span in self.data if span.opcode == Opcode.CHUNK]

    def add(self, span: RecordSpan) -> None:
        """Add a record to the list it belongs to."""
        if span.opcode == Opcode.FOOTER:
            self.footer = span.start
            return
        if self.data_end:  # the summary repeats records of the data section
            self.summary.append(span)
            return
        match span.opcode:
            case Opcode.CHUNK:
                self.data.append(span)
            case Opcode.MESSAGE:
                self._add_message(span)
            case Opcode.CHANNEL:
                self.channels.append(span)
            case Opcode.METADATA:
                self.metadata.append(span)
            case Opcode.ATTACHMENT:
                self.attachments.append(span)

    def _add_message(self, message: RecordSpan) -> None:
        """Lengthen the last span of messages by the one after it, or begin another."""
        if self.data:
            last = self.data[-1]
            joined = RecordSpan(Opcode.MESSAGE, last.start, message.stop)
            is_adjacent = last.opcode == Opcode.MESSAGE and last.stop == message.start
            if is_adjacent and joined.size <= _SPAN_BYTES:
                self.data[-1] = joined
                return
        self.data.append(message)


def walk(path: Path, stream: BinaryIO) -> FileContents:
    """Read the headers of all records up to the footer.

    Raises
    ------
    LogError
        If the file is not MCAP, truncated or damaged.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    magic = stream.read(len(MAGIC))
    if magic != MAGIC:
        # what else stands there is not shown: a stranger's scenario may name any file
        raise LogError(f"{path} is not an MCAP file: expected it to begin with {MAGIC!r}")
    contents = FileContents()
    position = len(MAGIC)
    opcode = 0
    while opcode != Opcode.FOOTER:
        stream.seek(position)
        header = stream.read(HEADER)
        length = int.from_bytes(header[1:], "little")
        stop = position + HEADER + length
        if len(header) < HEADER or stop > size:
            raise _incomplete(path, stream, contents, position=position, size=size)
        opcode = header[0]
        contents.add(RecordSpan(opcode, position, stop))
        if opcode == Opcode.DATA_END and not contents.data_end:
            contents.data_end = position
            contents.data_crc = int.from_bytes(stream.read(4), "little")
        position = stop
    stream.seek(position)
    # One byte more than the magic: nothing may follow it.
    if stream.read(len(MAGIC) + 1) != MAGIC:
        raise _incomplete(path, stream, contents, position=position, size=size)
    return contents


def _incomplete(
    path: Path, stream: BinaryIO, contents: FileContents, *, position: int, size: int
) -> LogError:
    """Return the error of a file of ``size`` bytes with no whole record at ``position``.

    A file that ends with the magic was closed, so a length in it is wrong; else its end is missing.
    """
    stream.seek(max(size - len(MAGIC), 0))
    if stream.read() == MAGIC:
        return damage_error(path, position, "no complete record begins there")
    return LogError(
        f"{path} is truncated at byte {size}: its end is missing, as after an interrupted "
        f"copy; {_rescue(stream, contents)}"
    )


def _rescue(stream: BinaryIO, contents: FileContents) -> str:
    """Return what is left of a truncated file, and the way out, for its error.

    A chunk holds rows of some components, so that others may end long before it.
    """
    chunks = contents.chunks
    if not chunks:
        return "it has no complete row: run it again"
    last = chunks[-1]
    stream.seek(last.start + HEADER + 8)  # after the time of its first message
    end_ns = int.from_bytes(stream.read(8), "little")
    return (
        f"its last complete chunk ends at t = {end_ns / 1e9} s: run it again, or recover the "
        "intact part with 'cosim recover', which reports what is lost"
    )


def damage_error(path: Path, offset: int, reason: str) -> LogError:
    """Return the error that names the byte at which a file is damaged."""
    return LogError(f"{path} is damaged at byte {offset}: {reason}")
