"""Messages of ROS 2, in CDR, by a schema in ``ros2msg`` or ``ros2idl``.

rosbags parses the schema and mcap-ros2-support decodes the messages; both come with an extra. What
could make a small file take long is refused before: messages of too many fields, or inside each
other, and arrays of no elements.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterable, Iterator, Mapping
from types import SimpleNamespace
from typing import Any, Final, NamedTuple, TypeAlias

from cosim.instants import NANOSECONDS
from cosim.log.foreign.fields import FieldProblem, StampNs
from cosim.log.foreign.formats import MISSING, MessageFormat
from cosim.log.foreign.topics import ForeignSchema

_MOST_TEXT: Final = 2**20  # bytes of a schema
_MOST_LEVELS: Final = 50  # of messages inside each other
_MOST_FIELDS: Final = 10_000  # of a message and all inside it
_MOST_ELEMENTS: Final = 2**24  # of an array of fixed length
_ENCAPSULATION: Final = 4  # bytes before the body
_TITLES: Final = re.compile(r"^(?:={3,}|IDL:.*|#.*)\s*$", re.MULTILINE)
_ENUMERATION: Final = re.compile(r"\benum\s+(\w+)")
_NESTED: Final = re.compile(r"\bsequence\s*<\s*sequence\b")
_SEPARATOR: Final = re.compile(r"^={3,}\s*$", re.MULTILINE)
_TIMES: Final = ("builtin_interfaces/Time", "builtin_interfaces/Duration")
# as ROS 2 has them
_NUMBERS: Final = {"octet": "byte", "byte": "byte", "char": "uint8", "bool": "bool"}
_SIZED: Final = re.compile(r"u?int(8|16|32|64)|float(32|64)")
_VARIABLE: Final = -1  # number of elements of a sequence


class RosField(NamedTuple):
    """A field of a message.

    Parameters
    ----------
    name : str
    type_name : str
        A number, ``string``, ``wstring``, or a message as ``package/Name``.
    elements : int or None
        Elements of an array; -1: of a sequence; None: it is a scalar.
    """

    name: str
    type_name: str
    elements: int | None

    @property
    def is_message(self) -> bool:
        """Whether it has messages."""
        return not (
            self.type_name in {*_NUMBERS.values(), "string"} or _SIZED.fullmatch(self.type_name)
        )


RosMessages: TypeAlias = Mapping[str, tuple[RosField, ...]]  # fields by the names of messages
_TIME: Final = (RosField("sec", "int32", None), RosField("nanosec", "uint32", None))


class RosFormat(MessageFormat):
    """Messages in CDR.

    Parameters
    ----------
    schema : ForeignSchema
    only : collection of str
        Fields of a message: those behind the last of them are not decoded. None: all are.

    Raises
    ------
    FieldProblem
        If the extra is not installed, or the schema cannot be parsed or is refused.
    """

    def __init__(self, schema: ForeignSchema, only: Collection[str] = ()) -> None:
        try:
            from mcap_ros2._dynamic import generate_dynamic
            from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg
        except ImportError as error:
            raise FieldProblem(
                "messages of ROS 2 need mcap-ros2-support and rosbags, which are not all "
                "installed: pip install 'cosim[ros]', or, in a clone of cosim, pip install -e "
                "'.[ros]'"
            ) from error
        self._name = _short(schema.name)
        text = _schema_text(schema)
        try:
            if schema.encoding == "ros2idl":
                types = get_types_from_idl(_TITLES.sub("", text))
            else:
                types = get_types_from_msg(_SEPARATOR.sub("=" * 80, text), self._name)
        except (TypesysError, RecursionError, ValueError) as error:
            reason, *rest = str(error).splitlines()
            if len(rest) > 1:  # the text, and where in it
                reason = f"nothing that is known begins at character {rest[1]}"
            raise FieldProblem(f"its schema {schema.name!r} cannot be parsed: {reason}") from error
        self._messages = _messages(types, set(_ENUMERATION.findall(text)))
        _size(self._name, self._messages, (), {})
        self._times = {name for name in _TIMES if _is_time(self._messages[name])}
        fields = self._messages[self._name]
        places = [place for place, field in enumerate(fields) if field.name in only]
        if places and len(places) == len(only):
            self._messages = {**self._messages, self._name: fields[: max(places) + 1]}
        try:
            self._decoder = generate_dynamic(self._name, self._text())[self._name]
        except Exception as error:  # of its own classes: names that ROS does not allow
            raise FieldProblem(f"its schema {schema.name!r} cannot be read: {error}") from error

    def _text(self) -> str:
        """Return the messages as mcap-ros2-support reads them, that of the schema first."""
        parts = []
        for name in dict.fromkeys([self._name, *self._messages]):
            lines = [f"MSG: {name}"]
            for field in self._messages[name]:
                count = "" if field.elements == _VARIABLE else field.elements
                inside = "" if field.elements is None else f"[{count}]"
                lines.append(f"{field.type_name}{inside} {field.name}")
            parts.append("\n".join(lines))
        return f"\n{'=' * 80}\n".join(parts)

    def fields(self, sample: bytes) -> Iterator[tuple[str, str]]:
        """Yield names and types of the numeric fields; those of any length have ``[]``."""
        return self._leaves(self._name, "")

    def _leaves(self, message: str, prefix: str) -> Iterator[tuple[str, str]]:
        for field in self._messages[message]:
            full = f"{prefix}{field.name}"
            inside = "" if field.elements is None else "[]"
            if field.is_message:
                if field.type_name in self._times:
                    yield full + inside, "time"
                yield from self._leaves(field.type_name, f"{full}{inside}.")
            elif not field.type_name.endswith("string"):
                is_fixed = field.elements not in (None, _VARIABLE)
                yield full + (f"[0:{field.elements}]" if is_fixed else inside), field.type_name

    def decode(self, data: bytes) -> Any:
        """Return a message."""
        _check_encapsulation(data)
        try:
            return self._decoder(data)
        except struct.error as error:
            raise FieldProblem(
                f"the message of {len(data)} bytes ends within its fields"
            ) from error
        except (IndexError, NotImplementedError, ValueError, MemoryError) as error:
            raise FieldProblem(
                f"the message of {len(data)} bytes cannot be decoded: {error}"
            ) from error

    def names(self, value: Any) -> Iterable[str] | None:
        """Return the names of the fields of a message."""
        return value.__slots__ if isinstance(value, SimpleNamespace) else None

    def field(self, message: Any, name: str) -> Any:
        """Return a field of a message."""
        value = getattr(message, name) if name in (self.names(message) or ()) else MISSING
        return memoryview(value) if isinstance(value, bytes) else value

    def stamp(self, message: Any) -> StampNs | None:
        """Return a Time or a Duration."""
        if str(message._type) not in self._times:
            return None
        return StampNs(message.sec * NANOSECONDS + message.nanosec)


def _check_encapsulation(data: bytes) -> None:
    """Check that a message is in plain CDR, of either byte order."""
    if len(data) < _ENCAPSULATION:
        raise FieldProblem(f"expected CDR, got a message of {len(data)} bytes")
    kind = int.from_bytes(data[:2], "big")
    if kind > 1:
        raise FieldProblem(f"expected plain CDR (serialization 0 or 1), got serialization {kind}")


# --- schemas ---


def _short(name: str) -> str:
    """Return ``package/Name`` for ``package/msg/Name``, or for a name without a package."""
    parts = name.split("/")
    return f"{parts[0] if len(parts) > 1 else 'unnamed'}/{parts[-1]}"


def _is_time(fields: Iterable[RosField]) -> bool:
    """Return whether the schema says of a message with the name of a time that it is one."""
    elements = {field.name: field.elements for field in fields}
    types = {field.type_name for field in fields}
    return elements == {"sec": None, "nanosec": None} and types <= {"int32", "uint32"}


def _messages(types: Mapping[str, Any], enumerations: Collection[str]) -> RosMessages:
    """Return the messages that rosbags has read, and those that every schema knows."""
    messages: dict[str, tuple[RosField, ...]] = dict.fromkeys(_TIMES, _TIME)
    defined = set(map(_short, types))
    for name, (_, fields) in types.items():
        own = []
        for described in fields:
            field = _field(*described)
            is_enumeration = field.type_name.rpartition("/")[2] in enumerations
            if is_enumeration and field.type_name not in defined:
                field = field._replace(type_name="uint32")
            own.append(field)
        messages[_short(name)] = tuple(own)
    return messages


def _schema_text(schema: ForeignSchema) -> str:
    if len(schema.data) > _MOST_TEXT:
        raise FieldProblem(f"its schema has {len(schema.data)} bytes, more than {_MOST_TEXT}")
    try:
        text = schema.data.decode()
    except UnicodeDecodeError as error:
        raise FieldProblem(f"its schema {schema.name!r} is not UTF-8 text") from error
    if schema.encoding == "ros2idl" and _NESTED.search(text):  # rosbags takes it for a sequence
        raise FieldProblem("its schema has a sequence of sequences: not supported")
    return text


def _field(name: str, described: Any) -> RosField:
    kind, content = described
    count = None
    if kind.name in ("ARRAY", "SEQUENCE"):
        (kind, content), count = content
        if described[0].name == "SEQUENCE":
            count = _VARIABLE
    type_name = content[0] if kind.name == "BASE" else _short(content)
    type_name = _NUMBERS.get(type_name, type_name)
    is_known = kind.name == "NAME" or type_name in {*_NUMBERS.values(), "string"}
    if type_name.endswith("wstring") or not (is_known or _SIZED.fullmatch(type_name)):
        kind_name = type_name.rpartition("/")[2]
        raise FieldProblem(f"its schema has a field of type {kind_name!r}, {name!r}: not supported")
    return RosField(name, type_name, count)


def _size(name: str, messages: RosMessages, above: tuple[str, ...], sizes: dict[str, int]) -> int:
    """Return how many fields a message has, those of messages inside too.

    Raises
    ------
    FieldProblem
        If one inside is not defined, or is inside itself; if there are too many fields, or an array
        has none or too many elements.
    """
    if name in above:
        raise FieldProblem(f"in its schema {name} contains itself")
    if len(above) > _MOST_LEVELS:
        raise FieldProblem(f"its schema nests messages {_MOST_LEVELS} deep")
    if name not in messages:
        raise FieldProblem(f"its schema does not define {name}")
    if name not in sizes:
        total = 1
        for field in messages[name]:
            if field.elements == 0 or (field.elements or 0) > _MOST_ELEMENTS:
                raise FieldProblem(f"its schema has an array of {field.elements} elements")
            total += 1
            if field.is_message:
                total += _size(field.type_name, messages, (*above, name), sizes)
        if total > _MOST_FIELDS:
            raise FieldProblem(f"its schema has more than {_MOST_FIELDS} fields")
        sizes[name] = total
    return sizes[name]
