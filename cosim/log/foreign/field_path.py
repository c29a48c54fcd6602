"""The written names of fields: ``/drive/state.position``, ``/joints.effort[3]``, ``/a.poses[0].x``.

A field is written as a topic, a dot and the path into a message: names of fields with dots between
them, and indices of elements, from 0, in brackets. ``[0:3]`` at the end selects several elements.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final, TypeAlias

from cosim.core.port import split_element

Step: TypeAlias = str | int | range
FieldPath: TypeAlias = tuple[Step, ...]

_PART: Final = re.compile(r"(?P<name>[^.\[\]]+)(?P<elements>(?:\[\d{1,9}\])*)")
_ELEMENT: Final = re.compile(r"\[(\d+)\]")


class FieldProblem(ValueError):
    """What is wrong with a field of a message: it is missing, or no number."""


def parse_path(text: str) -> FieldPath:
    """Return the way into a message that a text names.

    Raises
    ------
    FieldProblem
        If it names none.
    """
    whole, elements = split_element(text)
    last: FieldPath = ()
    if isinstance(elements, range):
        if not elements:
            raise FieldProblem(f"{text!r}: expected a slice such as [0:2], got an empty one")
        text = whole
        last = (elements,)
    steps: list[Step] = []
    for part in text.split("."):
        match = _PART.fullmatch(part)
        if match is None:
            raise FieldProblem(f"{text!r}: expected field names separated by dots, such as a.b[3]")
        steps.append(match["name"])
        steps += [int(number) for number in _ELEMENT.findall(match["elements"])]
    return (*steps, *last)


def path_text(path: Iterable[Step]) -> str:
    """Return a path as it is written."""
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


def topic_of(field: str, topics: Iterable[str]) -> str | None:
    """Return the topic of a field: the longest that it begins with; None: there is none."""
    matches = [topic for topic in topics if field.startswith(f"{topic}.")]
    return max(matches, key=len, default=None)
