"""An overview of an MCAP file of another tool: topics, times of messages, numeric fields."""

from __future__ import annotations

from array import array
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cosim.errors import LogError
from cosim.log.foreign.fields import FieldProblem, field_text
from cosim.log.foreign.samples import listed_fields
from cosim.log.foreign.topics import (
    ForeignChannel,
    Spacing,
    read_channels,
    read_messages,
    spacing_of,
)


@dataclass(frozen=True, slots=True)
class TopicSurvey:
    """A topic, or the part of it that has one schema.

    Parameters
    ----------
    topic : str
    encoding : str
        Of the messages.
    schema, schema_encoding : str
        Empty: there is none.
    spacing : Spacing or None
        Of the messages by their log times; None: there are none.
    fields : mapping of name to type
        The numeric ones, ``/topic.a.b``; of JSON those of the first message.
    problem : str
        Why there are none; empty: nothing is wrong.
    """

    topic: str
    encoding: str
    schema: str
    schema_encoding: str
    spacing: Spacing | None
    fields: dict[str, str]
    problem: str


@dataclass(slots=True)
class _KeptMessages:
    """What is kept of the messages of a topic and schema."""

    channel: ForeignChannel
    stamps: array[int] = field(default_factory=lambda: array("q"))
    first: bytes = b""


def survey(path: Path) -> list[TopicSurvey]:
    """Read all of a file once; of the messages only the first of every topic is decoded.

    Raises
    ------
    LogError
        If it cannot be read, is not MCAP, truncated or damaged, or has a time beyond 63 bits.
    """
    kept: dict[tuple[object, ...], _KeptMessages] = {}
    for channel in read_channels(path):
        kept.setdefault(_key(channel), _KeptMessages(channel))
    for message in read_messages(path, lambda channel: True):
        key = _key(message.channel)
        if key not in kept:  # a summary need not list every channel
            kept[key] = _KeptMessages(message.channel)
        messages = kept[key]
        if not messages.stamps:
            messages.first = message.data
        try:
            messages.stamps.append(message.log_time)
        except OverflowError:
            raise LogError(
                f"{path}: topic {message.channel.topic!r}: expected times below 2**63 ns (year "
                f"2262), got {message.log_time} ns"
            ) from None
    names = {messages.channel.topic for messages in kept.values()}
    topics = [_surveyed(messages, names) for messages in kept.values()]
    return sorted(topics, key=lambda topic: topic.topic)


def _key(channel: ForeignChannel) -> tuple[object, ...]:
    return channel.topic, channel.encoding, channel.schema


def _surveyed(messages: _KeptMessages, names: Collection[str]) -> TopicSurvey:
    channel = messages.channel
    fields: dict[str, str] = {}
    problem = ""
    try:
        for name, type_name in listed_fields(channel, messages.first).items():
            fields[field_text(channel.topic, name, names)] = type_name
    except FieldProblem as error:
        problem = str(error)
    schema = channel.schema
    stamps = np.array(messages.stamps, np.int64)
    return TopicSurvey(
        channel.topic,
        channel.encoding,
        "" if schema is None else schema.name,
        "" if schema is None else schema.encoding,
        spacing_of(stamps) if len(stamps) else None,
        fields,
        problem,
    )
