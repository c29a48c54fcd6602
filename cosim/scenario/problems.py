"""What pydantic finds wrong with a table, in our words: the key, what was found, what was needed, the nearest name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from cosim.errors import nearest
from cosim.scenario.document import Key

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
    found = [(_path(one["loc"], data), dict(one)) for one in error.errors(include_url=False)]
    problems: dict[Key, list[str]] = {}
    needed: dict[Key, list[str]] = {}
    for path, one in found:
        if one["type"] in TYPES:
            needed.setdefault(path, []).append(TYPES[one["type"]])
        else:
            problems.setdefault(path, []).append(_text(one, path, table))
    for (
        path,
        types,
    ) in needed.items():  # of the alternatives of a value, the one that went deepest says most
        whole = _whole(path) if len(types) > 1 or "a list" in types else path
        if not any(other[: len(whole)] == whole for other in problems):
            value = _value(data, path)
            problems[path] = [f"found {_short(value)}; needed {' or '.join(dict.fromkeys(types))}"]
    return [((*prefix, *path), text) for path, texts in problems.items() for text in texts]


def _children(data: Any) -> Mapping[Any, Any]:
    if isinstance(data, (list, tuple)):
        return dict(enumerate(data))
    return data if isinstance(data, Mapping) else {}


def _path(loc: tuple[int | str, ...], data: Any) -> Key:
    """Keep of pydantic's location what is a key of the data; the rest are names of types."""
    path: list[int | str] = []
    for part in loc:
        children = _children(data)
        if part in children:
            data = children[part]
            path.append(part)
    return tuple(path)


def _whole(path: Key) -> Key:
    """Give the list that an element stands in, also one of several dimensions: only as a whole it has a type."""
    while path and isinstance(path[-1], int):
        path = path[:-1]
    return path


def _value(data: Any, path: Key) -> Any:
    for part in path:
        data = data[part]
    return data


def _text(found: Mapping[str, Any], path: Key, table: type[BaseModel]) -> str:
    kind, value, last = found["type"], found.get("input"), str(found["loc"][-1])
    if kind == "extra_forbidden":
        return f"unknown key {last!r}; {nearest(last, sorted(_fields(table, path[:-1])))}"
    if kind == "missing":
        field = _fields(table, path).get(last)
        return f"{last!r} is missing; needed {(field.description if field is not None else None) or 'a value'}"
    if kind == "finite_number":
        return f"found {value}; needed a finite number"
    if kind == "string_pattern_mismatch":
        return f"found {value!r}; needed a name of letters, digits, '_' and '-' that begins with a letter"
    if kind == "literal_error":
        expected = str(found["ctx"]["expected"]).replace(" or ", ", ").split(",")
        return f"found {value!r}; {nearest(str(value), [choice.strip().strip(chr(39)) for choice in expected])}"
    return f"found {_short(value)}; {found['msg'][0].lower()}{found['msg'][1:]}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _fields(table: type[BaseModel], path: Key) -> dict[str, FieldInfo]:
    """Follow a path of keys to the table it ends in; give its fields by the names that a file uses."""
    here = table
    for part in path:
        field = here.model_fields.get(str(part))
        if field is not None:
            here = _table_in(field.annotation) or here
    return {field.alias or name: field for name, field in here.model_fields.items()}


def _table_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(
        (
            found
            for inner in getattr(annotation, "__args__", ())
            if (found := _table_in(inner)) is not None
        ),
        None,
    )
