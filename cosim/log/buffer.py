"""Rows kept until there are enough of them for a chunk, then turned into message records by numpy.

A block costs two copies here, however short it is; the records are filled once per chunk.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping, Sequence
from typing import TypeAlias, final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.contracts import Block
from cosim.core.signals import Layout
from cosim.log.content import hash_input
from cosim.log.layout import HEADER, Part, Records, blank_records, group_columns, record_dtype
from cosim.log.result import LastRow
from cosim.log.sink import MessageBatch

CHUNK_BYTES = 2**20  # of records, uncompressed
_CHANNELS = 128  # of a chunk; of more it is larger, as small pieces cost more than their rows
_LARGEST_CHUNK = 32  # in units of CHUNK_BYTES
_BUFFER_BYTES = 2**22  # of rows, where long periods leave few of them in a chunk
_DOUBLE_BYTES = 8
_SEQUENCE_MASK = 0xFFFFFFFF  # MCAP's sequence has 32 bits

_MESSAGE = struct.Struct("<BQHIQQ")  # a message record up to its data

RowSelection: TypeAlias = slice | NDArray[np.intp]


@final
class RowBuffer:
    """The rows of blocks, collected until they fill a chunk.

    Parameters
    ----------
    layout : Layout
    parts : sequence of (int, Part)
        MCAP channel ids with what they hold.
    """

    def __init__(self, layout: Layout, parts: Sequence[tuple[int, Part]]) -> None:
        self._layout = layout
        self._capacity = _capacity(layout, [part for _, part in parts])
        self._rows = np.empty((self._capacity, layout.width))
        self._time_ns = np.empty(self._capacity, dtype=np.int64)
        self._step = np.empty(self._capacity, dtype=np.int64)
        self._count = 0
        self._parts: list[tuple[Part, Records]] = []
        for channel_id, part in parts:
            recorded_rows = -(-self._capacity // part.channel.period)  # rounded up
            records = blank_records(channel_id, part.size, recorded_rows)
            self._parts.append((part, records))

    @property
    def capacity(self) -> int:
        """The number of rows that fill a chunk."""
        return self._capacity

    @property
    def full(self) -> bool:
        """Whether there is no room for another row."""
        return self._count == self._capacity

    @property
    def last_row(self) -> LastRow | None:
        """The last row in the buffer; None: it is empty."""
        if self._count == 0:
            return None
        last = self._count - 1
        step = int(self._step[last])
        time_ns = int(self._time_ns[last])
        return LastRow(step, time_ns)

    def append(self, block: Block, signals: Matrix, start: int) -> int:
        """Copy the rows of a block from ``start`` on, as many as there is room for.

        Returns
        -------
        int
            The row of the block to go on at.
        """
        room = self._capacity - self._count
        stop = min(start + room, block.steps + 1)
        new_count = self._count + stop - start
        target = slice(self._count, new_count)
        self._rows[target] = signals[start:stop]
        self._time_ns[target] = block.time_ns[start:stop]
        first_step = block.index + start
        self._step[target] = np.arange(first_step, block.index + stop)
        # Last: an interrupt before this line leaves the buffer as it was.
        self._count = new_count
        return stop

    def message_batches(self) -> list[MessageBatch]:
        """Return the message records of all rows, one batch per channel that has any.

        They share the buffer's memory: valid until the next call.
        """
        recorded = self._recorded_rows()
        batches = []
        for part, records in self._parts:
            selected = recorded[part.channel.period]
            batch = self._message_batch(part, records, selected)
            if len(batch.time_ns):
                batches.append(batch)
        return batches

    def hash_into(self, hashes: Mapping[str, hashlib._Hash]) -> None:
        """Add the rows in the buffer to the content hashes of their components."""
        recorded = self._recorded_rows()
        for channel in self._layout.channels:
            selected = recorded[channel.period]
            time_ns = self._time_ns[selected]
            rows = self._rows[selected, channel.columns]
            hashes[channel.name].update(hash_input(time_ns, rows))

    def clear(self) -> None:
        """Forget the rows."""
        self._count = 0

    def _recorded_rows(self) -> dict[int, RowSelection]:
        """Return for each period the rows that components of that period record."""
        periods = {channel.period for channel in self._layout.channels}
        return {period: self._every(period) for period in periods}

    def _every(self, period: int) -> RowSelection:
        if period == 1:
            return slice(self._count)
        steps = self._step[: self._count]
        return np.flatnonzero(steps % period == 0)

    def _message_batch(self, part: Part, blank: Records, selected: RowSelection) -> MessageBatch:
        time_ns: Nanoseconds = self._time_ns[selected].copy()
        records = blank[: len(time_ns)]
        records["sequence"] = self._step[selected].astype(np.uint32)
        records["log_time"] = time_ns
        records["publish_time"] = time_ns
        part_start = part.channel.start + part.columns.start
        for group, columns in group_columns(part.size).items():
            start = part_start + columns.start
            stop = part_start + columns.stop
            records[group]["value"] = self._rows[selected, start:stop]
        channel_id = int(blank["channel_id"][0])
        numbers = np.arange(len(records), dtype=np.int64)
        offsets = numbers * records.itemsize
        data = records.view(np.uint8).data
        return MessageBatch(channel_id, data, time_ns, offsets)


def _capacity(layout: Layout, parts: Sequence[Part]) -> int:
    """Return the number of rows that fill a chunk, or the buffer where periods are long."""
    record_bytes_per_step = 0.0
    for part in parts:
        record_bytes = record_dtype(part.size).itemsize
        record_bytes_per_step += record_bytes / part.channel.period
    chunks = min(max(len(parts) / _CHANNELS, 1.0), _LARGEST_CHUNK)
    rows_in_chunk = chunks * CHUNK_BYTES // max(record_bytes_per_step, 1.0)
    row_bytes = _DOUBLE_BYTES * max(layout.width, 1)
    rows_in_buffer = _BUFFER_BYTES // row_bytes
    capacity = int(min(rows_in_chunk, rows_in_buffer))
    return max(capacity, 1)


def message_batch(
    messages: Sequence[tuple[int, bytes]], *, channel_id: int, start_ns: int, step_ns: int
) -> MessageBatch:
    """Return the message records of (time [ns], data) pairs of any size.

    Their sequence is the number of the communication step since ``start_ns``.
    """
    records = []
    times = []
    offsets = []
    size = 0
    for time_ns, data in messages:
        length = _MESSAGE.size - HEADER + len(data)
        sequence = (time_ns - start_ns) // step_ns & _SEQUENCE_MASK
        header = _MESSAGE.pack(Opcode.MESSAGE, length, channel_id, sequence, time_ns, time_ns)
        records.append(header + data)
        times.append(time_ns)
        offsets.append(size)
        size += len(header) + len(data)
    data = b"".join(records)
    times_ns = np.array(times, dtype=np.int64)
    data_offsets = np.array(offsets, dtype=np.int64)
    return MessageBatch(channel_id, data, times_ns, data_offsets)
