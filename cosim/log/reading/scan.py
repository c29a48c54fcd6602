"""Find message records in the bytes of a chunk, consecutive ones of a channel at a time.

Our chunks hold the messages of one channel after those of another, and where a channel's end is
found by comparing whole columns. Chunks of other tools, with the channels' messages mixed, are read
by the same code, a few messages at a time.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode

from cosim.log.contents.layout import Records
from cosim.log.mcap_file.records import HEADER

_RECORD_HEADER = struct.Struct("<BQ")
_MESSAGE_KEY = 11  # bytes: opcode, length, channel id; equal in all messages of a channel
_MESSAGE_HEADER = 22  # bytes of a message's content before its data
_FIRST_WINDOW = 64  # records compared at once to begin with
_WINDOW_GROWTH = 8


@dataclass(frozen=True, slots=True)
class OtherRecord:
    """A record that is not a message of a known channel."""

    opcode: int
    channel_id: int  # of a message; else 0
    content: bytes


def scan(
    data: bytes | memoryview, dtypes: Mapping[int, np.dtype[np.void]]
) -> Iterator[tuple[int, Records] | OtherRecord]:
    """Yield the records in ``data`` in their order.

    Parameters
    ----------
    data : bytes or memoryview
    dtypes : mapping of channel id to dtype
        Consecutive messages of these channels are yielded together, as channel id and records,
        which share the memory of ``data``; all other records one by one, copied.

    Raises
    ------
    ValueError
        If ``data`` is not a sequence of records, or a message has another size than its channel's
        dtype.
    """
    position = 0
    while position < len(data):
        opcode, stop = _record_bounds(data, position)
        content = position + HEADER
        channel_id = 0
        dtype = None
        if opcode == Opcode.MESSAGE:
            channel_id = int.from_bytes(data[content : content + 2], "little")
            dtype = dtypes.get(channel_id)
        if dtype is None:
            yield OtherRecord(opcode, channel_id, bytes(data[content:stop]))
        elif stop - position != dtype.itemsize:
            raise ValueError(
                f"channel {channel_id}: expected messages of {dtype.itemsize} bytes, got "
                f"{stop - position}: re-encoded by another tool"
            )
        else:
            records = _consecutive_messages(data, position, dtype)
            yield channel_id, records
            stop = position + records.nbytes
        position = stop


def _record_bounds(data: bytes | memoryview, position: int) -> tuple[int, int]:
    """Return opcode and end of the record at ``position``.

    Raises
    ------
    ValueError
        If no whole record is there, or a message too short for its header.
    """
    if position + HEADER > len(data):
        raise ValueError(f"{len(data) - position} surplus bytes in a chunk")
    opcode, length = _RECORD_HEADER.unpack_from(data, position)
    stop = position + HEADER + length
    is_cut = stop > len(data)
    if is_cut or (opcode == Opcode.MESSAGE and length < _MESSAGE_HEADER):
        raise ValueError(f"a record of {length} bytes does not fit into its chunk")
    return opcode, stop


def _consecutive_messages(
    data: bytes | memoryview, position: int, dtype: np.dtype[np.void]
) -> Records:
    """Return the records from ``position`` on with opcode, length and channel of the first."""
    size = dtype.itemsize
    room = (len(data) - position) // size
    key = data[position : position + _MESSAGE_KEY]
    second = position + size
    second_key = data[second : second + _MESSAGE_KEY]
    # Chunks of other tools mix the channels: a single message is the usual case there, and cheap.
    if room == 1 or second_key != key:
        return np.frombuffer(data, dtype, 1, position)
    records = np.frombuffer(data, dtype, room, position)
    first = records[0]
    count = 2
    window = _FIRST_WINDOW
    while count < room:
        candidates = records[count : count + window]
        same = candidates["opcode"] == first["opcode"]
        same &= candidates["length"] == first["length"]
        same &= candidates["channel_id"] == first["channel_id"]
        if not same.all():
            count += int(same.argmin())
            break
        count += len(candidates)
        window *= _WINDOW_GROWTH
    return records[:count]
