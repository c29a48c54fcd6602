"""The protobuf schema of a component's rows, with legal names for any signal name.

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

import re
from collections.abc import Sequence

from google.protobuf import descriptor_pb2

from cosim.core.signals import Channel, Signal
from cosim.log.layout import Part, split_channel
from cosim.units import with_unit

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
_FIELD = descriptor_pb2.FieldDescriptorProto
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
