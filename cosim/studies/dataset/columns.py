"""The columns of a dataset: their names, types and units, and the values that they take.

A row has the number of the member, a column for each key that is varied, one for each metric, and
what else is known of the outcome, in this order. The types follow from the study, not from the
values of a part: all parts have one schema.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from cosim.errors import DatasetError, UsageError, quoted
from cosim.log.contents.metadata import read_json
from cosim.studies.contracts import RECORDING, SWAP, MemberOutcome, MetricValue, StudyMember

ColumnType: TypeAlias = Literal["double", "int64", "bool", "string", "list<double>", "json"]
ColumnRole: TypeAlias = Literal["number", "parameter", "metric", "outcome"]
MemberRow: TypeAlias = list[Any]

MEMBER: Final = "member"
LOG: Final = "log"
_ARRAY_TYPES: Final[Mapping[str, ColumnType]] = {
    "float64": "double",
    "int64": "int64",
    "bool": "bool",
}
_LARGEST_EXACT: Final = 2**53  # every whole number up to it is a double
_LARGEST_INT64: Final = 2**63


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


WARNINGS: Final = "warnings"
_FIRST: Final = (StudyColumn(MEMBER, "number", "int64"),)
_LAST: Final = (
    StudyColumn("status", "outcome", "string"),
    StudyColumn("reason", "outcome", "string"),
    StudyColumn(WARNINGS, "outcome", "string"),  # a line each
    StudyColumn("steps", "outcome", "int64"),
    StudyColumn("wall_time", "outcome", "double", "s"),
    StudyColumn("worker", "outcome", "string"),
    StudyColumn("designs", "outcome", "json"),
    StudyColumn("other_results", "outcome", "json"),
)
RESERVED: Final = frozenset(column.name for column in (*_FIRST, *_LAST)) | {LOG}


def all_columns(of_study: Sequence[StudyColumn]) -> tuple[StudyColumn, ...]:
    """Return every column of a part, in order; given those of the study's own.

    Raises
    ------
    DatasetError
        If two columns have one name.
    """
    names = set(RESERVED)
    for column in of_study:
        if column.name in names:
            raise DatasetError(
                f"{column.role} {column.name!r}: a column of the dataset already has this name; "
                "choose another one"
            )
        names.add(column.name)
    parameters = [column for column in of_study if column.role == "parameter"]
    metrics = [column for column in of_study if column.role == "metric"]
    return (*_FIRST, *parameters, *metrics, *_LAST)


def parameter_column(name: str, values: Iterable[Any], unit: str = "") -> StudyColumn:
    """Return the column of a varied key, whose type is that of its planned values."""
    return StudyColumn(name, "parameter", _type_of(values), unit)


def metric_column(name: str, expression: str = "", unit: str = "") -> StudyColumn:
    """Return the column of a metric, which is a number."""
    return StudyColumn(name, "metric", "double", unit, expression)


def result_columns(
    results: Mapping[str, MetricValue], taken: Iterable[str]
) -> tuple[StudyColumn, ...]:
    """Return the columns of what the result of one run says.

    Names that are taken have none; they stand in the column ``other_results``, as do results that
    other members have in addition.
    """
    names = RESERVED.union(taken)
    return tuple(
        StudyColumn(name, "metric", "string" if isinstance(value, str) else "double")
        for name, value in results.items()
        if name not in names
    )


def _type_of(values: Iterable[Any]) -> ColumnType:
    if isinstance(values, np.ndarray) and values.dtype.name in _ARRAY_TYPES:
        return _ARRAY_TYPES[values.dtype.name]
    present = [value for value in values if value is not None]
    types = {_kind(value) for value in present}
    if len(types) == 1:
        return types.pop()
    if types == {"int64", "double"}:
        whole = (abs(value) for value in present if isinstance(value, int))
        return "double" if max(whole) <= _LARGEST_EXACT else "json"
    return "json"


def _kind(value: Any) -> ColumnType:
    """Return the type of a single value."""
    if isinstance(value, bool | np.bool_):
        return "bool"
    if isinstance(value, int | np.integer):
        return "int64" if -_LARGEST_INT64 <= value < _LARGEST_INT64 else "json"
    if isinstance(value, float):
        return "double"
    if isinstance(value, str):
        return "string"
    if isinstance(value, list | tuple) and all(_is_number(element) for element in value):
        return "list<double>"
    return "json"


def _is_number(value: Any) -> bool:
    if isinstance(value, float):
        return True
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST_EXACT


def json_text(value: Any) -> str | None:
    """Return a value as JSON, dates as text; None: there is none."""
    return None if value is None else json.dumps(value, default=str, ensure_ascii=False)


def json_value(text: str) -> Any:
    """Return the value of a text that :func:`json_text` made.

    Raises
    ------
    DatasetError
        If it is none.
    """
    try:
        return read_json(text)
    except ValueError as error:
        raise DatasetError(f"the dataset is damaged: expected JSON, got {quoted(text)}") from error


class RowMaker:
    """Makes rows of members and their outcomes.

    Parameters
    ----------
    columns : sequence of StudyColumn
        All of them, in order.
    """

    def __init__(self, columns: Sequence[StudyColumn]) -> None:
        self._getters = [_getter(column) for column in columns if column.role == "parameter"]
        metrics = [column for column in columns if column.role == "metric"]
        self._metrics = [(column.name, column.type == "string") for column in metrics]
        self._names = {column.name for column in metrics}

    def row(self, member: StudyMember, outcome: MemberOutcome) -> MemberRow:
        """Return the values of a row, as JSON takes them; a metric is never NaN."""
        row: MemberRow = [outcome.number]
        row += [get(member) for get in self._getters]
        found = outcome.metrics
        others: dict[str, MetricValue] = {}
        for name, is_text in self._metrics:
            value = found.get(name)
            if value is not None and isinstance(value, str) is not is_text:
                others[name] = value
                value = None
            row.append(None if value != value else value)
        if not self._names.issuperset(found):
            others |= {name: found[name] for name in found if name not in self._names}
        row += (
            outcome.status,
            outcome.reason or None,
            "\n".join(outcome.warnings) or None,
            outcome.steps,
            outcome.wall_time,
            outcome.worker or None,
            outcome.designs or None,
            json_text(others) if others else None,
        )
        return row


def _getter(column: StudyColumn) -> Callable[[StudyMember], Any]:
    """Return what takes the value of a parameter from a member."""
    name = column.name
    if column.type == "json":
        return lambda member: json_text(member.set.get(name))
    if name == RECORDING:
        return lambda member: member.recording
    if name.startswith(SWAP):
        component = name.removeprefix(SWAP)
        return lambda member: member.set.get(name, member.swap.get(component))
    return lambda member: member.set.get(name)


def pyarrow() -> Any:
    """Return the library.

    Raises
    ------
    UsageError
        If there is none.
    """
    try:
        return import_module("pyarrow")
    except ImportError as error:
        raise UsageError(
            "studies need pyarrow, which is not installed: pip install pyarrow, or, in a clone of "
            "cosim, pip install -e '.[study]'"
        ) from error


def arrow_schema(columns: Sequence[StudyColumn], about: Mapping[str, str]) -> Any:
    """Return the schema of all parts; unit, role and expression are metadata of a field."""
    arrow = pyarrow()
    types = {
        "double": arrow.float64(),
        "int64": arrow.int64(),
        "bool": arrow.bool_(),
        "string": arrow.string(),
        "list<double>": arrow.list_(arrow.float64()),
        "json": arrow.string(),
    }
    fields = []
    for column in columns:
        metadata = {"role": column.role, "unit": column.unit, "text": column.text}
        kept = {key: text for key, text in metadata.items() if text}
        fields.append(
            arrow.field(
                column.name, types[column.type], nullable=column.name != MEMBER, metadata=kept
            )
        )
    return arrow.schema(fields, metadata=dict(about))


def planned_array(column: StudyColumn, values: Iterable[Any]) -> Any:
    """Return planned values of a parameter as an array of the type of its column."""
    arrow = pyarrow()
    kind = arrow_schema([column], {}).field(0).type
    if column.type == "json":
        return arrow.array([json_text(value) for value in values], kind)
    if isinstance(values, np.ndarray) and values.dtype != object:
        return arrow.array(values, kind, from_pandas=False)
    return arrow.array(list(values), kind)
