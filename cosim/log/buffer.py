"""Rows kept until there are enough of them for a chunk, then turned into message records by numpy.

A block costs two copies here, however short it is; the records are filled once per chunk.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping, Sequence
from typing import final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.contracts import Block
from cosim.core.signals import Layout
from cosim.log.content import hashable
from cosim.log.layout import HEADER, Part, blank_records, group_columns, record_dtype
from cosim.log.result import LastRow
from cosim.log.sink import Run

CHUNK_BYTES = 2**20  # of records, uncompressed
_BUFFER_BYTES = 2**22  # of rows, where long periods leave few of them in a chunk

_MESSAGE = struct.Struct("<BQHIQQ")  # a message record up to its data


@final
class RowBuffer:
    """Takes blocks, gives the message records of a chunk.

    Parameters
    ----------
    layout : Layout
    parts : sequence of (int, Part)
        MCAP channel ids with what they hold.
    """

    def __init__(self, layout: Layout, parts: Sequence[tuple[int, Part]]) -> None:
        self._layout = layout
        per_step = sum(record_dtype(part.size).itemsize / part.channel.period for _, part in parts)
        most = min(CHUNK_BYTES // max(per_step, 1.0), _BUFFER_BYTES // (8 * max(layout.width, 1)))
        self._capacity = max(int(most), 1)
        self._rows = np.empty((self._capacity, layout.width))
        self._time_ns = np.empty(self._capacity, dtype=np.int64)
        self._step = np.empty(self._capacity, dtype=np.int64)
        self._count = 0
        kept = {
            period: -(-self._capacity // period)
            for period in {part.channel.period for _, part in parts}
        }
        self._parts = [
            (part, blank_records(number, part.size, kept[part.channel.period]))
            for number, part in parts
        ]

    @property
    def full(self) -> bool:
        """Whether there is no room for another row."""
        return self._count == self._capacity

    @property
    def reached(self) -> LastRow | None:
        """The last row taken; None: there is none."""
        last = self._count - 1
        return None if last < 0 else LastRow(int(self._step[last]), int(self._time_ns[last]))

    def take(self, block: Block, signals: Matrix, start: int) -> int:
        """Copy rows of a block from ``start`` on, as many as there is room for; give the row to go on at."""
        stop = min(start + self._capacity - self._count, block.steps + 1)
        place = slice(self._count, self._count + stop - start)
        self._rows[place] = signals[start:stop]
        self._time_ns[place] = block.time_ns[start:stop]
        self._step[place] = np.arange(block.index + start, block.index + stop)
        self._count = place.stop
        return stop

    def runs(self) -> list[Run]:
        """Give the message records of all rows taken, one run per channel; valid until more is taken."""
        kept = self._kept()
        runs = [
            self._run(part, records, kept[part.channel.period]) for part, records in self._parts
        ]
        return [run for run in runs if len(run.time_ns)]

    def hash_into(self, hashes: Mapping[str, hashlib._Hash]) -> None:
        """Add the rows taken to the content hashes of their components."""
        kept = self._kept()
        for channel in self._layout.channels:
            chosen = kept[channel.period]
            hashes[channel.name].update(
                hashable(self._time_ns[chosen], self._rows[chosen, channel.columns])
            )

    def clear(self) -> None:
        """Forget the rows."""
        self._count = 0

    def _kept(self) -> dict[int, slice | NDArray[np.intp]]:
        """Say for each period which of the rows its log keeps."""
        periods = {channel.period for channel in self._layout.channels}
        return {period: self._every(period) for period in periods}

    def _every(self, period: int) -> slice | NDArray[np.intp]:
        return (
            slice(self._count)
            if period == 1
            else np.flatnonzero(self._step[: self._count] % period == 0)
        )

    def _run(self, part: Part, blank: NDArray[np.void], kept: slice | NDArray[np.intp]) -> Run:
        time_ns: Nanoseconds = self._time_ns[kept].copy()
        records = blank[: len(time_ns)]
        records["sequence"] = self._step[kept].astype(np.uint32)
        records["log_time"] = records["publish_time"] = time_ns
        first = part.channel.start + part.columns.start
        for name, columns in group_columns(part.size).items():
            records[name]["value"] = self._rows[kept, first + columns.start : first + columns.stop]
        offsets = np.arange(len(records), dtype=np.int64) * records.itemsize
        return Run(int(blank["channel_id"][0]), records.view(np.uint8).data, time_ns, offsets)


def message_run(messages: Sequence[tuple[int, bytes]], *, channel_id: int, step_ns: int) -> Run:
    """Give the message records of (time [ns], data) pairs of any size."""
    records, offsets, size = [], [], 0
    for time_ns, data in messages:
        length, step = _MESSAGE.size - HEADER + len(data), time_ns // step_ns & 0xFFFFFFFF
        records.append(
            _MESSAGE.pack(Opcode.MESSAGE, length, channel_id, step, time_ns, time_ns) + data
        )
        offsets.append(size)
        size += len(records[-1])
    times = np.array([time_ns for time_ns, _ in messages], dtype=np.int64)
    return Run(channel_id, b"".join(records), times, np.array(offsets, dtype=np.int64))
