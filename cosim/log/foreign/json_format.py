"""Fields of messages in JSON: the messages themselves are read, not their schema."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any, Final

from cosim.errors import nearest
from cosim.instants import NANOSECONDS
from cosim.log.foreign.field_path import FieldPath, FieldProblem, Step, path_text
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
    """Messages in JSON, an object each."""

    def fields(self, sample: bytes) -> dict[str, str]:
        """Return the types of the numeric fields of a message."""
        found: dict[str, str] = {}
        if not sample:
            return found
        for path, type_name in _leaves((), _decoded(sample)):
            found[path_text(path)] = type_name
            if len(found) == MOST_LISTED:
                break
        return found

    def picker(self, paths: Sequence[FieldPath]) -> Picker:
        """Return what takes fields out of messages."""

        def pick(data: bytes) -> list[Any]:
            tree = _decoded(data)
            return [_value_at(tree, path) for path in paths]

        return pick


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


def _value_at(tree: Any, path: FieldPath) -> Any:
    """Return what is at a path; None: the object has no such key, or null.

    Raises
    ------
    FieldProblem
        If there cannot be anything.
    """
    value = tree
    for position, step in enumerate(path):
        if value is None:
            return None
        value = _inside(value, step, path[:position])
    if isinstance(value, dict):
        stamp = _stamp(value)
        if stamp is None:
            names = [path_text((*path, name)) for name in value]
            raise FieldProblem(
                f"expected a number, got an object of several fields; {nearest('', names)}"
            )
        return stamp
    return value


def _inside(value: Any, step: Step, before: FieldPath) -> Any:
    if isinstance(step, str):
        if not isinstance(value, dict):
            what = repr(path_text(before)) if before else "the message"
            raise FieldProblem(f"{what} is not an object, so it has no {step!r}")
        return value.get(step)
    if not isinstance(value, list):
        raise FieldProblem(f"{path_text(before)!r} is not a list, so it cannot be indexed")
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
