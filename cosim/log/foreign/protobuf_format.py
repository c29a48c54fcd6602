"""Fields of messages in protobuf, by the descriptors in the schema; no code is generated."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TypeAlias

from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory

from cosim.errors import nearest
from cosim.instants import NANOSECONDS
from cosim.log.foreign.field_path import FieldPath, FieldProblem, path_text
from cosim.log.foreign.values import EnumNumber, Picker, StampNs

Getter: TypeAlias = Callable[[Any], Any]

MOST_LISTED: Final = 10_000  # fields of a message
_DEEPEST: Final = 16  # messages inside messages that are listed
_STAMPS: Final = ("google.protobuf.Timestamp", "google.protobuf.Duration")
_Field = descriptor_pb2.FieldDescriptorProto
_TYPES: Final = {
    _Field.TYPE_DOUBLE: "double",
    _Field.TYPE_FLOAT: "float",
    _Field.TYPE_INT64: "int64",
    _Field.TYPE_UINT64: "uint64",
    _Field.TYPE_INT32: "int32",
    _Field.TYPE_FIXED64: "fixed64",
    _Field.TYPE_FIXED32: "fixed32",
    _Field.TYPE_BOOL: "bool",
    _Field.TYPE_UINT32: "uint32",
    _Field.TYPE_ENUM: "enum",
    _Field.TYPE_SFIXED32: "sfixed32",
    _Field.TYPE_SFIXED64: "sfixed64",
    _Field.TYPE_SINT32: "sint32",
    _Field.TYPE_SINT64: "sint64",
}


class ProtobufFormat:
    """Messages in protobuf.

    Parameters
    ----------
    name : str
        Of the message.
    descriptors : bytes
        A FileDescriptorSet with the file of the message, and all that it imports.

    Raises
    ------
    FieldProblem
        If it is none, or has no such message.
    """

    def __init__(self, name: str, descriptors: bytes) -> None:
        try:
            files = descriptor_pb2.FileDescriptorSet.FromString(descriptors)
            self._descriptor = _pool_of(files).FindMessageTypeByName(name)
            self._class = message_factory.GetMessageClass(self._descriptor)
        except (message.DecodeError, TypeError, KeyError, ValueError, RecursionError) as error:
            raise FieldProblem(
                f"its schema is not a FileDescriptorSet with the message {name!r}: {error}"
            ) from error

    def fields(self, sample: bytes) -> dict[str, str]:
        """Return the types of the numeric fields; repeated ones have ``[]`` after their names."""
        found: dict[str, str] = {}
        for name, type_name in _leaves(self._descriptor, "", ()):
            found[name] = type_name
            if len(found) == MOST_LISTED:
                break
        return found

    def picker(self, paths: Sequence[FieldPath]) -> Picker:
        """Return what takes fields out of messages.

        Raises
        ------
        FieldProblem
            If there is no such field, or it is not a number.
        """
        getters = [self._getter(path) for path in paths]

        def pick(data: bytes) -> list[Any]:
            try:
                decoded = self._class.FromString(data)
            except message.DecodeError as error:
                raise FieldProblem(f"the message cannot be decoded: {error}") from error
            return [getter(decoded) for getter in getters]

        return pick

    def _getter(self, path: FieldPath) -> Getter:
        try:
            return _getter(self._descriptor, path, ())
        except _UnknownField as error:
            names = nearest(path_text(path), self.fields(b""))
            raise FieldProblem(f"{error}; {names}") from error


class _UnknownField(FieldProblem):
    """A message has no field of that name."""


def _pool_of(files: Any) -> Any:
    """Return a pool with these files, each after those that it imports."""
    by_name = {file.name: file for file in files.file}
    pool = descriptor_pool.DescriptorPool()
    added: set[str] = set()

    def add(name: str) -> None:
        if name in added or name not in by_name:
            return
        added.add(name)
        for dependency in by_name[name].dependency:
            add(dependency)
        pool.Add(by_name[name])

    for name in by_name:
        add(name)
    return pool


def _protos(descriptor: Any) -> dict[str, Any]:
    """Return the fields of a message as their definition has them, by name."""
    definition = descriptor_pb2.DescriptorProto()
    descriptor.CopyToProto(definition)
    return {field.name: field for field in definition.field}


def _is_repeated(proto: Any) -> bool:
    return bool(proto.label == _Field.LABEL_REPEATED)


def _leaves(descriptor: Any, prefix: str, above: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Yield names and types of the numeric fields, those inside of others too."""
    for name, proto in _protos(descriptor).items():
        full = f"{prefix}{name}"
        nested = descriptor.fields_by_name[name].message_type
        brackets = "[]" if _is_repeated(proto) else ""
        if nested is None:
            if proto.type in _TYPES:
                yield full + brackets, _TYPES[proto.type]
            continue
        if _is_stamp(nested):
            yield full + brackets, "time"
        is_map = nested.GetOptions().map_entry
        if not is_map and nested.full_name not in above and len(above) < _DEEPEST:
            yield from _leaves(nested, f"{full}{brackets}.", (*above, nested.full_name))


def _is_stamp(descriptor: Any) -> bool:
    """Return whether a message is a time, by its name and by what the file says is in it."""
    if descriptor.full_name not in _STAMPS:
        return False
    fields = {name: (proto.type, proto.label) for name, proto in _protos(descriptor).items()}
    return fields == {
        "seconds": (_Field.TYPE_INT64, _Field.LABEL_OPTIONAL),
        "nanos": (_Field.TYPE_INT32, _Field.LABEL_OPTIONAL),
    }


def _getter(descriptor: Any, path: FieldPath, before: FieldPath) -> Getter:
    """Return what takes a field out of a message.

    Raises
    ------
    FieldProblem
        If there is no such field, or it is not a number.
    """
    name, *rest = path
    place = (*before, name)
    text = path_text(place)
    if not isinstance(name, str):
        raise FieldProblem(f"{path_text(before)!r} is not repeated, so it cannot be indexed")
    field = descriptor.fields_by_name.get(name)
    if field is None:
        raise _UnknownField(f"unknown field {text!r}")
    if field.message_type is not None and field.message_type.GetOptions().map_entry:
        raise FieldProblem(f"{text!r}: expected numbers, got a map")
    proto = _protos(descriptor)[name]
    inner = _value_getter(field, proto, tuple(rest), place)
    if not _is_repeated(proto):
        if field.has_presence and not field.has_default_value:
            return lambda owner: inner(getattr(owner, name)) if owner.HasField(name) else None
        return lambda owner: inner(getattr(owner, name))
    if not rest:
        return lambda owner: [inner(item) for item in getattr(owner, name)]
    if isinstance(rest[0], int):
        return _element_getter(name, rest[0], inner, text)
    if isinstance(rest[0], range):
        return _slice_getter(name, rest[0], inner, text)
    raise FieldProblem(f"{text!r} is repeated; choose one of its elements, such as {text}[0]")


def _value_getter(field: Any, proto: Any, rest: FieldPath, place: FieldPath) -> Getter:
    """Return what takes a number out of a value of a field, or of its elements."""
    text = path_text(place)
    if _is_repeated(proto) and rest and not isinstance(rest[0], str):
        rest = rest[1:]
    nested = field.message_type
    if nested is not None and rest:
        return _getter(nested, rest, place)
    if nested is not None:
        if _is_stamp(nested):
            return lambda value: StampNs(value.seconds * NANOSECONDS + value.nanos)
        names = [name for name, _ in _leaves(nested, f"{text}.", (nested.full_name,))]
        raise FieldProblem(f"{text!r}: expected a number, got a message; {nearest('', names)}")
    if proto.type not in _TYPES:
        what = "text" if proto.type == _Field.TYPE_STRING else "bytes"
        raise FieldProblem(f"{text!r}: expected a number, got {what}")
    if rest:
        raise FieldProblem(f"{text!r} is a number, so it has no {path_text(rest)!r}")
    if proto.type == _Field.TYPE_ENUM:
        return EnumNumber
    return lambda value: value


def _element_getter(name: str, index: int, inner: Getter, text: str) -> Getter:
    def get(owner: Any) -> Any:
        items = getattr(owner, name)
        if index >= len(items):
            raise FieldProblem(_too_short(text, len(items), index))
        return inner(items[index])

    return get


def _slice_getter(name: str, elements: range, inner: Getter, text: str) -> Getter:
    def get(owner: Any) -> Any:
        items = getattr(owner, name)
        if elements.stop > len(items):
            raise FieldProblem(_too_short(text, len(items), elements.stop - 1))
        return [inner(item) for item in items[elements.start : elements.stop]]

    return get


def _too_short(text: str, count: int, last: int) -> str:
    return f"{text!r}: index {last} is out of range for {count} elements, numbered from 0"
