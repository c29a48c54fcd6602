"""Validation errors of pydantic as problems: the key, what was expected, what was found."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from cosim.errors import UsageError, nearest, quoted
from cosim.scenario.document.places import Key, Problem

TYPES = {
    "string_type",
    "float_type",
    "int_type",
    "bool_type",
    "tuple_type",
    "list_type",
    "dict_type",
    "model_type",
}


class TableProblems(UsageError):
    """Problems of a table that show only while its component is built.

    Parameters
    ----------
    problems : sequence of Problem
        Their keys are those of the table.
    """

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__("; ".join(f"{'.'.join(map(str, key))}: {text}" for key, text in problems))
        self.problems = tuple(problems)


class _ValueProblem(NamedTuple):
    """A validation error: where its value stands, what was tried for that, and what is wrong."""

    path: Key  # of a missing key, where it should stand
    choices: tuple[tuple[Key, str | int], ...]  # values with alternatives, and the one tried
    is_type: bool
    problem: Problem


def problems_of(
    error: ValidationError, table: type[BaseModel], data: Any, prefix: Key
) -> list[Problem]:
    """Translate a validation error of ``data``, which stands under the key ``prefix``."""
    items: list[Mapping[str, Any]] = [dict(item) for item in error.errors(include_url=False)]
    unknown = [str(item["loc"][-1]) for item in items if item["type"] == "extra_forbidden"]
    found = []
    for item in items:
        loc = item["loc"]
        if item["type"] == "missing" and get_close_matches(str(loc[-1]), unknown, cutoff=0.5):
            continue  # the unknown key is probably this one
        if item["type"] == "too_short" and any(
            other["loc"][: len(loc)] == loc != other["loc"] for other in items
        ):
            continue  # pydantic does not count the entries that are wrong
        found.append(_value_problem(item, table, data, prefix))
    texts = dict.fromkeys(problem.problem for problem in _nearest(found, 0, table, data))
    return [((*prefix, *key), text) for key, text in texts]


def _value_problem(
    item: Mapping[str, Any], table: type[BaseModel], data: Any, prefix: Key
) -> _ValueProblem:
    """Separate pydantic's location into keys of the data and names of alternatives."""
    loc = item["loc"]
    missing: Key = loc[-1:] if item["type"] == "missing" else ()
    path: Key = ()
    choices = []
    value = data
    for part in loc[: len(loc) - len(missing)]:
        children = dict(enumerate(value)) if isinstance(value, list | tuple) else value
        if isinstance(children, Mapping) and part in children:
            value = children[part]
            path = (*path, part)
        else:
            choices.append((path, part))
    problem = (path, _message(item, path, table, prefix))
    return _ValueProblem((*path, *missing), tuple(choices), item["type"] in TYPES, problem)


def _nearest(
    problems: Sequence[_ValueProblem], level: int, table: type[BaseModel], data: Any
) -> list[_ValueProblem]:
    """Return the problems of the alternatives that values are nearest to.

    An alternative that refuses a value as a whole is out, if another one refuses parts of it. Where
    this leaves several that do not agree, the value is refused as a whole: pydantic's messages
    about each of them would contradict each other. ``level`` counts the choices inwards.
    """
    nearest_problems = [problem for problem in problems if len(problem.choices) <= level]
    chosen: dict[Key, dict[str | int, list[_ValueProblem]]] = {}
    for problem in problems:
        if len(problem.choices) > level:
            at, alternative = problem.choices[level]
            chosen.setdefault(at, {}).setdefault(alternative, []).append(problem)
    for at, alternatives in chosen.items():
        kept = [_nearest(group, level + 1, table, data) for group in alternatives.values()]
        inside = [group for group in kept if any(len(p.path) > len(at) for p in group)]
        candidates = inside or kept
        exact = [group for group in candidates if not any(p.is_type for p in group)]
        if exact or len(candidates) == 1:
            nearest_problems += (exact or candidates)[0]
            continue
        value = data
        for part in at:
            value = value[part]
        text = f"expected {described(annotation_at(table, at))}, got {quoted(value)}"
        nearest_problems.append(_ValueProblem(at, (), True, (at, text)))
    return nearest_problems


def _message(details: Mapping[str, Any], path: Key, table: type[BaseModel], prefix: Key) -> str:
    name = str(details["loc"][-1])
    match details["type"]:
        case "extra_forbidden":
            fields = _fields(table, path[:-1])
            suggestion = nearest(name, sorted(fields))
            start = fields.get("start")
            is_clear = suggestion.startswith("did you mean") and not isinstance(
                details["input"], Mapping
            )
            if start is not None and get_origin(start.annotation) is dict and not is_clear:
                key = ".".join(map(str, (*prefix[-1:], *path[:-1], "start")))
                variable = _dotted(name, details["input"])
                suggestion = f"a variable is set by {key}.{variable}; {suggestion}"
            return f"unknown key {quoted(name)}; {suggestion}"
        case "missing":
            field = _fields(table, path).get(name)
            description = None if field is None else field.description
            return f"{name!r} is missing ({description})" if description else f"{name!r} is missing"
        case "value_error":
            return str(details["ctx"]["error"])
        case "literal_error":
            expected = str(details["ctx"]["expected"]).replace(" or ", ", ")
            choices = [choice.strip().strip("'") for choice in expected.split(",")]
            value = details["input"]
            return f"unknown value {quoted(value)}; {nearest(str(value), choices)}"
        case _:
            expected = _expected(details, path, table)
            return f"expected {expected}, got {quoted(details.get('input'))}"


def _dotted(name: str, value: Any) -> str:
    """Return the name of a variable such as ``damper.d``, of which TOML makes tables, as a key."""
    while isinstance(value, Mapping) and len(value) == 1:
        ((part, value),) = value.items()
        name = f"{name}.{part}"
    return name


def _expected(details: Mapping[str, Any], path: Key, table: type[BaseModel]) -> str:
    """Return what is expected in place of a value that is wrong."""
    context = details.get("ctx", {})
    match details["type"]:
        case "finite_number":
            return "a finite number"
        case "greater_than":
            return f"a number > {context['gt']:g}"
        case "less_than":
            return f"a number < {context['lt']:g}"
        case "greater_than_equal":
            return f"a number >= {_bound(context['ge'])}"
        case "less_than_equal":
            return f"a number <= {_bound(context['le'])}"
        case "too_short":
            return f"at least {context['min_length']}"
        case "float_type" if type(details["input"]) is int:
            return f"a number <= {sys.float_info.max:g}"
        case "int_from_float":
            return _WORDS[int]
        case kind if kind in TYPES:
            return described(annotation_at(table, path))
        case _:
            return str(details["msg"]).removeprefix("Input should be ")


def _bound(value: float) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


# --- the types of a schema ---

_WORDS = {
    str: "a string",
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    complex: "a complex number",
}
_PLURALS = {
    "a string": "strings",
    "a number": "numbers",
    "a whole number": "whole numbers",
    "a complex number": 'numbers, complex ones as strings such as "-3+2j"',
}


def annotation_at(table: type[BaseModel], path: Key) -> Any:
    """Return the type of the value at a path of keys; the schema itself for no key."""
    annotation: Any = table
    for part in path:
        for alternative in _alternatives(annotation):
            inner = _inner(alternative, part)
            if inner is not None:
                annotation = inner
                break
    return annotation


def _inner(annotation: Any, part: str | int) -> Any:
    """Return the type of an entry of a table or a list; None: it is neither or has no such key."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        field = _fields(annotation, ()).get(str(part))
        return None if field is None else field.annotation
    arguments = get_args(annotation)
    if get_origin(annotation) in (list, tuple) and isinstance(part, int):
        return arguments[0]
    return arguments[1] if get_origin(annotation) is dict else None


def _alternatives(annotation: Any) -> list[Any]:
    """Return the types of a union, without None and without what is only said about them."""
    if get_origin(annotation) is Annotated:
        return _alternatives(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        alternatives = []
        for argument in get_args(annotation):
            alternatives += _alternatives(argument)
        return [alternative for alternative in alternatives if alternative is not type(None)]
    return [annotation]


def described(annotation: Any) -> str:
    """Return what values a type has, in words: ``a number or a list of numbers``."""
    words: dict[str, None] = {}
    for alternative in _alternatives(annotation):
        words[_word(alternative)] = None
    if "a number" in words:
        words.pop("a whole number", None)
    return " or ".join(words)


def _word(annotation: Any) -> str:
    if annotation in _WORDS:
        return _WORDS[annotation]
    if get_origin(annotation) in (list, tuple):
        element = described(get_args(annotation)[0])
        if element.startswith("a list of "):
            return f"a list of lists of {element.removeprefix('a list of ')}"
        return f"a list of {_PLURALS[element]}" if element in _PLURALS else "a list"
    if get_origin(annotation) is Literal:
        return " or ".join(map(repr, get_args(annotation)))
    return "a table"


def _fields(table: type[BaseModel], path: Key) -> dict[str, FieldInfo]:
    """Return the fields of the table at a path of keys, by the names that a file uses."""
    for part in path:
        field = table.model_fields.get(str(part))
        if field is not None:
            table = table_in(field.annotation) or table
    return {field.alias or name: field for name, field in table.model_fields.items()}


def table_in(annotation: Any) -> type[BaseModel] | None:
    """Return the first table among the alternatives of a type."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        table = table_in(inner)
        if table is not None:
            return table
    return None
