"""The rows of a log file: one pass over its chunks, from which everything else is made.

A pass reads some columns of some components in a span of time, chunk by chunk, with every CRC
checked. Blocks are its pieces as they come; arrays are its pieces joined and, where another tool
has reordered messages, sorted. Of a component with many rows only what is asked for is kept.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple, final

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel as DeclaredChannel

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.clock import LARGEST_NS
from cosim.core.recorded.run import rows_within
from cosim.core.recording import TimedRows
from cosim.core.signals import Channel
from cosim.errors import LogError
from cosim.instants import NANOSECONDS, Grid
from cosim.log.container import Container, OtherRecord, scan
from cosim.log.layout import Part, Records, copy_columns, record_dtype
from cosim.log.places import MALFORMED

_DOUBLE_BYTES: Final = 8
_ROWS: Final = 2**15  # that are converted at a time
_MOST_KEPT: Final = 2**24  # bytes of rows that are kept where one of their signals is asked for
_MOST_WHOLE: Final = 2**26  # bytes of rows that are kept, or read as a whole where blocks would do
_MOST_SORTED: Final = 2**28  # the same of files of other tools, whose rows may be in any order
_MOST_PENDING: Final = 2**26  # bytes of one part's rows that wait for those of another
_FIRST_ROWS: Final = 1024


class _Span(NamedTuple):
    """Rows in ``first_ns <= time <= last_ns`` [ns]; None: from the first on, up to the last."""

    first_ns: int | None = None
    last_ns: int | None = None

    def of(self, records: Records) -> Records:
        """Return the records in it."""
        if self.first_ns is not None:
            records = records[records["log_time"] >= max(self.first_ns, 0)]
        if self.last_ns is not None:
            records = records[records["log_time"] <= max(self.last_ns, 0)]
        return records


_WHOLE: Final = _Span()


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
        self._loaded: dict[str, TimedRows] = {}
        self._kept: dict[str, TimedRows] = {}  # the one that was asked for last behind all others

    # --- arrays ---

    def load(self, components: Sequence[str]) -> None:
        """Read several components in one pass over the file; none named: all."""
        wanted = components or tuple(self._channels)
        self._loaded |= self._arrays({name: None for name in wanted if name not in self._loaded})

    def of(self, component: str, columns: slice | None = None) -> TimedRows:
        """Return times and rows of a component, or some columns of them.

        Of one with many rows nothing but these columns is read then, and nothing is kept. Else
        those in the same chunks are read in the same pass, as far as they fit, and those asked for
        last are kept: whoever asks for one component after another needs few passes.
        """
        if component in self._loaded:
            times, rows = self._loaded[component]
        elif component in self._kept:
            times, rows = self._kept[component] = self._kept.pop(component)
        elif columns is not None and self._row_bytes(component) > _MOST_KEPT:
            return self._arrays({component: columns})[component]
        else:
            times, rows = self._read_batch(component)
        return times, rows if columns is None else rows[:, columns]

    def _read_batch(self, component: str) -> TimedRows:
        batch = self._batch(component)
        self._kept |= self._arrays(dict.fromkeys(batch))
        size = sum(map(_bytes_of, self._kept.values()))
        for name in list(self._kept):
            if size <= _MOST_WHOLE or name in batch:
                break
            size -= _bytes_of(self._kept.pop(name))
        rows = self._kept[component] = self._kept.pop(component)
        return rows

    def _batch(self, component: str) -> list[str]:
        """Return a component, and its neighbours among those in its chunks, as far as they fit."""
        shared = self._file.shared_with(self._parts_of[component].keys())
        batch: list[str] = []
        size = 0
        for name in self._channels:
            if name != component and shared.isdisjoint(self._parts_of[name]):
                continue
            size += self._row_bytes(name)
            if size > _MOST_WHOLE and batch:
                if component in batch:
                    break
                batch = []
                size = self._row_bytes(name)
            batch.append(name)
        return batch

    def _arrays(
        self, wanted: Mapping[str, slice | None], span: _Span = _WHOLE
    ) -> dict[str, TimedRows]:
        """Return columns of components in order of time, read in one pass; None: all columns."""
        if not wanted:
            return {}
        try:
            found = {name: self._room(name, columns, span) for name, columns in wanted.items()}
            for name, times, rows in self._pieces(wanted, span):
                found[name].append(times, rows)
            return {name: rows.in_order() for name, rows in found.items()}
        except MemoryError as error:
            names = ", ".join(wanted)
            raise LogError(f"{self.path}: not enough memory for the rows of {names}") from error

    def _room(self, component: str, columns: slice | None, span: _Span) -> _Rows:
        own = self._channels[component].columns if columns is None else columns
        expected = 0
        if span == _WHOLE and self._file.summary.statistics is not None:
            number = next(iter(self._parts_of[component]))
            expected = self._file.expected_messages(number, self._dtypes[number].itemsize)
        return _Rows(expected, own.stop - own.start)

    # --- blocks ---

    def blocks(
        self, components: Sequence[str], first_ns: int | None, last_ns: int | None
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield names, times and rows of components in one pass over their chunks.

        Chunks without rows in ``first_ns <= time <= last_ns`` are not read, and nothing is kept.
        Of few rows all are read at once, and may be in any order in the file.
        """
        span = _Span(first_ns, last_ns)
        most = _MOST_WHOLE if self._file.places.is_indexed else _MOST_SORTED
        wanted: dict[str, slice | None] = dict.fromkeys(components)
        if len(components) == 1 and (components[0] in self._loaded or components[0] in self._kept):
            yield components[0], *rows_within(*self.of(components[0]), *span)
        elif sum(map(self._row_bytes, components)) <= most:
            for name, (times, rows) in self._arrays(wanted, span).items():
                yield name, times, rows
        else:
            yield from self._in_order(wanted, span)

    def _in_order(
        self, wanted: Mapping[str, slice | None], span: _Span
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield the pieces of a pass; of each component one at least, and all in order of time."""
        last = dict.fromkeys(wanted, 0)
        for name in wanted:
            width = self._channels[name].columns
            yield name, np.empty(0, np.int64), np.empty((0, width.stop - width.start))
        for name, times, rows in self._pieces(wanted, span):
            if int(times[0]) < last[name] or (times[1:] < times[:-1]).any():
                raise LogError(
                    f"{self.path}: the rows of {name!r} are not in order of time, and "
                    f"{self._row_bytes(name)} bytes are too many to sort in memory; sort the file "
                    "first, with 'mcap sort'"
                )
            last[name] = int(times[-1])
            yield name, times, rows

    @property
    def row_bytes(self) -> int:
        """The memory that the rows of all components take, as doubles [bytes]."""
        return sum(map(self._row_bytes, self._channels))

    def shares_chunks(self, component: str) -> bool:
        """Return whether rows of other components are in most of the chunks of a component."""
        own = self._parts_of[component].keys()
        return bool((self._file.shared_with(own) - own) & self._parts.keys())

    # --- the pass ---

    def _pieces(
        self, wanted: Mapping[str, slice | None], span: _Span
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield rows as they stand in the file, never none: the parts of a component joined."""
        joined = {name: _Joined(self._parts_of[name], own) for name, own in wanted.items()}
        counts = {number: 0 for own in joined.values() for number in own.columns}
        try:
            for number, records in self._records(counts, span):
                counts[number] += len(records)
                name = self._parts[number].channel.name
                for begin in range(0, len(records), _ROWS):
                    for times, rows in joined[name].add(number, records[begin : begin + _ROWS]):
                        yield name, times, rows
            for own in joined.values():
                own.check_whole()
            if span == _WHOLE:
                self._check_counts(counts)
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error

    def _records(self, numbers: Collection[int], span: _Span) -> Iterator[tuple[int, Records]]:
        """Yield the message records of some channels."""
        for block in self._file.blocks(numbers, first_ns=span.first_ns, last_ns=span.last_ns):
            for record in scan(block, self._dtypes):
                if isinstance(record, OtherRecord):
                    # a flipped bit may hide a row in another channel
                    if record.opcode == Opcode.MESSAGE and record.channel_id not in self._declared:
                        raise ValueError(f"a message of the undeclared channel {record.channel_id}")
                elif record[0] in numbers:
                    records = span.of(record[1])
                    if len(records):
                        yield record[0], records

    def other_records(
        self, numbers: Collection[int], first_ns: int | None = None, last_ns: int | None = None
    ) -> Iterator[OtherRecord]:
        """Yield the records in chunks of some channels that are not rows of a component.

        Chunks without messages in ``first_ns <= time <= last_ns`` are not read.
        """
        for block in self._file.blocks(numbers, first_ns=first_ns, last_ns=last_ns):
            for record in scan(block, self._dtypes):
                if isinstance(record, OtherRecord):
                    yield record

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

    def _row_bytes(self, component: str) -> int:
        """Return the size of a component's rows in memory; the largest possible, if not known."""
        size = 0
        for number, part in self._parts_of[component].items():
            count = self._file.expected_messages(number, self._dtypes[number].itemsize)
            size += count * (part.size + 1) * _DOUBLE_BYTES
        return size

    @cached_property
    def _parts_of(self) -> dict[str, dict[int, Part]]:
        """The parts of each component by channel id, in the order of its row."""
        parts_of: dict[str, dict[int, Part]] = {name: {} for name in self._channels}
        for number, part in sorted(self._parts.items(), key=lambda item: item[1].columns.start):
            parts_of[part.channel.name][number] = part
        return parts_of

    @cached_property
    def _dtypes(self) -> dict[int, np.dtype[np.void]]:
        return {number: record_dtype(part.size) for number, part in self._parts.items()}


@final
class _Joined:
    """Some columns of a component, of which each part has a channel of its own.

    Parameters
    ----------
    parts : mapping of channel id to Part
        In the order of the row.
    columns : slice or None
        Of its row; None: all.

    Attributes
    ----------
    columns : mapping of channel id to slice
        What is read of each part.
    """

    def __init__(self, parts: Mapping[int, Part], columns: slice | None) -> None:
        self._parts = parts
        self._first_ns: int | None = None
        self.columns: dict[int, slice] = {}
        for number, part in parts.items():
            start, stop = part.columns.start, part.columns.stop
            if columns is not None:
                start, stop = max(columns.start, start), min(columns.stop, stop)
            if columns is None or start < stop:
                self.columns[number] = slice(start - part.columns.start, stop - part.columns.start)
        if not self.columns:  # only the times
            self.columns[next(iter(parts))] = slice(0, 0)
        self._waiting: dict[int, list[TimedRows]] = {number: [] for number in self.columns}

    def add(self, number: int, records: Records) -> Iterator[TimedRows]:
        """Add message records of a channel; yield the rows that are whole now.

        Raises
        ------
        ValueError
            If the records are damaged, the channels have rows at different times, or one is off the
            grid.
        """
        part = self._parts[number]
        times = record_times(records)
        self._first_ns = int(times[0]) if self._first_ns is None else self._first_ns
        _check_grid(times, self._first_ns, part)
        columns = self.columns[number]
        values = np.empty((len(records), columns.stop - columns.start))
        copy_columns(records, values, size=part.size, columns=columns)
        if len(self.columns) == 1:
            yield times, values
            return
        self._waiting[number].append((times, values))
        if sum(rows.nbytes for _, rows in self._waiting[number]) > _MOST_PENDING:
            raise ValueError("the channels of a component are too far apart to be joined")
        while all(self._waiting.values()):
            count = min(len(own[0][0]) for own in self._waiting.values())
            taken = [own.pop(0) for own in self._waiting.values()]
            if any(not np.array_equal(taken[0][0][:count], own[:count]) for own, _ in taken):
                raise ValueError("the channels of a component have rows at different times")
            for own, (times, rows) in zip(self._waiting.values(), taken, strict=True):
                if len(times) > count:
                    own.insert(0, (times[count:], rows[count:]))
            yield taken[0][0][:count], np.hstack([rows[:count] for _, rows in taken])

    def check_whole(self) -> None:
        """Check that no rows are left.

        Raises
        ------
        ValueError
            If a channel has fewer rows than another.
        """
        if any(self._waiting.values()):
            raise ValueError("the channels of a component have different numbers of rows")


@final
class _Rows:
    """Times and rows that are joined; there is room for ``expected`` of them at once."""

    def __init__(self, expected: int, width: int) -> None:
        self._times = np.empty(expected, np.int64)
        self._rows = np.empty((expected, width))
        self._count = 0

    def append(self, times: Nanoseconds, rows: Matrix) -> None:
        """Append rows."""
        stop = self._count + len(times)
        if stop > len(self._times):
            added = max(stop, 2 * len(self._times), _FIRST_ROWS) - len(self._times)
            self._times = np.concatenate([self._times, np.empty(added, np.int64)])
            self._rows = np.concatenate([self._rows, np.empty((added, rows.shape[1]))])
        self._times[self._count : stop] = times
        self._rows[self._count : stop] = rows
        self._count = stop

    def in_order(self) -> TimedRows:
        """Return times (n,) and rows (n, width) in the order of time; read-only."""
        times = self._times[: self._count]
        rows = self._rows[: self._count]
        if (times[1:] < times[:-1]).any():
            # Stable: rows of one instant are the limits of a jump, told apart by their order.
            order = np.argsort(times, kind="stable")
            times, rows = times[order], rows[order]
        times.setflags(write=False)
        rows.setflags(write=False)
        return times, rows


def record_times(records: Records) -> Nanoseconds:
    """Return the times of message records.

    Raises
    ------
    ValueError
        If one is beyond 2**63 - 1 ns.
    """
    times: Nanoseconds = records["log_time"].astype(np.int64)
    if (times < 0).any():
        raise ValueError(f"a time beyond {LARGEST_NS} ns")
    return times


def _check_grid(times: Nanoseconds, first_ns: int, part: Part) -> None:
    """Check that the times of rows are whole periods of their component away from one of them.

    Raises
    ------
    ValueError
        If one is not.
    """
    grid = Grid(first_ns, part.step_ns)
    period = part.channel.period
    off = grid.stamp(grid.number(times) // period * period) != times  # faster than a remainder
    if off.any():
        time = times[int(off.argmax())] / 1e9
        raise ValueError(
            f"a row of {part.channel.name!r} at t = {time} s is off its grid: rows are "
            f"{float(period * part.step_ns / NANOSECONDS)} s apart, from {first_ns / 1e9} s on"
        )


def _bytes_of(rows: TimedRows) -> int:
    return sum(array.nbytes for array in rows)
