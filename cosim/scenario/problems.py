"""Validation errors of pydantic as problems: the key, what was found, what was needed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from cosim.errors import nearest

Key: TypeAlias = tuple[str | int, ...]  # where a value stands in the tables of a scenario
Problem: TypeAlias = tuple[Key, str]

TYPES = {
    "string_type": "a string",
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
}


def problems_of(
    error: ValidationError, table: type[BaseModel], data: Any, prefix: Key
) -> list[tuple[Key, str]]:
    """Translate a validation error of ``data``, which stands under the key ``prefix``."""
    problems: dict[Key, list[str]] = {}
    needed: dict[Key, list[str]] = {}
    for details in error.errors(include_url=False):
        path = _path(details["loc"], data)
        if details["type"] in TYPES:
            needed.setdefault(path, []).append(TYPES[details["type"]])
        else:
            problems.setdefault(path, []).append(_message(dict(details), path, table))
    for path, types in needed.items():
        # pydantic reports every alternative of a value; a problem deeper inside it says most.
        value_path = _without_elements(path) if len(types) > 1 or "a list" in types else path
        if not any(other[: len(value_path)] == value_path for other in problems):
            alternatives = " or ".join(dict.fromkeys(types))
            value = _value(data, value_path)
            problems[value_path] = [f"found {_shortened(value)}; needed {alternatives}"]
    messages: list[tuple[Key, str]] = []
    for path, texts in problems.items():
        messages += [((*prefix, *path), text) for text in texts]
    return messages


def _children(data: Any) -> Mapping[Any, Any]:
    if isinstance(data, (list, tuple)):
        return dict(enumerate(data))
    return data if isinstance(data, Mapping) else {}


def _path(loc: tuple[int | str, ...], data: Any) -> Key:
    """Return the keys of the data in pydantic's location; the rest are names of types."""
    path: list[int | str] = []
    for part in loc:
        children = _children(data)
        if part in children:
            data = children[part]
            path.append(part)
    return tuple(path)


def _without_elements(path: Key) -> Key:
    """Return the path of the list, of whatever dimensions, that an element stands in."""
    while path and isinstance(path[-1], int):
        path = path[:-1]
    return path


def _value(data: Any, path: Key) -> Any:
    for part in path:
        data = data[part]
    return data


def _message(details: Mapping[str, Any], path: Key, table: type[BaseModel]) -> str:
    value = details.get("input")
    name = str(details["loc"][-1])
    match details["type"]:
        case "extra_forbidden":
            known = sorted(_fields(table, path[:-1]))
            return f"unknown key {name!r}; {nearest(name, known)}"
        case "missing":
            field = _fields(table, path).get(name)
            description = None if field is None else field.description
            return f"{name!r} is missing; needed {description or 'a value'}"
        case "finite_number":
            return f"found {value}; needed a finite number"
        case "string_pattern_mismatch":
            return (
                f"found {value!r}; needed a name of letters, digits, '_' and '-' "
                "that begins with a letter"
            )
        case "literal_error":
            expected = str(details["ctx"]["expected"]).replace(" or ", ", ")
            choices = [choice.strip().strip("'") for choice in expected.split(",")]
            return f"found {value!r}; {nearest(str(value), choices)}"
        case _:
            message = str(details["msg"])
            return f"found {_shortened(value)}; {message[0].lower()}{message[1:]}"


def _shortened(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


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
