"""The parameters of a component kind: the keys of its table and what they mean."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from cosim.scenario.document.problems import table_in
from cosim.scenario.kinds.base import Kind
from cosim.scenario.kinds.table_keys import TableKeys


@dataclass(frozen=True, slots=True)
class Parameter:
    """A key of a component's table.

    Parameters
    ----------
    name : str
        ``key.inner`` for a key of a table inside.
    required : bool
    default : object
        None where it is required, or where its description tells what holds without it.
    description : str
    """

    name: str
    required: bool
    default: Any
    description: str


def parameters_of(table: type[BaseModel]) -> list[Parameter]:
    """Return the keys of a table, as of a kind, each with those inside it.

    The required ones come first, those that every kind has, or every table, last.
    """
    required: list[Parameter] = []
    optional: list[Parameter] = []
    shared: list[Parameter] = []
    for name, field in table.model_fields.items():
        parameters = list(_with_inner(name, table))
        if field.is_required():
            required += parameters
        elif name in Kind.model_fields or name in TableKeys.model_fields:
            shared += parameters
        else:
            optional += parameters
    return [parameter for parameter in required if parameter.name != "kind"] + optional + shared


def _with_inner(name: str, table: type[BaseModel], prefix: str = "") -> Iterator[Parameter]:
    """Yield a field of a table, then the fields of the table that it may be."""
    field = table.model_fields[name]
    required = field.is_required()
    default = None if required else field.default
    key = field.alias or name
    yield Parameter(prefix + key, required, default, field.description or "")
    inner = table_in(field.annotation)
    if inner is not None:
        for inner_name in inner.model_fields:
            yield from _with_inner(inner_name, inner, f"{prefix}{key}.")
