"""The dataset of a study: what its members came to, as columns.

::

    study.json        whose dataset it is: what its members rest on, and its columns
    parts/part-FIRST-LAST-CHECKSUM.parquet    a row for each member, a thousand at most
    _journal.jsonl    rows of members whose part is not complete yet, each with a checksum
    _lock             held by who writes (in folders)
    logs/7.mcap       logs of members that are kept

A row is in the journal first. When all members of a part have come, the part is written, and their
lines in the journal no longer count. A part is never changed: where a study has grown, the next one
begins where the last one ended. So there is always one place from which a row is read.
"""

from __future__ import annotations

import io
import json
import math
import re
import secrets
import zlib
from bisect import bisect, insort
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib import import_module
from itertools import groupby
from pathlib import Path
from time import monotonic
from typing import Any, Final, Literal, NamedTuple, Protocol, Self, TypeAlias, final

import numpy as np
from pydantic import TypeAdapter

from cosim.digests import digest_of
from cosim.errors import DatasetError, UsageError, command, flag, nearest, quoted
from cosim.log.contents.metadata import read_json
from cosim.studies.contracts import (
    FAILED,
    RECORDING,
    SWAP,
    MemberOutcome,
    MetricValue,
    StudyMember,
)
from cosim.studies.storage import Bucket, Folder, open_storage
from cosim.version import __version__

FORMAT: Final = 3
PART_SIZE: Final = 1000
DESCRIPTION: Final = "study.json"
JOURNAL: Final = "_journal.jsonl"
PARTS: Final = "parts"
LOGS: Final = "logs"
OF_KEY: Final = "key "  # begins what the digest of a key of the scenario is named
OF_METRICS: Final = "the metrics"  # what the digest of the metrics is named
MEMBER: Final = "member"
LOG: Final = "log"
WARNINGS: Final = "warnings"
_PART: Final = re.compile(r"part-(\d+)-(\d+)-([0-9a-f]{8})\.parquet")
_LOG: Final = re.compile(r"(\d+)\.(mcap|txt)")
_PERIOD: Final = 10.0  # [s] between two writes of a journal to which nothing can be appended
_SHOWN: Final = 8  # differences
_LARGEST_EXACT: Final = 2**53  # every whole number up to it is a double

ColumnType: TypeAlias = Literal["double", "int64", "bool", "string", "list<double>", "json"]
ColumnRole: TypeAlias = Literal["number", "parameter", "metric", "outcome"]


# --- columns ---


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


_FIRST: Final = (StudyColumn(MEMBER, "number", "int64"),)
_LAST: Final = (
    StudyColumn("status", "outcome", "string"),
    StudyColumn("reason", "outcome", "string"),
    StudyColumn(WARNINGS, "outcome", "string"),  # a line each
    StudyColumn("steps", "outcome", "int64"),
    StudyColumn("wall_time", "outcome", "double", "s"),
    StudyColumn("worker", "outcome", "string"),
    StudyColumn("other_results", "outcome", "json"),
)
RESERVED: Final = frozenset(column.name for column in (*_FIRST, *_LAST)) | {LOG}


def parameter_column(name: str, values: Iterable[Any], unit: str = "") -> StudyColumn:
    """Return the column of a varied key, whose type is that of its planned values."""
    return StudyColumn(name, "parameter", _type_of(values), unit)


def metric_column(name: str, expression: str = "", unit: str = "") -> StudyColumn:
    """Return the column of a metric, which is a number."""
    return StudyColumn(name, "metric", "double", unit, expression)


def result_columns(
    results: Mapping[str, MetricValue], taken: Iterable[str]
) -> tuple[StudyColumn, ...]:
    """Return the columns of what the result of one run says, but of names that are taken."""
    names = RESERVED.union(taken)
    return tuple(
        StudyColumn(name, "metric", "string" if isinstance(value, str) else "double")
        for name, value in results.items()
        if name not in names
    )


def _type_of(values: Iterable[Any]) -> ColumnType:
    if isinstance(values, np.ndarray) and values.dtype != object:
        values = values[:1].tolist()
    present = [value for value in values if value is not None]
    types = {_kind(value) for value in present}
    if types == {"int64", "double"} and all(map(_is_double, present)):
        return "double"
    return types.pop() if len(types) == 1 else "json"


def _kind(value: Any) -> ColumnType:
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


def json_value(text: str) -> Any:
    """Return the value of a column of JSON."""
    try:
        return read_json(text)
    except ValueError as error:
        raise DatasetError(f"the dataset is damaged: expected JSON, got {quoted(text)}") from error


def pyarrow() -> Any:
    """Return the library; UsageError: it is not installed."""
    try:
        return import_module("pyarrow")
    except ImportError as error:
        raise UsageError(
            "studies need pyarrow, which is not installed: pip install pyarrow, or, in a clone of "
            "cosim, pip install -e '.[study]'"
        ) from error


def _stored(column: StudyColumn, value: Any) -> Any:
    """Return a value as its column has it."""
    if column.type != "json" or value is None:
        return value
    return json.dumps(value, default=str, ensure_ascii=False)


# --- whose dataset it is ---


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
    columns : tuple of StudyColumn
        Of parameters and metrics.
    members : int
        That are planned; the dataset may grow.
    version : str
        Of cosim.
    salt : str
        Of the checksums of parts and rows, which those of another dataset do not have.
    """

    name: str
    text: str
    digests: Mapping[str, str]
    columns: tuple[StudyColumn, ...]
    members: int
    version: str = __version__
    salt: str = field(default_factory=partial(secrets.token_hex, 8))

    @property
    def all_columns(self) -> tuple[StudyColumn, ...]:
        """Every column of a part, in order.

        Raises
        ------
        DatasetError
            If two have one name.
        """
        names = set(RESERVED)
        for column in self.columns:
            if column.name in names:
                raise DatasetError(
                    f"{column.role} {column.name!r}: a column of the dataset already has this "
                    "name; choose another one"
                )
            names.add(column.name)
        own = sorted(self.columns, key=lambda column: column.role != "parameter")
        return (*_FIRST, *own, *_LAST)

    def to_json(self) -> bytes:
        """Return the description of a dataset."""
        fields = asdict(self)
        content = {"format": FORMAT, "checksum": digest_of(fields), **fields}
        return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()


def _recorded(storage: Folder | Bucket) -> StudyIdentity | None:
    """Read the description of a dataset; None: there is none.

    Raises
    ------
    DatasetError
        If it is damaged, or of another format.
    """
    content = storage.read(DESCRIPTION)
    if content is None:
        return None
    label = storage.label(DESCRIPTION)
    with suppress(ValueError, KeyError, TypeError, AttributeError):
        found = read_json(content)
        version = found.pop("format")
        if version != FORMAT:
            writer = found.get("cosim", found.get("version"))  # before format 3, since
            raise DatasetError(
                f"{label}: expected dataset format {FORMAT}, got {version!r}; read it with cosim "
                f"{writer}, or choose another folder"
            )
        if found.pop("checksum") == digest_of(found):
            return TypeAdapter(StudyIdentity).validate_python(found)
    raise DatasetError(
        f"{label} is damaged; restore it from a copy, or use {flag('new')} to start over without "
        "the recorded members"
    )


def scenario_digests(tables: Mapping[str, Any]) -> dict[str, str]:
    """Return the digests of the keys of a scenario, by their names."""
    digests = {}
    for name, table in tables.items():
        if not isinstance(table, Mapping) or not table:
            digests[f"{OF_KEY}{name}"] = digest_of(table)
            continue
        for key, value in table.items():
            digests[f"{OF_KEY}{name}.{key}"] = digest_of(value)
    return digests


def differences(recorded: StudyIdentity, planned: StudyIdentity) -> str:
    """Return what has changed between two studies; empty: nothing that outcomes rest on."""
    found = []
    if recorded.version != planned.version:
        found.append(f"it was made by cosim {recorded.version}, this is {planned.version}")
    before, after = recorded.digests, planned.digests
    for name in before:
        if name not in after:
            found.append(f"{name} is no longer part of it")
        elif after[name] != before[name]:
            found.append(f"{name} changed")
    found += [f"{n} is new" for n in after if n.startswith(OF_KEY) and n not in before]
    was, now = (
        {c.name: c.type for c in one.columns if c.role == "parameter"}
        for one in (recorded, planned)
    )
    for name in sorted(was.keys() | now.keys()):
        if name not in now:
            found.append(f"{name} is no longer varied")
        elif name not in was:
            found.append(f"{name} is varied now")
        elif was[name] != now[name]:
            found.append(f"the values of {name} were of type {was[name]}, are {now[name]}")
    more = len(found) - _SHOWN
    if more > 0:
        found = [*found[:_SHOWN], f"and {more} more"]
    return "; ".join(found)


class PlannedColumns(Protocol):
    """The planned values of the parameters of members."""

    def column(self, name: str, begin: int = 0, end: int | None = None) -> Any:
        """Return the values of a parameter, from one member to another (not included)."""
        ...


# --- the dataset ---


class _PartFile(NamedTuple):
    first: int
    last: int
    name: str


@final
class StudyDataset:
    """The outcomes of a study; a context manager that closes it.

    Made by :meth:`open`, and for writing by :meth:`open_or_create`.
    """

    def __init__(self, storage: Folder | Bucket, identity: StudyIdentity, *, writes: bool) -> None:
        self.storage = storage
        self.identity = identity
        self.columns = identity.all_columns
        self._schema = _arrow_schema(self.columns)
        self._writes = writes
        # the journal before the parts: its lines end when they are in one
        journal = storage.read(JOURNAL) or b""
        rows = self._read_journal(journal)
        self._parts = self._listed_parts()
        self._rows = {number: row for number, row in rows.items() if not self._is_in_part(number)}
        self._lines = len(rows)  # of the journal
        self._unwritten = 0  # rows that are not in it yet
        self._due = monotonic() + _PERIOD
        if writes:
            for number in sorted(self._rows):
                if number in self._rows:
                    self._write_if_complete(number)
            if journal != b"".join(map(self._line, self._rows.values())):
                self._write_journal()

    @staticmethod
    def is_at(place: str | Path) -> bool:
        """Return whether the description of a dataset is there."""
        pyarrow()
        return open_storage(place).read(DESCRIPTION) is not None

    @classmethod
    def open(cls, place: str | Path) -> Self:
        """Open a dataset for reading, also while a study writes it.

        Raises
        ------
        DatasetError
            If there is none, or it is damaged.
        """
        pyarrow()
        storage = open_storage(place)
        identity = _recorded(storage)
        if identity is None:
            raise DatasetError(
                f"{storage.label()}: no {DESCRIPTION} there; expected the dataset of a study, as "
                f"written by {command('study')}"
            )
        return cls(storage, identity, writes=False)

    @classmethod
    def open_or_create(
        cls,
        place: str | Path,
        identity: StudyIdentity,
        *,
        design: PlannedColumns | None = None,
        new: bool = False,
    ) -> Self:
        """Open the dataset of a study for writing, or make it where there is none.

        Parameters
        ----------
        place : str or Path
            A folder, or a URL of fsspec. Of a URL it is not guarded that only one study writes
            there.
        identity : StudyIdentity
            It may have more members than when the dataset was made.
        design : PlannedColumns, optional
            The planned values of the parameters, which those of recorded members have to be.
        new : bool
            Remove the dataset that is there first: files of a dataset only.

        Raises
        ------
        DatasetError
            If another study's is there, it is damaged, or another process writes there.
        """
        pyarrow()
        _ = identity.all_columns  # two of one name are refused before anything is made
        storage = open_storage(place)
        storage.lock()
        try:
            if new:
                _remove(storage)
            recorded = _recorded(storage)
            if recorded is not None:
                identity = _grown(storage, recorded, identity, design)
            elif left := _files(storage):
                raise DatasetError(
                    f"{storage.label(left[0])} belongs to a dataset, but no {DESCRIPTION} says to "
                    f"which; choose another folder, or use {flag('new')} to delete it and start "
                    "over"
                )
            if identity != recorded:
                storage.write(DESCRIPTION, identity.to_json())
            return cls(storage, identity, writes=True)
        except BaseException:
            storage.close()
            raise

    @classmethod
    def check(
        cls, place: str | Path, identity: StudyIdentity, *, design: PlannedColumns | None = None
    ) -> None:
        """Check that a study goes on in the dataset that is there; change nothing.

        Raises
        ------
        DatasetError
            As of :meth:`open_or_create`, and if there is none.
        """
        dataset = cls.open(place)
        _grown(dataset.storage, dataset.identity, identity, design)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Let others write; twice does no harm."""
        if self._writes:
            self._writes = False
            try:
                if self._unwritten:
                    self._write_journal()
            finally:
                self.storage.close()

    @property
    def label(self) -> str:
        """Its place."""
        return self.storage.label()

    @property
    def total(self) -> int:
        """How many members are planned."""
        return self.identity.members

    def __len__(self) -> int:
        """Return how many members have an outcome."""
        return sum(part.last - part.first + 1 for part in self._parts) + len(self._rows)

    @property
    def failed(self) -> int:
        """How many members have failed."""
        return sum(table["status"].to_pylist().count(FAILED) for table in self.tables(["status"]))

    def missing(self) -> list[range]:
        """Return the members without an outcome, as ranges in order."""
        there = [(part.first, part.last) for part in self._parts]
        there += [(number, number) for number in self._rows]
        found = []
        begin = 0
        for first, last in [*sorted(there), (self.total, self.total)]:
            if begin < first:
                found.append(range(begin, first))
            begin = last + 1
        return found

    # --- writing ---

    def add(self, member: StudyMember, outcome: MemberOutcome) -> None:
        """Add the outcome of a member that has none; its part is written when it is complete.

        Raises
        ------
        DatasetWriteError
            If it cannot be written; what was written before is there.
        """
        number = member.number
        assert self._writes
        assert number not in self._rows
        assert not self._is_in_part(number)
        row = self._row(member, outcome)
        if isinstance(self.storage, Folder):
            self.storage.append(JOURNAL, self._line(row))
            self._lines += 1
        else:
            self._unwritten += 1
        self._rows[number] = row
        self._write_if_complete(number)
        if self._unwritten and monotonic() >= self._due:
            self._write_journal()

    def _write_if_complete(self, number: int) -> None:
        """Write the part of a member: between those that are there, in a thousand of its own."""
        place = bisect(self._parts, (number,))
        begin = number - number % PART_SIZE
        end = min(begin + PART_SIZE, self.total)
        begin = max([begin, *(part.last + 1 for part in self._parts[max(place - 1, 0) : place])])
        end = min([end, *(part.first for part in self._parts[place : place + 1])])
        if not all(other in self._rows for other in reversed(range(begin, end))):
            return
        from pyarrow import parquet

        stream = io.BytesIO()
        texts = [column.name for column in self.columns if column.type in ("string", "json")]
        table = self._table(self._rows[other] for other in range(begin, end))
        parquet.write_table(table, stream, compression="zstd", use_dictionary=texts)
        content = stream.getvalue()
        name = f"part-{begin:010d}-{end - 1:010d}-{self._checksum(content)}.parquet"
        self.storage.write(f"{PARTS}/{name}", content)
        insort(self._parts, _PartFile(begin, end - 1, name))
        for other in range(begin, end):
            del self._rows[other]
        if self._lines > 2 * len(self._rows):
            self._write_journal()

    def _write_journal(self) -> None:
        self.storage.write(JOURNAL, b"".join(map(self._line, self._rows.values())))
        self._lines = len(self._rows)
        self._unwritten = 0
        self._due = monotonic() + _PERIOD

    # --- reading ---

    def read(
        self, columns: Iterable[str] | None = None, members: Collection[int] | None = None
    ) -> Any:
        """Return what is recorded as a ``pyarrow.Table``, in the order of members.

        Parameters
        ----------
        columns : iterable of str, optional
            Without them all, and ``log``: the path of a member's log that was kept, or null.
        members : collection of int, optional
            Of these only; those without an outcome have no row.

        Raises
        ------
        DatasetError
            If a column is unknown, or a part is damaged.
        """
        schema = self._chosen(columns)
        return pyarrow().concat_tables([schema.empty_table(), *self.tables(schema.names, members)])

    def tables(
        self, columns: Iterable[str] | None = None, members: Collection[int] | None = None
    ) -> Iterator[Any]:
        """Yield what :meth:`read` returns part by part, in memory for one of them."""
        arrow = pyarrow()
        schema = self._chosen(columns)
        names = [MEMBER, *(name for name in schema.names if name not in (MEMBER, LOG))]
        chosen = None if members is None else np.asarray(list(members), np.int64)
        logs = self.logs() if LOG in schema.names else {}
        for first, last, table in self._pieces(names):
            if chosen is not None and not ((first <= chosen) & (chosen <= last)).any():
                continue
            rows = table()
            if chosen is not None:
                rows = rows.filter(arrow.array(np.isin(rows[MEMBER].to_numpy(), chosen)))
            places = [logs.get(number) for number in rows[MEMBER].to_pylist()]
            rows = rows.append_column(LOG, arrow.array(places, arrow.string()))
            yield rows.select(schema.names).cast(schema)

    def _pieces(self, names: list[str]) -> Iterator[tuple[int, int, Callable[[], Any]]]:
        """Yield the parts, and the rows between them that are in none, in order."""
        between = groupby(sorted(self._rows), lambda number: bisect(self._parts, (number,)))
        open_rows = {
            place: [self._rows[number] for number in numbers] for place, numbers in between
        }
        for place in range(len(self._parts) + 1):
            if rows := open_rows.get(place):
                yield rows[0][MEMBER], rows[-1][MEMBER], partial(self._table, rows)
            for part in self._parts[place : place + 1]:
                yield part.first, part.last, partial(self._read_part, part.name, names)

    def row_of(self, member: StudyMember, outcome: MemberOutcome) -> dict[str, Any]:
        """Return the row of an outcome as it would be read when it was added; nothing is."""
        row: dict[str, Any] = self._table([self._row(member, outcome)]).to_pylist()[0]
        return row

    def logs(self) -> dict[int, str]:
        """Return the places of the logs that are kept, by member."""
        found = map(_LOG.fullmatch, self.storage.names(LOGS))
        return {
            int(log[1]): self.storage.label(f"{LOGS}/{log[0]}")
            for log in found
            if log is not None and log[2] == "mcap"
        }

    # --- rows ---

    def _row(self, member: StudyMember, outcome: MemberOutcome) -> dict[str, Any]:
        """Return a row as JSON takes it; a metric is never NaN."""
        swaps = {f"{SWAP}{name}": path for name, path in member.swap.items()}
        given = {**member.set, **swaps, RECORDING: member.recording}
        others = dict(outcome.metrics)
        row: dict[str, Any] = {MEMBER: outcome.number}
        for column in self.identity.columns:
            value = (given if column.role == "parameter" else others).get(column.name)
            if column.role == "parameter":
                row[column.name] = _stored(column, value)
            elif value is None or isinstance(value, str) is (column.type == "string"):
                others.pop(column.name, None)
                row[column.name] = None if value != value else value
        return row | {
            "status": outcome.status,
            "reason": _plain(outcome.reason),
            WARNINGS: _plain("\n".join(outcome.warnings)),
            "steps": outcome.steps,
            "wall_time": outcome.wall_time,
            "worker": _plain(outcome.worker),
            "other_results": json.dumps(others, ensure_ascii=False) if others else None,
        }

    def _table(self, rows: Iterable[Mapping[str, Any]]) -> Any:
        return pyarrow().Table.from_pylist(list(rows), schema=self._schema)

    def _line(self, row: Mapping[str, Any]) -> bytes:
        text = json.dumps(row)
        return f'["{self._checksum(text.encode())}", {text}]\n'.encode()

    def _checksum(self, content: bytes) -> str:
        return f"{zlib.crc32(content, zlib.crc32(self.identity.salt.encode())):08x}"

    def _read_journal(self, content: bytes) -> dict[int, dict[str, Any]]:
        """Return the rows of the journal; a kill may have cut the last line, which is dropped."""
        rows = {}
        lines = content[: content.rfind(b"\n") + 1].splitlines()
        for number, line in enumerate(lines, 1):
            try:
                row = read_json(line)[1]
                if self._line(row) != line + b"\n":
                    raise ValueError
            except (ValueError, TypeError, LookupError) as error:
                raise DatasetError(
                    f"{self.storage.label(JOURNAL)}: line {number} is damaged; remove that line "
                    "and run the study again: its member is rerun"
                ) from error
            rows[row[MEMBER]] = row
        return rows

    def _read_part(self, name: str, columns: list[str]) -> Any:
        from pyarrow import parquet

        content = self.storage.read(f"{PARTS}/{name}")
        if content is None or not name.endswith(f"{self._checksum(content)}.parquet"):
            what = "removed while it was read" if content is None else "damaged, or not of it"
            raise self._wrong_part(name, what)
        return parquet.read_table(io.BytesIO(content), columns=columns, use_threads=False)

    def _listed_parts(self) -> list[_PartFile]:
        """Return the parts that are there, in order."""
        found = map(_PART.fullmatch, self.storage.names(PARTS))
        parts = sorted(_PartFile(int(p[1]), int(p[2]), p[0]) for p in found if p is not None)
        begin = 0
        for part in parts:
            if not begin <= part.first <= part.last:
                raise self._wrong_part(part.name, "not a part of this dataset")
            begin = part.last + 1
        return parts

    def _wrong_part(self, name: str, what: str) -> DatasetError:
        return DatasetError(
            f"{self.storage.label(f'{PARTS}/{name}')}: {what}; remove it and run the study again: "
            "its members are rerun"
        )

    def _is_in_part(self, number: int) -> bool:
        place = bisect(self._parts, (number, math.inf))
        return place > 0 and number <= self._parts[place - 1].last

    def _chosen(self, columns: Iterable[str] | None) -> Any:
        """Return the schema of some columns."""
        arrow = pyarrow()
        schema = self._schema.append(arrow.field(LOG, arrow.string()))
        names = schema.names if columns is None else list(columns)
        for name in names:
            if name not in schema.names:
                raise DatasetError(
                    f"{self.label}: there is no column {name!r}; {nearest(name, schema.names)}"
                )
        return arrow.schema([schema.field(name) for name in names])


def _plain(text: str) -> str | None:
    """Return a text as a column has it: of Unicode, or none."""
    return text.encode(errors="backslashreplace").decode() or None


def _arrow_schema(columns: Iterable[StudyColumn]) -> Any:
    arrow = pyarrow()
    types = {
        "double": arrow.float64(),
        "int64": arrow.int64(),
        "bool": arrow.bool_(),
        "list<double>": arrow.list_(arrow.float64()),
    }
    fields = []
    for column in columns:
        about = {"role": column.role, "unit": column.unit, "text": column.text}
        kept = {key: text for key, text in about.items() if text}
        kind = types.get(column.type, arrow.string())
        fields.append(arrow.field(column.name, kind, column.name != MEMBER, metadata=kept))
    return arrow.schema(fields)


def _grown(
    storage: Folder | Bucket,
    recorded: StudyIdentity,
    identity: StudyIdentity,
    design: PlannedColumns | None,
) -> StudyIdentity:
    """Return the identity of a dataset that goes on with a study.

    Raises
    ------
    DatasetError
        If it is of another study, or its members are.
    """
    found = differences(recorded, identity)
    if found:
        raise DatasetError(
            f"{storage.label()} holds the dataset of another study: {found}; choose another "
            f"folder, or use {flag('new')} to delete it and start over"
        )
    dataset = StudyDataset(storage, recorded, writes=False)
    parameters = [column for column in dataset.columns if column.role == "parameter"]
    last = -1
    for table in dataset.tables([MEMBER, *(column.name for column in parameters)]):
        last = table[MEMBER][-1].as_py()
        if last < identity.members and design is not None:
            _check_planned(dataset.label, parameters, table, design)
    if last >= identity.members:
        raise DatasetError(
            f"{storage.label()}: member {last} is recorded, but only {identity.members} members "
            "are planned; a study can only grow: plan at least as many, choose another folder, or "
            f"use {flag('new')} to delete the dataset and start over"
        )
    digests = {**recorded.digests, **identity.digests}
    return replace(identity, digests=digests, columns=recorded.columns, salt=recorded.salt)


def _check_planned(
    label: str, parameters: Sequence[StudyColumn], table: Any, design: PlannedColumns
) -> None:
    """Check that recorded members have the values that are planned for their numbers."""
    members = table[MEMBER].to_pylist()
    begin = members[0]
    wrong = []
    for column in parameters:
        values = design.column(column.name, begin, members[-1] + 1)
        plain = values.tolist() if isinstance(values, np.ndarray) else values
        stored = [_stored(column, plain[number - begin]) for number in members]
        planned = pyarrow().array(stored, table.schema.field(column.name).type).to_pylist()
        pairs = zip(members, table[column.name].to_pylist(), planned, strict=True)
        wrong += [(n, column.name, was, now) for n, was, now in pairs if repr(was) != repr(now)]
    if wrong:
        number, name, was, now = min(wrong, key=lambda item: item[0])
        raise DatasetError(
            f"{label}: member {number} was {name} = {quoted(was)}, is {quoted(now)}; members keep "
            "their numbers where random or Sobol samples, or cases, are appended; without these, "
            "seeds; without seeds, values at the end of the first key of the grid: do that, "
            f"choose another folder, or use {flag('new')} to delete the dataset and start over"
        )


def _files(storage: Folder | Bucket) -> list[str]:
    """Return the files of a dataset that are there, but its description."""
    names = [f"{PARTS}/{name}" for name in sorted(storage.names(PARTS)) if _PART.fullmatch(name)]
    names += [f"{LOGS}/{name}" for name in storage.names(LOGS) if _LOG.fullmatch(name)]
    return names + [name for name in storage.names() if name == JOURNAL]


def _remove(storage: Folder | Bucket) -> None:
    """Remove the files of a dataset, whosever it is, and no others; the description last."""
    content = storage.read(DESCRIPTION)
    if content is not None and b'"checksum"' not in content:
        raise DatasetError(
            f"{storage.label(DESCRIPTION)} is not that of a dataset; choose another folder, or "
            "remove it"
        )
    storage.remove([*_files(storage), DESCRIPTION])
