"""The rows of a log file, read in passes over it, chunk by chunk, with every CRC checked."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple, final

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel as DeclaredChannel

from cosim.arrays import Matrix, Nanoseconds, read_only
from cosim.core.signals import Channel
from cosim.errors import LogError
from cosim.log.contents.content import combine_hashes, hash_input
from cosim.log.contents.layout import Part, Records, copy_columns, record_dtype
from cosim.log.reading.columns import SignalRows
from cosim.log.reading.container import MALFORMED, Container
from cosim.log.reading.scan import OtherRecord, scan
from cosim.log.reading.stream import RowStream, TimedRows, check_grid, record_times

_DOUBLE_BYTES = 8
_MOST_AHEAD = 2**26  # bytes of rows that are read ahead, or that a block has
_ALWAYS_AHEAD = 2**24  # bytes of rows that every pass reads: little beside what a pass costs
_MOST_WHOLE = 2**24  # bytes of a component's rows that are read whole where parts would do
_MOST_KEPT = 2**24  # bytes of rows that are kept where one of their signals is asked for
_MOST_OF_ALL = 2**26  # bytes of rows that are kept of all components together
_AHEAD_GROWTH = 64  # components that a pass reads ahead, in units of those of the one before
_MOST_SORTED = 2**28  # bytes of rows that are sorted in memory to be hashed


class _Window(NamedTuple):
    """Rows in ``first_ns <= time <= last_ns`` [ns]; None: from the first on, up to the last."""

    first_ns: int | None = None
    last_ns: int | None = None

    @property
    def is_whole(self) -> bool:
        return self.first_ns is None and self.last_ns is None

    def of(self, records: Records) -> Records:
        """Return the records in it.

        The parts of a component may have chunks of other lengths: here their rows are the same.
        """
        if self.first_ns is not None:
            records = records[records["log_time"] >= max(self.first_ns, 0)]
        if self.last_ns is not None:
            records = records[records["log_time"] <= max(self.last_ns, 0)]
        return records


_WHOLE: Final = _Window()


@final
class LogRows:
    """Reads the rows of components when they are first asked for.

    Parameters
    ----------
    file : Container
    declared : mapping of channel id to channel
        All that the file declares.
    parts : mapping of channel id to Part
        Those of components.
    channels : mapping of component name to Channel

    Raises
    ------
    LogError
        From every method: if the file is damaged.
    """

    def __init__(
        self,
        file: Container,
        declared: Mapping[int, DeclaredChannel],
        parts: Mapping[int, Part],
        channels: Mapping[str, Channel],
    ) -> None:
        self.path: Path = file.path
        self._file = file
        self._declared = declared
        self._parts = parts
        self._channels = channels
        self._rows: dict[str, TimedRows] = {}  # read by load
        self._kept: dict[str, TimedRows] = {}  # asked for, the last one behind all others
        self._kept_bytes = 0
        self._ahead: dict[str, TimedRows] = {}  # read together with the last one asked for
        self._passes = 0

    def of(self, component: str) -> TimedRows:
        """Return times and rows of a component; keep those that were asked for last."""
        if component in self._rows:
            return self._rows[component]
        rows = self._kept.pop(component, None)
        if rows is None:
            rows = self._read_ahead(component)
            self._kept_bytes += _bytes_of(rows)
        self._kept[component] = rows  # as the last one
        while self._kept_bytes > _MOST_OF_ALL and len(self._kept) > 1:
            oldest = next(iter(self._kept))
            self._kept_bytes -= _bytes_of(self._kept.pop(oldest))
        return rows

    def times(self, component: str) -> Nanoseconds:
        """Return the times of a component's rows; of one with many nothing else is kept."""
        if not self._is_small(component):
            streams = self._streams([component])
            times = [np.empty(0, np.int64)]
            times += [time_ns for _, time_ns, _ in self._streamed(streams)]
            if streams[component].ordered:
                joined = np.concatenate(times)
                joined.setflags(write=False)
                return joined
        return self.of(component)[0]

    def columns(self, component: str, columns: slice) -> Matrix:
        """Return some columns of a component's rows; of one with many nothing else is kept."""
        if not self._is_small(component):
            for number, part in self._parts_of[component].items():
                if part.columns.start <= columns.start and columns.stop <= part.columns.stop:
                    values = self._read_columns(number, columns)
                    if values is not None:
                        return values
        return self.of(component)[1][:, columns]

    def blocks(
        self, component: str, *, first_ns: int | None = None, last_ns: int | None = None
    ) -> Iterator[TimedRows]:
        """Yield times and rows of a component; nothing is kept.

        Chunks without rows in ``first_ns <= time <= last_ns`` are not read. Of few rows all are
        read at once, and may be in any order in the file.
        """
        window = _Window(first_ns, last_ns)
        if component in self._rows or component in self._kept:
            yield self.of(component)
        elif self._row_bytes(component) > self._most_whole:
            yield from self._stream(component, window)
        elif window.is_whole:
            yield self._read_ahead(component)
        else:
            yield self._read_rows([component], window)[component]

    def blocks_of(
        self, components: Sequence[str], first_ns: int | None, last_ns: int | None
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield names, times and rows of components in one pass over their chunks.

        Of few rows all are read at once, and may be in any order in the file.
        """
        window = _Window(first_ns, last_ns)
        size = sum(self._row_bytes(name) for name in components)
        if size <= self._most_whole:
            whole = self._read_rows(components, window)
            for name, (time_ns, rows) in whole.items():
                yield name, time_ns, rows
            return
        streams = self._streams(components)
        yield from self._streamed(streams, window)
        for name, stream in streams.items():
            if not stream.ordered:
                raise self._unordered(name)

    @property
    def row_bytes(self) -> int:
        """The memory that the rows of all components take, as doubles [bytes]."""
        return sum(self._row_bytes(name) for name in self._channels)

    def shares_chunks(self, component: str) -> bool:
        """Return whether rows of other components are in most of the chunks of a component."""
        own = self._parts_of[component].keys()
        return bool((self._file.shared_with(own) - own) & self._parts.keys())

    def load(self, components: Sequence[str]) -> None:
        """Read several components in one pass over the file; none named: all."""
        wanted = components or tuple(self._channels)
        missing = [name for name in dict.fromkeys(wanted) if name not in self._rows]
        self._rows.update(self._read_rows(missing))

    def other_records(
        self,
        channel_ids: Collection[int],
        *,
        first_ns: int | None = None,
        last_ns: int | None = None,
    ) -> Iterator[OtherRecord]:
        """Yield the records of some channels that are not rows of a component.

        Chunks without messages in ``first_ns <= time <= last_ns`` are not read.
        """
        for block in self._file.blocks(channel_ids, first_ns=first_ns, last_ns=last_ns):
            for record in scan(block, self._dtypes):
                if isinstance(record, OtherRecord):
                    yield record

    def content_hash(self) -> str:
        """Compute the hash of every bit of every signal from the rows, in one pass over the file.

        Rows that are not in order of time, as another tool may write them, are sorted in memory.

        Raises
        ------
        LogError
            If the file is damaged, or has too many rows to be sorted.
        """
        # Rows read for the hash are not kept: a log may be larger than the memory.
        digests = {name: hashlib.sha256() for name in self._channels}
        unordered = self._hash_ordered(list(self._channels), digests)
        for name in unordered:
            size = self._row_bytes(name)
            if size > _MOST_SORTED:
                raise self._unordered(name)
            time_ns, rows = self._read_rows([name])[name]
            digests[name] = hashlib.sha256(hash_input(time_ns, rows))
        components = []
        for name, digest in digests.items():
            components.append((name, self._declaration(name), digest.hexdigest()))
        return combine_hashes(components)

    def _declaration(self, component: str) -> str:
        """Return the declaration of the signals as it was recorded.

        Written anew, it would have what a later version adds to it.
        """
        number = next(iter(self._parts_of[component]))
        declaration: str = self._declared[number].metadata["cosim.signals"]
        return declaration

    def _hash_ordered(
        self, components: Sequence[str], digests: Mapping[str, hashlib._Hash]
    ) -> list[str]:
        """Add the rows of components to their hashes; return those with rows out of order."""
        streams = self._streams(components)
        for name, time_ns, rows in self._streamed(streams):
            digests[name].update(hash_input(time_ns, rows))
        return [name for name, stream in streams.items() if not stream.ordered]

    @property
    def _most_whole(self) -> int:
        """How many bytes of rows are read whole; more if they may have to be sorted."""
        return _MOST_WHOLE if self._file.is_indexed else _MOST_AHEAD

    def _is_small(self, component: str) -> bool:
        """Return whether all rows of a component are in memory, or may be at any time."""
        is_read = component in self._rows or component in self._kept
        return is_read or self._row_bytes(component) <= _MOST_KEPT

    def _read_columns(self, number: int, columns: slice) -> Matrix | None:
        """Read some columns of a part; None: its rows are not in order of time."""
        part = self._parts[number]
        dtype = self._dtypes[number]
        in_part = slice(columns.start - part.columns.start, columns.stop - part.columns.start)
        values = np.empty((self._file.expected_messages(number, dtype.itemsize), _size(columns)))
        count = 0
        first_ns: int | None = None
        last_ns = 0
        try:
            for records in self._records_of(number):
                stop = count + len(records)
                if stop > len(values):
                    raise ValueError(f"more rows of {part.channel.name!r} than in its summary")
                time_ns = record_times(records)
                first_ns = int(time_ns[0]) if first_ns is None else first_ns
                check_grid(time_ns, first_ns, part)
                if int(time_ns[0]) < last_ns or (time_ns[1:] < time_ns[:-1]).any():
                    return None
                last_ns = int(time_ns[-1])
                copy_columns(records, values[count:stop], size=part.size, columns=in_part)
                count = stop
            self._check_counts({number: count})
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error
        return read_only(values[:count])

    def _records_of(self, number: int) -> Iterator[Records]:
        """Yield the message records of a channel."""
        for block in self._file.blocks([number]):
            for record in scan(block, self._dtypes):
                if isinstance(record, OtherRecord):
                    self._check_declared(record)
                elif record[0] == number:
                    yield record[1]

    def _blocks_of(self, components: Iterable[str], window: _Window) -> Iterator[memoryview]:
        """Yield the chunks that have rows of some components and time."""
        channel_ids: set[int] = set()
        for name in components:
            channel_ids |= self._parts_of[name].keys()
        yield from self._file.blocks(channel_ids, first_ns=window.first_ns, last_ns=window.last_ns)

    def _stream(self, component: str, window: _Window) -> Iterator[TimedRows]:
        """Yield the rows of a component in one pass over the file."""
        streams = self._streams([component])
        width = self._channels[component].columns
        yield np.empty(0, np.int64), np.empty((0, width.stop - width.start))
        for _, time_ns, rows in self._streamed(streams, window):
            yield time_ns, rows
        if not streams[component].ordered:
            raise self._unordered(component)

    def _unordered(self, component: str) -> LogError:
        size = self._row_bytes(component)
        return LogError(
            f"{self.path}: the rows of {component!r} are not in order of time, and {size} bytes "
            "are too many to sort in memory; sort the file first, with 'mcap sort'"
        )

    def _streams(self, components: Sequence[str]) -> dict[str, RowStream]:
        return {name: RowStream(self._parts_of[name]) for name in components}

    def _streamed(
        self, streams: Mapping[str, RowStream], window: _Window = _WHOLE
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield the rows of components as they come, in a window of time."""
        dtypes = self._dtypes
        try:
            for block in self._blocks_of(streams, window):
                for record in scan(block, dtypes):
                    if isinstance(record, OtherRecord):
                        self._check_declared(record)
                        continue
                    number, records = record
                    name = self._parts[number].channel.name
                    if name in streams:
                        records = window.of(records)
                        for time_ns, rows in streams[name].append(number, records):
                            yield name, time_ns, rows
            for stream in streams.values():
                stream.finish()
                if window.is_whole:
                    self._check_counts(stream.counts)
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error

    def _read_ahead(self, component: str) -> TimedRows:
        """Return the rows of a component; read those in the same chunks in the same pass.

        The first pass reads one component, the second 64, those behind it 4096, as far as they
        fit, and each as many more as are small: whoever asks for one component after another needs
        few passes, however many there are, and whoever asks for one only reads no other that would
        take long.
        """
        if component not in self._ahead:
            names = list(self._channels)
            first = names.index(component)
            shared = self._file.shared_with(self._parts_of[component].keys())
            others = []
            for name in [*names[first + 1 :], *names[:first]]:
                if not shared.isdisjoint(self._parts_of[name]):
                    others.append(name)
            batch = [component]
            size = self._row_bytes(component)
            most_others = _AHEAD_GROWTH ** min(self._passes, 2) - 1
            for number, name in enumerate(others):
                size += self._row_bytes(name)
                if size > (_MOST_AHEAD if number < most_others else _ALWAYS_AHEAD):
                    break
                batch.append(name)
            self._passes += 1
            self._ahead = {}  # before the others are read
            self._ahead = self._read_rows(batch)
        return self._ahead[component]

    def _row_bytes(self, component: str) -> int:
        """Return the size of a component's rows in memory; the largest possible, if not known."""
        size = 0
        for number, part in self._parts_of[component].items():
            itemsize = self._dtypes[number].itemsize
            count = self._file.expected_messages(number, itemsize)
            size += count * (part.size + 1) * _DOUBLE_BYTES
        return size

    def _read_rows(
        self, components: Sequence[str], window: _Window = _WHOLE
    ) -> dict[str, TimedRows]:
        """Read the rows of some components, in a window of time, in one pass."""
        if not components:
            return {}
        try:
            parts = self._read_part_rows(components, window)
            if window.is_whole:
                self._check_counts({number: rows.count for number, rows in parts.items()})
            rows = {}
            for name in components:
                own_parts = [parts[number] for number in self._parts_of[name]]
                rows[name] = _side_by_side(own_parts)
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error
        except MemoryError as error:
            names = ", ".join(components)
            raise LogError(f"{self.path}: not enough memory for the rows of {names}") from error
        return rows

    def _read_part_rows(self, components: Sequence[str], window: _Window) -> dict[int, SignalRows]:
        """Read the rows of some components, in a window of time, by channel id."""
        dtypes = self._dtypes
        rows: dict[int, SignalRows] = {}
        has_counts = window.is_whole and self._file.summary.statistics is not None
        for name in components:
            for number, part in self._parts_of[name].items():
                expected = self._file.expected_messages(number, dtypes[number].itemsize)
                rows[number] = SignalRows(part, expected if has_counts else 0)
        for block in self._blocks_of(components, window):
            for record in scan(block, dtypes):
                if isinstance(record, OtherRecord):
                    self._check_declared(record)
                    continue
                number, messages = record
                if number in rows:
                    rows[number].append(window.of(messages))
        return rows

    def _check_declared(self, record: OtherRecord) -> None:
        """Check that a message's channel exists: a flipped bit may hide a row in another channel.

        Raises
        ------
        ValueError
            If it does not.
        """
        is_declared = record.channel_id in self._declared
        if record.opcode == Opcode.MESSAGE and not is_declared:
            raise ValueError(f"a message of the undeclared channel {record.channel_id}")

    def _check_counts(self, counts: Mapping[int, int]) -> None:
        """Check the numbers of rows against the summary, if there is one.

        Raises
        ------
        ValueError
            If they differ.
        """
        statistics = self._file.summary.statistics
        if statistics is None:
            return
        for number, count in counts.items():
            expected = statistics.channel_message_counts.get(number, 0)
            if count != expected:
                name = self._parts[number].channel.name
                raise ValueError(
                    f"expected {expected} rows of {name!r}, as in its summary, got {count}"
                )

    @cached_property
    def _parts_of(self) -> dict[str, dict[int, Part]]:
        """The parts of each component by channel id."""
        parts_of: dict[str, dict[int, Part]] = {name: {} for name in self._channels}
        for number, part in self._parts.items():
            parts_of[part.channel.name][number] = part
        return parts_of

    @cached_property
    def _dtypes(self) -> dict[int, np.dtype[np.void]]:
        return {number: record_dtype(part.size) for number, part in self._parts.items()}


def _side_by_side(parts: list[SignalRows]) -> tuple[Nanoseconds, Matrix]:
    """Join the parts of a component to its rows.

    Raises
    ------
    ValueError
        If they have rows at different times.
    """
    ordered = sorted(parts, key=lambda rows: rows.part.columns.start)
    time_ns, values = ordered[0].in_time_order()
    columns = [values]
    for rows in ordered[1:]:
        other_time_ns, other_values = rows.in_time_order()
        if not np.array_equal(time_ns, other_time_ns):
            raise ValueError(f"the channels of {rows.component!r} have rows at different times")
        columns.append(other_values)
    if len(columns) > 1:
        values = np.hstack(columns)
    time_ns.setflags(write=False)
    values.setflags(write=False)
    return time_ns, values


def _bytes_of(rows: TimedRows) -> int:
    return sum(array.nbytes for array in rows)


def _size(columns: slice) -> int:
    return int(columns.stop - columns.start)
