"""The records of an MCAP file that cosim writes itself, as bytes.

Records from 0x80 on are private: every reader skips them.
"""

from __future__ import annotations

import struct
from typing import Final

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import McapRecord

# As in mcap.writer and mcap.reader, which load every compressor that is installed.
MAGIC: Final = b"\x89MCAP0\r\n"  # at both ends of a file

HOLE: Final = 0x80  # room that a file which is still written has for its next rows
SLOT: Final = 0x81  # room for a summary
PAD: Final = 0x82  # bytes without a meaning

RECORD_HEADER: Final = struct.Struct("<BQ")  # opcode, length
FOOTER: Final = struct.Struct("<BQQQI")  # opcode, length, summary, summary offsets, CRC
HEADER: Final = RECORD_HEADER.size  # bytes
FOOTER_SIZE: Final = FOOTER.size  # bytes
END_SIZE: Final = FOOTER_SIZE + len(MAGIC)  # bytes, of footer and magic
DATA_END_SIZE: Final = HEADER + 4  # bytes

_FOOTER_CONTENT: Final = FOOTER_SIZE - HEADER


def encoded(*items: McapRecord) -> bytes:
    """Return records as bytes, one after another."""
    builder = RecordBuilder()
    for item in items:
        item.write(builder)
    return bytes(builder.end())


def record_header(opcode: int, length: int) -> bytes:
    """Return the header of a record whose content has ``length`` bytes."""
    return RECORD_HEADER.pack(opcode, length)


def data_end(crc: int = 0) -> bytes:
    """Return the record that ends the data; CRC 0: not known."""
    return record_header(Opcode.DATA_END, 4) + crc.to_bytes(4, "little")


def footer(summary_start: int, offset_start: int, crc: int = 0) -> bytes:
    """Return the footer; CRC 0: not known."""
    return FOOTER.pack(Opcode.FOOTER, _FOOTER_CONTENT, summary_start, offset_start, crc)
