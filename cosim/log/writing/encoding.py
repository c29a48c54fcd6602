"""The rows of a run as message records, filled by numpy a flush at a time, and their hashes."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Sequence
from typing import TypeAlias, final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cosim.core.signals import Layout
from cosim.instants import Grid
from cosim.log.contents.content import hash_input
from cosim.log.contents.layout import Part, Records, blank_records, group_columns, record_dtype
from cosim.log.mcap_file.chunks import CHUNK_BYTES, MessageBatch
from cosim.log.mcap_file.records import HEADER
from cosim.log.writing.buffer import RunContent, RunRows, WaitingMessage

_CHANNEL_BYTES = 2**21  # of a channel in a flush, as long as there are few
_LARGEST_FLUSH = 2**23  # bytes of records
_BUFFER_BYTES = 2**22  # of rows, where long periods leave few of them in a chunk
_DOUBLE_BYTES = 8
_SEQUENCE_MASK = 0xFFFFFFFF  # MCAP's sequence has 32 bits

_MESSAGE = struct.Struct("<BQHIQQ")  # a message record up to its data

RowSelection: TypeAlias = slice | NDArray[np.intp]


@final
class MessageEncoder:
    """Makes the message records of rows.

    Parameters
    ----------
    layout : Layout
    parts : sequence of (int, Part)
        MCAP channel ids with what they hold.
    """

    def __init__(self, layout: Layout, parts: Sequence[tuple[int, Part]]) -> None:
        self._layout = layout
        self._parts = parts
        self._blank: dict[int, Records] = {}  # by channel id, filled again every time
        self.row_bytes = _row_bytes([part for _, part in parts])
        self.capacity = _capacity(layout, len(parts), self.row_bytes)

    def batches(self, content: RunContent, grid: Grid) -> list[MessageBatch]:
        """Return the message records, one batch per channel that has any.

        They share the encoder's memory: valid until the next call.

        Parameters
        ----------
        content : RunContent
        grid : Grid
            The communication points: the sequence of messages that are not rows.
        """
        selected = self._selected(content.rows)
        batches = []
        for channel_id, part in self._parts:
            rows = selected[part.channel.period]
            batch = self._batch(channel_id, part, content.rows, rows)
            if len(batch.time_ns):
                batches.append(batch)
        messages: dict[int, list[WaitingMessage]] = {}
        for message in content.messages:
            messages.setdefault(message.channel_id, []).append(message)
        for waiting in messages.values():
            batches.append(_message_batch(waiting, grid))
        return batches

    def _batch(
        self, channel_id: int, part: Part, rows: RunRows, selected: RowSelection
    ) -> MessageBatch:
        time_ns = rows.time_ns[selected]
        records = self._records(channel_id, part.size, len(time_ns))
        records["sequence"] = rows.steps[selected].astype(np.uint32)
        unsigned_ns = time_ns.view(np.uint64)  # else numpy would convert each
        records["log_time"] = unsigned_ns
        records["publish_time"] = unsigned_ns
        part_start = part.channel.start + part.columns.start
        for group, columns in group_columns(part.size).items():
            start = part_start + columns.start
            stop = part_start + columns.stop
            records[group]["value"] = rows.values[selected, start:stop]
        offsets = np.arange(0, records.nbytes, records.itemsize)
        return MessageBatch(channel_id, records.view(np.uint8).data, time_ns, offsets)

    def _records(self, channel_id: int, size: int, count: int) -> Records:
        """Return records with everything constant filled in."""
        blank = self._blank.get(channel_id)
        if blank is None or len(blank) < count:
            blank = blank_records(channel_id, size, count)
            self._blank[channel_id] = blank
        return blank[:count]

    def hash_into(self, hashes: dict[str, hashlib._Hash], rows: RunRows) -> None:
        """Add rows to the content hashes of their components."""
        selected = self._selected(rows)
        for channel in self._layout.channels:
            own = selected[channel.period]
            values = rows.values[own, channel.columns]
            hashes[channel.name].update(hash_input(rows.time_ns[own], values))

    def _selected(self, rows: RunRows) -> dict[int, RowSelection]:
        """Return for each period the rows that components of that period record."""
        selected: dict[int, RowSelection] = {}
        for period in {channel.period for channel in self._layout.channels}:
            every = slice(len(rows.steps))
            selected[period] = every if period == 1 else np.flatnonzero(rows.steps % period == 0)
        return selected


def _row_bytes(parts: Sequence[Part]) -> float:
    """Return how many bytes of records a row has, on average."""
    total = 0.0
    for part in parts:
        total += record_dtype(part.size).itemsize / part.channel.period
    return total


def _capacity(layout: Layout, channels: int, row_bytes: float) -> int:
    """Return the number of rows of a flush, or of the buffer where periods are long."""
    flush_bytes = min(max(channels * _CHANNEL_BYTES, CHUNK_BYTES), _LARGEST_FLUSH)
    rows_in_flush = flush_bytes // max(row_bytes, 1.0)
    rows_in_buffer = max(_BUFFER_BYTES, flush_bytes) // (_DOUBLE_BYTES * max(layout.width, 1))
    return max(int(min(rows_in_flush, rows_in_buffer)), 1)


def _message_batch(messages: Sequence[WaitingMessage], grid: Grid) -> MessageBatch:
    """Return the records of messages of any size in one channel.

    Their sequence is the number of the communication step.
    """
    records = []
    times = []
    offsets = []
    size = 0
    for channel_id, time_ns, data in messages:
        length = _MESSAGE.size - HEADER + len(data)
        sequence = grid.number(time_ns) & _SEQUENCE_MASK
        header = _MESSAGE.pack(Opcode.MESSAGE, length, channel_id, sequence, time_ns, time_ns)
        records.append(header + data)
        times.append(time_ns)
        offsets.append(size)
        size += len(header) + len(data)
    return MessageBatch(
        messages[0].channel_id,
        memoryview(b"".join(records)),
        np.array(times, dtype=np.int64),
        np.array(offsets, dtype=np.int64),
    )
