"""Messages in protobuf, decoded by its own library: no code is generated from a schema.

Fields taken out of messages that a library decodes to objects.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any, Final

from cosim.errors import nearest
from cosim.instants import NANOSECONDS
from cosim.log.foreign.fields import EnumNumber, FieldPath, FieldProblem, StampNs, path_text
from cosim.log.foreign.topics import ForeignSchema


class DecodedFormat(ABC):
    """Messages that are decoded to objects with fields."""

    @abstractmethod
    def fields(self, sample: bytes) -> Iterator[tuple[str, str]]:
        """Yield names and types of the numeric fields, by the schema."""

    @abstractmethod
    def decode(self, data: bytes) -> Any:
        """Return a message."""

    @abstractmethod
    def _is_message(self, value: Any) -> bool:
        """Return whether a value is a message."""

    @abstractmethod
    def _field(self, message: Any, name: str) -> Any:
        """Return a field of a message, None if it is not set; raise KeyError if there is none."""

    @abstractmethod
    def _stamp(self, message: Any) -> StampNs | None:
        """Return a message as a time; None: it is none."""

    def value(self, message: Any, path: FieldPath) -> Any:
        """Return what is at a path in a message; None: it is not set."""
        value = message
        for position, step in enumerate(path):
            if value is None:
                return None
            place = path_text(path[:position])
            is_list = isinstance(value, Sequence) and not isinstance(value, str | bytes)
            if isinstance(step, str):
                if is_list:
                    raise FieldProblem(
                        f"{place!r} is an array; choose one of its elements, such as {place}[0]"
                    )
                if not self._is_message(value):
                    what = "text" if isinstance(value, str | bytes) else "a number"
                    raise FieldProblem(f"{place!r} is {what}, so it has no fields")
                try:
                    value = self._field(value, step)
                except KeyError:
                    names = nearest(path_text(path), [name for name, _ in self.fields(b"")])
                    text = path_text(path[: position + 1])
                    raise FieldProblem(f"unknown field {text!r}; {names}") from None
                continue
            if not is_list:
                raise FieldProblem(f"{place!r} is not an array, so it cannot be indexed")
            last = step if isinstance(step, int) else step[-1]
            if last >= len(value):
                raise FieldProblem(
                    f"{place!r}: index {last} is out of range for {len(value)} elements, numbered "
                    "from 0"
                )
            value = value[last] if isinstance(step, int) else value[step.start : step.stop]
        return self._number(value, path)

    def _number(self, value: Any, path: FieldPath) -> Any:
        place = path_text(path)
        if isinstance(value, str | bytes):
            what = "text" if isinstance(value, str) else "bytes"
            raise FieldProblem(f"{place!r}: expected a number, got {what}")
        if isinstance(value, Sequence):
            if len(value) and not isinstance(value[0], int | float):
                return [self._number(item, path) for item in value]
            return value
        if not self._is_message(value):
            return value
        stamp = self._stamp(value)
        if stamp is None:
            known = [name for name, _ in self.fields(b"") if name.startswith(f"{place}.")]
            raise FieldProblem(f"{place!r}: expected a number, got a message; {nearest('', known)}")
        return stamp


_DEEPEST: Final = 16  # messages inside messages that are listed


class ProtobufFormat(DecodedFormat):
    """Messages in protobuf, by the descriptors in the schema.

    Raises
    ------
    FieldProblem
        If the schema is no FileDescriptorSet with the file of the message, and all that it imports.
    """

    def __init__(self, schema: ForeignSchema) -> None:
        from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory

        try:
            files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
            pool = descriptor_pool.DescriptorPool()
            for file in _in_order({file.name: file for file in files.file}):
                pool.Add(file)
            self._descriptor = pool.FindMessageTypeByName(schema.name)
        except (message.DecodeError, TypeError, KeyError, ValueError, RecursionError) as error:
            raise FieldProblem(
                f"its schema is not a FileDescriptorSet with the message {schema.name!r}: {error}"
            ) from error
        self._class = message_factory.GetMessageClass(self._descriptor)
        self._message = message.Message
        self._error = message.DecodeError

    def fields(self, sample: bytes) -> Iterator[tuple[str, str]]:
        """Yield names and types of the numeric fields; repeated ones have ``[]`` after them."""
        return _leaves(self._descriptor, "", ())

    def decode(self, data: bytes) -> Any:
        """Return a message."""
        try:
            return self._class.FromString(data)
        except self._error as error:
            raise FieldProblem(f"the message cannot be decoded: {error}") from error

    def _is_message(self, value: Any) -> bool:
        return isinstance(value, self._message)

    def _field(self, message: Any, name: str) -> Any:
        field = message.DESCRIPTOR.fields_by_name[name]
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            raise FieldProblem(f"{name!r}: expected numbers, got a map")
        if field.has_presence and not field.has_default_value and not message.HasField(name):
            return None
        value = getattr(message, name)
        if field.enum_type is not None:
            return list(map(EnumNumber, value)) if field.is_repeated else EnumNumber(value)
        return value

    def _stamp(self, message: Any) -> StampNs | None:
        if not _is_stamp(message.DESCRIPTOR):
            return None
        return StampNs(message.seconds * NANOSECONDS + message.nanos)


def _in_order(files: dict[str, Any]) -> Iterator[Any]:
    """Yield files, each after those that it imports."""
    added: set[str] = set()

    def add(name: str) -> Iterator[Any]:
        if name in added or name not in files:
            return
        added.add(name)
        for dependency in files[name].dependency:
            yield from add(dependency)
        yield files[name]

    for name in files:
        yield from add(name)


def _type_name(field: Any) -> str:
    """Return the type of a field as a .proto file names it; empty: it is no number."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto

    name = FieldDescriptorProto.Type.Name(field.type).removeprefix("TYPE_").lower()
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
