"""Documents: what a log says of its run beside its rows.

A document is a frozen dataclass that JSON carries. Who knows something of a run fills in one, the
log keeps it, and who reads the log gets the same class back: so a figure has one declaration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from functools import cache
from typing import TYPE_CHECKING, Any, Final, TypeVar, dataclass_transform

from cosim.errors import LogError, quoted, shortened

if TYPE_CHECKING:
    from pydantic import ConfigDict, TypeAdapter

_Class = TypeVar("_Class")
STRICT: Final[ConfigDict] = {"strict": True, "allow_inf_nan": False, "extra": "forbid"}


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def document(cls: type[_Class]) -> type[_Class]:
    """Make a class a document; where it is read its fields are checked, and no others are taken."""
    cls.__pydantic_config__ = STRICT  # type: ignore[attr-defined]
    return dataclass(frozen=True)(cls)


def told(default: Any = None) -> Any:
    """Declare a field that JSON has only where it is not what it is without."""
    return field(default=default, metadata={"told": True})


def plain(value: Any) -> dict[str, Any]:
    """Return a document as JSON has it."""
    return {
        one.name: _plain(getattr(value, one.name))
        for one in fields(value)
        if not one.metadata or getattr(value, one.name) != one.default
    }


def _plain(value: Any) -> Any:
    match value:
        case Mapping():
            return {key: _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
        case Enum():
            return value.value
    if is_dataclass(value):
        return value.to_dict() if hasattr(value, "to_dict") else plain(value)
    return value


def understood(kind: type[_Class], text: str, what: str) -> _Class:
    """Return the document, or the container of documents, that a text of a log is.

    Parameters
    ----------
    kind : type
    text : str
        JSON.
    what : str
        Where it is, for messages.

    Raises
    ------
    LogError
        If it is something else; names the place in it, what was expected there, and what is there.
    """
    from pydantic import ValidationError

    try:
        document: _Class = _reader(kind).validate_json(text)  # type: ignore[arg-type]
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        got = quoted(first["input"])
        match first["type"]:
            case "unexpected_keyword_argument" | "extra_forbidden":
                expected = "only keys that this version of cosim knows"
                got = quoted(first["loc"][-1])
            case "missing_argument" | "missing":
                expected = "a value"
                got = "none"
            case "json_invalid":
                expected = "JSON"
                got += first["msg"].removeprefix("Invalid JSON")
            case _:
                said = first["msg"].removeprefix("Input should be ")
                expected = said.removeprefix("Value error, expected ")
        where = f"{shortened(place)}: " if place else ""
        raise LogError(
            f"{what} cannot be understood: {where}expected {expected}, got {got}"
        ) from error
    return document


@cache
def _reader(kind: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    has_own = hasattr(kind, "__pydantic_config__") or hasattr(kind, "model_config")
    return TypeAdapter(kind, config=None if has_own else STRICT)
