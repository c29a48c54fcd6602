"""Fields of messages in JSON: the messages themselves are read, not their schema.

Names in JSON may have dots and brackets: ``a.b`` is a field ``b`` in ``a``, or one of that name. In
a message that has both it has to be written in quotes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any, Final

from cosim.errors import nearest
from cosim.instants import NANOSECONDS
from cosim.log.foreign.field_path import (
    FieldPath,
    FieldProblem,
    Quoted,
    Step,
    exact_text,
    parse_path,
    path_text,
)
from cosim.log.foreign.values import Picker, StampNs

MOST_LISTED: Final = 10_000  # fields of a message
_DEEPEST: Final = 50  # levels of objects and lists in which fields are listed
_STAMPS: Final = (
    ("sec", "nsec"),
    ("sec", "nanosec"),
    ("secs", "nsecs"),
    ("seconds", "nanos"),
)


class JsonFormat:
    """Messages in JSON: objects, arrays of numbers, or numbers."""

    def fields(self, sample: bytes) -> dict[str, str]:
        """Return the types of the numeric fields of a message."""
        found: dict[str, str] = {}
        if not sample:
            return found
        tree = _decoded(sample)
        for path, type_name in _leaves((), tree):
            text = path_text(path)
            found[text if _is_plain(path, text, tree) else exact_text(path)] = type_name
            if len(found) == MOST_LISTED:
                break
        return found

    def picker(self, paths: Sequence[FieldPath]) -> Picker:
        """Return what takes fields out of messages."""
        wanted = [_Wanted(path) for path in paths]

        def pick(data: bytes) -> list[Any]:
            tree = _decoded(data)
            return [field.value_in(tree) for field in wanted]

        return pick


def _is_plain(path: FieldPath, text: str, tree: Any) -> bool:
    """Return whether a text without quotes names a field, and no other."""
    try:
        return [place for place, _ in _Wanted(parse_path(text)).places(tree)] == [path]
    except FieldProblem:
        return False


def _decoded(data: bytes) -> Any:
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise FieldProblem(f"the message is not JSON: {error}") from error


def _leaves(path: FieldPath, value: Any) -> Iterator[tuple[FieldPath, str]]:
    """Yield the paths of numbers, lists of numbers and times, with their types."""
    if len(path) > _DEEPEST:
        return
    match value:
        case bool():
            yield path, "bool"
        case int() | float():
            yield path, "number"
        case dict():
            if _stamp(value) is not None:
                yield path, "time"
            for name, item in value.items():
                yield from _leaves((*path, name), item)
        case [bool() | int() | float(), *_]:
            yield (*path, range(len(value))), "number"
        case list():
            for index, item in enumerate(value):
                yield from _leaves((*path, index), item)


class _Wanted:
    """A field of messages, whatever dots in its written name belong to names."""

    def __init__(self, path: FieldPath) -> None:
        self._path = path
        # what may be a key from each step on, and the step behind it
        self._keys: list[list[tuple[str, int]]] = []
        for start in range(len(path)):
            keys = []
            for stop in range(start + 1, len(path) + 1):
                steps = path[start:stop]
                is_one = len(steps) == 1
                if not isinstance(steps[0], str) or any(isinstance(s, Quoted) for s in steps[1:]):
                    break
                if is_one or not isinstance(steps[0], Quoted):
                    keys.append((path_text(steps), stop))
            self._keys.append(keys)

    def value_in(self, tree: Any) -> Any:
        """Return what is at the path; None: the object has no such key, or null.

        Raises
        ------
        FieldProblem
            If there cannot be anything, or there are several.
        """
        found = self.places(tree)
        if len(found) > 1:
            names = " and ".join(exact_text(path) for path, _ in found)
            raise FieldProblem(f"several fields are written so; expected quotes, as in {names}")
        value = found[0][1] if found else None
        if isinstance(value, dict):
            stamp = _stamp(value)
            if stamp is None:
                names = nearest("", [path_text((*self._path, name)) for name in value])
                raise FieldProblem(f"expected a number, got an object of several fields; {names}")
            return stamp
        return value

    def places(
        self, value: Any, start: int = 0, before: FieldPath = ()
    ) -> list[tuple[FieldPath, Any]]:
        """Return where the path from a step on leads to, and what is there."""
        if value is None or start == len(self._path):
            return [(before, value)]
        step = self._path[start]
        if not isinstance(value, dict) or not isinstance(step, str):
            return self.places(_inside(value, step, before), start + 1, (*before, step))
        found = []
        problem: FieldProblem | None = None
        for key, stop in self._keys[start]:
            if key in value:
                try:
                    found += self.places(value[key], stop, (*before, key))
                except FieldProblem as error:
                    problem = error
        if problem is not None and not found:
            raise problem
        return found


def _inside(value: Any, step: Step, before: FieldPath) -> Any:
    if isinstance(step, str):
        if not isinstance(value, dict):
            what = repr(path_text(before)) if before else "the message"
            raise FieldProblem(f"{what} is not an object, so it has no {step!r}")
        return value.get(step)
    if not isinstance(value, list):
        what = repr(path_text(before)) if before else "the message"
        raise FieldProblem(f"{what} is not a list, so it cannot be indexed")
    last = step if isinstance(step, int) else step[-1]
    if last >= len(value):
        raise FieldProblem(
            f"{path_text(before)!r}: index {last} is out of range for {len(value)} elements, "
            "numbered from 0"
        )
    return value[step] if isinstance(step, int) else value[step.start : step.stop]


def _stamp(value: dict[str, Any]) -> StampNs | None:
    """Return an object of seconds and nanoseconds as a time; None: it is none."""
    for seconds, nanoseconds in _STAMPS:
        if value.keys() == {seconds, nanoseconds}:
            parts = (value[seconds], value[nanoseconds])
            if all(type(part) is int for part in parts):
                return StampNs(parts[0] * NANOSECONDS + parts[1])
    return None
