"""The messages of a log beside its rows: texts, jumps of signals, substeps of loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any, Final, final, get_args

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

from cosim.core.recording import EventCause, MessageLevel, SignalEvent, Substep
from cosim.core.signals import FaultKind
from cosim.errors import quoted

# foxglove.Log.Level 1 to 5
LEVELS: tuple[MessageLevel, ...] = ("debug", "info", "warning", "error", "fatal")
CAUSES: tuple[EventCause, ...] = (
    "override",
    *get_args(FaultKind),
    "release",
    "set",
    "swap",
    "follow",
    "jump",
)

_FIELD = descriptor_pb2.FieldDescriptorProto


@final
class MessageSchema:
    """The protobuf schema of messages of one type.

    Parameters
    ----------
    name : str
        Of the type, with its package.
    descriptors : callable
        Returns the files that it is defined in.
    """

    def __init__(
        self, name: str, descriptors: Callable[[], descriptor_pb2.FileDescriptorSet]
    ) -> None:
        self.name = name
        self._descriptors = descriptors

    @cached_property
    def serialized(self) -> bytes:
        """The FileDescriptorSet, serialized."""
        return bytes(self._descriptors().SerializeToString())

    @cached_property
    def message(self) -> Any:
        """The class of its messages."""
        pool = descriptor_pool.DescriptorPool()
        for file in self._descriptors().file:
            pool.Add(file)
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(self.name))

    def parsed(self, data: bytes) -> Any:
        """Return a serialized message.

        Raises
        ------
        ValueError
            If ``data`` is not such a message.
        """
        try:
            return self.message.FromString(data)
        # The error's type depends on which of its three implementations protobuf runs on.
        except Exception as error:
            raise ValueError(f"not a {self.name} message: {error}") from error


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


LOG_SCHEMA: Final = MessageSchema("foxglove.Log", _log_descriptors)
EVENT_SCHEMA: Final = MessageSchema("cosim_event.SignalEvent", _event_descriptors)
STEP_SCHEMA: Final = MessageSchema("cosim_step.Substep", _step_descriptors)


def encode_log(time_ns: int, level: MessageLevel, source: str, text: str) -> bytes:
    """Serialize a ``foxglove.Log``."""
    number = LEVELS.index(level) + 1
    message = LOG_SCHEMA.message(level=number, message=text, name=source)
    message.timestamp.FromNanoseconds(time_ns)
    return _serialized(message)


def decode_log(data: bytes) -> tuple[MessageLevel, str, str]:
    """Return level, source and text of a serialized ``foxglove.Log``.

    Raises
    ------
    ValueError
        If ``data`` is not such a message.
    """
    message = LOG_SCHEMA.parsed(data)
    # Other tools may write levels that foxglove.Log does not have, such as UNKNOWN, 0.
    number = min(max(message.level, 1), len(LEVELS))
    return LEVELS[number - 1], message.name, message.message


def encode_event(event: SignalEvent) -> bytes:
    """Serialize the jump of a signal, but for its time, which is that of its record."""
    message = EVENT_SCHEMA.message(
        cause=event.cause, signal=event.signal, values=event.values, parameters=event.parameters
    )
    return _serialized(message)


def decode_event(time_ns: int, data: bytes) -> SignalEvent:
    """Return a serialized jump of a signal.

    Raises
    ------
    ValueError
        If ``data`` is not such a message.
    """
    message = EVENT_SCHEMA.parsed(data)
    for cause in CAUSES:
        if message.cause == cause:
            values = tuple(message.values)
            return SignalEvent(time_ns, cause, message.signal, values, tuple(message.parameters))
    raise ValueError(
        f"event cause: expected one of {', '.join(CAUSES)}, got {quoted(message.cause)}"
    )


def encode_substep(substep: Substep) -> bytes:
    """Serialize a substep; where there is no estimate of its error, that is NaN."""
    message = STEP_SCHEMA.message(
        begin=substep.begin,
        end=substep.end,
        loop=substep.loop,
        error=math.nan if substep.error is None else substep.error,
        accepted=substep.accepted,
        event=substep.event,
        values=substep.values,
    )
    return _serialized(message)


def decode_substep(data: bytes) -> Substep:
    """Return a serialized substep.

    Raises
    ------
    ValueError
        If ``data`` is not such a message, or it does not end after its begin.
    """
    message = STEP_SCHEMA.parsed(data)
    if not -math.inf < message.begin < message.end < math.inf:
        raise ValueError(
            f"not a {STEP_SCHEMA.name} message: a substep from {message.begin} s to {message.end} s"
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


def _serialized(message: Any) -> bytes:
    # Deterministic: the files of equal runs have equal bytes.
    return bytes(message.SerializeToString(deterministic=True))
