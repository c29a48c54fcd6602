"""Archives as nobody should make them, built entry by entry."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

XML = (
    '<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="m" guid="{1}">'
    "<ModelVariables/></fmiModelDescription>"
)


@dataclass(frozen=True)
class Entry:
    """One entry, every field as it will be written; None: as it should be."""

    name: str | bytes
    content: bytes = b""
    method: int = 8
    unix_mode: int = 0o100644
    flags: int = 0
    packed: bytes | None = None
    size: int | None = None  # declared, unpacked
    packed_size: int | None = None  # declared
    crc: int | None = None
    offset: int | None = None  # of the local header
    extra: bytes = b""


def write(
    path: Path, entries: Sequence[Entry], *, xml: bytes | None = XML.encode(), tail: bytes = b""
) -> Path:
    """Write an archive: the description first, unless it is None."""
    described = [Entry("modelDescription.xml", xml)] if xml is not None else []
    written = [*described, *entries]
    body = bytearray()
    directory = bytearray()
    for entry in written:
        offset = len(body) if entry.offset is None else entry.offset
        if entry.offset is None:
            body += local_header(entry)
        directory += directory_header(entry, offset)
    counts = (len(written), len(written))
    places = (len(directory), len(body))
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, *counts, *places, 0)
    path.write_bytes(bytes(body + directory) + end + tail)
    return path


def local_header(entry: Entry) -> bytes:
    """Return an entry as it stands in the archive: header, name, packed content."""
    header = struct.pack("<4s5H3I2H", b"PK\3\4", 20, *fields(entry))
    return header + encoded_name(entry) + entry.extra + packed_content(entry)


def directory_header(entry: Entry, offset: int) -> bytes:
    """Return an entry as it stands in the list of entries."""
    attributes = entry.unix_mode << 16
    fixed = (0, 0, 0, attributes, offset)
    header = struct.pack("<4s6H3I5H2I", b"PK\1\2", 0x314, 20, *fields(entry), *fixed)
    return header + encoded_name(entry) + entry.extra


def fields(entry: Entry) -> tuple[int, ...]:
    """Return what both headers have.

    These are flags, method, time, date, sum, sizes, and the lengths of name and extra.
    """
    flags = entry.flags | 0x800 if isinstance(entry.name, str) else entry.flags
    crc = zlib.crc32(entry.content) if entry.crc is None else entry.crc
    packed = packed_content(entry)
    packed_size = len(packed) if entry.packed_size is None else entry.packed_size
    size = len(entry.content) if entry.size is None else entry.size
    lengths = (len(encoded_name(entry)), len(entry.extra))
    return (flags, entry.method, 0, 33, crc, packed_size, size, *lengths)


def encoded_name(entry: Entry) -> bytes:
    return entry.name.encode() if isinstance(entry.name, str) else entry.name


def packed_content(entry: Entry) -> bytes:
    if entry.packed is not None:
        return entry.packed
    return deflate(entry.content) if entry.method == 8 else entry.content


def deflate(content: bytes) -> bytes:
    """Compress as in an archive, without a header."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(content) + packer.flush()


def zeros(size: int) -> bytes:
    """Return a deflate stream of that many zeros, made in pieces."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    piece = bytes(2**20)
    stream = b"".join(packer.compress(piece) for _ in range(size // len(piece)))
    rest = bytes(size % len(piece))
    return stream + packer.compress(rest) + packer.flush()
