"""Message definitions of ROS 2 in the text of a schema: ``ros2msg``.

::

    std_msgs/Header header            a field: type, name, perhaps a default value
    float64[9] covariance
    int32[<=4] counts
    uint8 STATUS_OK=0                 a constant, which no message has
    ================================================================================
    MSG: std_msgs/Header
    builtin_interfaces/Time stamp     the definitions that it needs, one after the other

https://docs.ros.org/en/rolling/Concepts/Basic/About-Interfaces.html
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from cosim.log.foreign.field_path import FieldProblem

VARIABLE: Final = -1  # number of elements of a sequence
MOST_LEVELS: Final = 50  # of messages inside each other
MOST_FIELDS: Final = 10_000  # of a message and all inside it
MOST_ELEMENTS: Final = 2**24  # of an array of fixed length
TIMES: Final = ("builtin_interfaces/Time", "builtin_interfaces/Duration")
PRIMITIVES: Final = {
    "bool": "?",
    "byte": "B",
    "char": "B",  # ROS 2 has it as uint8
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
STRINGS: Final = ("string", "wstring")

_SEPARATOR: Final = re.compile(r"^={3,}\s*$", re.MULTILINE)
_TITLE: Final = re.compile(r"\s*MSG:\s*(\S+)\s*\n?")
_FIELD: Final = re.compile(
    r"(?P<type>[A-Za-z]\w*(?:/\w+)*)(?:<=\d+)?"
    r"(?P<array>\[(?:(?P<most><=)?(?P<count>\d{1,9}))?\])?"
    r"\s+(?P<name>[A-Za-z]\w*)(?P<rest>.*)"
)


@dataclass(frozen=True, slots=True)
class RosField:
    """A field of a message.

    Parameters
    ----------
    name : str
    type_name : str
        A primitive type, a string, or a message as ``package/Name``.
    count : int or None
        Elements of an array of fixed length; VARIABLE: of a sequence; None: it is a scalar.
    """

    name: str
    type_name: str
    count: int | None


RosMessages = Mapping[str, tuple[RosField, ...]]  # fields by the names of messages

TIME_FIELDS: Final = {
    "builtin_interfaces/Time": (
        RosField("sec", "int32", None),
        RosField("nanosec", "uint32", None),
    ),
    "builtin_interfaces/Duration": (
        RosField("sec", "int32", None),
        RosField("nanosec", "uint32", None),
    ),
}


def is_time(name: str, messages: RosMessages) -> bool:
    """Return whether a message is a time, by its name and by what the schema says is in it."""
    if name not in TIMES:
        return False
    fields = {field.name: field.count for field in messages[name]}
    types = {field.type_name for field in messages[name]}
    return fields == {"sec": None, "nanosec": None} and types <= {"int32", "uint32"}


def short_name(name: str) -> str:
    """Return ``package/Name`` for ``package/msg/Name``."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) > 1 else name


def read_ros2msg(name: str, text: str) -> RosMessages:
    """Return the messages that a schema defines; the first is that of the channel.

    Raises
    ------
    FieldProblem
        If it cannot be parsed; says the line.
    """
    messages: dict[str, tuple[RosField, ...]] = dict(TIME_FIELDS)
    current = short_name(name)
    for number, part in enumerate(_SEPARATOR.split(text)):
        title = _TITLE.match(part)
        body = part
        if title is not None:
            current = short_name(title[1])
            body = part[title.end() :]
        elif number:
            raise FieldProblem("its schema has a definition without a line 'MSG: package/Name'")
        messages[current] = tuple(_fields(current, body))
    check_messages(short_name(name), messages)
    return messages


def _fields(message: str, body: str) -> Iterator[RosField]:
    package = message.partition("/")[0]
    for line in body.split("\n"):
        code = line.partition("#")[0].strip()
        if not code:
            continue
        match = _FIELD.fullmatch(code)
        if match is None:
            raise FieldProblem(f"its schema has a line in {message} that is not a field: {code!r}")
        if match["rest"].lstrip().startswith("="):
            continue  # a constant
        type_name = match["type"]
        if type_name not in PRIMITIVES and type_name not in STRINGS:
            type_name = short_name(type_name) if "/" in type_name else f"{package}/{type_name}"
        count = None
        if match["array"] is not None:
            is_fixed = match["count"] is not None and match["most"] is None
            count = int(match["count"]) if is_fixed else VARIABLE
        yield RosField(match["name"], type_name, count)


def check_messages(name: str, messages: RosMessages) -> None:
    """Check that all messages inside of one are defined, and none is inside itself.

    Raises
    ------
    FieldProblem
        If not, or it has too many fields, or an array has none or too many elements.
    """
    sizes: dict[str, int] = {}  # fields, those of messages inside too

    def size(current: str, above: tuple[str, ...]) -> int:
        if current in above:
            raise FieldProblem(f"in its schema {current} contains itself")
        if current in sizes:
            return sizes[current]
        if len(above) > MOST_LEVELS:
            raise FieldProblem(f"its schema nests messages {MOST_LEVELS} deep")
        if current not in messages:
            raise FieldProblem(f"its schema does not define {current}")
        total = 1
        for field in messages[current]:
            if field.count == 0 or (field.count or 0) > MOST_ELEMENTS:
                raise FieldProblem(f"its schema has an array of {field.count} elements")
            total += 1
            if field.type_name not in PRIMITIVES and field.type_name not in STRINGS:
                total += size(field.type_name, (*above, current))
        if total > MOST_FIELDS:
            raise FieldProblem(f"its schema has more than {MOST_FIELDS} fields")
        sizes[current] = total
        return total

    size(name, ())
