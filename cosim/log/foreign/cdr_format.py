"""Fields of messages in CDR, the serialization of ROS 2; fields that are not needed are skipped.

::

    message  = 0, byte order (0: big, 1: little), 2 bytes of options, body
    number   = padding to a multiple of its size, counted from the body; number
    string   = length u4, bytes
    sequence = length u4, elements;    array = elements;    message = its fields

OMG, DDS-XTypes 1.3, section 7.4 (plain CDR, version 1).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import Any, Final

from cosim.errors import nearest
from cosim.instants import NANOSECONDS
from cosim.log.foreign.cdr_program import CdrBody, Wanted, compiled_program, too_few_text
from cosim.log.foreign.field_path import FieldPath, FieldProblem, path_text
from cosim.log.foreign.ros_definitions import (
    PRIMITIVES,
    STRINGS,
    VARIABLE,
    RosField,
    RosMessages,
    is_time,
)
from cosim.log.foreign.values import Picker, StampNs

MOST_LISTED: Final = 10_000  # fields of a message
_ENCAPSULATION: Final = 4  # bytes before the body
_ORDERS: Final = {0: ">", 1: "<"}


class CdrFormat:
    """Messages in CDR.

    Parameters
    ----------
    name : str
        Of the message, as ``package/Name``.
    messages : mapping of name to fields
        What it is made of.
    """

    def __init__(self, name: str, messages: RosMessages) -> None:
        self._name = name
        self._messages = messages

    def fields(self, sample: bytes) -> dict[str, str]:
        """Return the types of the numeric fields; those of any length have ``[]`` after them."""
        found: dict[str, str] = {}
        for name, type_name in self._leaves(self._name, ""):
            found[name] = type_name
            if len(found) == MOST_LISTED:
                break
        return found

    def _leaves(self, message: str, prefix: str) -> Iterator[tuple[str, str]]:
        for item in self._messages[message]:
            name = f"{prefix}{item.name}"
            if item.type_name in PRIMITIVES:
                yield name + _brackets(item.count), item.type_name
            elif is_time(item.type_name, self._messages):
                yield name + ("" if item.count is None else "[]"), "time"
            if item.type_name in self._messages:
                inside = "" if item.count is None else "[]"
                yield from self._leaves(item.type_name, f"{name}{inside}.")

    def picker(self, paths: Sequence[FieldPath]) -> Picker:
        """Return what takes fields out of messages.

        Raises
        ------
        FieldProblem
            If there is no such field, or it is not a number.
        """
        wanted = Wanted()
        stamps = []
        slots = len(paths)
        for slot, path in enumerate(paths):
            if self._is_time(path):
                wanted.add((*path, "sec"), slots)
                wanted.add((*path, "nanosec"), slots + 1)
                stamps.append((slot, slots))
                slots += 2
            else:
                wanted.add(path, slot)
        program = compiled_program(self._name, self._messages, wanted)

        def pick(data: bytes) -> list[Any]:
            body = CdrBody(data[_ENCAPSULATION:], _order(data), slots)
            try:
                for operation in program:
                    operation(body)
            except struct.error as error:
                raise FieldProblem(
                    f"the message of {len(data)} bytes ends before its last field"
                ) from error
            values = body.values
            for slot, first in stamps:
                values[slot] = StampNs(values[first] * NANOSECONDS + values[first + 1])
            return values[: len(paths)]

        return pick

    def _is_time(self, path: FieldPath) -> bool:
        """Check a path, and return whether it leads to a time."""
        message = self._name
        item = None
        is_element = True
        for position, step in enumerate(path):
            place = path_text(path[: position + 1])
            if isinstance(step, str):
                if item is not None:
                    message = self._inside(item, path[:position], is_element=is_element)
                items = {known.name: known for known in self._messages[message]}
                if step not in items:
                    names = nearest(path_text(path), self.fields(b""))
                    raise FieldProblem(f"unknown field {place!r}; {names}")
                item = items[step]
                is_element = item.count is None
            else:
                assert item is not None  # a path begins with a name
                if is_element:
                    before = path_text(path[:position])
                    raise FieldProblem(f"{before!r} is not an array, so it cannot be indexed")
                _check_element(item, step, path_text(path[:position]))
                is_element = isinstance(step, int)
        assert item is not None
        return self._check_number(item, path, is_element=is_element)

    def _inside(self, item: RosField, before: FieldPath, *, is_element: bool) -> str:
        place = path_text(before)
        if item.type_name not in self._messages:
            raise FieldProblem(f"{place!r} is {_what(item)}, so it has no fields")
        if not is_element:
            raise FieldProblem(
                f"{place!r} is an array; choose one of its elements, such as {place}[0]"
            )
        return item.type_name

    def _check_number(self, item: RosField, path: FieldPath, *, is_element: bool) -> bool:
        place = path_text(path)
        if item.type_name in PRIMITIVES:
            return False
        if is_element and is_time(item.type_name, self._messages):
            return True
        if item.type_name in STRINGS:
            raise FieldProblem(f"{place!r}: expected a number, got text")
        names = [name for name, _ in self._leaves(item.type_name, f"{place}.")]
        raise FieldProblem(f"{place!r}: expected a number, got a message; {nearest('', names)}")


def _what(item: RosField) -> str:
    return "text" if item.type_name in STRINGS else "a number"


def _check_element(item: RosField, step: int | range, place: str) -> None:
    last = step if isinstance(step, int) else step[-1]
    if item.count is not None and item.count != VARIABLE and last >= item.count:
        raise FieldProblem(too_few_text(place, item.count, last))


def _brackets(count: int | None) -> str:
    if count is None:
        return ""
    return "[]" if count == VARIABLE else f"[0:{count}]"


def _order(data: bytes) -> str:
    """Return the byte order of a message.

    Raises
    ------
    FieldProblem
        If it is in another serialization than plain CDR.
    """
    if len(data) < _ENCAPSULATION:
        raise FieldProblem(f"expected CDR, got a message of {len(data)} bytes")
    if data[0] or data[1] not in _ORDERS:
        kind = int.from_bytes(data[:2], "big")
        raise FieldProblem(f"expected plain CDR (serialization 0 or 1), got serialization {kind}")
    return _ORDERS[data[1]]
