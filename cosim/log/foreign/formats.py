"""How messages are decoded: JSON and protobuf, each by its library; no code is generated.

A decoded message has fields, which are messages, arrays, numbers or texts; the way from it to a
number is the same in every format. Names in JSON may have dots and brackets: ``a.b`` is a field
``b`` in ``a``, or one of that name. In a message that has both it has to be written in quotes.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

from google.protobuf import descriptor_pb2, descriptor_pool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from cosim.errors import nearest
from cosim.instants import NANOSECONDS
from cosim.log.foreign.fields import (
    EnumNumber,
    FieldPath,
    FieldProblem,
    StampNs,
    Step,
    Steps,
    exact_text,
    parse_path,
    path_text,
)
from cosim.log.foreign.topics import ForeignSchema

MISSING: Final = object()


class MessageFormat(ABC):
    """How the messages of a channel are decoded.

    Attributes
    ----------
    has_schema : bool
        A schema says which fields there are, and names have no dots: one that is not there is an
        error. Else a message need not have it.
    """

    has_schema = True

    @abstractmethod
    def fields(self, sample: bytes) -> Iterator[tuple[str, str]]:
        """Yield names and types of the numeric fields; ``x[]`` may have any length.

        ``sample`` is a message of the channel; empty: there is none.
        """

    @abstractmethod
    def decode(self, data: bytes) -> Any:
        """Return a message; raise FieldProblem if it cannot be decoded."""

    @abstractmethod
    def names(self, value: Any) -> Iterable[str] | None:
        """Return the names of the fields of a message; None: it is no message."""

    @abstractmethod
    def field(self, message: Any, name: str) -> Any:
        """Return a field of a message, None if it is not set; MISSING if it has none."""

    @abstractmethod
    def stamp(self, message: Any) -> StampNs | None:
        """Return a message as a time; None: it is none."""

    def value(self, message: Any, path: FieldPath) -> Any:
        """Return what is at a path: a number, a sequence of them; None where there is nothing.

        Raises
        ------
        FieldProblem
            If there is no such field, or several, or a message.
        """
        found = self.places(message, path)
        if len(found) > 1:
            names = " and ".join(exact_text(steps) for steps, _ in found)
            raise FieldProblem(f"several fields are written so; expected quotes, as in {names}")
        value: Any = found[0][1] if found else None
        if isinstance(value, int | float):
            return value
        if _is_array(value):
            if len(value) and self.names(value[0]) is not None:
                return [self._stamp_at(item, path) for item in value]
            return value
        return value if self.names(value) is None else self._stamp_at(value, path)

    def _stamp_at(self, message: Any, path: FieldPath) -> StampNs:
        stamp = self.stamp(message)
        if stamp is None:
            known = [path_text((*path.steps, name)) for name in self.names(message) or ()]
            raise FieldProblem(f"expected a number, got a message; {nearest('', known)}")
        return stamp

    def places(
        self, value: Any, path: FieldPath, start: int = 0, before: Steps = ()
    ) -> list[tuple[Steps, Any]]:
        """Return where a path leads to from a step on, and what is there.

        Raises
        ------
        FieldProblem
            If there cannot be anything.
        """
        if value is None or start == len(path.steps):
            return [(before, value)]
        step = path.steps[start]
        if not isinstance(step, str):
            return self.places(_elements(value, step, before), path, start + 1, (*before, step))
        found: list[tuple[Steps, Any]] = []
        problem: FieldProblem | None = None
        for name, stop in path.names[start][: 1 if self.has_schema else None]:
            inside = self.field(value, name)
            if inside is not MISSING:
                try:
                    found += self.places(inside, path, stop, (*before, name))
                except FieldProblem as error:
                    problem = error
        if problem is not None and not found:
            raise problem
        if not found:
            self._check_has(value, step, before)
        return found

    def _check_has(self, value: Any, name: str, before: Steps) -> None:
        """Say why a value has no field of a name, unless a message need not have it."""
        names = self.names(value)
        if names is None:
            raise FieldProblem(f"{_place(before)} is {_what(value, before)}, so it has no {name!r}")
        if self.has_schema:
            known = nearest(name, [path_text((*before, other)) for other in names])
            raise FieldProblem(f"unknown field {path_text((*before, name))!r}; {known}")


def _is_array(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def _place(steps: Steps) -> str:
    return repr(path_text(steps)) if steps else "the message"


def _what(value: Any, place: Steps) -> str:
    if _is_array(value):
        return f"an array; choose one of its elements, such as {path_text((*place, 0))}"
    return "text" if isinstance(value, str | bytes) else "a number"


def _elements(value: Any, step: int | range, before: Steps) -> Any:
    if not _is_array(value):
        raise FieldProblem(f"{_place(before)} is not an array, so it cannot be indexed")
    last = step if isinstance(step, int) else step[-1]
    if last >= len(value):
        raise FieldProblem(
            f"{_place(before)}: index {last} is out of range for {len(value)} elements, numbered "
            "from 0"
        )
    return value[step] if isinstance(step, int) else value[step.start : step.stop]


# --- JSON ---

MOST_LEVELS: Final = 50  # of objects and arrays in which fields are listed
_STAMPS: Final = (
    ("sec", "nsec"),
    ("sec", "nanosec"),
    ("secs", "nsecs"),
    ("seconds", "nanos"),
)


class JsonFormat(MessageFormat):
    """Messages in JSON: objects, arrays of numbers, or numbers. They are read, not their schema."""

    has_schema = False

    def fields(self, sample: bytes) -> Iterator[tuple[str, str]]:
        """Yield names and types of the numeric fields of a message; none where it is empty."""
        if not sample:
            return
        tree = self.decode(sample)
        for steps, type_name in self._leaves((), tree):
            text = path_text(steps)
            yield text if self.is_plain(steps, text, tree) else exact_text(steps), type_name

    def is_plain(self, steps: Steps, text: str, tree: Any) -> bool:
        """Return whether a text without quotes names a field of a message, and no other."""
        try:
            return [place for place, _ in self.places(tree, parse_path(text))] == [steps]
        except FieldProblem:
            return False

    def _leaves(self, steps: Steps, value: Any) -> Iterator[tuple[Steps, str]]:
        """Yield the paths of numbers, arrays of numbers and times, with their types."""
        if len(steps) > MOST_LEVELS:
            return
        inside: Iterable[tuple[Step, Any]] = ()
        match value:
            case bool():
                yield steps, "bool"
            case int() | float():
                yield steps, "number"
            case dict():
                if self.stamp(value) is not None:
                    yield steps, "time"
                inside = value.items()
            case [bool() | int() | float(), *_]:
                yield (*steps, range(len(value))), "number"
            case list():
                inside = enumerate(value)
        for step, item in inside:
            yield from self._leaves((*steps, step), item)

    def decode(self, data: bytes) -> Any:
        """Return a message."""
        try:
            return json.loads(data)
        except (ValueError, RecursionError) as error:
            raise FieldProblem(f"the message is not JSON: {error}") from error

    def names(self, value: Any) -> Iterable[str] | None:
        """Return the names of the fields of an object."""
        return value.keys() if isinstance(value, dict) else None

    def field(self, message: Any, name: str) -> Any:
        """Return a field of an object; None: null."""
        return message.get(name, MISSING) if isinstance(message, dict) else MISSING

    def stamp(self, message: Any) -> StampNs | None:
        """Return an object of seconds and nanoseconds as a time; None: it is none."""
        for pair in _STAMPS if len(message) == 2 else ():
            if message.keys() == set(pair):
                seconds, nanoseconds = (message[name] for name in pair)
                if type(seconds) is type(nanoseconds) is int:
                    return StampNs(seconds * NANOSECONDS + nanoseconds)
        return None


# --- protobuf ---

_DEEPEST: Final = 16  # messages inside messages that are listed


class ProtobufFormat(MessageFormat):
    """Messages in protobuf, by the descriptors in the schema.

    Raises
    ------
    FieldProblem
        If the schema is no FileDescriptorSet with the file of the message, and all that it imports.
    """

    def __init__(self, schema: ForeignSchema) -> None:
        pool = descriptor_pool.DescriptorPool()
        try:
            found = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
            files = {file.name: file for file in found.file}
            for name in list(files):
                _add(name, files, pool)
            self._descriptor = pool.FindMessageTypeByName(schema.name)
        except (DecodeError, TypeError, KeyError, ValueError, RecursionError) as error:
            raise FieldProblem(
                f"its schema is not a FileDescriptorSet with the message {schema.name!r}: {error}"
            ) from error
        self._class = GetMessageClass(self._descriptor)

    def fields(self, sample: bytes) -> Iterator[tuple[str, str]]:
        """Yield names and types of the numeric fields; repeated ones have ``[]`` after them."""
        return _leaves(self._descriptor, "", ())

    def decode(self, data: bytes) -> Any:
        """Return a message."""
        try:
            return self._class.FromString(data)
        except DecodeError as error:
            raise FieldProblem(f"the message cannot be decoded: {error}") from error

    def names(self, value: Any) -> Iterable[str] | None:
        """Return the names of the fields of a message."""
        return value.DESCRIPTOR.fields_by_name.keys() if isinstance(value, Message) else None

    def field(self, message: Any, name: str) -> Any:
        """Return a field of a message; None: it is not set."""
        field = (
            message.DESCRIPTOR.fields_by_name.get(name) if isinstance(message, Message) else None
        )
        if field is None:
            return MISSING
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            raise FieldProblem(f"{name!r}: expected numbers, got a map")
        if field.has_presence and not field.has_default_value and not message.HasField(name):
            return None
        value = getattr(message, name)
        if field.enum_type is not None:
            return list(map(EnumNumber, value)) if field.is_repeated else EnumNumber(value)
        return value

    def stamp(self, message: Any) -> StampNs | None:
        """Return a Timestamp or a Duration."""
        if not _is_stamp(message.DESCRIPTOR):
            return None
        return StampNs(message.seconds * NANOSECONDS + message.nanos)


def _add(name: str, files: dict[str, Any], pool: Any) -> None:
    """Take a file out of ``files`` and add it, behind those that it imports."""
    file = files.pop(name, None)
    if file is not None:
        for dependency in file.dependency:
            _add(dependency, files, pool)
        pool.Add(file)


def _type_name(field: Any) -> str:
    """Return the type of a field as a .proto file names it; empty: it is no number."""
    name = descriptor_pb2.FieldDescriptorProto.Type.Name(field.type).removeprefix("TYPE_").lower()
    return "" if name in ("string", "bytes", "group", "message") else name


def _leaves(descriptor: Any, prefix: str, above: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Yield names and types of the numeric fields, those inside of others too."""
    for field in descriptor.fields:
        nested = field.message_type
        full = f"{prefix}{field.name}{'[]' if field.is_repeated else ''}"
        if nested is None:
            if _type_name(field):
                yield full, _type_name(field)
            continue
        if _is_stamp(nested):
            yield full, "time"
        is_map = nested.GetOptions().map_entry
        if not is_map and nested.full_name not in above and len(above) < _DEEPEST:
            yield from _leaves(nested, f"{full}.", (*above, nested.full_name))


def _is_stamp(descriptor: Any) -> bool:
    """Return whether a message is a time, by its name and by what the file says is in it."""
    if descriptor.full_name not in ("google.protobuf.Timestamp", "google.protobuf.Duration"):
        return False
    fields = {field.name: (_type_name(field), field.is_repeated) for field in descriptor.fields}
    return fields == {"seconds": ("int64", False), "nanos": ("int32", False)}
