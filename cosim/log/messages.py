"""The messages of a log: texts, jumps of signals, substeps of loops; the schemas of rows.

A protobuf field name is an identifier, and its JSON name drops the underscores and capitalizes the
letter after each. Two fields with one JSON name (``x_1`` and ``x1``, ``a_b`` and ``aB``) make the
stock decoders refuse the whole channel. So no two names differ only by underscores and case here;
the original names stand in the channel's metadata, and in the comments of the schema
(``source_code_info``), with what else people want to know of a field. Decoders skip these.

Viewers find the elements of a signal by message paths. The grammar is that of Foxglove and
Lichtblick: a topic, quoted where it has other characters than letters, digits, ``_``, ``-`` and
``/``, a dot, a field: ``/plant.x_a_0``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Final, final, get_args

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

from cosim.core.recording import EventCause, MessageLevel, SignalEvent, Substep
from cosim.core.signals import Channel, FaultKind, Signal
from cosim.errors import quoted
from cosim.log.layout import Part, split_channel
from cosim.units import with_unit

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
_STRING = _FIELD.TYPE_STRING
_DOUBLE = _FIELD.TYPE_DOUBLE


@final
class MessageSchema:
    """The protobuf schema of messages of one type.

    Parameters
    ----------
    name : str
        Of the type, with its package.
    file : str
        What the file is called that it is defined in.
    fields : mapping of name to (type, ...)
        In the order of their numbers; after the type of a message or an enum its name.
    repeated : tuple of str
        Those that have any number of values.
    enum : (str, sequence of str), optional
        A type of the message: name and values from 1 on.
    imports : tuple of FileDescriptorProto
        Files that define the types of fields.

    Attributes
    ----------
    serialized : bytes
        The FileDescriptorSet.
    """

    def __init__(
        self,
        name: str,
        file: str,
        fields: Mapping[str, tuple[Any, ...]],
        *,
        repeated: tuple[str, ...] = (),
        enum: tuple[str, Sequence[str]] | None = None,
        imports: tuple[descriptor_pb2.FileDescriptorProto, ...] = (),
    ) -> None:
        self.name = name
        package, _, title = name.partition(".")
        own = descriptor_pb2.FileDescriptorProto(name=file, package=package, syntax="proto3")
        own.dependency.extend(other.name for other in imports)
        message = own.message_type.add(name=title)
        if enum is not None:
            values = message.enum_type.add(name=enum[0])
            for number, value in enumerate(("UNKNOWN", *enum[1])):
                values.value.add(name=value, number=number)
        for number, (field, (of, *type_name)) in enumerate(fields.items(), start=1):
            label = _FIELD.LABEL_REPEATED if field in repeated else _FIELD.LABEL_OPTIONAL
            added = message.field.add(name=field, number=number, type=of, label=label)
            if type_name:
                (added.type_name,) = type_name
        self._files = (*imports, own)
        files = descriptor_pb2.FileDescriptorSet(file=self._files)
        self.serialized = bytes(files.SerializeToString())

    @cached_property
    def message(self) -> Any:
        """The class of its messages."""
        pool = descriptor_pool.DescriptorPool()
        for file in self._files:
            pool.Add(file)
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(self.name))

    def encoded(self, **values: Any) -> bytes:
        """Serialize a message, of equal values to equal bytes."""
        return bytes(self.message(**values).SerializeToString(deterministic=True))

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


def _timestamp_file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(file)
    return file


# Numbers and types are those of foxglove's own schema; viewers know it by its name.
LOG_SCHEMA: Final = MessageSchema(
    "foxglove.Log",
    "foxglove/Log.proto",
    {
        "timestamp": (_FIELD.TYPE_MESSAGE, ".google.protobuf.Timestamp"),
        "level": (_FIELD.TYPE_ENUM, ".foxglove.Log.Level"),
        "message": (_STRING,),
        "name": (_STRING,),
        "file": (_STRING,),
        "line": (_FIELD.TYPE_FIXED32,),
    },
    enum=("Level", [level.upper() for level in LEVELS]),
    imports=(_timestamp_file(),),
)
EVENT_SCHEMA: Final = MessageSchema(
    "cosim_event.SignalEvent",
    "cosim/event.proto",
    {"cause": (_STRING,), "signal": (_STRING,), "values": (_DOUBLE,), "parameters": (_DOUBLE,)},
    repeated=("values", "parameters"),
)
STEP_SCHEMA: Final = MessageSchema(
    "cosim_step.Substep",
    "cosim/step.proto",
    {
        "begin": (_DOUBLE,),
        "end": (_DOUBLE,),
        "loop": (_STRING,),
        "error": (_DOUBLE,),
        "accepted": (_FIELD.TYPE_BOOL,),
        "event": (_STRING,),
        "values": (_DOUBLE,),
    },
    repeated=("values",),
)


def encode_log(time_ns: int, level: MessageLevel, source: str, text: str) -> bytes:
    """Serialize a ``foxglove.Log``."""
    timestamp = timestamp_pb2.Timestamp()
    timestamp.FromNanoseconds(time_ns)
    at = {"seconds": timestamp.seconds, "nanos": timestamp.nanos}
    number = LEVELS.index(level) + 1
    return LOG_SCHEMA.encoded(timestamp=at, level=number, message=text, name=source)


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
    return EVENT_SCHEMA.encoded(
        cause=event.cause, signal=event.signal, values=event.values, parameters=event.parameters
    )


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
    error = math.nan if substep.error is None else substep.error
    return STEP_SCHEMA.encoded(**{**substep._asdict(), "error": error})


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


# --- rows ---

_PLAIN_TOPIC = re.compile(r"[A-Za-z0-9_/-]+")
_QUOTED = re.compile(r'["\\]')


def message_paths(channel: Channel) -> list[str]:
    """Return the message path of every element of a component, in the order of its row."""
    paths: list[str] = []
    # Kind and step of a part are in none of its names.
    for part in split_channel(channel, kind="", step_ns=1):
        topic = _topic_text(f"/{part.title}")
        paths += [f"{topic}.{field}" for field in identifiers(part.elements)]
    return paths


def _topic_text(topic: str) -> str:
    if _PLAIN_TOPIC.fullmatch(topic):
        return topic
    escaped = _QUOTED.sub(lambda match: f"\\{match[0]}", topic)
    return f'"{escaped}"'


def part_comment(part: Part) -> str:
    """Return what a channel holds: ``plant, descriptor``."""
    name = part.channel.name
    return f"{name}, {part.kind}" if part.kind else name


def element_comments(part: Part) -> list[str]:
    """Return what each element of a part is: ``x[0] [m], state: positions of the masses``.

    The description of a signal stands at its first element only, as it may have thousands.
    """
    interface = part.channel.interface
    texts: list[str] = []
    for signal in interface.inputs:
        texts += _signal_comments(signal, "input")
    for signal in interface.outputs:
        texts += _signal_comments(signal, signal.role)
    return texts[part.columns]


def _signal_comments(signal: Signal, role: str) -> list[str]:
    kind = role if signal.type == "real" else f"{role}, {signal.type}"
    comments = []
    for name, unit in zip(signal.elements, signal.measures, strict=True):
        comments.append(f"{with_unit(name, unit.name)}, {kind}")
    if signal.description:
        comments[0] += f": {signal.description}"
    return comments


_LEGAL = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_ILLEGAL = re.compile(r"[^A-Za-z0-9_]+")
# Where the one message of a file is, by the numbers of the descriptors' fields, and on which line.
_MESSAGE_PATH = (descriptor_pb2.FileDescriptorProto.MESSAGE_TYPE_FIELD_NUMBER, 0)
_FIELDS = descriptor_pb2.DescriptorProto.FIELD_FIELD_NUMBER
_MESSAGE_LINE = 3


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


def component_schema(
    message: str, elements: Sequence[str], *, title: str = "", comments: Sequence[str] = ()
) -> bytes:
    """Return the FileDescriptorSet of the message ``cosim.<message>``, one double per element.

    Field numbers are 1 to ``len(elements)``: a channel has at most 4096, so the reserved 19000 to
    19999 are never reached.

    Parameters
    ----------
    message : str
    elements : sequence of str
        Their names.
    title : str
        The comment of the message.
    comments : sequence of str
        Those of the fields, one for each element, or none.
    """
    file = descriptor_pb2.FileDescriptorProto(
        name=f"cosim/{message}.proto", package="cosim", syntax="proto3"
    )
    descriptor = file.message_type.add(name=message)
    for number, name in enumerate(identifiers(elements), start=1):
        field = descriptor.field.add(name=name, number=number)
        field.type = _FIELD.TYPE_DOUBLE
        field.label = _FIELD.LABEL_OPTIONAL
    if title:
        _add_comment(file, _MESSAGE_PATH, title, line=_MESSAGE_LINE)
    for place, comment in enumerate(comments):
        path = (*_MESSAGE_PATH, _FIELDS, place)
        _add_comment(file, path, comment, line=_MESSAGE_LINE + 1 + place)
    return bytes(descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString())


def _add_comment(
    file: descriptor_pb2.FileDescriptorProto, path: Sequence[int], text: str, *, line: int
) -> None:
    """Add the comment in front of a declaration, as protoc finds it after ``//``."""
    location = file.source_code_info.location.add(path=path, span=(line, 0, 0))
    # Names and descriptions may have unpaired surrogates, which strings of protobuf may not.
    readable = text.encode("utf-8", "replace").decode("utf-8")
    location.leading_comments = f" {readable}\n"
