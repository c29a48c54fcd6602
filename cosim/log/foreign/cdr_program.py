"""Programs that read messages in CDR: they take the fields that are needed and skip all others.

A sequence of numbers, with what is skipped between them, is one call of :mod:`struct`; its padding
depends on where it begins. A program ends after the last field that is needed.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

from cosim.log.foreign.field_path import FieldPath, FieldProblem, Step
from cosim.log.foreign.ros_definitions import PRIMITIVES, STRINGS, VARIABLE, RosField, RosMessages

_LENGTH_ALIGNMENT: Final = 4
_ALIGNMENTS: Final = 8


@dataclass(slots=True)
class Wanted:
    """Which slots take a value, and what is wanted inside of it."""

    slots: list[int] = field(default_factory=list)
    inside: dict[Step, Wanted] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.slots or self.inside)

    def add(self, path: FieldPath, slot: int) -> None:
        """Add a slot that takes what is at a path."""
        if not path:
            self.slots.append(slot)
            return
        self.inside.setdefault(path[0], Wanted()).add(path[1:], slot)


class CdrBody:
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
            raise FieldProblem(f"the message announces {count} elements, but ends before them")
        return int(count)


CdrOperation: TypeAlias = Callable[[CdrBody], None]


def too_few_text(place: str, count: int, last: int) -> str:
    """Return why an element is not there."""
    return f"{place!r}: index {last} is out of range for {count} elements, numbered from 0"


@dataclass(slots=True)
class _Run:
    """Numbers one after the other, some of which are taken."""

    items: list[tuple[str, int]] = field(default_factory=list)  # code and number of elements
    taken: dict[int, Wanted] = field(default_factory=dict)  # by the number of the item
    compiled: dict[tuple[int, str], tuple[struct.Struct, list[tuple[int, int, int | None]]]] = (
        field(default_factory=dict)
    )

    def __call__(self, body: CdrBody) -> None:
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


def _slots(wanted: Wanted, first: int, elements: int) -> Iterator[tuple[int, int, int | None]]:
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


def compiled_program(name: str, messages: RosMessages, wanted: Wanted) -> list[CdrOperation]:
    """Return the program of a message up to the last field that is wanted."""
    return _CdrCompiler(messages).message(name, wanted)


class _CdrCompiler:
    """Compiles messages to programs."""

    def __init__(self, messages: RosMessages) -> None:
        self._messages = messages

    def message(self, name: str, wanted: Wanted) -> list[CdrOperation]:
        """Return the program of a message up to the last field that is wanted."""
        return _merged(self._operations(name, wanted, is_last=True))

    def _operations(self, name: str, wanted: Wanted, *, is_last: bool) -> Iterator[CdrOperation]:
        """Yield what reads the fields; of what is last, nothing after the last wanted one."""
        items = self._messages[name]
        if not items:
            yield _Run([("B", 1)])  # an empty message has a byte
        remaining = sum(item.name in wanted.inside for item in items)
        for item in items:
            inner = wanted.inside.get(item.name, Wanted())
            remaining -= item.name in wanted.inside
            ends = is_last and not remaining
            if ends and not inner:
                return
            yield from self._item(item, inner, is_last=ends)
            if ends:
                return

    def _item(self, item: RosField, wanted: Wanted, *, is_last: bool) -> Iterator[CdrOperation]:
        name = item.type_name
        if name in PRIMITIVES:
            yield self._numbers(item, wanted)
        elif name in STRINGS:
            yield _Strings(name, item.count)
        elif item.count is None:
            yield from self._operations(name, wanted, is_last=is_last)
        else:
            plain = _merged(self._operations(name, Wanted(), is_last=False))
            programs = {}
            for step, inner in wanted.inside.items():
                assert isinstance(step, int)  # checked with the path
                programs[step] = _merged(self._operations(name, inner, is_last=False))
            yield _Messages(item, plain, programs)

    def _numbers(self, item: RosField, wanted: Wanted) -> CdrOperation:
        code = PRIMITIVES[item.type_name]
        if item.count == VARIABLE:
            return _Sequence(code, item.name, wanted)
        if item.count is not None and wanted.slots:
            wanted.inside[_WHOLE] = Wanted(wanted.slots)
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
    wanted: Wanted

    def __call__(self, body: CdrBody) -> None:
        """Read or skip it."""
        count = body.length()
        if not count:
            self._take(body, ())
            return
        size = struct.calcsize(f"={self.code}")
        begin = -(-body.position // size) * size
        body.position = begin + size * count
        if body.position > len(body.data):
            raise FieldProblem(f"the message announces {count} numbers, but ends before them")
        if self.wanted:
            self._take(
                body, struct.unpack_from(f"{body.order}{count}{self.code}", body.data, begin)
            )

    def _take(self, body: CdrBody, numbers: Sequence[Any]) -> None:
        for slot in self.wanted.slots:
            body.values[slot] = numbers
        for step, inner in self.wanted.inside.items():
            last = step[-1] if isinstance(step, range) else step
            assert isinstance(last, int)  # checked with the path
            if last >= len(numbers):
                raise FieldProblem(too_few_text(self.name, len(numbers), last))
            value = numbers[step.start : step.stop] if isinstance(step, range) else numbers[last]
            for slot in inner.slots:
                body.values[slot] = value


@dataclass(frozen=True, slots=True)
class _Strings:
    """A string, or several, which are skipped."""

    type_name: str
    count: int | None

    def __call__(self, body: CdrBody) -> None:
        """Skip them."""
        if self.type_name == "wstring":
            raise FieldProblem("a wstring before a requested field cannot be read")
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

    def __call__(self, body: CdrBody) -> None:
        """Read them."""
        count = body.length() if self.item.count == VARIABLE else self.item.count or 0
        last = max(self.programs, default=-1)
        if last >= count:
            raise FieldProblem(too_few_text(self.item.name, count, last))
        for index in range(count):
            for operation in self.programs.get(index, self.plain):
                operation(body)
