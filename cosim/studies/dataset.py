"""The dataset of a study: what its members came to, as columns.

::

    study.json        whose dataset it is: what its members rest on, and its columns
    parts/part-FIRST-LAST-CHECKSUM.parquet    a row for each member, a thousand at most
    _journal.jsonl    rows of members whose part is not complete yet, each with a checksum
    _lock             held by who writes (in folders)
    logs/7.mcap       logs of members that are kept

A row is in the journal first. When the last member of a part has come, the part is written, and its
lines in the journal no longer count. The last part of a study that has grown is read back, and
replaced when it is complete again. So there is always one place from which a row is read.
"""

from __future__ import annotations

import io
import json
import re
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, Protocol, Self, TypeAlias, final

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
    if types == {"int64", "double"}:
        whole = (abs(value) for value in present if isinstance(value, int))
        return "double" if max(whole) <= _LARGEST_EXACT else "json"
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
        case list() | tuple() if all(
            _kind(element) == "double" or _fits(element) for element in value
        ):
            return "list<double>"
    return "json"


def _fits(value: Any) -> bool:
    return type(value) is int and abs(value) <= _LARGEST_EXACT


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
    """

    name: str
    text: str
    digests: Mapping[str, str]
    columns: tuple[StudyColumn, ...]
    members: int
    version: str = __version__

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
        content: dict[str, Any] = {"format": FORMAT, **asdict(self)}
        content["checksum"] = digest_of(content)
        return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()

    @classmethod
    def from_json(cls, content: bytes, label: str) -> Self:
        """Read the description of a dataset.

        Raises
        ------
        DatasetError
            If it is damaged, or of another format.
        """
        try:
            found = read_json(content)
            checksum = found.pop("checksum")
            version = found["format"]
        except (ValueError, KeyError, TypeError, AttributeError):
            version = checksum = None
        if version not in (None, FORMAT):
            raise DatasetError(
                f"{label}: expected dataset format {FORMAT}, got {version!r}; read it with cosim "
                f"{found.get('cosim')}, or choose another folder"
            )
        if version is None or checksum != digest_of(found):
            raise DatasetError(
                f"{label} is damaged; restore it from a copy, or use {flag('new')} to start over "
                "without the recorded members"
            )
        del found["format"]
        return TypeAdapter(cls).validate_python(found)


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
    found += [f"{name} is no longer varied" for name in sorted(was.keys() - now.keys())]
    found += [f"{name} is varied now" for name in sorted(now.keys() - was.keys())]
    for name in sorted(was.keys() & now.keys()):
        if was[name] != now[name]:
            found.append(f"the values of {name} were of type {was[name]}, are {now[name]}")
    more = len(found) - _SHOWN
    if more > 0:
        found = [*found[:_SHOWN], f"and {more} other difference{'' if more == 1 else 's'}"]
    return "; ".join(found)


class PlannedColumns(Protocol):
    """The planned values of the parameters of members."""

    def column(self, name: str, begin: int = 0, end: int | None = None) -> Any:
        """Return the values of a parameter, from one member to another (not included)."""
        ...


# --- the dataset ---


@final
class StudyDataset:
    """The outcomes of a study; a context manager that closes it.

    Made by :meth:`open`, and for writing by :meth:`open_or_create`.
    """

    def __init__(self, storage: Folder | Bucket, identity: StudyIdentity, *, writes: bool) -> None:
        self._storage = storage
        self.identity = identity
        self.columns = identity.all_columns
        types = {column.name: column.type for column in identity.columns}
        self._salt = digest_of([identity.version, identity.name, types]).encode()
        self._schema = _arrow_schema(self.columns)
        # whose rows are known: those of the journal first, as its lines end when a part is there
        self._open: dict[int, dict[int, list[Any]]] = {}  # by the first member of the part
        lines = self._read_journal()
        self._parts = self._listed_parts()
        self._loose: set[int] = set()  # rows whose place is a part that is to be replaced
        self._journal = None
        if writes:
            self._reopen_short_parts()
        for first, part in self._parts.items():
            rows = self._open.get(first, {})
            for number in part[0]:
                rows.pop(number, None)
            if not rows:
                self._open.pop(first, None)
        if writes:
            self._lines = lines
            self._journal = storage.journal(JOURNAL)
            for first in [*self._open]:
                self._write_if_complete(first)

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
        identity = _identity(storage)
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
            recorded = _identity(storage)
            if recorded is None:
                left = _files(storage)
                if left:
                    raise DatasetError(
                        f"{storage.label(left[0])} belongs to a dataset, but no {DESCRIPTION} says "
                        f"to which; choose another folder, or use {flag('new')} to delete it and "
                        "start over"
                    )
            else:
                identity = _grown(storage, recorded, identity, design)
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
        _grown(dataset._storage, dataset.identity, identity, design)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let others write; twice does no harm."""
        if self._journal is not None:
            journal, self._journal = self._journal, None
            try:
                journal.close()
            finally:
                self._storage.close()

    @property
    def label(self) -> str:
        """Its place."""
        return self._storage.label()

    @property
    def total(self) -> int:
        """How many members are planned."""
        return self.identity.members

    @property
    def storage(self) -> Folder | Bucket:
        """Where it is."""
        return self._storage

    def __len__(self) -> int:
        """Return how many members have an outcome."""
        whole = sum(len(part) for part, _ in self._parts.values())
        return whole + sum(map(len, self._open.values()))

    @property
    def failed(self) -> int:
        """How many members have failed."""
        return sum(table["status"].to_pylist().count(FAILED) for table in self.tables(["status"]))

    def missing(self) -> list[range]:
        """Return the members without an outcome, as ranges in order."""
        found: list[range] = []
        for first in range(0, self.total, PART_SIZE):
            there = self._open.get(first, {})
            begin = self._parts[first][0].stop if first in self._parts else first
            end = min(first + PART_SIZE, self.total)
            absent = [range(begin, end)] if begin < end else []
            if there:
                absent = [range(n, n + 1) for n in range(begin, end) if n not in there]
            for numbers in absent:
                if found and found[-1].stop == numbers.start:
                    found[-1] = range(found[-1].start, numbers.stop)
                else:
                    found.append(numbers)
        return found

    # --- writing ---

    def add(self, member: StudyMember, outcome: MemberOutcome) -> None:
        """Add the outcome of a member that has none; its part is written when it is complete.

        Raises
        ------
        DatasetWriteError
            If it cannot be written; what was written before is there.
        """
        assert self._journal is not None
        row = self._row(member, outcome)
        self._journal.append(_line(row))
        self._lines += 1
        first = member.number - member.number % PART_SIZE
        self._open.setdefault(first, {})[member.number] = row
        self._write_if_complete(first)

    def _write_if_complete(self, first: int) -> None:
        rows = self._open[first]
        numbers = range(first, min(first + PART_SIZE, self.total))
        if len(rows) < len(numbers):
            return
        from pyarrow import parquet

        stream = io.BytesIO()
        texts = [column.name for column in self.columns if column.type in ("string", "json")]
        table = self._table([rows[number] for number in numbers])
        parquet.write_table(table, stream, compression="zstd", use_dictionary=texts)
        content = stream.getvalue()
        name = f"part-{first:010d}-{numbers[-1]:010d}-{self._checksum(content)}.parquet"
        self._storage.write(f"{PARTS}/{name}", content)
        self._parts[first] = (numbers, name)
        del self._open[first]
        self._loose.difference_update(numbers)
        assert self._journal is not None
        kept = [row for rows in self._open.values() for row in rows.values()]
        kept = [row for row in kept if row[0] not in self._loose]
        if self._lines > 2 * len(kept):
            self._journal.replace([_line(row) for row in kept])
            self._lines = len(kept)
        others = [other for other in self._storage.names(PARTS) if other != name]
        self._storage.remove(f"{PARTS}/{o}" for o in others if o.startswith(name[:16]))

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
        names = self._names(columns)
        return pyarrow().concat_tables(
            [self._chosen(names).empty_table(), *self.tables(names, members)]
        )

    def tables(
        self, columns: Iterable[str] | None = None, members: Collection[int] | None = None
    ) -> Iterator[Any]:
        """Yield what :meth:`read` returns part by part, in memory for one of them."""
        arrow = pyarrow()
        names = self._names(columns)
        chosen = None if members is None else np.asarray(list(members), np.int64)
        logs = self.logs() if LOG in names else {}
        for first in sorted({*self._parts, *self._open}):
            inside = (
                (chosen >= first) & (chosen < first + PART_SIZE) if chosen is not None else None
            )
            if inside is not None and not inside.any():
                continue
            table = self._rows_of(first, [MEMBER, *(n for n in names if n not in (MEMBER, LOG))])
            if chosen is not None:
                table = table.filter(arrow.array(np.isin(table[MEMBER].to_numpy(), chosen)))
            if LOG in names:
                places = [logs.get(number) for number in table[MEMBER].to_pylist()]
                table = table.append_column(LOG, arrow.array(places, arrow.string()))
            yield table.select(names).cast(self._chosen(names))

    def row_of(self, member: StudyMember, outcome: MemberOutcome) -> dict[str, Any]:
        """Return the row of an outcome as it would be read when it was added; nothing is."""
        (row,) = self._table([self._row(member, outcome)]).to_pylist()
        return dict(row)

    def logs(self) -> dict[int, str]:
        """Return the places of the logs that are kept, by member."""
        found = (_LOG.fullmatch(name) for name in self._storage.names(LOGS))
        return {
            int(log[1]): self._storage.label(f"{LOGS}/{log[0]}")
            for log in found
            if log is not None and log[2] == "mcap"
        }

    # --- rows ---

    def _row(self, member: StudyMember, outcome: MemberOutcome) -> list[Any]:
        """Return the values of a row, as JSON takes them; a metric is never NaN."""
        row: list[Any] = []
        others = dict(outcome.metrics)
        for column in self.columns:
            name = column.name
            if column.role == "parameter":
                swapped = member.swap.get(name.removeprefix(SWAP)) if SWAP in name else None
                value = member.recording if name == RECORDING else member.set.get(name, swapped)
                row.append(_stored(column, value))
            elif column.role == "metric":
                value = others.get(name)
                if value is None or isinstance(value, str) is (column.type == "string"):
                    others.pop(name, None)
                    row.append(None if value != value else value)
                else:
                    row.append(None)
        text = json.dumps(others, ensure_ascii=False) if others else None
        of_outcome = (
            outcome.status,
            outcome.reason or None,
            "\n".join(outcome.warnings) or None,
            outcome.steps,
            outcome.wall_time,
            outcome.worker or None,
            text,
        )
        return [outcome.number, *row, *of_outcome]

    def _table(self, rows: Sequence[Sequence[Any]]) -> Any:
        arrow = pyarrow()
        columns = list(zip(*rows, strict=True)) or [()] * len(self.columns)
        try:
            arrays = [
                arrow.array(values, field.type)
                for values, field in zip(columns, self._schema, strict=True)
            ]
        except (arrow.ArrowException, TypeError, ValueError, OverflowError) as error:
            raise self._damaged(JOURNAL, "a row of it is") from error
        return arrow.Table.from_arrays(arrays, schema=self._schema)

    def _rows_of(self, first: int, names: list[str]) -> Any:
        """Return the rows from a first member on: of its part, and those that came since."""
        arrow = pyarrow()
        tables = []
        if first in self._parts:
            tables.append(self._read_part(self._parts[first][1], names))
        rows = self._open.get(first)
        if rows:
            tables.append(self._table([rows[number] for number in sorted(rows)]).select(names))
        return arrow.concat_tables(tables)

    def _read_part(self, name: str, columns: list[str]) -> Any:
        from pyarrow import parquet

        content = self._storage.read(f"{PARTS}/{name}")
        if content is None:
            raise DatasetError(
                f"{self._storage.label(f'{PARTS}/{name}')}: removed while it was read"
            )
        if name != _PART.sub(rf"part-\1-\2-{self._checksum(content)}.parquet", name):
            raise self._damaged(f"{PARTS}/{name}", "it, or a part of another study, is")
        return parquet.read_table(io.BytesIO(content), columns=columns, use_threads=False)

    def _checksum(self, content: bytes) -> str:
        return f"{zlib.crc32(content, zlib.crc32(self._salt)):08x}"

    def _damaged(self, name: str, what: str) -> DatasetError:
        return DatasetError(
            f"{self._storage.label(name)}: {what} damaged; remove it and run the study again: its "
            "members are rerun"
        )

    def _read_journal(self) -> int:
        """Take the rows of the journal; return how many lines it has."""
        content = self._storage.read(JOURNAL) or b""
        lines = content[: content.rfind(b"\n") + 1].splitlines()
        for number, line in enumerate(lines, 1):
            row = _row_of(line)
            if row is None or len(row) != len(self.columns) or not 0 <= row[0] < self.total:
                raise DatasetError(
                    f"{self._storage.label(JOURNAL)}: line {number} is damaged; remove that line "
                    "and run the study again: its member is rerun"
                )
            self._open.setdefault(row[0] - row[0] % PART_SIZE, {})[row[0]] = row
        return len(lines)

    def _listed_parts(self) -> dict[int, tuple[range, str]]:
        """Return the parts that are there by their first member: of several the longest one."""
        found: dict[int, tuple[range, str]] = {}
        for name in self._storage.names(PARTS):
            match = _PART.fullmatch(name)
            if match is None:
                continue
            first, last = int(match[1]), int(match[2])
            if first % PART_SIZE or not first <= last < min(first + PART_SIZE, self.total):
                raise DatasetError(
                    f"{self._storage.label(f'{PARTS}/{name}')}: not a part of this dataset; remove "
                    "it and run the study again"
                )
            if first not in found or last >= found[first][0].stop:
                found[first] = (range(first, last + 1), name)
        return found

    def _reopen_short_parts(self) -> None:
        """Take the rows of parts that more members belong to now."""
        for first, (numbers, name) in list(self._parts.items()):
            if numbers.stop < min(first + PART_SIZE, self.total):
                table = self._read_part(name, list(self._schema.names))
                rows = zip(*(table[c].to_pylist() for c in self._schema.names), strict=True)
                own = self._open.setdefault(first, {})
                own.update({row[0]: list(row) for row in rows})
                self._loose.update(numbers)
                del self._parts[first]

    def _names(self, columns: Iterable[str] | None) -> list[str]:
        known = [*self._schema.names, LOG]
        names = known if columns is None else list(columns)
        for name in names:
            if name not in known:
                raise DatasetError(
                    f"{self.label}: there is no column {name!r}; {nearest(name, known)}"
                )
        return names

    def _chosen(self, names: Iterable[str]) -> Any:
        arrow = pyarrow()
        log = arrow.field(LOG, arrow.string())
        return arrow.schema([log if n == LOG else self._schema.field(n) for n in names])


def _arrow_schema(columns: Sequence[StudyColumn]) -> Any:
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


def _line(row: Sequence[Any]) -> bytes:
    text = json.dumps(row)
    return f'["{zlib.crc32(text.encode()):08x}", {text}]\n'.encode()


def _row_of(line: bytes) -> list[Any] | None:
    """Return the row of a line; None: it is damaged."""
    try:
        _, row = read_json(line)
        if _line(row) == line + b"\n" and type(row[0]) is int:
            return list(row)
    except (ValueError, TypeError, IndexError):
        pass
    return None


def _identity(storage: Folder | Bucket) -> StudyIdentity | None:
    content = storage.read(DESCRIPTION)
    if content is None:
        return None
    return StudyIdentity.from_json(content, storage.label(DESCRIPTION))


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
    names = [MEMBER, *(column.name for column in parameters)]
    last = -1
    for table in dataset.tables(names):
        last = max(last, table[MEMBER][-1].as_py())
        if last < identity.members and design is not None:
            _check_planned(dataset.label, parameters, table, design)
    if last >= identity.members:
        raise DatasetError(
            f"{storage.label()}: member {last} is recorded, but only {identity.members} members "
            "are planned; a study can only grow: plan at least as many, choose another folder, or "
            f"use {flag('new')} to delete the dataset and start over"
        )
    digests = {**recorded.digests, **identity.digests}
    return replace(identity, digests=digests, columns=recorded.columns)


def _check_planned(
    label: str, parameters: Sequence[StudyColumn], table: Any, design: PlannedColumns
) -> None:
    """Check that recorded members have the values that are planned for their numbers."""
    members = table[MEMBER].to_pylist()
    begin = members[0]
    wrong: list[tuple[int, str, Any, Any]] = []
    for column in parameters:
        values = design.column(column.name, begin, members[-1] + 1)
        plain = values.tolist() if isinstance(values, np.ndarray) else values
        kind = _arrow_schema([column]).field(0).type
        stored = [_stored(column, plain[number - begin]) for number in members]
        planned = pyarrow().array(stored, kind).to_pylist()
        for number, was, now in zip(members, table[column.name].to_pylist(), planned, strict=True):
            if repr(was) != repr(now):
                wrong.append((number, column.name, was, now))
                break
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
    names = [f"{PARTS}/{name}" for name in storage.names(PARTS) if _PART.fullmatch(name)]
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
