"""Protobuf schemas: legal names for any signal name, and what a component's messages look like.

A protobuf field name is an identifier, and its JSON name drops the underscores and raises the letter behind each. Two fields
with one JSON name (``x_1`` and ``x1``, ``a_b`` and ``aB``) make the stock decoders refuse the whole channel. So two names
never differ by underscores and case alone here; the original names stand in the channel's metadata.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

from cosim.core.contracts import MessageLevel

LEVELS: tuple[MessageLevel, ...] = (
    "debug",
    "info",
    "warning",
    "error",
    "fatal",
)  # foxglove.Log.Level 1 to 5
LOG_SCHEMA = "foxglove.Log"

_LEGAL = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_ILLEGAL = re.compile(r"[^A-Za-z0-9_]+")
_FIELD = descriptor_pb2.FieldDescriptorProto


def identifiers(names: Sequence[str]) -> list[str]:
    """Give each name an identifier that no other has, nor its JSON name; legal names keep theirs where they can."""
    result, taken, last = [""] * len(names), set[str](), dict[str, int]()
    for i in sorted(range(len(names)), key=lambda i: _LEGAL.fullmatch(names[i]) is None):
        base = names[i] if _LEGAL.fullmatch(names[i]) else _ILLEGAL.sub("_", names[i]).strip("_")
        base = base if base[:1].isalpha() else f"n{base}"
        chosen = base
        while _folded(chosen) in taken:
            last[base] = last.get(base, 1) + 1
            chosen = f"{base}_{last[base]}"
        taken.add(_folded(chosen))
        result[i] = chosen
    return result


def _folded(name: str) -> str:
    return name.replace("_", "").lower()


def component_schema(message: str, elements: Sequence[str]) -> bytes:
    """Describe the message ``cosim.<message>`` with one double per element as a serialized FileDescriptorSet.

    Field numbers are 1 to ``len(elements)``: a channel has at most 4096, so the reserved 19000 to 19999 are never reached.
    """
    file = descriptor_pb2.FileDescriptorProto(
        name=f"cosim/{message}.proto", package="cosim", syntax="proto3"
    )
    described = file.message_type.add(name=message)
    for number, name in enumerate(identifiers(elements), start=1):
        described.field.add(
            name=name, number=number, type=_FIELD.TYPE_DOUBLE, label=_FIELD.LABEL_OPTIONAL
        )
    return bytes(descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString())


@cache
def log_schema() -> bytes:
    """Describe ``foxglove.Log`` as a serialized FileDescriptorSet."""
    return bytes(_log_files().SerializeToString())


def encode_log(time_ns: int, level: MessageLevel, name: str, text: str) -> bytes:
    """Serialize a ``foxglove.Log``."""
    message = _log_message()(level=LEVELS.index(level) + 1, message=text, name=name)
    message.timestamp.FromNanoseconds(time_ns)
    return bytes(message.SerializeToString(deterministic=True))


def decode_log(data: bytes) -> tuple[MessageLevel, str, str]:
    """Give level, name and text of a serialized ``foxglove.Log``.

    Raises
    ------
    ValueError
        If ``data`` is no such message.
    """
    try:
        message = _log_message().FromString(data)
    except (
        Exception
    ) as error:  # the error's type depends on which of its three implementations protobuf runs on
        raise ValueError(f"no {LOG_SCHEMA} message: {error}") from error
    return LEVELS[min(max(message.level, 1), 5) - 1], message.name, message.message


@cache
def _log_message() -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in _log_files().file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(LOG_SCHEMA))


def _log_files() -> descriptor_pb2.FileDescriptorSet:
    timestamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove/Log.proto", package="foxglove", syntax="proto3"
    )
    file.dependency.append(timestamp.name)
    log = file.message_type.add(name="Log")
    levels = log.enum_type.add(name="Level")
    for number, level in enumerate(("UNKNOWN", *(level.upper() for level in LEVELS))):
        levels.value.add(name=level, number=number)
    field = {"label": _FIELD.LABEL_OPTIONAL}
    log.field.add(
        name="timestamp",
        number=1,
        type=_FIELD.TYPE_MESSAGE,
        type_name=".google.protobuf.Timestamp",
        **field,
    )
    log.field.add(
        name="level", number=2, type=_FIELD.TYPE_ENUM, type_name=".foxglove.Log.Level", **field
    )
    for number, name in enumerate(("message", "name", "file"), start=3):
        log.field.add(name=name, number=number, type=_FIELD.TYPE_STRING, **field)
    log.field.add(name="line", number=6, type=_FIELD.TYPE_FIXED32, **field)
    return descriptor_pb2.FileDescriptorSet(file=[timestamp, file])
