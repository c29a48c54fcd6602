"""Numeric fields of messages in an MCAP file, as samples with their times.

One pass over the file keeps the requested fields, and nothing else. Messages need not be in order
of time: they are sorted, and of several at one instant the last one in the file counts. The result
says how many there were of both.

How the messages of a channel are decoded: which format reads which encoding and schema.
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from cosim.arrays import NAN, Matrix
from cosim.errors import LogError, nearest
from cosim.instants import NANOSECONDS
from cosim.log.foreign.fields import (
    EnumNumber,
    FieldPath,
    FieldProblem,
    field_text,
    nanoseconds_in,
    numbers,
    parse_path,
    split_field,
)
from cosim.log.foreign.topics import (
    ForeignChannel,
    ForeignMessage,
    ForeignSchema,
    Instants,
    Spacing,
    read_channels,
    read_messages,
    spacing_of,
)

MOST_LISTED: Final = 10_000  # fields of a message
_READABLE: Final = "protobuf, json, or cdr with a schema in ros2msg or ros2idl"


class MessageFormat(Protocol):
    """How the messages of a channel are decoded."""

    def fields(self, sample: bytes) -> Iterator[tuple[str, str]]:
        """Yield names and types of the numeric fields; ``x[]`` may have any length.

        ``sample`` is a message of the channel; empty: there is none.
        """
        ...

    def decode(self, data: bytes) -> Any:
        """Return a message, whatever that is; raise FieldProblem if it cannot be decoded."""
        ...

    def value(self, message: Any, path: FieldPath) -> Any:
        """Return a number, a sequence of them, or None where the message has none.

        Raises
        ------
        FieldProblem
            If there is no such field, or it is no number.
        """
        ...


def listed_fields(channel: ForeignChannel, sample: bytes) -> dict[str, str]:
    """Return the types of the numeric fields of a channel's messages by name, at most 10 000.

    Raises
    ------
    FieldProblem
        As from :func:`format_of`, or if the message cannot be decoded.
    """
    return dict(islice(format_of(channel).fields(sample), MOST_LISTED))


def format_of(channel: ForeignChannel) -> MessageFormat:
    """Return how the messages of a channel are decoded.

    Raises
    ------
    FieldProblem
        If nothing here decodes them, or their schema cannot be parsed.
    """
    schema = channel.schema or ForeignSchema("", "", b"")
    match channel.encoding, schema.encoding:
        case "json", _:
            from cosim.log.foreign.json_format import JsonFormat  # each only where it is needed

            return JsonFormat()
        case "protobuf", "protobuf":
            from cosim.log.foreign.decoding import ProtobufFormat

            return ProtobufFormat(schema)
        case "cdr", "ros2msg" | "ros2idl":
            from cosim.log.foreign.ros import RosFormat

            return RosFormat(schema)
    found = f"a schema in {schema.encoding!r}" if channel.schema is not None else "no schema"
    raise FieldProblem(f"expected messages in {_READABLE}, got {channel.encoding!r} with {found}")


LOG_TIME: Final = "log_time"
PUBLISH_TIME: Final = "publish_time"
MOST_NUMBERS: Final = 2**25  # that are kept of a file


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """A field of the messages of a topic.

    Parameters
    ----------
    field : str
    topic : str
    time_ns : Instants, shape (N,)
        Ascending.
    values : Matrix, shape (N, size)
        NaN where a message has none.
    spacing : Spacing
        Of the messages of the topic.
    is_discrete : bool
        All are truth values or enumerations: there is nothing between two of them.
    end_ns : int
        The last time of the recording: of all its messages, if they are not timed by a field.
    """

    field: str
    topic: str
    time_ns: Instants
    values: Matrix
    spacing: Spacing
    is_discrete: bool
    end_ns: int = 0


def read_fields(
    path: Path, fields: Sequence[str], *, time: str = LOG_TIME, time_unit_ns: int = NANOSECONDS
) -> list[FieldSamples]:
    """Read fields of messages, such as ``/drive/state.position`` and ``/joints.effort[0:3]``.

    Parameters
    ----------
    path : Path
    fields : sequence of str
    time : str
        ``"log_time"``, ``"publish_time"``, or a field of the same messages, ``"header.stamp"``.
    time_unit_ns : int
        What a number that is a time counts, in ns.

    Raises
    ------
    LogError
        If the file cannot be read or is damaged; a field is not there, is not a number, or has not
        always the same number of elements; a time is none.
    """
    topics: dict[str, list[ForeignChannel]] = defaultdict(list)
    for channel in read_channels(path):
        topics[channel.topic].append(channel)
    collectors: dict[str, _Collector] = {}
    for name in dict.fromkeys(fields):
        topic, inside = _known_topic(path, name, topics)
        if topic not in collectors:
            collectors[topic] = _Collector(path, topics[topic], time, time_unit_ns)
        collectors[topic].add_field(name, inside)
    for collector in collectors.values():
        collector.begin()
    kept = 0
    last = _LastTime(time)
    for message in read_messages(path, lambda channel: channel.topic in collectors, last.take):
        kept += collectors[message.channel.topic].take(message)
        if kept > MOST_NUMBERS:
            raise LogError(
                f"{path} has more than {MOST_NUMBERS} numbers in {len(collectors)} topics; choose "
                "fewer fields or a shorter file"
            )
    samples = {}
    for collector in collectors.values():
        for found in collector.samples():
            samples[found.field] = found
    end_ns = max([last.time_ns, *(int(found.time_ns[-1]) for found in samples.values())])
    return [replace(samples[name], end_ns=end_ns) for name in fields]


class _LastTime:
    """The last time of the messages that are not read, if it is not in a field of them."""

    def __init__(self, time: str) -> None:
        self.time_ns = -(2**63)
        self._place = {LOG_TIME: 0, PUBLISH_TIME: 1}.get(time)

    def take(self, *times: int) -> None:
        """Take the log time and the publish time of a message."""
        if self._place is not None:
            self.time_ns = max(self.time_ns, times[self._place])


def _known_topic(path: Path, name: str, topics: Mapping[str, Any]) -> tuple[str, str]:
    """Return the topic of a field, and the path in it.

    Raises
    ------
    LogError
        If there is none, or there are several.
    """
    try:
        found = split_field(name, topics)
    except FieldProblem as error:
        raise LogError(f"{path}: {name!r}: {error}") from error
    if found is not None:
        return found
    choice = nearest(name.partition(".")[0], topics)
    raise LogError(f"{path}: no topic for {name!r}, expected TOPIC.FIELD; {choice}")


def _is_discrete(value: Any) -> bool:
    items = value if isinstance(value, list | tuple) else (value,)
    return all(isinstance(item, bool | EnumNumber) for item in items)


class _Column:
    """What is kept of a field: as many numbers of every message."""

    def __init__(self, field: str, path: FieldPath) -> None:
        self.field = field
        self.path = path
        self.size: int | None = None
        self._numbers = array("d")
        self._before = 0  # messages before the first that had it
        self.is_discrete = True  # as far as it has been seen

    def add(self, value: Any) -> int:
        """Keep the value of a message; return how many numbers it has.

        Raises
        ------
        FieldProblem
            If it is not a number, or has another number of elements than those before.
        """
        if value is None:
            if self.size is None:
                self._before += 1
            else:
                self._numbers.extend([NAN] * self.size)
            return self.size or 1
        row = numbers(value)
        self.is_discrete = self.is_discrete and _is_discrete(value)
        if self.size is None:
            self.size = len(row)
            self._numbers.extend([NAN] * (self.size * self._before))
        if len(row) != self.size:
            raise FieldProblem(
                f"expected {self.size} elements, as in the first message, got {len(row)}; choose "
                f"single elements, such as {self.field}[0]"
            )
        self._numbers.extend(row)
        return self.size

    def values(self, count: int) -> Matrix:
        """Return the numbers of ``count`` messages, shape (count, size)."""
        size = self.size or 0
        rows: Matrix = np.array(self._numbers, np.float64).reshape(count, size)
        return rows


class _Collector:
    """What is kept of the messages of a topic."""

    def __init__(
        self, path: Path, channels: Sequence[ForeignChannel], time: str, time_unit_ns: int
    ) -> None:
        self._path = path
        self._topic = channels[0].topic
        self._channels = list(channels)
        self._time = time
        self._time_unit_ns = time_unit_ns
        self._columns: list[_Column] = []
        self._stamps = array("q")
        self._formats: dict[int, MessageFormat] = {}
        self._time_path: FieldPath = ()

    def add_field(self, field: str, inside: str) -> None:
        """Add a field of the topic that is kept, by its name and the path in the messages.

        Raises
        ------
        LogError
            If it is none.
        """
        with self._naming(field):
            path = parse_path(inside)
            if self._channels[0].encoding != "json" and not (path and isinstance(path[0], str)):
                raise FieldProblem(f"expected {self._topic}.FIELD")
        self._columns.append(_Column(field, path))

    def begin(self) -> None:
        """Check that the messages can be decoded.

        Raises
        ------
        LogError
            If nothing here does that.
        """
        if self._is_field_time:
            with self._naming(f"{self._topic}.{self._time}"):
                self._time_path = parse_path(self._time)
        self._format_of(self._channels[0])

    @contextmanager
    def _naming(self, name: str) -> Iterator[None]:
        """Name the file and a field in what is wrong with it."""
        try:
            yield
        except FieldProblem as error:
            raise LogError(f"{self._path}: {name!r}: {error}") from error

    def _format_of(self, channel: ForeignChannel) -> MessageFormat:
        """Return how the messages of a channel are decoded."""
        found = self._formats.get(channel.id)
        if found is None:
            if channel not in self._channels:  # a summary need not list every channel
                self._channels.append(channel)
            with self._naming(self._columns[-1].field):
                found = self._formats[channel.id] = format_of(channel)
        return found

    @property
    def _is_field_time(self) -> bool:
        return self._time not in (LOG_TIME, PUBLISH_TIME)

    def take(self, message: ForeignMessage) -> int:
        """Keep the fields of a message; return how many numbers were kept.

        Raises
        ------
        LogError
            If one is not there, or not a number; names the message.
        """
        name = self._topic
        message_format = self._format_of(message.channel)
        try:
            decoded = message_format.decode(message.data)
            kept = 1
            for column in self._columns:
                name = column.field
                kept += column.add(message_format.value(decoded, column.path))
            if self._is_field_time:
                name = f"{self._topic}.{self._time}"
                value = message_format.value(decoded, self._time_path)
                stamp = nanoseconds_in(value, self._time_unit_ns)
            else:
                is_log_time = self._time == LOG_TIME
                stamp = message.log_time if is_log_time else message.publish_time
            self._stamps.append(stamp)
        except FieldProblem as error:
            of_schema = f"schema {_schema_text(message.channel)}: "
            reason = f"{of_schema if len(self._channels) > 1 else ''}{error}"
            raise self._message_error(name, reason) from error
        except OverflowError:
            reason = f"expected a time below 2**63 ns (year 2262), got {stamp} ns"
            raise self._message_error(self._topic, reason) from None
        return kept

    def _message_error(self, name: str, reason: str) -> LogError:
        number = len(self._stamps) + 1
        return LogError(f"{self._path}: {name!r}, message {number}: {reason}")

    def samples(self) -> list[FieldSamples]:
        """Return what was kept, by ascending time.

        Raises
        ------
        LogError
            If no message has a field.
        """
        stamps = np.array(self._stamps, np.int64)
        count = len(stamps)
        if not count:
            raise LogError(f"{self._path}: topic {self._topic!r} has no messages")
        spacing = spacing_of(stamps)
        order = np.argsort(stamps, kind="stable")
        ordered = stamps[order]
        is_last = np.append(ordered[1:] != ordered[:-1], True)
        kept = order[is_last]
        samples = []
        for column in self._columns:
            if not column.size:
                raise LogError(self._nothing_text(column))
            values = column.values(count)[kept]
            found = FieldSamples(
                column.field, self._topic, stamps[kept], values, spacing, column.is_discrete
            )
            samples.append(found)
        return samples

    def _nothing_text(self, column: _Column) -> str:
        """Return why there is no value of a field, in all messages."""
        text = f"{self._path}: {column.field!r}: "
        if column.size == 0:
            return f"{text}expected numbers, got no elements"
        for message in read_messages(self._path, lambda channel: channel.topic == self._topic):
            fields = listed_fields(message.channel, message.data)
            names = [field_text(self._topic, name) for name in fields]
            return f"{text}no message has this field; {nearest(column.field, names)}"
        raise AssertionError("there are messages, or nothing would be asked of them")


def _schema_text(channel: ForeignChannel) -> str:
    name = channel.schema.name if channel.schema is not None else "none"
    return f"{name!r} in {channel.encoding!r}"
