"""The schema of a scenario file: what may stand in it, and every problem of a file in one report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from cosim.errors import nearest
from cosim.scenario.document import Key

Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Whole = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]
Row = tuple[Number, ...]
Rows = tuple[Row, ...]

NAME = r"^[A-Za-z][A-Za-z0-9_-]*$"


class Table(BaseModel):
    """A table of the file: frozen, no unknown keys, no conversions between types."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, validate_default=False)


class Settings(Table):
    """The table [scenario]."""

    name: Annotated[str, Field(pattern=NAME)]
    stop: Number = Field(description="end of the run [s]")
    step: Number = Field(description="communication step [s]")
    coupling: Literal["gauss-seidel", "jacobi"] = Field("gauss-seidel", description="how the components of a loop advance")
    hold: Literal["line", "start"] = Field("line", description="inputs inside a step: straight lines, or held from the start")
    description: str = ""


class DescriptorTable(Table):
    """A table of [models]: E x' = A x + Bu u + Bd delta, y = C x, E = diag(I, 0)."""

    n_a: Whole = Field(ge=1, description="number of dynamic states")
    A: Rows
    Bu: Rows
    Bd: Rows
    C: Rows


class ConnectionTable(Table):
    """A connection with a linear map."""

    source: str = Field(alias="from")
    gain: Number | Rows = 1.0
    offset: Number = 0.0
    unit: str | None = None


class File(Table):
    """The content of a scenario file, but for its components, which their kinds describe."""

    scenario: Settings
    models: dict[str, DescriptorTable] = {}
    components: dict[Annotated[str, Field(pattern=NAME)], dict[str, Any]]
    connections: dict[str, str | ConnectionTable] = {}
    truth: dict[str, str | Number | Row] = {}


def flatten_connections(tree: Mapping[str, Any]) -> tuple[dict[str, Any], list[tuple[Key, str]]]:
    """Give [connections] with every input as one dotted key; ``plant.u = ...`` and ``"plant.u" = ...`` mean the same."""
    flat: dict[str, Any] = {}
    problems: list[tuple[Key, str]] = []
    for key, value in tree.items():
        nested = isinstance(value, dict) and "from" not in value
        pairs = {f"{key}.{name}": one for name, one in value.items()} if nested else {key: value}
        for to, one in pairs.items():
            if to in flat:
                problems.append(
                    (("connections", to), f"'{to}' is driven twice; an input has one source (add signals with a 'sum')")
                )
            flat[to] = one
    return flat, problems


def problems_of(error: ValidationError, table: type[BaseModel], prefix: Key) -> list[tuple[Key, str]]:
    """Say what pydantic found in our words: the key, what was found, what was needed, the nearest name."""
    return [_problem(dict(found), table, prefix) for found in error.errors(include_url=False)]


def _problem(found: Mapping[str, Any], table: type[BaseModel], prefix: Key) -> tuple[Key, str]:
    at: Key = tuple(
        part for part in found["loc"] if not (isinstance(part, str) and part.startswith(("function-", "tuple[", "float")))
    )
    key = (*prefix, *at)
    kind, value = found["type"], found.get("input")
    if kind == "extra_forbidden":
        return key, f"unknown key {at[-1]!r}; {nearest(str(at[-1]), sorted(_keys(_at(table, at[:-1]))))}"
    if kind == "missing":
        return key[:-1], f"{at[-1]!r} is missing; needed {_needed(_field(table, at))}"
    if kind == "finite_number":
        return key, f"found {value}; needed a finite number"
    if kind == "string_pattern_mismatch":
        return key, f"found {value!r}; needed a name of letters, digits, '_' and '-' that begins with a letter"
    if kind == "literal_error":
        return key, f"found {value!r}; {nearest(str(value), [part.strip(chr(39)) for part in _expected(found)])}"
    return key, f"found {_short(value)}; {found['msg'][0].lower()}{found['msg'][1:]}"


def _expected(found: Mapping[str, Any]) -> list[str]:
    return [part.strip() for part in str(found["ctx"]["expected"]).replace(" or ", ", ").split(",")]


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _keys(table: type[BaseModel] | None) -> Iterable[str]:
    return [field.alias or name for name, field in table.model_fields.items()] if table is not None else []


def _at(table: type[BaseModel], path: Key) -> type[BaseModel] | None:
    """Follow a path of keys to the table it ends in; None where it leaves our classes."""
    here: Any = table
    for part in path:
        if not (isinstance(here, type) and issubclass(here, BaseModel)):
            return None
        field = here.model_fields.get(str(part))
        here = _table_in(field.annotation) if field is not None else (here if isinstance(part, int) else None)
    return here if isinstance(here, type) and issubclass(here, BaseModel) else None


def _table_in(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for inner in getattr(annotation, "__args__", ()) if (found := _table_in(inner)) is not None), None)


def _field(table: type[BaseModel], path: Key) -> FieldInfo | None:
    outer = _at(table, path[:-1])
    return None if outer is None else next((f for n, f in outer.model_fields.items() if (f.alias or n) == path[-1]), None)


def _needed(field: FieldInfo | None) -> str:
    return (field.description if field is not None else None) or "a value"


def matrix(rows: Rows, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Turn rows into a matrix.

    Raises
    ------
    ValueError
        If the rows have different lengths.
    """
    lengths = [len(row) for row in rows]
    if not rows or len(set(lengths)) != 1 or lengths[0] == 0:
        raise ValueError(f"{name}: found rows of lengths {lengths}, needed rows of one length, like [[0, 1], [2, 3]]")
    return np.array(rows, dtype=np.float64)
