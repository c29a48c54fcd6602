"""Validation errors of pydantic as problems: the key, what was expected, what was found."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any, Final, NamedTuple, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from cosim.errors import UsageError, nearest, quoted
from cosim.scenario.document.places import Key, Problem, written

_TYPES: Final = {
    "string_type": "a string",
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "is_instance_of": 'a fraction such as "1/60"',
}
_RANGES: Final = {
    "finite_number": "a finite number",
    "greater_than": "a number > {gt}",
    "less_than": "a number < {lt}",
    "greater_than_equal": "a number >= {ge}",
    "less_than_equal": "a number <= {le}",
    "too_short": "at least {min_length}",
}


class TableProblems(UsageError):
    """Problems of a table that show only while its component is built.

    Parameters
    ----------
    problems : sequence of Problem
        Their keys are those of the table.
    """

    def __init__(self, problems: Sequence[Problem]) -> None:
        lines = [": ".join(filter(None, (".".join(map(str, key)), text))) for key, text in problems]
        super().__init__("; ".join(lines))
        self.problems = tuple(problems)


def problems_in(error: Exception, place: Key) -> list[Problem]:
    """Return what an error says of the table, or of the key, that stands at a place."""
    if isinstance(error, TableProblems):
        return [((*place, *key), text) for key, text in error.problems]
    if isinstance(error, ArithmeticError | MemoryError):  # of numbers near the largest or smallest
        return [(place, out_of_range(error))]
    return [(place, str(error))]


def out_of_range(error: Exception) -> str:
    """Return in words that a number has left the range of numbers."""
    return f"numeric overflow or underflow: {error}"


class _Error(NamedTuple):
    """A validation error."""

    path: Key  # of what is wrong; of a missing key, of the table that lacks it
    choices: tuple[tuple[Key, str | int], ...]  # values with alternatives, and the one tried
    details: Mapping[str, Any]

    @property
    def words(self) -> str | None:
        """What is expected in place of a value of a wrong type; None: the type is right."""
        if self.details["type"] == "float_type" and type(self.details["input"]) is int:
            return f"a number <= {sys.float_info.max:g}"
        return _TYPES.get(self.details["type"])


def problems_of(
    error: ValidationError, table: type[BaseModel], data: Any, prefix: Key
) -> list[Problem]:
    """Translate a validation error of ``data``, which stands under the key ``prefix``."""
    items = error.errors(include_url=False)
    unknown = [str(item["loc"][-1]) for item in items if item["type"] == "extra_forbidden"]
    errors = []
    for item in items:
        loc = item["loc"]
        if item["type"] == "missing" and get_close_matches(str(loc[-1]), unknown, cutoff=0.5):
            continue  # the unknown key is probably this one
        if item["type"] == "too_short" and any(
            other["loc"][: len(loc)] == loc != other["loc"] for other in items
        ):
            continue  # pydantic does not count the entries that are wrong
        errors.append(_located(dict(item), data))
    likely = _likely(errors)
    expected: dict[Key, dict[str, None]] = {}
    for wrong in likely:
        if wrong.words is not None:
            expected.setdefault(wrong.path, {})[wrong.words] = None
    problems: dict[Problem, None] = {}
    for wrong in likely:
        words = expected.get(wrong.path, {})
        if "a number" in words:
            words.pop("a whole number", None)
        if wrong.words is None:
            text = _text(wrong, table, prefix)
        else:
            text = f"expected {' or '.join(words)}, got {quoted(wrong.details['input'])}"
        problems[(*prefix, *wrong.path), text] = None
    return list(problems)


def _located(details: Mapping[str, Any], data: Any) -> _Error:
    """Separate pydantic's location of an error into keys of the data and names of alternatives."""
    path: Key = ()
    choices = []
    value = data
    for part in details["loc"][: -1 if details["type"] == "missing" else None]:
        children = dict(enumerate(value)) if isinstance(value, list | tuple) else value
        if isinstance(children, Mapping) and part in children:
            value = children[part]
            path = (*path, part)
        else:
            choices.append((path, part))
    return _Error(path, tuple(choices), details)


def _likely(errors: Sequence[_Error], level: int = 0) -> list[_Error]:
    """Return the errors of the alternatives that values are nearest to.

    An alternative that refuses a value as a whole is out where another one accepts its type; of
    several, the one with the fewest errors is meant, or that which is wrong behind the most
    elements. ``level`` counts the choices inwards.
    """
    likely: list[_Error] = []
    chosen: dict[Key, dict[str | int, list[_Error]]] = {}
    for error in errors:
        if len(error.choices) > level:
            at, alternative = error.choices[level]
            chosen.setdefault(at, {}).setdefault(alternative, []).append(error)
        else:
            likely.append(error)
    for at, alternatives in chosen.items():
        groups = [_likely(group, level + 1) for group in alternatives.values()]
        ranks = [_distance(group, at) for group in groups]
        for group, rank in zip(groups, ranks, strict=True):
            likely += group if rank == min(ranks) else []
    return likely


def _distance(group: Sequence[_Error], at: Key) -> tuple[bool, int, int]:
    """Return how far a value is from an alternative that refuses it with these errors."""
    first = group[0].path[len(at) : len(at) + 1]
    accepted = first[0] if first and isinstance(first[0], int) else 0  # elements of a list
    if all(error.path == at and error.words is not None for error in group):
        return True, 0, 0  # the value as a whole
    return False, len(group), -accepted


def _text(error: _Error, table: type[BaseModel], prefix: Key) -> str:
    """Return what is wrong in the table that stands at ``prefix``."""
    details = error.details
    name = str(details["loc"][-1])
    value = details["input"]
    context = details.get("ctx", {})
    match details["type"]:
        case "extra_forbidden":
            fields = _fields_at(table, error.path[:-1])
            suggestion = nearest(name, sorted(fields))
            is_clear = suggestion.startswith("did you mean") and not isinstance(value, Mapping)
            starts: Any = fields["start"].annotation if "start" in fields else None
            if get_origin(starts) is dict and not is_clear:
                variable = written((*prefix[-1:], *error.path[:-1], "start", name))
                while isinstance(value, Mapping) and len(value) == 1:  # as of damper.d = 2
                    ((part, value),) = value.items()
                    variable = f"{variable}.{part}"
                suggestion = f"a variable is set by {variable}; {suggestion}"
            return f"unknown key {quoted(name)}; {suggestion}"
        case "missing":
            field = _fields_at(table, error.path).get(name)
            description = field.description if field else None
            return f"{name!r} is missing ({description})" if description else f"{name!r} is missing"
        case "value_error":
            return str(context["error"])
        case "literal_error":
            choices = str(context["expected"]).replace(" or ", ", ").split(", ")
            known = [choice.strip("'") for choice in choices]
            return f"unknown value {quoted(value)}; {nearest(str(value), known)}"
        case kind if kind in _RANGES:
            limits = {k: f"{v:g}" if isinstance(v, float) else v for k, v in context.items()}
            return f"expected {_RANGES[kind].format(**limits)}, got {quoted(value)}"
    expected = str(details["msg"]).removeprefix("Input should be ")
    return f"expected {expected}, got {quoted(value)}"


def _fields_at(table: type[BaseModel], path: Key) -> dict[str, FieldInfo]:
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
    tables = map(table_in, getattr(annotation, "__args__", ()))
    return next((table for table in tables if table is not None), None)
