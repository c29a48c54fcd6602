"""A log file as arrays.

A component's rows are read when first asked for, chunk by chunk, with every CRC checked.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, final

import numpy as np
from mcap.opcode import Opcode

from cosim.arguments import log_argument
from cosim.arrays import Mask, Matrix, Nanoseconds
from cosim.core.contracts import Design, SignalEvent, Substep
from cosim.core.recorded import RecordedSignals, RunMessage, find_channel
from cosim.core.recorders import Memory
from cosim.core.signals import Channel
from cosim.errors import GraphError, LogError, UsageError, nearest, quoted
from cosim.log.columns import SignalRows
from cosim.log.container import MALFORMED, Container
from cosim.log.content import combine_hashes, hash_input
from cosim.log.layout import Part, read_number, read_part, record_dtype
from cosim.log.metadata import (
    decode_design,
    json_table,
    json_texts,
    read_json,
    verify_checksum,
)
from cosim.log.own_file import OwnFile
from cosim.log.paths import log_path
from cosim.log.preamble import EVENT_TOPIC, FORMAT, LOG_TOPIC, STEP_TOPIC
from cosim.log.result import RESULT, RESULT_FILE
from cosim.log.scan import OtherRecord, scan
from cosim.log.schema import decode_event, decode_log, decode_substep
from cosim.log.stream import RowStream, TimedRows

_LOG_TIME = slice(6, 14)  # of a message record's content
_DATA = slice(22, None)
_DOUBLE_BYTES = 8
_MOST_AHEAD = 2**26  # bytes of rows that are read ahead, or that a block has
_ALWAYS_AHEAD = 2**24  # bytes of rows that every pass reads: little beside what a pass costs
_AHEAD_GROWTH = 64  # components that a pass reads ahead, in units of those of the one before
_MOST_SORTED = 2**28  # bytes of rows that are sorted in memory to be hashed

_Parsed = TypeVar("_Parsed")


def open_log(path: Path | str) -> Log:
    """Open a log file.

    Raises
    ------
    UsageError
        If it is no path but a run in memory, or the path of a scenario or an FMU.
    LogError
        If the file is no MCAP, truncated or damaged, or was not written by cosim.
    """
    if isinstance(path, Memory):
        raise UsageError(
            f"log: found {path!r}, which was kept in memory; needed the path of a log: a run "
            "writes one with out='x.mcap'"
        )
    return Log(log_argument(log_path(path)))


@final
class Log(RecordedSignals):
    """A recorded run in an MCAP file.

    Parameters
    ----------
    path : Path or str
    own : OwnFile, optional
        The file itself, held open by the run that wrote it.

    Raises
    ------
    LogError
        From every method: if the file is damaged, has changed, or lacks what is asked for.
    """

    def __init__(self, path: Path | str, own: OwnFile | None = None) -> None:
        self._file = Container(log_path(path), own)
        self.path = self._file.path
        self._declared = self._file.channels()
        self._metadata = self._read_metadata()
        self._check_format()
        self._parts = self._read_parts()
        self._channels = self._read_channels()
        self._kinds = {part.channel.name: part.kind for part in self._parts.values()}
        self._attachments = self._file.attachments()
        self._rows: dict[str, TimedRows] = {}
        self._ahead: dict[str, TimedRows] = {}  # read together with the last one asked for
        self._passes = 0
        self._check_rows_of_run()

    @property
    def label(self) -> str:
        """The path."""
        return str(self.path)

    @property
    def is_at_its_path(self) -> bool:
        """Whether the path leads to this log; not where a run's own was replaced or removed."""
        own = self._file.own
        return self.path.exists() if own is None else own.is_at_its_path

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name, in the order of the row."""
        return MappingProxyType(self._channels)

    @property
    def kinds(self) -> Mapping[str, str]:
        """The kinds of the components, as the scenario calls them."""
        return MappingProxyType(self._kinds)

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The metadata records by name."""
        return MappingProxyType(self._metadata)

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return tuple(self._attachments)

    @property
    def step_ns(self) -> int:
        """Communication step [ns]."""
        return next(part.step_ns for part in self._parts.values())

    @property
    def status(self) -> str:
        """How the run ended: ``complete``, ``failed`` or ``interrupted``.

        ``unknown`` if another tool left that out.
        """
        return self._metadata.get(RESULT, {}).get("status", "unknown")

    @property
    def reason(self) -> str:
        """Stop reason; empty where the run came to its end."""
        return self._metadata.get(RESULT, {}).get("reason", "")

    @property
    def end_ns(self) -> int:
        """The last recorded instant [ns], from the result; 0 if there are no rows."""
        return self._result_number("end_ns")

    @property
    def steps(self) -> int:
        """Number of the last recorded communication step, from the result."""
        return self._result_number("steps")

    @property
    def recorded_hash(self) -> str:
        """The content hash that the run recorded; :meth:`content_hash` computes that of the rows.

        Raises
        ------
        LogError
            If there is none.
        """
        try:
            return self._metadata[RESULT]["content_hash"]
        except KeyError as error:
            raise self._missing("content_hash") from error

    @property
    def schedule(self) -> list[str]:
        """The stages of the run in their order; empty if another tool left them out.

        Raises
        ------
        LogError
            If they are no list of texts.
        """
        text = self._metadata.get("cosim.schedule", {}).get("stages", "[]")
        try:
            return json_texts(text)
        except MALFORMED as error:
            raise LogError(f"{self.path}: stages cannot be understood: {error}") from error

    @property
    def results(self) -> Mapping[str, Any]:
        """What was recorded of the end of the run, with how it ended and the content hash.

        It is the content of ``result.json``; empty if there is none.

        Raises
        ------
        LogError
            If it is no JSON object, or damaged.
        """
        if RESULT_FILE not in self._attachments:
            return {}
        try:
            return json_table(self.attachment(RESULT_FILE))
        except ValueError as error:
            raise LogError(f"{self.path}: {RESULT_FILE} cannot be read: {error}") from error

    @cached_property
    def designs(self) -> Mapping[str, Design]:
        """The design-time arrays of every component, bit for bit."""
        designs: dict[str, Design] = {}
        for name in self._channels:
            designs[name] = self._component_metadata(name, "cosim.design", decode_design, {})
        return MappingProxyType(designs)

    @cached_property
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component had a zero-order hold."""
        held: dict[str, Mask] = {}
        for name, channel in self._channels.items():
            none_held = np.zeros(channel.interface.n_u, dtype=np.bool_)
            mask = self._component_metadata(name, "cosim.held", _read_mask, none_held)
            if len(mask) != len(none_held):
                raise LogError(
                    f"{self.path}: cosim.held of {name!r} has {len(mask)} elements, "
                    f"needed {len(none_held)}"
                )
            held[name] = mask
        return MappingProxyType(held)

    def rows(self, component: str) -> Matrix:
        """Return all rows of a component: applied inputs, then outputs.

        Shape (N, width), read-only.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        LogError
            If the file is damaged.
        """
        return self._times_and_rows(component)[1]

    def time_ns(self, component: str) -> Nanoseconds:
        """Return the instants of a component's rows, shape (N,) [ns]; read-only.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        LogError
            If the file is damaged.
        """
        return self._times_and_rows(component)[0]

    def blocks(self, component: str) -> Iterator[TimedRows]:
        """Yield times and rows of a component in order of time; of a long log some at a time.

        Nothing is kept: the memory that this takes does not grow with the log.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        LogError
            If the file is damaged.
        """
        find_channel(self._channels, component, source=str(self.path))
        if component in self._rows:
            yield self._rows[component]
        elif self._row_bytes(component) <= _MOST_AHEAD:
            yield self._read_ahead(component)
        else:
            yield from self._stream(component)

    def load(self, *components: str) -> None:
        """Read several components in one pass over the file; none named: all.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        LogError
            If the file is damaged.
        """
        for name in components:
            find_channel(self._channels, name, source=str(self.path))
        wanted = components or tuple(self._channels)
        missing = [name for name in dict.fromkeys(wanted) if name not in self._rows]
        self._rows.update(self._read_rows(missing))

    def attachment(self, name: str) -> bytes:
        """Return the content of an attachment.

        Raises
        ------
        LogError
            If there is none of that name, or it is damaged.
        """
        if not isinstance(name, str) or name not in self._attachments:
            nearest_names = nearest(str(name), self._attachments)
            raise LogError(f"{self.path} has no attachment {name!r}; {nearest_names}")
        return self._file.attachment(self._attachments[name])

    def messages(self) -> list[RunMessage]:
        """Return the messages of the run and its components, in the order of time.

        Raises
        ------
        LogError
            If the file is damaged.
        """
        return sorted(self.each_message(), key=lambda message: message.time_ns)

    def each_message(self) -> Iterator[RunMessage]:
        """Yield the messages in the order of the file.

        Raises
        ------
        LogError
            If the file is damaged.
        """
        try:
            for time_ns, data in self._messages_of(LOG_TOPIC):
                level, source, text = decode_log(data)
                yield RunMessage(time_ns, level, source, text)
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error

    def events(self) -> list[SignalEvent]:
        """Return the jumps of signals, in the order of time.

        Raises
        ------
        LogError
            If the file is damaged.
        """
        try:
            events = [decode_event(*message) for message in self._messages_of(EVENT_TOPIC)]
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error
        return sorted(events, key=lambda event: event.time_ns)

    def substeps(self) -> list[Substep]:
        """Return the substeps of loops, in the order of where they begin.

        Raises
        ------
        LogError
            If the file is damaged.
        """
        try:
            substeps = [decode_substep(*message) for message in self._messages_of(STEP_TOPIC)]
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error
        return sorted(substeps, key=lambda substep: substep.begin_ns)

    def _messages_of(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield time [ns] and data of the messages of a topic, in the order of the file."""
        channel_ids = set()
        for number, channel in self._declared.items():
            if channel.topic == topic:
                channel_ids.add(number)
        if not channel_ids:
            return
        for record in self._other_records():
            if record.opcode == Opcode.MESSAGE and record.channel_id in channel_ids:
                time_ns = int.from_bytes(record.content[_LOG_TIME], "little")
                yield time_ns, bytes(record.content[_DATA])

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

    def _stream(self, component: str) -> Iterator[TimedRows]:
        """Yield the rows of a component in one pass over the file."""
        streams = self._streams([component])
        width = self._channels[component].columns
        yield np.empty(0, np.int64), np.empty((0, width.stop - width.start))
        for _, time_ns, rows in self._streamed(streams):
            yield time_ns, rows
        if not streams[component].ordered:
            raise self._unordered(component)

    def _unordered(self, component: str) -> LogError:
        size = self._row_bytes(component)
        return LogError(
            f"{self.path}: the rows of {component!r} are not in order of time, and {size} bytes "
            "are too many to be sorted in memory; sort the file first, with 'mcap sort'"
        )

    def _streams(self, components: Sequence[str]) -> dict[str, RowStream]:
        return {name: RowStream(self._parts_of[name]) for name in components}

    def _streamed(
        self, streams: Mapping[str, RowStream]
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield the rows of components as they come."""
        dtypes = self._dtypes
        try:
            for block in self._file.blocks():
                for record in scan(block, dtypes):
                    if isinstance(record, OtherRecord):
                        self._check_declared(record)
                        continue
                    number, records = record
                    name = self._parts[number].channel.name
                    if name in streams:
                        for time_ns, rows in streams[name].append(number, records):
                            yield name, time_ns, rows
            for stream in streams.values():
                stream.finish()
                self._check_counts(stream.counts)
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error

    def _times_and_rows(self, component: str) -> TimedRows:
        find_channel(self._channels, component, source=str(self.path))
        if component not in self._rows:
            self._rows[component] = self._read_ahead(component)
        return self._rows[component]

    def _read_ahead(self, component: str) -> TimedRows:
        """Return the rows of a component; read those behind it in the same pass.

        The first pass reads one component, the second 64, those behind it 4096, as far as they
        fit, and each as many more as are small: whoever asks for one component after another needs
        few passes, however many there are, and whoever asks for one only reads no other that would
        take long.
        """
        if component not in self._ahead:
            names = list(self._channels)
            first = names.index(component)
            others = [*names[first + 1 :], *names[:first]]
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

    def _other_records(self) -> Iterator[OtherRecord]:
        """Yield the records that are no rows of a component."""
        for block in self._file.blocks():
            for record in scan(block, self._dtypes):
                if isinstance(record, OtherRecord):
                    yield record

    def _read_rows(self, components: Sequence[str]) -> dict[str, TimedRows]:
        """Read the rows of some components in one pass."""
        if not components:
            return {}
        try:
            parts = self._read_part_rows(components)
            self._check_counts({number: rows.count for number, rows in parts.items()})
            rows = {}
            for name in components:
                own_parts = [parts[number] for number in self._parts_of[name]]
                rows[name] = _side_by_side(own_parts)
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error
        except MemoryError as error:
            names = ", ".join(components)
            raise LogError(f"{self.path}: too little memory for the rows of {names}") from error
        return rows

    def _read_part_rows(self, components: Sequence[str]) -> dict[int, SignalRows]:
        """Read the rows of some components by channel id."""
        dtypes = self._dtypes
        rows: dict[int, SignalRows] = {}
        has_counts = self._file.summary.statistics is not None
        for name in components:
            for number, part in self._parts_of[name].items():
                expected = self._file.expected_messages(number, dtypes[number].itemsize)
                rows[number] = SignalRows(part, expected if has_counts else 0)
        for block in self._file.blocks():
            for record in scan(block, dtypes):
                if isinstance(record, OtherRecord):
                    self._check_declared(record)
                    continue
                number, messages = record
                if number in rows:
                    rows[number].append(messages)
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
            raise ValueError(f"a message of channel {record.channel_id}, which is declared nowhere")

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
            needed = statistics.channel_message_counts.get(number, 0)
            if count != needed:
                name = self._parts[number].channel.name
                raise ValueError(f"{count} rows of {name!r} found, its summary says {needed}")

    def _check_rows_of_run(self) -> None:
        """Check that the summary counts the rows of as many steps as the run has recorded.

        Raises
        ------
        LogError
            If rows of a component are missing, or there are too many.
        """
        statistics = self._file.summary.statistics
        text = self._metadata.get(RESULT, {}).get("steps", "")
        if statistics is None or not text.isdecimal():
            return  # what is no number is refused where it is asked for
        steps = self.steps
        for number, part in self._parts.items():
            count = statistics.channel_message_counts.get(number, 0)
            needed = steps // part.channel.period + 1
            if count != needed and (count or steps):  # a run may end before its first row
                raise LogError(
                    f"{self.path} is damaged: {count} rows of {part.channel.name!r}; needed "
                    f"{needed}, as the run recorded {steps} steps"
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

    def _check_format(self) -> None:
        log_format = self._metadata.get("cosim.run", {}).get("format", FORMAT)
        if log_format != FORMAT:
            raise LogError(
                f"{self.path}: written in log format {log_format!r}, by another version of cosim; "
                f"needed format {FORMAT!r}: run its scenario again"
            )

    def _read_parts(self) -> dict[int, Part]:
        """Read the parts of the components from their channels' metadata, by channel id."""
        parts = {}
        for number, channel in self._declared.items():
            if "cosim.component" not in channel.metadata:
                continue
            try:
                parts[number] = read_part(channel.metadata)
            except (*MALFORMED, GraphError) as error:
                raise LogError(
                    f"{self.path}: channel {channel.topic!r} cannot be understood: {error}"
                ) from error
        if not parts:
            topics = [channel.topic for channel in self._declared.values()]
            joined = ", ".join(topics) or "no channels at all"
            raise LogError(
                f"{self.path} has no channels of cosim, which carry 'cosim.component';"
                f" found: {joined}"
            )
        return parts

    def _read_channels(self) -> dict[str, Channel]:
        """Return the components in the order of the row, each checked to be whole."""
        # By name too: a component without signals starts where the next one does.
        parts = sorted(
            self._parts.values(), key=lambda part: (part.channel.start, part.channel.name)
        )
        channels = {part.channel.name: part.channel for part in parts}
        columns: dict[str, list[slice]] = {name: [] for name in channels}
        for part in parts:
            name = part.channel.name
            if part.channel != channels[name] or part.step_ns != parts[0].step_ns:
                raise LogError(f"{self.path}: the channels of {name!r} declare different things")
            columns[name].append(part.columns)
        for name, channel in channels.items():
            self._check_whole(channel, columns[name])
        return channels

    def _check_whole(self, channel: Channel, columns: list[slice]) -> None:
        """Check that the parts of a component tile its row.

        Raises
        ------
        LogError
            If some columns are missing, or recorded more than once.
        """
        spans = sorted((span.start, span.stop) for span in columns)
        column = 0
        is_contiguous = True
        for start, stop in spans:
            is_contiguous &= start == column
            column = stop
        width = channel.columns.stop - channel.start
        if not is_contiguous or column != width:
            raise LogError(
                f"{self.path}: component {channel.name!r} is not complete: its channels hold"
                f" columns {spans}, needed 0 to {width} once"
            )

    def _read_metadata(self) -> dict[str, Mapping[str, str]]:
        metadata: dict[str, Mapping[str, str]] = {}
        try:
            for record in self._file.metadata():
                metadata[record.name] = verify_checksum(record.name, record.metadata)
        except ValueError as error:
            raise LogError(f"{self.path}: {error}") from error
        return metadata

    def _result_number(self, key: str) -> int:
        try:
            return read_number(self._metadata[RESULT][key])
        except KeyError as error:
            raise self._missing(key) from error
        except ValueError as error:
            raise LogError(f"{self.path}: {key} cannot be understood: {error}") from error

    def _missing(self, key: str) -> LogError:
        return LogError(f"{self.path} has no {key!r}: needed a {RESULT} record, which cosim writes")

    def _component_metadata(
        self, component: str, key: str, parse: Callable[[str], _Parsed], default: _Parsed
    ) -> _Parsed:
        """Parse a component's metadata; ``default`` where another tool left them out."""
        items = self._metadata.get(f"cosim.component.{component}", {})
        text = items.get(key)
        try:
            return default if text is None else parse(text)
        except MALFORMED as error:
            raise LogError(
                f"{self.path}: {key} of {component!r} cannot be understood: {error}"
            ) from error


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


def _read_mask(text: str) -> Mask:
    values = read_json(text)
    if not isinstance(values, list) or not all(isinstance(value, bool) for value in values):
        raise ValueError(f"found {quoted(values)}, needed a list of truth values")
    mask = np.array(values, dtype=np.bool_)
    mask.setflags(write=False)
    return mask
