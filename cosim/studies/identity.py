"""Whose dataset it is: what the outcomes of a study rest on, and the columns that they have."""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any, Final, Literal, Self, TypeAlias

import numpy as np
from pydantic import TypeAdapter

from cosim.digests import digest_of
from cosim.errors import DatasetError, flag, quoted
from cosim.log.metadata import read_json
from cosim.studies.contracts import MetricValue
from cosim.version import __version__

_FORMAT: Final = 3
_OF_KEY: Final = "key "  # begins what the digest of a key of the scenario is named
OF_METRICS: Final = "the metrics"  # what the digest of the metrics is named
MEMBER: Final = "member"
LOG: Final = "log"
_VARIED: Final = "varied key "
_SHOWN: Final = 8  # differences
_LARGEST_EXACT: Final = 2**53  # every whole number up to it is a double

ColumnType: TypeAlias = Literal["double", "int64", "bool", "string", "list<double>", "json"]
ColumnRole: TypeAlias = Literal["number", "parameter", "metric", "outcome"]


@dataclass(frozen=True, slots=True)
class StudyColumn:
    """A column of a dataset.

    Parameters
    ----------
    name : str
        Of a parameter its dotted key, ``swap.COMPONENT`` or ``recording``.
    role : {"number", "parameter", "metric", "outcome"}
    type : {"double", "int64", "bool", "string", "list<double>", "json"}
        ``json`` is text that holds any value.
    unit : str
    text : str
        Of a metric its expression.
    """

    name: str
    role: ColumnRole
    type: ColumnType
    unit: str = ""
    text: str = ""

    def stored(self, value: Any) -> Any:
        """Return a value as this column has it."""
        if self.type != "json" or value is None:
            return value
        return json.dumps(value, default=str, ensure_ascii=False)

    def value(self, stored: Any) -> Any:
        """Return what was stored."""
        if self.type != "json" or stored is None:
            return stored
        try:
            return read_json(stored)
        except ValueError as error:
            text = f"the dataset is damaged: expected JSON, got {quoted(stored)}"
            raise DatasetError(text) from error


_NUMBER: Final = StudyColumn(MEMBER, "number", "int64")
_OUTCOME: Final = (
    StudyColumn("status", "outcome", "string"),
    StudyColumn("reason", "outcome", "string"),
    StudyColumn("warnings", "outcome", "string"),  # a line each
    StudyColumn("steps", "outcome", "int64"),
    StudyColumn("wall_time", "outcome", "double", "s"),
    StudyColumn("worker", "outcome", "string"),
    StudyColumn("other_results", "outcome", "json"),
)
_RESERVED: Final = {MEMBER, LOG, *(column.name for column in _OUTCOME)}


def parameter_column(name: str, values: Iterable[Any]) -> StudyColumn:
    """Return the column of a varied key, whose type is that of its planned values."""
    if isinstance(values, np.ndarray) and values.dtype != object:
        values = values[:1].tolist()
    present = [value for value in values if value is not None]
    types = {_type_of(value) for value in present}
    if types == {"int64", "double"} and all(map(_is_double, present)):
        types = {"double"}
    return StudyColumn(name, "parameter", types.pop() if len(types) == 1 else "json")


def metric_column(name: str, expression: str) -> StudyColumn:
    """Return the column of a metric, which is a number."""
    return StudyColumn(name, "metric", "double", text=expression)


def result_columns(results: Mapping[str, MetricValue], taken: Iterable[str]) -> list[StudyColumn]:
    """Return the columns of what the result of one run says, but of names that are taken."""
    names = _RESERVED.union(taken)
    return [
        StudyColumn(name, "metric", "string" if isinstance(value, str) else "double")
        for name, value in results.items()
        if name not in names
    ]


def _type_of(value: Any) -> ColumnType:
    match value:
        case bool():
            return "bool"
        case int():
            return "int64" if -(2**63) <= value < 2**63 else "json"
        case float():
            return "double"
        case str():
            return "string"
        case list() | tuple() if all(map(_is_double, value)):
            return "list<double>"
    return "json"


def _is_double(value: Any) -> bool:
    return isinstance(value, float) or (type(value) is int and abs(value) <= _LARGEST_EXACT)


@dataclass(frozen=True, slots=True)
class StudyIdentity:
    """What the outcomes of a study rest on.

    Parameters
    ----------
    name : str
    text : str
        The study, for who reads the dataset.
    digests : mapping of name to SHA-256
        Named as messages name what has changed.
    columns : sequence of StudyColumn
        Of parameters and metrics.
    members : int
        That are planned; the dataset may grow.
    version : str
        Of cosim.
    salt : str
        Of the checksums of parts and rows, which those of another dataset do not have.

    Raises
    ------
    DatasetError
        If two columns have one name.
    """

    name: str
    text: str
    digests: Mapping[str, str]
    columns: tuple[StudyColumn, ...]
    members: int
    version: str = __version__
    salt: str = field(default_factory=partial(secrets.token_hex, 8))

    def __post_init__(self) -> None:
        taken = set(_RESERVED)
        for column in self.columns:
            if column.name in taken:
                raise DatasetError(
                    f"{column.role} {column.name!r}: a column of the dataset already has this "
                    "name; choose another one"
                )
            taken.add(column.name)

    @property
    def all_columns(self) -> tuple[StudyColumn, ...]:
        """Every column of a part, in order."""
        return (_NUMBER, *self.columns, *_OUTCOME)

    def to_json(self) -> bytes:
        """Return the description of a dataset."""
        study = asdict(self)
        head = {"format": _FORMAT, "cosim": self.version, "checksum": digest_of(study)}
        return (json.dumps({**head, "study": study}, indent=1, ensure_ascii=False) + "\n").encode()

    @classmethod
    def read(cls, content: bytes, label: str) -> Self:
        """Read what :meth:`to_json` wrote; ``label``: where it is.

        Raises
        ------
        DatasetError
            If it is damaged, or of another format.
        """
        with suppress(ValueError, KeyError, TypeError):
            found = read_json(content)
            if found["format"] != _FORMAT:
                raise DatasetError(
                    f"{label}: expected dataset format {_FORMAT}, got {found['format']!r}; read it "
                    f"with cosim {found['cosim']}, or choose another folder"
                )
            identity = TypeAdapter(cls).validate_python(found["study"])
            if identity.to_json() == content:
                return identity
        raise DatasetError(
            f"{label} is damaged; restore it from a copy, or use {flag('new')} to start over "
            "without the recorded members"
        )


def scenario_digests(tables: Mapping[str, Any]) -> dict[str, str]:
    """Return the digests of the keys of a scenario, by their names."""
    digests: dict[str, str] = {}
    for name, table in tables.items():
        if isinstance(table, Mapping) and table:
            digests |= {f"{_OF_KEY}{name}.{key}": digest_of(value) for key, value in table.items()}
        else:
            digests[f"{_OF_KEY}{name}"] = digest_of(table)
    return digests


def differences(recorded: StudyIdentity, planned: StudyIdentity) -> str:
    """Return what has changed between two studies; empty: nothing that outcomes rest on."""
    before, after = _facts(recorded), _facts(planned)
    found = []
    for name, was in before.items():
        if name not in after:
            found.append(f"{name} is no longer part of it")
        elif name in recorded.digests and after[name] != was:
            found.append(f"{name} changed")
        elif after[name] != was:
            found.append(f"{name} was {was}, is {after[name]}")
    new = [name for name in after if name not in before and name.startswith((_OF_KEY, _VARIED))]
    found += [f"{name} is new" for name in new]
    if len(found) > _SHOWN:
        found[_SHOWN:] = [f"and {len(found) - _SHOWN} more"]
    return "; ".join(found)


def _facts(identity: StudyIdentity) -> dict[str, str]:
    varied = {_VARIED + c.name: c.type for c in identity.columns if c.role == "parameter"}
    return {"the version of cosim": identity.version, **identity.digests, **varied}
