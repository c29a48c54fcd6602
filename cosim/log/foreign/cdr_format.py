"""Fields of messages in CDR, the serialization of ROS 2: what is not asked for is skipped.

::

    message  = 0, byte order (0: big, 1: little), 2 bytes of options, body
    number   = padding to a multiple of its size, counted from the body; number
    string   = length u4, bytes
    sequence = length u4, elements;    array = elements;    message = its fields

A message is compiled to a program: a run of numbers, with what is skipped between them, is one
call of :mod:`struct`; its padding depends on where it begins. The program ends behind the last
field that is wanted.

OMG, DDS-XTypes 1.3, section 7.4 (plain CDR, version 1).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

from cosim.errors import nearest
from cosim.log.foreign.field_path import FieldPath, FieldProblem, Step, path_text
from cosim.log.foreign.ros_definitions import (
    PRIMITIVES,
    STRINGS,
    VARIABLE,
    RosField,
    RosMessages,
    is_time,
)
from cosim.log.foreign.values import NANOSECONDS, Picker, StampNs

MOST_LISTED: Final = 10_000  # fields of a message
_ENCAPSULATION: Final = 4  # bytes before the body
_ORDERS: Final = {0: ">", 1: "<"}
_LENGTH_ALIGNMENT: Final = 4
_ALIGNMENTS: Final = 8


@dataclass(slots=True)
class _Wanted:
    """Which slots take a value, and what is wanted inside of it."""

    slots: list[int] = field(default_factory=list)
    inside: dict[Step, _Wanted] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.slots or self.inside)

    def add(self, path: FieldPath, slot: int) -> None:
        """Have a slot take what is at a path."""
        if not path:
            self.slots.append(slot)
            return
        self.inside.setdefault(path[0], _Wanted()).add(path[1:], slot)


class _Body:
    """A message that is being read, and the values that are taken from it."""

    __slots__ = ("data", "order", "position", "values")

    def __init__(self, data: bytes, order: str, slots: int) -> None:
        self.data = data
        self.order = order
        self.position = 0
        self.values: list[Any] = [None] * slots

    def length(self) -> int:
        """Read the length of a string or sequence, of which every element has a byte at least."""
        begin = -(-self.position // _LENGTH_ALIGNMENT) * _LENGTH_ALIGNMENT
        (count,) = struct.unpack_from(f"{self.order}I", self.data, begin)
        self.position = begin + _LENGTH_ALIGNMENT
        if count > len(self.data) - self.position:
            raise FieldProblem(f"the message says that {count} elements follow, and ends before")
        return int(count)


CdrOperation: TypeAlias = Callable[[_Body], None]


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
        """Return the types of the numeric fields; those of any length have ``[]`` behind them."""
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
            If there is no such field, or it is no number.
        """
        wanted = _Wanted()
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
        program = _CdrCompiler(self._messages).message(self._name, wanted)

        def pick(data: bytes) -> list[Any]:
            body = _Body(data[_ENCAPSULATION:], _order(data), slots)
            try:
                for operation in program:
                    operation(body)
            except struct.error as error:
                raise FieldProblem(
                    f"the message of {len(data)} bytes ends within its fields"
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
                    raise FieldProblem(f"there is no field {place!r}; {names}")
                item = items[step]
                is_element = item.count is None
            else:
                assert item is not None  # a path begins with a name
                if is_element:
                    before = path_text(path[:position])
                    raise FieldProblem(f"{before!r} is no array, so it has no elements")
                _check_element(item, step, path_text(path[:position]))
                is_element = isinstance(step, int)
        assert item is not None
        return self._check_number(item, path, is_element=is_element)

    def _inside(self, item: RosField, before: FieldPath, *, is_element: bool) -> str:
        place = path_text(before)
        if item.type_name not in self._messages:
            raise FieldProblem(f"{place!r} is {_what(item)}, so there are no fields in it")
        if not is_element:
            raise FieldProblem(f"{place!r} is an array; needed one of its elements: {place}[0]")
        return item.type_name

    def _check_number(self, item: RosField, path: FieldPath, *, is_element: bool) -> bool:
        place = path_text(path)
        if item.type_name in PRIMITIVES:
            return False
        if is_element and is_time(item.type_name, self._messages):
            return True
        if item.type_name in STRINGS:
            raise FieldProblem(f"{place!r} is text; needed a number")
        names = [name for name, _ in self._leaves(item.type_name, f"{place}.")]
        raise FieldProblem(
            f"{place!r} is a message; needed a field of it that is a number; {nearest('', names)}"
        )


def _what(item: RosField) -> str:
    return "text" if item.type_name in STRINGS else "a number"


def _check_element(item: RosField, step: int | range, place: str) -> None:
    last = step if isinstance(step, int) else step[-1]
    if item.count is not None and item.count != VARIABLE and last >= item.count:
        raise FieldProblem(_too_few(place, item.count, last))


def _too_few(place: str, count: int, last: int) -> str:
    return f"{place!r} has {count} elements, numbered from 0; needed [{last}]"


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
        raise FieldProblem(f"a message of {len(data)} bytes; needed CDR")
    if data[0] or data[1] not in _ORDERS:
        kind = int.from_bytes(data[:2], "big")
        raise FieldProblem(f"the message is in the serialization {kind}; needed plain CDR, 0 or 1")
    return _ORDERS[data[1]]


# --- programs ---


@dataclass(slots=True)
class _Run:
    """Numbers one behind the other, some of which are taken."""

    items: list[tuple[str, int]] = field(default_factory=list)  # code and number of elements
    taken: dict[int, _Wanted] = field(default_factory=dict)  # by the number of the item
    compiled: dict[tuple[int, str], tuple[struct.Struct, list[tuple[int, int, int | None]]]] = (
        field(default_factory=dict)
    )

    def __call__(self, body: _Body) -> None:
        """Read the numbers."""
        key = (body.position % _ALIGNMENTS, body.order)
        if key not in self.compiled:
            self.compiled[key] = self._compile(*key)
        layout, slots = self.compiled[key]
        numbers = layout.unpack_from(body.data, body.position)
        body.position += layout.size
        for slot, first, stop in slots:
            body.values[slot] = numbers[first] if stop is None else numbers[first:stop]

    def _compile(
        self, begin: int, order: str
    ) -> tuple[struct.Struct, list[tuple[int, int, int | None]]]:
        """Return the layout of a run that begins at a position, and what its slots take."""
        codes = [order]
        slots: list[tuple[int, int, int | None]] = []
        position = begin
        count = 0
        for number, (code, elements) in enumerate(self.items):
            size = struct.calcsize(f"={code}")
            padding = -position % size if elements else 0
            codes.append(f"{padding}x")
            position += padding + size * elements
            wanted = self.taken.get(number)
            if wanted is None:
                codes.append(f"{size * elements}x")
                continue
            codes.append(f"{elements}{code}")
            slots += _slots(wanted, count, elements)
            count += elements
        return struct.Struct("".join(codes)), slots


def _slots(wanted: _Wanted, first: int, elements: int) -> Iterator[tuple[int, int, int | None]]:
    """Yield which slots take which of a run's numbers, for an item that begins at ``first``."""
    for slot in wanted.slots:
        yield slot, first, None
    for step, inner in wanted.inside.items():
        for slot in inner.slots:
            match step:
                case int(index):
                    yield slot, first + index, None
                case range():
                    yield slot, first + step.start, first + step.stop
                case _:  # the whole array
                    yield slot, first, first + elements


_WHOLE: Final = "[]"  # step of an array as a whole


class _CdrCompiler:
    """Compiles messages to programs."""

    def __init__(self, messages: RosMessages) -> None:
        self._messages = messages

    def message(self, name: str, wanted: _Wanted) -> list[CdrOperation]:
        """Return the program of a message up to the last field that is wanted."""
        return _merged(self._operations(name, wanted, is_last=True))

    def _operations(self, name: str, wanted: _Wanted, *, is_last: bool) -> Iterator[CdrOperation]:
        """Yield what reads the fields; of what is last, nothing behind the last wanted one."""
        items = self._messages[name]
        if not items:
            yield _Run([("B", 1)])  # an empty message has a byte
        remaining = sum(item.name in wanted.inside for item in items)
        for item in items:
            inner = wanted.inside.get(item.name, _Wanted())
            remaining -= item.name in wanted.inside
            ends = is_last and not remaining
            if ends and not inner:
                return
            yield from self._item(item, inner, is_last=ends)
            if ends:
                return

    def _item(self, item: RosField, wanted: _Wanted, *, is_last: bool) -> Iterator[CdrOperation]:
        name = item.type_name
        if name in PRIMITIVES:
            yield self._numbers(item, wanted)
        elif name in STRINGS:
            yield _Strings(name, item.count)
        elif item.count is None:
            yield from self._operations(name, wanted, is_last=is_last)
        else:
            plain = _merged(self._operations(name, _Wanted(), is_last=False))
            programs = {}
            for step, inner in wanted.inside.items():
                assert isinstance(step, int)  # checked with the path
                programs[step] = _merged(self._operations(name, inner, is_last=False))
            yield _Messages(item, plain, programs)

    def _numbers(self, item: RosField, wanted: _Wanted) -> CdrOperation:
        code = PRIMITIVES[item.type_name]
        if item.count == VARIABLE:
            return _Sequence(code, item.name, wanted)
        if item.count is not None and wanted.slots:
            wanted.inside[_WHOLE] = _Wanted(wanted.slots)
            wanted.slots = []
        return _Run([(code, item.count or int(item.count is None))], {0: wanted} if wanted else {})


def _merged(operations: Iterator[CdrOperation]) -> list[CdrOperation]:
    """Return operations with runs that follow each other made one."""
    result: list[CdrOperation] = []
    for operation in operations:
        last = result[-1] if result else None
        if isinstance(operation, _Run) and isinstance(last, _Run):
            for number, wanted in operation.taken.items():
                last.taken[len(last.items) + number] = wanted
            last.items += operation.items
        else:
            result.append(operation)
    return result


@dataclass(frozen=True, slots=True)
class _Sequence:
    """A sequence of numbers."""

    code: str
    name: str
    wanted: _Wanted

    def __call__(self, body: _Body) -> None:
        """Read or skip it."""
        count = body.length()
        if not count:
            self._take(body, ())
            return
        size = struct.calcsize(f"={self.code}")
        begin = -(-body.position // size) * size
        body.position = begin + size * count
        if body.position > len(body.data):
            raise FieldProblem(f"the message says that {count} numbers follow, and ends before")
        if self.wanted:
            self._take(
                body, struct.unpack_from(f"{body.order}{count}{self.code}", body.data, begin)
            )

    def _take(self, body: _Body, numbers: Sequence[Any]) -> None:
        for slot in self.wanted.slots:
            body.values[slot] = numbers
        for step, inner in self.wanted.inside.items():
            last = step[-1] if isinstance(step, range) else step
            assert isinstance(last, int)  # checked with the path
            if last >= len(numbers):
                raise FieldProblem(_too_few(self.name, len(numbers), last))
            value = numbers[step.start : step.stop] if isinstance(step, range) else numbers[last]
            for slot in inner.slots:
                body.values[slot] = value


@dataclass(frozen=True, slots=True)
class _Strings:
    """A string, or several, which are skipped."""

    type_name: str
    count: int | None

    def __call__(self, body: _Body) -> None:
        """Skip them."""
        if self.type_name == "wstring":
            raise FieldProblem("a wstring stands before a field that is wanted; none can be read")
        count = body.length() if self.count == VARIABLE else self.count
        for _ in range(1 if count is None else count):
            length = body.length()
            body.position += length


@dataclass(frozen=True, slots=True)
class _Messages:
    """Several messages, some of which have fields that are wanted."""

    item: RosField
    plain: list[CdrOperation]
    programs: dict[int, list[CdrOperation]]

    def __call__(self, body: _Body) -> None:
        """Read them."""
        count = body.length() if self.item.count == VARIABLE else self.item.count or 0
        last = max(self.programs, default=-1)
        if last >= count:
            raise FieldProblem(_too_few(self.item.name, count, last))
        for index in range(count):
            for operation in self.programs.get(index, self.plain):
                operation(body)
