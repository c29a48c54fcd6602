"""Fields of messages in JSON: the messages themselves are read, not their schema.

Names in JSON may have dots and brackets: ``a.b`` is a field ``b`` in ``a``, or one of that name. In
a message that has both it has to be written in quotes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Final

from cosim.errors import nearest
from cosim.instants import NANOSECONDS
from cosim.log.foreign.fields import (
    FieldPath,
    FieldProblem,
    Quoted,
    StampNs,
    Step,
    exact_text,
    parse_path,
    path_text,
)

_DEEPEST: Final = 50  # levels of objects and lists in which fields are listed
_STAMPS: Final = (
    ("sec", "nsec"),
    ("sec", "nanosec"),
    ("secs", "nsecs"),
    ("seconds", "nanos"),
)


class JsonFormat:
    """Messages in JSON: objects, arrays of numbers, or numbers."""

    def fields(self, sample: bytes) -> Iterator[tuple[str, str]]:
        """Yield names and types of the numeric fields of a message; none where it is empty."""
        if not sample:
            return
        tree = self.decode(sample)
        for path, type_name in _leaves((), tree):
            text = path_text(path)
            yield text if _is_plain(path, text, tree) else exact_text(path), type_name

    def __init__(self) -> None:
        self._wanted: dict[FieldPath, _Wanted] = {}

    def decode(self, data: bytes) -> Any:
        """Return a message."""
        try:
            return json.loads(data)
        except (ValueError, RecursionError) as error:
            raise FieldProblem(f"the message is not JSON: {error}") from error

    def value(self, message: Any, path: FieldPath) -> Any:
        """Return what is at a path; None: the object has no such key, or null."""
        wanted = self._wanted.get(path)
        if wanted is None:
            wanted = self._wanted[path] = _Wanted(path)
        return wanted.value_in(message)


def _is_plain(path: FieldPath, text: str, tree: Any) -> bool:
    """Return whether a text without quotes names a field, and no other."""
    try:
        return [place for place, _ in _Wanted(parse_path(text)).places(tree)] == [path]
    except FieldProblem:
        return False


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
