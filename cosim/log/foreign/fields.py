"""Fields of messages: their written names, and their values as float64.

A field is written as a topic, a dot and the path into a message, ``/drive/state.position``,
``/joints.effort[3]``, ``/a.poses[0].x``: names of fields with dots between them, and indices of
elements, from 0, in brackets. ``[0:3]`` at the end selects several elements. In quotes, as in TOML,
a name is itself whatever is in it: ``/drive."motor.speed"``; so is a topic:
``"/drive.left".speed``. A message that is an array has ``/drive[0]``, one that is a number
``/drive``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple, TypeAlias

from cosim.arrays import NAN
from cosim.instants import NANOSECONDS

Step: TypeAlias = str | int | range
Steps: TypeAlias = tuple[Step, ...]

_QUOTED: Final = r'"(?:[^"\\]|\\.)*"'
_STEP: Final = re.compile(
    rf"(?P<dot>\.)?(?P<name>[^.\[\]\"]+|{_QUOTED})|\[(?P<index>\d{{1,9}})(:(?P<stop>\d{{1,9}}))?\]"
)
_TOPIC: Final = re.compile(_QUOTED)


class FieldProblem(ValueError):
    """What is wrong with a field of a message: it is missing, or no number."""


class Quoted(str):
    """A name that was written in quotes: it is no part of another one."""


class FieldPath(NamedTuple):
    """The way into a message.

    Parameters
    ----------
    steps : tuple of str, int or range
        () is the message itself.
    names : tuple
        From each step on: what may be one name, with the dots and brackets in it, and the number
        of the step behind it. The step alone comes first.
    """

    steps: Steps
    names: tuple[tuple[tuple[str, int], ...], ...]


def parse_path(text: str) -> FieldPath:
    """Return the way into a message that a text names.

    Raises
    ------
    FieldProblem
        If it names none.
    """
    steps: list[Step] = []
    position = 0
    while position < len(text):
        match = _STEP.match(text, position)
        is_name = match is not None and match["name"] is not None
        is_after_range = bool(steps) and isinstance(steps[-1], range)
        is_joined = not is_name or (match is not None and (match["dot"] is None) == (not steps))
        if match is None or is_after_range or not is_joined:
            raise FieldProblem(
                f"{text!r}: expected field names separated by dots, such as a.b[3], those with "
                "dots or brackets in quotes"
            )
        steps.append(_step(text, match))
        position = match.end()
    return FieldPath(tuple(steps), tuple(_names(steps, start) for start in range(len(steps))))


def _step(text: str, match: re.Match[str]) -> Step:
    name = match["name"]
    if name is not None:
        return Quoted(_unquoted(text, name)) if name.startswith('"') else name
    if match["stop"] is None:
        return int(match["index"])
    elements = range(int(match["index"]), int(match["stop"]))
    if not elements:
        raise FieldProblem(f"{text!r}: expected a slice such as [0:2], got an empty one")
    return elements


def _unquoted(text: str, name: str) -> str:
    try:
        return str(json.loads(name))
    except ValueError as error:
        raise FieldProblem(f"{text!r}: the quotes of {name} cannot be read") from error


def _names(steps: Sequence[Step], start: int) -> tuple[tuple[str, int], ...]:
    first = steps[start]
    if not isinstance(first, str):
        return ()
    names = [(str(first), start + 1)]
    for stop in range(start + 2, len(steps) + 1):
        if isinstance(first, Quoted) or isinstance(steps[stop - 1], Quoted):
            break
        names.append((path_text(steps[start:stop]), stop))
    return tuple(names)


def path_text(path: Iterable[Step]) -> str:
    """Return a path as it is written, without quotes."""
    text = ""
    for step in path:
        match step:
            case str():
                text += f".{step}" if text else step
            case int():
                text += f"[{step}]"
            case range():
                text += f"[{step.start}:{step.stop}]"
    return text


def exact_text(path: Iterable[Step]) -> str:
    """Return a path with every name in quotes: it names nothing else."""
    quoted: list[Step] = []
    for step in path:
        quoted.append(json.dumps(step, ensure_ascii=False) if isinstance(step, str) else step)
    return path_text(quoted)


def field_text(topic: str, path: str, topics: Iterable[str] = ()) -> str:
    """Return the written name of a field of a topic, in quotes where others may begin it, too."""
    point = "." if path and not path.startswith("[") else ""
    text = f"{topic}{point}{path}"
    if any(other != topic and _begins(text, other) for other in topics):
        text = f"{json.dumps(topic, ensure_ascii=False)}{point}{path}"
    return text


def _begins(field: str, topic: str) -> bool:
    return field == topic or field.startswith((f"{topic}.", f"{topic}["))


def split_field(field: str, topics: Iterable[str]) -> tuple[str, str] | None:
    """Return the topic of a field and the path in it; None: there is no such topic.

    Raises
    ------
    FieldProblem
        If the name begins with several topics, of which none is in quotes.
    """
    quoted = _TOPIC.match(field)
    if quoted is not None:
        topic = _unquoted(field, quoted[0])
        return (topic, field[quoted.end() :].removeprefix(".")) if topic in set(topics) else None
    matches = [topic for topic in topics if _begins(field, topic)]
    if len(matches) > 1:
        names = " or ".join(json.dumps(topic, ensure_ascii=False) for topic in matches)
        raise FieldProblem(f"it begins with several topics; expected one in quotes, {names}")
    return (matches[0], field[len(matches[0]) :].removeprefix(".")) if matches else None


# --- values ---

_KINDS: Final = {type(None): "missing", str: "text", bytes: "bytes", list: "a list"}


class StampNs(int):
    """A time or duration in ns, which is s as a value of a field."""


class EnumNumber(int):
    """The number of an enumeration: there is nothing between two of them."""


def numbers(value: Any) -> list[float]:
    """Return the value of a field as numbers; NaN: the message has none.

    Raises
    ------
    FieldProblem
        If it is not a number, infinite, or an integer that no float64 is.
    """
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [number(item) for item in value]
    return [number(value)]


def number(value: Any) -> float:
    """Return a value as a number; NaN: there is none.

    Raises
    ------
    FieldProblem
        As from :func:`numbers`.
    """
    if value is None:
        return NAN
    if not isinstance(value, int | float):
        raise FieldProblem(f"expected a number, got {_what(value)}")
    try:
        if isinstance(value, StampNs):
            return value / NANOSECONDS
        found = float(value)
    except OverflowError:
        raise FieldProblem("expected a number below 2**1024") from None
    if abs(found) == math.inf:
        raise FieldProblem(f"expected a finite number, got {value}")
    if isinstance(value, int) and found != value:  # bool, enumerations too
        raise FieldProblem(
            f"expected an integer that a float64 represents (up to 2**53), got {value}"
        )
    return found if found == found else NAN


def _what(value: Any) -> str:
    kind = type(value)
    return _KINDS.get(kind, f"of type {kind.__name__}")


def nanoseconds_in(value: Any, unit_ns: int) -> int:
    """Return a time that a message has in ns; a number counts units of ``unit_ns``.

    Raises
    ------
    FieldProblem
        If it is not a time.
    """
    if isinstance(value, StampNs):
        return int(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FieldProblem(f"expected a time, got {_what(value)}")
    if isinstance(value, int):
        return value * unit_ns
    if not abs(value * unit_ns) < 2**63:
        raise FieldProblem("expected a time, got a number that is not finite or too large")
    # apart: the product of both, of 19 digits, would be rounded to 16
    rest, whole = math.modf(value)
    return int(whole) * unit_ns + round(rest * unit_ns)
