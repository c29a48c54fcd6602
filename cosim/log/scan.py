"""Find message records in the bytes of a chunk, a run of equal ones at a time.

Our chunks hold one run per channel, and a run is found by comparing whole columns. Chunks of other tools, with the channels'
messages mixed, are read by the same code, one short run after another.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode

from cosim.log.layout import HEADER, Records

_HEAD = struct.Struct("<BQ")
_HEAD_BYTES = 11  # opcode, length, channel id
_FIRST_LOOK = 64  # records compared at once to begin with


@dataclass(frozen=True, slots=True)
class Loose:
    """A record that is no message of a known channel."""

    opcode: int
    channel_id: int  # of a message
    content: bytes


def scan(
    data: bytes, dtypes: Mapping[int, np.dtype[np.void]]
) -> Iterator[tuple[int, Records] | Loose]:
    """Give the records in ``data`` in their order: runs of messages of the channels in ``dtypes``, and all others one by one.

    Raises
    ------
    ValueError
        If ``data`` is no sequence of records, or a message has another size than its channel's dtype.
    """
    at = 0
    while at < len(data):
        if at + HEADER > len(data):
            raise ValueError(f"{len(data) - at} bytes too many in a chunk")
        opcode, length = _HEAD.unpack_from(data, at)
        stop = at + HEADER + length
        if stop > len(data) or (opcode == Opcode.MESSAGE and length < 22):
            raise ValueError(f"a record of {length} bytes does not fit into its chunk")
        channel_id = (
            int.from_bytes(data[at + HEADER : at + _HEAD_BYTES], "little")
            if opcode == Opcode.MESSAGE
            else 0
        )
        dtype = dtypes.get(channel_id)
        if dtype is None or opcode != Opcode.MESSAGE:
            yield Loose(opcode, channel_id, data[at + HEADER : stop])
        elif stop - at != dtype.itemsize:
            raise ValueError(
                f"a message of {stop - at} bytes in channel {channel_id}, needed {dtype.itemsize}: re-encoded by another tool"
            )
        else:
            records = _run(data, at, dtype)
            yield channel_id, records
            stop = at + records.nbytes
        at = stop


def _run(data: bytes, at: int, dtype: np.dtype[np.void]) -> Records:
    """Give the records from ``at`` on that have the opcode, length and channel of the first."""
    size, head = dtype.itemsize, data[at : at + _HEAD_BYTES]
    most = (len(data) - at) // size
    if most == 1 or data[at + size : at + size + _HEAD_BYTES] != head:
        return np.frombuffer(data, dtype, 1, at)
    records = np.frombuffer(data, dtype, most, at)
    first, found, look = records[0], 2, _FIRST_LOOK
    while found < most:
        part = records[found : found + look]
        same = (part["opcode"] == first["opcode"]) & (part["length"] == first["length"])
        same &= part["channel_id"] == first["channel_id"]
        if not same.all():
            found += int(same.argmin())
            break
        found, look = found + len(part), look * 8
    return records[:found]
