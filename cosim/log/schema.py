"""Protobuf schemas: legal names for any signal name, and what a component's messages look like.

A protobuf field name is an identifier, and its JSON name drops the underscores and capitalizes the
letter behind each. Two fields with one JSON name (``x_1`` and ``x1``, ``a_b`` and ``aB``) make the
stock decoders refuse the whole channel. So no two names differ only by underscores and case here;
the original names stand in the channel's metadata.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, get_args

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

from cosim.core.recording import EventCause, MessageLevel, SignalEvent, Substep
from cosim.core.signals import FaultKind
from cosim.errors import quoted

# foxglove.Log.Level 1 to 5
LEVELS: tuple[MessageLevel, ...] = ("debug", "info", "warning", "error", "fatal")
LOG_SCHEMA = "foxglove.Log"
EVENT_SCHEMA = "cosim_event.SignalEvent"
STEP_SCHEMA = "cosim_step.Substep"
CAUSES: tuple[EventCause, ...] = (
    "override",
    *get_args(FaultKind),
    "release",
    "set",
    "swap",
    "follow",
    "jump",
)

_LEGAL = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_ILLEGAL = re.compile(r"[^A-Za-z0-9_]+")
_FIELD = descriptor_pb2.FieldDescriptorProto


def identifiers(names: Sequence[str]) -> list[str]:
    """Return an identifier for each name, such that no two have the same JSON name.

    Legal names are kept where they can be.
    """
    result = [""] * len(names)
    taken: set[str] = set()
    last_number: dict[str, int] = {}
    # Legal names first, so that no illegal one takes theirs; otherwise in order, so that the same
    # names always get the same identifiers.
    order = sorted(range(len(names)), key=lambda i: not _is_legal(names[i]))
    for i in order:
        base = _legal_name(names[i])
        identifier = base
        while _comparable(identifier) in taken:
            last_number[base] = last_number.get(base, 1) + 1
            identifier = f"{base}_{last_number[base]}"
        taken.add(_comparable(identifier))
        result[i] = identifier
    return result


def _is_legal(name: str) -> bool:
    return _LEGAL.fullmatch(name) is not None


def _legal_name(name: str) -> str:
    """Return the name with everything illegal replaced."""
    if _is_legal(name):
        return name
    replaced = _ILLEGAL.sub("_", name).strip("_")
    return replaced if replaced[:1].isalpha() else f"n{replaced}"


def _comparable(identifier: str) -> str:
    """Return the same text for identifiers that may have one JSON name."""
    return identifier.replace("_", "").lower()


def component_schema(message: str, elements: Sequence[str]) -> bytes:
    """Return the FileDescriptorSet of the message ``cosim.<message>``, one double per element.

    Field numbers are 1 to ``len(elements)``: a channel has at most 4096, so the reserved 19000 to
    19999 are never reached.
    """
    file = descriptor_pb2.FileDescriptorProto(
        name=f"cosim/{message}.proto", package="cosim", syntax="proto3"
    )
    descriptor = file.message_type.add(name=message)
    for number, name in enumerate(identifiers(elements), start=1):
        field = descriptor.field.add(name=name, number=number)
        field.type = _FIELD.TYPE_DOUBLE
        field.label = _FIELD.LABEL_OPTIONAL
    return bytes(descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString())


@cache
def log_schema() -> bytes:
    """Return the FileDescriptorSet of ``foxglove.Log``, serialized."""
    return bytes(_log_descriptors().SerializeToString())


def encode_log(time_ns: int, level: MessageLevel, source: str, text: str) -> bytes:
    """Serialize a ``foxglove.Log``."""
    number = LEVELS.index(level) + 1
    message = _log_message()(level=number, message=text, name=source)
    message.timestamp.FromNanoseconds(time_ns)
    # Deterministic: the files of equal runs have equal bytes.
    return bytes(message.SerializeToString(deterministic=True))


def decode_log(data: bytes) -> tuple[MessageLevel, str, str]:
    """Return level, source and text of a serialized ``foxglove.Log``.

    Raises
    ------
    ValueError
        If ``data`` is no such message.
    """
    try:
        message = _log_message().FromString(data)
    # The error's type depends on which of its three implementations protobuf runs on.
    except Exception as error:
        raise ValueError(f"no {LOG_SCHEMA} message: {error}") from error
    # Other tools may write levels that foxglove.Log does not have, such as UNKNOWN, 0.
    number = min(max(message.level, 1), len(LEVELS))
    return LEVELS[number - 1], message.name, message.message


@cache
def _log_message() -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in _log_descriptors().file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(LOG_SCHEMA))


def _log_descriptors() -> descriptor_pb2.FileDescriptorSet:
    timestamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove/Log.proto", package="foxglove", syntax="proto3"
    )
    file.dependency.append(timestamp.name)
    log = file.message_type.add(name="Log")
    levels = log.enum_type.add(name="Level")
    levels.value.add(name="UNKNOWN", number=0)
    for number, level in enumerate(LEVELS, start=1):
        levels.value.add(name=level.upper(), number=number)
    # Numbers and types are those of foxglove's own schema; viewers know it by its name.
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


@cache
def event_schema() -> bytes:
    """Return the FileDescriptorSet of the jump of a signal, serialized."""
    return bytes(_event_descriptors().SerializeToString())


def encode_event(event: SignalEvent) -> bytes:
    """Serialize the jump of a signal, but for its time, which is that of its record."""
    message = _message_class(EVENT_SCHEMA, _event_descriptors)(
        cause=event.cause, signal=event.signal, values=event.values, parameters=event.parameters
    )
    return bytes(message.SerializeToString(deterministic=True))


def decode_event(time_ns: int, data: bytes) -> SignalEvent:
    """Return a serialized jump of a signal.

    Raises
    ------
    ValueError
        If ``data`` is no such message.
    """
    try:
        message = _message_class(EVENT_SCHEMA, _event_descriptors).FromString(data)
    # The error's type depends on which of its three implementations protobuf runs on.
    except Exception as error:
        raise ValueError(f"no {EVENT_SCHEMA} message: {error}") from error
    for cause in CAUSES:
        if message.cause == cause:
            values = tuple(message.values)
            return SignalEvent(time_ns, cause, message.signal, values, tuple(message.parameters))
    raise ValueError(f"an event has the cause {quoted(message.cause)}; needed one of {CAUSES}")


@cache
def step_schema() -> bytes:
    """Return the FileDescriptorSet of a substep, serialized."""
    return bytes(_step_descriptors().SerializeToString())


def encode_substep(substep: Substep) -> bytes:
    """Serialize a substep; where there is no estimate of its error, that is NaN."""
    message = _message_class(STEP_SCHEMA, _step_descriptors)(
        begin=substep.begin,
        end=substep.end,
        loop=substep.loop,
        error=math.nan if substep.error is None else substep.error,
        accepted=substep.accepted,
        event=substep.event,
        values=substep.values,
    )
    return bytes(message.SerializeToString(deterministic=True))


def decode_substep(data: bytes) -> Substep:
    """Return a serialized substep.

    Raises
    ------
    ValueError
        If ``data`` is no such message.
    """
    try:
        message = _message_class(STEP_SCHEMA, _step_descriptors).FromString(data)
    # The error's type depends on which of its three implementations protobuf runs on.
    except Exception as error:
        raise ValueError(f"no {STEP_SCHEMA} message: {error}") from error
    if not -math.inf < message.begin < message.end < math.inf:
        raise ValueError(
            f"no {STEP_SCHEMA} message: a part of a step from {message.begin} s to {message.end} s"
        )
    return Substep(
        message.begin,
        message.end,
        message.loop,
        None if math.isnan(message.error) else message.error,
        message.accepted,
        message.event,
        tuple(message.values),
    )


@cache
def _message_class(schema: str, descriptors: Callable[[], descriptor_pb2.FileDescriptorSet]) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptors().file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema))


def _event_descriptors() -> descriptor_pb2.FileDescriptorSet:
    file = descriptor_pb2.FileDescriptorProto(
        name="cosim/event.proto", package="cosim_event", syntax="proto3"
    )
    event = file.message_type.add(name="SignalEvent")
    for number, name in enumerate(("cause", "signal"), start=1):
        event.field.add(
            name=name, number=number, type=_FIELD.TYPE_STRING, label=_FIELD.LABEL_OPTIONAL
        )
    for number, name in enumerate(("values", "parameters"), start=3):
        event.field.add(
            name=name, number=number, type=_FIELD.TYPE_DOUBLE, label=_FIELD.LABEL_REPEATED
        )
    return descriptor_pb2.FileDescriptorSet(file=[file])


def _step_descriptors() -> descriptor_pb2.FileDescriptorSet:
    file = descriptor_pb2.FileDescriptorProto(
        name="cosim/step.proto", package="cosim_step", syntax="proto3"
    )
    substep = file.message_type.add(name="Substep")
    types = {
        "begin": _FIELD.TYPE_DOUBLE,
        "end": _FIELD.TYPE_DOUBLE,
        "loop": _FIELD.TYPE_STRING,
        "error": _FIELD.TYPE_DOUBLE,
        "accepted": _FIELD.TYPE_BOOL,
        "event": _FIELD.TYPE_STRING,
    }
    for number, (name, of) in enumerate(types.items(), start=1):
        substep.field.add(name=name, number=number, type=of, label=_FIELD.LABEL_OPTIONAL)
    substep.field.add(name="values", number=7, type=_FIELD.TYPE_DOUBLE, label=_FIELD.LABEL_REPEATED)
    return descriptor_pb2.FileDescriptorSet(file=[file])
