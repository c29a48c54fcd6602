"""Numeric fields of messages in an MCAP file, as samples with their times; what a file has of them.

One pass over the file keeps the requested fields, and nothing else. Messages need not be in order
of time: they are sorted, and of several at one instant the last one in the file counts. The result
says how many there were of both.
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

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
from cosim.log.foreign.formats import JsonFormat, MessageFormat, ProtobufFormat
from cosim.log.foreign.topics import (
    ForeignChannel,
    ForeignFile,
    ForeignMessage,
    ForeignSchema,
    Instants,
    Spacing,
    spacing_of,
)

MOST_LISTED: Final = 10_000  # fields of a message
_READABLE: Final = "protobuf, json, or cdr with a schema in ros2msg or ros2idl"
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
    end_ns: int


def read_fields(
    path: Path,
    fields: Sequence[str],
    *,
    time: str = LOG_TIME,
    time_unit_ns: int = NANOSECONDS,
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
    channels: dict[str, list[ForeignChannel]] = defaultdict(list)
    file = ForeignFile(path)
    for channel in file.channels:
        channels[channel.topic].append(channel)
    asked: dict[str, dict[str, str]] = defaultdict(dict)
    for name in fields:
        topic, inside = _known_topic(path, name, channels)
        asked[topic][name] = inside
    collectors: dict[str, _Collector] = {}
    for topic, paths in asked.items():
        collectors[topic] = _Collector(path, channels[topic], paths, time, time_unit_ns)
    kept = 0
    end_ns = -(2**63)
    for message in file.messages():
        collector = collectors.get(message.channel.topic)
        if collector is not None:
            kept += collector.take(message)
        elif time in (LOG_TIME, PUBLISH_TIME):
            end_ns = max(end_ns, getattr(message, time))
        if kept > MOST_NUMBERS:
            raise LogError(
                f"{path} has more than {MOST_NUMBERS} numbers in {len(collectors)} topics; choose "
                "fewer fields or a shorter file"
            )
    end_ns = max([end_ns, *(collector.last_ns for collector in collectors.values())])
    samples: dict[str, FieldSamples] = {}
    for collector in collectors.values():
        samples |= {found.field: found for found in collector.samples(end_ns)}
    return [samples[name] for name in fields]


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
    """What is kept of the messages of a topic.

    Parameters
    ----------
    path : Path
    channels : sequence of ForeignChannel
        Those of the topic.
    fields : mapping of str to str
        The path in the messages of each field.
    time : str
    time_unit_ns : int
        See :func:`read_fields`.

    Raises
    ------
    LogError
        If a field is none, or nothing here decodes the messages.
    """

    def __init__(
        self,
        path: Path,
        channels: Sequence[ForeignChannel],
        fields: Mapping[str, str],
        time: str,
        time_unit_ns: int,
    ) -> None:
        self._path = path
        self._topic = channels[0].topic
        self._time = time
        self._time_unit_ns = time_unit_ns
        self._columns: list[_Column] = []
        self._stamps = array("q")
        self._formats: dict[ForeignChannel, MessageFormat] = {}
        for field, inside in fields.items():
            with self._naming(field):
                steps = parse_path(inside)
                if channels[0].encoding != "json" and inside[:1] in ("", "["):
                    raise FieldProblem(f"expected {self._topic}.FIELD")
            self._columns.append(_Column(field, steps))
        self._time_path: FieldPath | None = None
        if time not in (LOG_TIME, PUBLISH_TIME):
            with self._naming(f"{self._topic}.{time}"):
                self._time_path = parse_path(time)
        self._format_of(channels[0])

    @contextmanager
    def _naming(self, name: str) -> Iterator[None]:
        """Name the file and a field in what is wrong with it."""
        try:
            yield
        except FieldProblem as error:
            raise LogError(f"{self._path}: {name!r}: {error}") from error

    def _format_of(self, channel: ForeignChannel) -> MessageFormat:
        """Return how the messages of a channel are decoded."""
        found = self._formats.get(channel)
        if found is None:
            with self._naming(self._columns[-1].field):
                only = {str(path.steps[0]) for path in self._paths if path.steps}
                found = self._formats[channel] = format_of(channel, only)
        return found

    @property
    def _paths(self) -> list[FieldPath]:
        """All that is read of a message."""
        paths = [column.path for column in self._columns]
        return paths if self._time_path is None else [*paths, self._time_path]

    def take(self, message: ForeignMessage) -> int:
        """Keep the fields of a message; return how many numbers were kept.

        Raises
        ------
        LogError
            If one is not there, or not a number; names the message.
        """
        name = self._topic
        message_format = self._format_of(message.channel)
        data = bytes(message.data)
        if not self._stamps:
            self._first = (message.channel, data)
        try:
            decoded = message_format.decode(data)
            kept = 1
            for column in self._columns:
                name = column.field
                kept += column.add(message_format.value(decoded, column.path))
            if self._time_path is not None:
                name = f"{self._topic}.{self._time}"
                value = message_format.value(decoded, self._time_path)
                stamp = nanoseconds_in(value, self._time_unit_ns)
            else:
                stamp = getattr(message, self._time)
            self._stamps.append(stamp)
        except FieldProblem as error:
            raise self._message_error(name, str(error)) from error
        except OverflowError:
            reason = f"expected a time below 2**63 ns (year 2262), got {stamp} ns"
            raise self._message_error(self._topic, reason) from None
        return kept

    def _message_error(self, name: str, reason: str) -> LogError:
        number = len(self._stamps) + 1
        return LogError(f"{self._path}: {name!r}, message {number}: {reason}")

    @property
    def last_ns(self) -> int:
        """The latest time.

        Raises
        ------
        LogError
            If there are no messages.
        """
        if not self._stamps:
            raise LogError(f"{self._path}: topic {self._topic!r} has no messages")
        return max(self._stamps)

    def samples(self, end_ns: int) -> list[FieldSamples]:
        """Return what was kept, by ascending time.

        Raises
        ------
        LogError
            If no message has a field.
        """
        stamps = np.array(self._stamps, np.int64)
        spacing = spacing_of(stamps)
        order = np.argsort(stamps, kind="stable")
        ordered = stamps[order]
        kept = order[np.append(ordered[1:] != ordered[:-1], True)]
        samples = []
        for column in self._columns:
            if not column.size:
                raise LogError(self._nothing_text(column))
            values = column.values(len(stamps))[kept]
            found = FieldSamples(
                column.field, self._topic, stamps[kept], values, spacing, column.is_discrete, end_ns
            )
            samples.append(found)
        return samples

    def _nothing_text(self, column: _Column) -> str:
        """Return why there is no value of a field, in all messages."""
        text = f"{self._path}: {column.field!r}: "
        if column.size == 0:
            return f"{text}expected numbers, got no elements"
        names = [field_text(self._topic, name) for name in listed_fields(*self._first)]
        known = "" if column.field in names else f"; {nearest(column.field, names)}"
        return f"{text}no message has this field{known}"


# --- what a file has ---


def listed_fields(channel: ForeignChannel, sample: bytes) -> dict[str, str]:
    """Return the types of the numeric fields of a channel's messages by name, at most 10 000.

    Raises
    ------
    FieldProblem
        As from :func:`format_of`, or if the message cannot be decoded.
    """
    return dict(islice(format_of(channel).fields(sample), MOST_LISTED))


def format_of(channel: ForeignChannel, only: Collection[str] = ()) -> MessageFormat:
    """Return how the messages of a channel are decoded, or some of their fields.

    Raises
    ------
    FieldProblem
        If nothing here decodes them, or their schema cannot be parsed.
    """
    schema = channel.schema or ForeignSchema("", "", b"")
    match channel.encoding, schema.encoding:
        case "json", _:
            return JsonFormat()
        case "protobuf", "protobuf":
            return ProtobufFormat(schema)
        case "cdr", "ros2msg" | "ros2idl":
            from cosim.log.foreign.ros import RosFormat  # which needs an extra

            return RosFormat(schema, only)
    found = f"a schema in {schema.encoding!r}" if channel.schema is not None else "no schema"
    raise FieldProblem(f"expected messages in {_READABLE}, got {channel.encoding!r} with {found}")


class TopicSurvey(NamedTuple):
    """A topic, or the part of it that has one schema.

    Parameters
    ----------
    channel : ForeignChannel
    spacing : Spacing or None
        Of the messages by their log times; None: there are none.
    fields : mapping of name to type
        The numeric ones, ``/topic.a.b``; of JSON those of the first message.
    problem : str
        Why there are none; empty: nothing is wrong.
    """

    channel: ForeignChannel
    spacing: Spacing | None
    fields: dict[str, str]
    problem: str


def survey(path: Path) -> list[TopicSurvey]:
    """Read all of a file once; of the messages only the first of every topic is decoded.

    Raises
    ------
    LogError
        If it cannot be read, is not MCAP, truncated or damaged, or has a time beyond 63 bits.
    """
    file = ForeignFile(path)
    stamps: dict[ForeignChannel, array[int]] = {one: array("q") for one in file.channels}
    first: dict[ForeignChannel, bytes] = {}
    for message in file.messages():
        channel = message.channel
        if channel not in first:
            first[channel] = bytes(message.data)
            stamps.setdefault(channel, array("q"))  # a summary need not list every channel
        try:
            stamps[channel].append(message.log_time)
        except OverflowError:
            raise LogError(
                f"{path}: topic {channel.topic!r}: expected times below 2**63 ns (year 2262), got "
                f"{message.log_time} ns"
            ) from None
    names = {channel.topic for channel in stamps}
    found = [_surveyed(one, own, first.get(one, b""), names) for one, own in stamps.items()]
    return sorted(found, key=lambda topic: topic.channel.topic)


def _surveyed(
    channel: ForeignChannel, stamps: array[int], first: bytes, topics: Collection[str]
) -> TopicSurvey:
    fields: dict[str, str] = {}
    problem = ""
    try:
        for name, type_name in listed_fields(channel, first).items():
            fields[field_text(channel.topic, name, topics)] = type_name
    except FieldProblem as error:
        problem = str(error)
    spacing = spacing_of(np.array(stamps, np.int64)) if stamps else None
    return TopicSurvey(channel, spacing, fields, problem)
