"""Messages of chunks, gathered by channel until there are enough for chunks of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final, TypeAlias, final

import numpy as np
from mcap.opcode import Opcode

from cosim.arrays import Mask, Nanoseconds
from cosim.log.mcap_file.chunks import MessageBatch
from cosim.log.mcap_file.records import record_header
from cosim.log.reading.scan import OtherRecord, scan
from cosim.log.reading.stream import record_times

# Returns which messages of a channel are wanted, by their times and records.
MessageFilter: TypeAlias = Callable[[int, Nanoseconds, list[bytes] | None], Mask]

_LOG_TIME: Final = slice(6, 14)  # of a message record's content
_GATHERED_BYTES: Final = 2**22


def gathered(
    blocks: Iterable[bytes | memoryview],
    dtypes: Mapping[int, np.dtype[np.void]],
    wanted: MessageFilter,
) -> Iterator[list[MessageBatch]]:
    """Yield the wanted messages of chunks, one batch a channel, many chunks at a time.

    Parameters
    ----------
    blocks : iterable of bytes or memoryview
        The records of chunks.
    dtypes : mapping of channel id to dtype
        Of the rows of components.
    wanted : callable
        Is asked once for every run of messages of a channel, in the order of the file; the records
        are None for rows.

    Raises
    ------
    ValueError
        If a block is not a sequence of records.
    """
    waiting = _Waiting()
    for block in blocks:
        others: dict[int, list[bytes]] = {}
        for item in scan(block, dtypes):
            if isinstance(item, OtherRecord):
                if item.opcode == Opcode.MESSAGE:
                    others.setdefault(item.channel_id, []).append(item.content)
                continue
            number, rows = item
            time_ns = record_times(rows)
            kept = wanted(number, time_ns, None)
            if not kept.all():
                rows = rows[kept]
                time_ns = time_ns[kept]
            if len(rows):
                sizes = np.full(len(rows), rows.itemsize, np.int64)
                waiting.add(number, rows.tobytes(), time_ns, sizes)
        for number, contents in others.items():
            _add_others(waiting, number, contents, wanted)
        if waiting.size >= _GATHERED_BYTES:
            yield waiting.take()
    if waiting.size:
        yield waiting.take()


def _add_others(
    waiting: _Waiting, number: int, contents: list[bytes], wanted: MessageFilter
) -> None:
    """Add messages that are not rows."""
    times = [int.from_bytes(content[_LOG_TIME], "little") for content in contents]
    kept = wanted(number, np.array(times, np.int64), contents)
    records = []
    for content, is_kept in zip(contents, kept, strict=True):
        if is_kept:
            records.append(record_header(Opcode.MESSAGE, len(content)) + content)
    if records:
        sizes = np.array([len(record) for record in records], np.int64)
        waiting.add(number, b"".join(records), np.array(times, np.int64)[kept], sizes)


@final
class _Waiting:
    """Message records by channel."""

    def __init__(self) -> None:
        self.size = 0  # bytes
        self._parts: dict[int, list[tuple[bytes, Nanoseconds, Nanoseconds]]] = {}

    def add(self, number: int, data: bytes, time_ns: Nanoseconds, sizes: Nanoseconds) -> None:
        """Add records of a channel, with their times [ns] and sizes [bytes]."""
        self._parts.setdefault(number, []).append((data, time_ns, sizes))
        self.size += len(data)

    def take(self) -> list[MessageBatch]:
        """Return all that is here."""
        batches = []
        for number, parts in self._parts.items():
            data = b"".join(part for part, _, _ in parts)
            time_ns = np.concatenate([times for _, times, _ in parts])
            sizes = np.concatenate([own for _, _, own in parts])
            offsets = np.cumsum(sizes) - sizes
            batches.append(MessageBatch(number, memoryview(data), time_ns, offsets))
        self._parts = {}
        self.size = 0
        return batches
