"""How large a log may become."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from cosim.core.signals import Channel
from cosim.log.contents.layout import Part, record_dtype
from cosim.log.mcap_file.chunks import CHUNK_BYTES

_CHUNK: Final = 256  # bytes of a chunk beside its records, with its entry in the summary; 194
_CHUNK_CHANNEL: Final = 25  # bytes a chunk has for each channel: 15 in its index, 10 in the summary
_PADDING: Final = 16  # bytes before the header of a chunk that would cross a page; 9
_INDEX_ENTRY: Final = 16  # bytes that the index has for each message
_EXPANSION: Final = 255  # a compression makes a chunk longer by one part of this, at most
_END: Final = 8192  # bytes of the result and the records that close the file
_VALUE: Final = 64  # bytes of a value in the result, beside its name
_ESCAPED: Final = 6  # bytes of a character of a name in JSON


def size_bound(parts: Sequence[Part], steps: int, *, start: int, capacity: int) -> int:
    """Return how large the log of a run can become, without its messages [bytes].

    It is an upper bound for every compression, however often the file is flushed.

    Parameters
    ----------
    parts : sequence of Part
    steps : int
        Of the run.
    start : int
        Bytes of the file before its first row.
    capacity : int
        Rows of a flush.
    """
    rows = steps + 1
    records = 0
    for part in parts:
        messages = steps // part.channel.period + 1
        records += messages * (record_dtype(part.size).itemsize + _INDEX_ENTRY)
    channels = {part.channel.name: part.channel for part in parts}
    values = sum(map(_result_bytes, channels.values()))
    # A flush of few rows is joined by others until they make half a chunk, or by a full one.
    flushes = 2 * (rows // capacity + records // (CHUNK_BYTES // 2)) + 2
    flush_overhead = _PADDING + len(parts) * (_CHUNK + _CHUNK_CHANNEL)
    overhead = flushes * flush_overhead + records // CHUNK_BYTES * _CHUNK
    # Twice the start: the summary repeats its schemas and channels.
    return records + records // _EXPANSION + overhead + 2 * start + values + _END


def _result_bytes(channel: Channel) -> int:
    """Return how long the last values of a channel are in the result, at most."""
    total = 0
    for signal in channel.signals:
        name = len(channel.name) + len(signal.name)
        total += signal.size * (_VALUE + _ESCAPED * name)
    return total
