"""Archives as nobody should make them, built entry by entry."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

XML = '<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="m" guid="{1}"><ModelVariables/></fmiModelDescription>'


@dataclass(frozen=True)
class Entry:
    """One entry, every field as it will be written; None: as it should be."""

    name: str | bytes
    content: bytes = b""
    method: int = 8
    interface_type: int = 0o100644
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
    body, directory = bytearray(), bytearray()
    described = [Entry("modelDescription.xml", xml)] if xml is not None else []
    written = [*described, *entries]
    for entry in written:
        name = entry.name.encode() if isinstance(entry.name, str) else entry.name
        flags = entry.flags | 0x800 if isinstance(entry.name, str) else entry.flags
        packed = entry.packed
        if packed is None:
            packed = deflate(entry.content) if entry.method == 8 else entry.content
        size = len(entry.content) if entry.size is None else entry.size
        packed_size = len(packed) if entry.packed_size is None else entry.packed_size
        crc = zlib.crc32(entry.content) if entry.crc is None else entry.crc
        fields = (flags, entry.method, 0, 33, crc, packed_size, size, len(name), len(entry.extra))
        offset = len(body) if entry.offset is None else entry.offset
        if entry.offset is None:
            body += struct.pack("<4s5H3I2H", b"PK\3\4", 20, *fields) + name + entry.extra + packed
        directory += struct.pack(
            "<4s6H3I5H2I",
            b"PK\1\2",
            0x314,
            20,
            *fields,
            0,
            0,
            0,
            entry.interface_type << 16,
            offset,
        )
        directory += name + entry.extra
    end = struct.pack(
        "<4s4H2IH", b"PK\5\6", 0, 0, len(written), len(written), len(directory), len(body), 0
    )
    path.write_bytes(bytes(body + directory) + end + tail)
    return path


def deflate(content: bytes) -> bytes:
    """Compress as in an archive, without a header."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(content) + packer.flush()


def zeros(size: int) -> bytes:
    """Give a deflate stream of that many zeros, made in pieces."""
    packer, piece = zlib.compressobj(9, zlib.DEFLATED, -15), bytes(2**20)
    found = b"".join(packer.compress(piece) for _ in range(size // len(piece)))
    return found + packer.compress(bytes(size % len(piece))) + packer.flush()


def plain(path: Path, **members: str) -> Path:
    """Write an ordinary archive."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in members.items():
            archive.writestr(name, text)
    return path
