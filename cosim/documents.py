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

from cosim.errors import LogError

if TYPE_CHECKING:
    from pydantic import TypeAdapter

_Class = TypeVar("_Class")
STRICT: Final = {"strict": True, "allow_inf_nan": False, "extra": "forbid"}
_IN_WORDS: Final = {
    "unexpected_keyword_argument": "a key that this version of cosim does not know",
    "missing_argument": "it is missing",
    "missing": "it is missing",
}


@dataclass_transform(frozen_default=True)
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


def understood(kind: Any, text: str, what: str) -> Any:
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
        If it is something else; names the place in it.
    """
    from pydantic import ValidationError

    try:
        return _reader(kind).validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        problem = _IN_WORDS.get(first["type"], first["msg"])
        raise LogError(f"{what} cannot be understood: {place}: {problem}") from error


@cache
def _reader(kind: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)
