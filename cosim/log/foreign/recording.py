"""All numeric fields of all topics of an MCAP file, as what a run has recorded.

Every message is decoded once, and is a row of its topic. Which fields a topic has is the union of
what its messages have; where one has none of a field, or an array ends early, there is ABSENT. What
cannot be read costs itself alone: a field of which a message has no number, a topic of which a
message cannot be decoded. It is left out with everything inside it, and named.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from itertools import repeat
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from cosim.arrays import ABSENT, Matrix, Nanoseconds
from cosim.errors import LogError
from cosim.log.foreign.fields import (
    EnumNumber,
    FieldProblem,
    Steps,
    exact_text,
    number,
    path_text,
)
from cosim.log.foreign.formats import MOST_LEVELS, JsonFormat, MessageFormat
from cosim.log.foreign.samples import MOST_LISTED, MOST_NUMBERS, format_of
from cosim.log.foreign.topics import ForeignChannel, ForeignFile, ForeignMessage

VALUE: Final = "value"  # the field of a message that is itself a number or an array
MOST_ELEMENTS: Final = 1000  # of an array; longer ones are images and point clouds
MOST_OBJECTS: Final = 100  # of an array of them, each of which has fields of its own

# what there may be at a place in a message
_NUMBER: Final = "a number"
_ARRAY: Final = "an array of numbers"
_TIME: Final = "a time"
_TEXT: Final = "text"
_OBJECT: Final = "an object"
_OBJECTS: Final = "an array of objects"
_NUMERIC: Final = frozenset({_NUMBER, _ARRAY, _TIME})

_NONE: Final = frozenset({type(None)})
_DISCRETE: Final = frozenset({bool, EnumNumber})
_TEXTS: Final = frozenset({str, bytes})
_NUMBERS: Final = frozenset({float, int}) | _DISCRETE


class RecordedField(NamedTuple):
    """A field of the messages of a topic.

    Parameters
    ----------
    name : str
        The path into a message, in quotes where it might be another one.
    values : Matrix, shape (N, size)
        Of every message; ABSENT where it has none.
    is_discrete : bool
        All are truth values or enumerations: there is nothing between two of them.
    """

    name: str
    values: Matrix
    is_discrete: bool


class RecordedTopic(NamedTuple):
    """The messages of a topic by ascending log time; those of one instant as in the file."""

    topic: str
    time_ns: Nanoseconds
    fields: Sequence[RecordedField]


class ForeignRecording(NamedTuple):
    """What a file has.

    Parameters
    ----------
    topics : sequence of RecordedTopic
        Those with numeric fields, by name.
    left_out : dict of str to str
        Why a topic, ``/topic``, or a field, ``/topic.field``, with all inside it, is not there.
    """

    topics: Sequence[RecordedTopic]
    left_out: dict[str, str]


def read_recording(path: Path) -> ForeignRecording:
    """Read all numeric fields of the messages in a file.

    Raises
    ------
    LogError
        If it cannot be read, is not MCAP, truncated or damaged, or has more numbers than are kept.
    """
    collectors: dict[str, _TopicRows] = {}
    kept = 0
    for message in ForeignFile(path).messages():
        topic = message.channel.topic
        collector = collectors.get(topic)
        if collector is None:
            collector = collectors[topic] = _TopicRows()
        kept += collector.take(message)
        if kept > MOST_NUMBERS:
            raise _too_many(path)
    if sum(collector.size for collector in collectors.values()) > MOST_NUMBERS:
        raise _too_many(path)
    topics = []
    left_out: dict[str, str] = {}
    for topic, collector in sorted(collectors.items()):
        time_ns, fields, problems = collector.result()
        if fields:
            topics.append(RecordedTopic(topic, time_ns, fields))
        for name, problem in problems.items():
            left_out[f"{topic}.{name}" if name else topic] = problem
    return ForeignRecording(topics, left_out)


def _too_many(path: Path) -> LogError:
    return LogError(f"{path} has more than {MOST_NUMBERS} numbers; expected a shorter file")


class _Node:
    """A place in the messages of a topic: what was there so far, and the places inside it."""

    __slots__ = (
        "elements",
        "inside",
        "is_discrete",
        "kind",
        "kinds",
        "lengths",
        "numbers",
        "problem",
    )

    def __init__(self) -> None:
        self.kind = ""
        self.kinds: dict[str, int] = {}  # each with the number of its first message
        self.is_discrete = True
        self.problem = ""
        self.clear()

    def clear(self) -> None:
        """Forget the numbers, and what lies inside."""
        self.inside: dict[str, _Node] = {}
        self.elements: list[_Node] = []
        self.numbers = array("d")
        self.lengths = array("q")  # of arrays: how many of the numbers each message has

    def size(self) -> int:
        """Return the largest number of elements."""
        return max(self.lengths) if self.lengths else min(1, len(self.numbers))

    def values(self, count: int) -> Matrix:
        """Return the numbers of ``count`` messages, shape (count, size)."""
        values = np.full((count, self.size()), ABSENT)
        if not self.lengths:
            values[: len(self.numbers), 0] = self.numbers
            return values
        lengths = np.zeros(count, np.int64)
        lengths[: len(self.lengths)] = self.lengths
        values[np.arange(self.size()) < lengths[:, np.newaxis]] = self.numbers
        return values

    def all_inside(self, steps: Steps = ()) -> Iterator[tuple[Steps, _Node]]:
        """Yield this place and those inside it, in the order in which they were found."""
        yield steps, self
        for name, node in self.inside.items():
            yield from node.all_inside((*steps, name))
        for index, node in enumerate(self.elements):
            yield from node.all_inside((*steps, index))


class _TopicRows:
    """What is kept of the messages of a topic."""

    def __init__(self) -> None:
        self._root = _Node()
        self._nodes = 1
        self._stamps = array("q")
        self._row = -1  # number of the message, from 0
        self._kept = 0
        self._format: MessageFormat  # of the message
        self._formats: dict[ForeignChannel, MessageFormat] = {}

    def take(self, message: ForeignMessage) -> int:
        """Keep the numbers of a message; return how many more are kept than before."""
        if self._root.problem:
            return 0
        before = self._kept
        self._row += 1
        try:
            found = self._formats.get(message.channel)
            if found is None:
                found = self._formats[message.channel] = format_of(message.channel)
        except FieldProblem as error:
            self._leave_out(self._root, str(error))
            return self._kept - before
        try:
            self._stamps.append(message.log_time)
            self._format = found
            self._keep(self._root, found.decode(bytes(message.data)), 0)
        except FieldProblem as error:
            self._refuse(self._root, str(error))
        except OverflowError:
            self._refuse(
                self._root,
                f"expected a time below 2**63 ns (year 2262), got {message.log_time} ns",
            )
        return self._kept - before

    def _keep(self, node: _Node, value: Any, level: int) -> None:
        """Keep what a message has at a place, or leave the place out."""
        if value is None or node.problem:
            return
        try:
            if isinstance(value, int | float):
                if self._is(node, _NUMBER):
                    self._keep_number(node, value)
            elif isinstance(value, str | bytes):
                self._is(node, _TEXT)
            elif level > MOST_LEVELS:
                raise FieldProblem(f"more than {MOST_LEVELS} objects and arrays inside each other")
            elif isinstance(value, Sequence):
                self._keep_array(node, value, level)
            else:
                self._keep_object(node, value, level)
        except FieldProblem as error:
            self._refuse(node, str(error))

    def _keep_object(self, node: _Node, value: Any, level: int) -> None:
        message_format = self._format
        stamp = message_format.stamp(value)
        if not self._is(node, _OBJECT if stamp is None else _TIME):
            return
        if stamp is not None:
            self._keep_number(node, stamp)
        for name in message_format.names(value) or ():
            inside = node.inside.get(name)
            if inside is None:
                inside = node.inside[name] = self._new_node()
            try:
                item = message_format.field(value, name)
            except FieldProblem as error:
                self._refuse(inside, str(error))
            else:
                self._keep(inside, item, level + 1)

    def _keep_array(self, node: _Node, items: Sequence[Any], level: int) -> None:
        count = len(items)
        if count > MOST_ELEMENTS and not isinstance(items[0], str | bytes):
            raise FieldProblem(f"an array of {count} elements, more than {MOST_ELEMENTS}")
        types = set(map(type, items)) - _NONE
        if not types:
            return
        if types <= _TEXTS:
            self._is(node, _TEXT)
        elif types <= _TEXTS | _NUMBERS:
            if self._is(node, _ARRAY):
                self._keep_row(node, items, types)
        elif self._is(node, _OBJECTS):
            if count > MOST_OBJECTS:
                raise FieldProblem(f"{_OBJECTS}, {count} of them, more than {MOST_OBJECTS}")
            while len(node.elements) < count:
                node.elements.append(self._new_node())
            for element, item in zip(node.elements, items, strict=False):
                self._keep(element, item, level + 1)

    def _new_node(self) -> _Node:
        if self._nodes == MOST_LISTED:
            raise FieldProblem(f"more than {MOST_LISTED} fields in the topic")
        self._nodes += 1
        return _Node()

    def _is(self, node: _Node, kind: str) -> bool:
        """Note what is at a place; return whether numbers of it can be kept."""
        if node.kind != kind:
            node.kind = kind
            node.kinds.setdefault(kind, self._row + 1)
            if len(node.kinds) > 1 and not _NUMERIC.isdisjoint(node.kinds):
                texts = [f"{kind} in message {first}" for kind, first in node.kinds.items()]
                self._leave_out(node, f"it is {', '.join(texts)}")
        return not node.problem

    def _keep_number(self, node: _Node, value: Any) -> None:
        found = number(value)
        node.is_discrete = node.is_discrete and type(value) in _DISCRETE
        missing = self._row - len(node.numbers)
        if missing:
            node.numbers.extend(repeat(ABSENT, missing))
        node.numbers.append(found)
        self._kept += missing + 1

    def _keep_row(self, node: _Node, items: Sequence[Any], types: Collection[type]) -> None:
        if types == {float} and None not in items and all(map(math.isfinite, items)):
            row: Sequence[float] = items
        else:
            row = [ABSENT if item is None else number(item) for item in items]
        node.is_discrete = node.is_discrete and _DISCRETE.issuperset(types)
        missing = self._row - len(node.lengths)
        node.lengths.extend(repeat(0, missing))
        node.lengths.append(len(row))
        node.numbers.extend(row)
        self._kept += missing + 1 + len(row)

    def _refuse(self, node: _Node, problem: str) -> None:
        """Leave a place out because of what is in this message."""
        self._leave_out(node, f"message {self._row + 1}: {problem}")

    def _leave_out(self, node: _Node, problem: str) -> None:
        for _, inside in node.all_inside():
            self._kept -= len(inside.numbers) + len(inside.lengths)
            self._nodes -= inside is not node
        node.clear()
        node.problem = problem

    @property
    def size(self) -> int:
        """How many numbers the result has."""
        nodes = self._root.all_inside()
        return len(self._stamps) * sum(node.size() for _, node in nodes)

    def result(self) -> tuple[Nanoseconds, list[RecordedField], dict[str, str]]:
        """Return the times, the fields, and what is left out: of all, the name is empty."""
        stamps = np.array(self._stamps, np.int64)
        order = np.argsort(stamps, kind="stable")
        fields = []
        problems = {}
        for name, node in self._named():
            if node.problem:
                problems[name] = node.problem
            elif node.numbers:
                values = node.values(len(stamps))[order]
                fields.append(RecordedField(name or VALUE, values, node.is_discrete))
        return stamps[order], fields, problems

    def _named(self) -> Iterator[tuple[str, _Node]]:
        """Yield all nodes with their names, in quotes where others are written so, too."""
        nodes = list(self._root.all_inside())
        texts = [path_text(steps) for steps, _ in nodes]
        counts = Counter(texts)
        for text, (_, node) in zip(texts, nodes, strict=True):
            if node.lengths:
                counts.update(f"{text}[{index}]" for index in range(node.size()))
        for text, (steps, node) in zip(texts, nodes, strict=True):
            is_plain = counts[text] == 1 and _is_plain(steps, text)
            yield text if is_plain else exact_text(steps), node


def _is_plain(steps: Steps, text: str) -> bool:
    """Return whether a text without quotes is that of a path."""
    tree: Any = 0
    for step in reversed(steps):
        tree = [*repeat(None, step), tree] if isinstance(step, int) else {step: tree}
    return JsonFormat().is_plain(steps, text, tree)
