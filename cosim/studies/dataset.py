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
import zlib
from bisect import bisect, insort
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Final, NamedTuple, Self, TypeAlias, final

import numpy as np

from cosim.errors import DatasetError, command, flag, nearest, optional_library, quoted
from cosim.log.metadata import read_json
from cosim.studies.contracts import RECORDING, SWAP, MemberOutcome, StudyMember
from cosim.studies.identity import LOG, MEMBER, StudyColumn, StudyIdentity, differences
from cosim.studies.storage import Storage

PART_SIZE: Final = 1000
DESCRIPTION: Final = "study.json"
JOURNAL: Final = "_journal.jsonl"
PARTS: Final = "parts"
LOGS: Final = "logs"
_PART: Final = re.compile(r"part-(\d+)-(\d+)-([0-9a-f]{8})\.parquet")
_LOG: Final = re.compile(r"(\d+)\.(mcap|txt)")

# the planned values of a parameter, from one member to another (not included)
PlannedColumn: TypeAlias = Callable[[str, int, int], Any]


class _PartFile(NamedTuple):
    first: int
    last: int
    name: str


@final
class StudyDataset:
    """The outcomes of a study; a context manager that closes it.

    Made by :meth:`open`, and for writing by :meth:`open_or_create`.
    """

    def __init__(self, storage: Storage, identity: StudyIdentity, *, writes: bool) -> None:
        self.storage = storage
        self.identity = identity
        self.columns = identity.all_columns
        self._schema = _arrow_schema(self.columns)
        self._writes = writes
        # the journal before the parts: its lines end when they are in one
        rows = self._read_journal()
        found = map(_PART.fullmatch, storage.names(PARTS))
        self._parts = sorted(_PartFile(int(p[1]), int(p[2]), p[0]) for p in found if p is not None)
        self._rows = {number: row for number, row in rows.items() if not self._is_in_part(number)}
        if writes:
            for number in sorted(self._rows):
                if number in self._rows:
                    self._write_if_complete(number)
            self._write_journal()

    @staticmethod
    def is_at(place: str | Path) -> bool:
        """Return whether the description of a dataset is there."""
        return Storage(place).read(DESCRIPTION) is not None

    @classmethod
    def open(cls, place: str | Path) -> Self:
        """Open a dataset for reading, also while a study writes it.

        Raises
        ------
        DatasetError
            If there is none, or it is damaged.
        """
        storage = Storage(place)
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
        planned: PlannedColumn | None = None,
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
        planned : callable, optional
            Returns the planned values of a parameter, which those of recorded members have to be.
        new : bool
            Remove the dataset that is there first: files of a dataset only.

        Raises
        ------
        DatasetError
            If another study's is there, it is damaged, or another process writes there.
        """
        storage = Storage(place)
        try:
            storage.lock()
            if new:
                _remove(storage)
            recorded = _recorded(storage)
            if recorded is not None:
                identity = cls(storage, recorded, writes=False).grown(identity, planned)
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

    def grown(self, identity: StudyIdentity, planned: PlannedColumn | None = None) -> StudyIdentity:
        """Return the identity that this dataset has when it goes on with a study.

        Raises
        ------
        DatasetError
            If it is of another study, or its members are.
        """
        label = self.storage.label()
        otherwise = f"choose another folder, or use {flag('new')} to delete it and start over"
        found = differences(self.identity, identity)
        if found:
            raise DatasetError(f"{label} holds the dataset of another study: {found}; {otherwise}")
        last = max([*self._rows, *(part.last for part in self._parts)], default=-1)
        if last >= identity.members:
            raise DatasetError(
                f"{label}: member {last} is recorded, but only {identity.members} members are "
                f"planned; a study can only grow: plan at least as many, {otherwise}"
            )
        columns = [column for column in self.columns if column.role == "parameter"]
        for table in self.tables([MEMBER, *(column.name for column in columns)]):
            wrong = "" if planned is None else next(_renumbered(table, columns, planned), "")
            if wrong:
                raise DatasetError(
                    f"{label}: {wrong}; members keep their numbers where random or Sobol samples, "
                    "or cases, are appended; without these, seeds; without seeds, values at the "
                    f"end of the first key of the grid: do that, {otherwise}"
                )
        own = self.identity
        digests = {**own.digests, **identity.digests}
        return replace(identity, digests=digests, columns=own.columns, salt=own.salt)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Let others write; twice does no harm."""
        self._writes = False
        self.storage.close()

    def __len__(self) -> int:
        """Return how many members have an outcome."""
        return sum(part.last - part.first + 1 for part in self._parts) + len(self._rows)

    def missing(self) -> list[range]:
        """Return the members without an outcome, as ranges in order."""
        total = self.identity.members
        there = [(part.first, part.last) for part in self._parts]
        there += [(number, number) for number in self._rows]
        found = []
        begin = 0
        for first, last in [*sorted(there), (total, total)]:
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
        self.storage.append(JOURNAL, self._line(row))
        self._rows[number] = row
        if self._write_if_complete(number):
            self._write_journal()

    def _write_if_complete(self, number: int) -> bool:
        """Write the part of a member: between those that are there, in a thousand of its own."""
        place = bisect(self._parts, (number,))
        begin = number - number % PART_SIZE
        end = min(begin + PART_SIZE, self.identity.members)
        begin = max([begin, *(part.last + 1 for part in self._parts[max(place - 1, 0) : place])])
        end = min([end, *(part.first for part in self._parts[place : place + 1])])
        if not all(other in self._rows for other in reversed(range(begin, end))):
            return False
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
        return True

    def _write_journal(self) -> None:
        self.storage.write(JOURNAL, b"".join(map(self._line, self._rows.values())))

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
        tables = self.tables(schema.names, members)
        return optional_library("pyarrow").concat_tables([schema.empty_table(), *tables])

    def tables(
        self, columns: Iterable[str] | None = None, members: Collection[int] | None = None
    ) -> Iterator[Any]:
        """Yield what :meth:`read` returns part by part, in memory for one of them."""
        arrow = optional_library("pyarrow")
        schema = self._chosen(columns)
        names = [MEMBER, *(name for name in schema.names if name not in (MEMBER, LOG))]
        chosen = None if members is None else np.asarray(list(members), np.int64)
        logs = self.logs() if LOG in schema.names else {}
        pieces: list[tuple[int, int, Callable[[], Any]]] = [
            (part.first, part.last, partial(self._read_part, part.name, names))
            for part in self._parts
        ]
        between = groupby(sorted(self._rows), lambda number: bisect(self._parts, (number,)))
        for own in ([self._rows[number] for number in numbers] for _, numbers in between):
            pieces.append((own[0][MEMBER], own[-1][MEMBER], partial(self._table, own)))
        for first, last, table in sorted(pieces, key=itemgetter(0)):
            if chosen is not None and not ((first <= chosen) & (chosen <= last)).any():
                continue
            rows = table()
            if chosen is not None:
                rows = rows.filter(arrow.array(np.isin(rows[MEMBER].to_numpy(), chosen)))
            places = [logs.get(number) for number in rows[MEMBER].to_pylist()]
            rows = rows.append_column(LOG, arrow.array(places, arrow.string()))
            yield rows.select(schema.names).cast(schema)

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
            if column.role == "parameter":
                row[column.name] = column.stored(given.get(column.name))
                continue
            value = others.get(column.name)
            if value is None or isinstance(value, str) is (column.type == "string"):
                others.pop(column.name, None)
                row[column.name] = None if value != value else value
        return row | {
            "status": outcome.status,
            "reason": _plain(outcome.reason),
            "warnings": _plain("\n".join(outcome.warnings)),
            "steps": outcome.steps,
            "wall_time": outcome.wall_time,
            "worker": _plain(outcome.worker),
            "other_results": json.dumps(others, ensure_ascii=False) if others else None,
        }

    def _table(self, rows: Iterable[Mapping[str, Any]]) -> Any:
        return optional_library("pyarrow").Table.from_pylist(list(rows), schema=self._schema)

    def _line(self, row: Mapping[str, Any]) -> bytes:
        text = json.dumps(row)
        return f'["{self._checksum(text.encode())}", {text}]\n'.encode()

    def _checksum(self, content: bytes) -> str:
        return f"{zlib.crc32(content, zlib.crc32(self.identity.salt.encode())):08x}"

    def _read_journal(self) -> dict[int, dict[str, Any]]:
        """Return the rows of the journal; a kill may have cut the last line, which is dropped."""
        rows = {}
        lines = (self.storage.read(JOURNAL) or b"").split(b"\n")[:-1]
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

        path = f"{PARTS}/{name}"
        content = self.storage.read(path)
        if content is None or not name.endswith(f"{self._checksum(content)}.parquet"):
            what = "removed while it was read" if content is None else "damaged, or of another one"
            raise DatasetError(
                f"{self.storage.label(path)}: {what}; remove it and run the study again: its "
                "members are rerun"
            )
        return parquet.read_table(io.BytesIO(content), columns=columns, use_threads=False)

    def _is_in_part(self, number: int) -> bool:
        place = bisect(self._parts, (number, math.inf))
        return place > 0 and number <= self._parts[place - 1].last

    def _chosen(self, columns: Iterable[str] | None) -> Any:
        """Return the schema of some columns."""
        arrow = optional_library("pyarrow")
        schema = self._schema.append(arrow.field(LOG, arrow.string()))
        names = schema.names if columns is None else list(columns)
        for name in names:
            if name not in schema.names:
                raise DatasetError(
                    f"{self.storage.label()}: there is no column {name!r}; "
                    f"{nearest(name, schema.names)}"
                )
        return arrow.schema([schema.field(name) for name in names])


def _plain(text: str) -> str | None:
    """Return a text as a column has it: of Unicode, or none."""
    return text.encode(errors="backslashreplace").decode() or None


def _renumbered(
    table: Any, columns: Iterable[StudyColumn], planned: PlannedColumn
) -> Iterator[str]:
    """Yield which members have not, bit for bit, the values that are planned for their numbers."""
    members = table[MEMBER].to_pylist()
    for column in columns:
        found = planned(column.name, members[0], members[-1] + 1)
        values = found.tolist() if isinstance(found, np.ndarray) else found
        stored = [column.stored(values[number - members[0]]) for number in members]
        again = (
            optional_library("pyarrow")
            .array(stored, table.schema.field(column.name).type)
            .to_pylist()
        )
        for number, was, now in zip(members, table[column.name].to_pylist(), again, strict=True):
            if repr(was) != repr(now):
                yield f"member {number} was {column.name} = {quoted(was)}, is {quoted(now)}"


def _arrow_schema(columns: Iterable[StudyColumn]) -> Any:
    arrow = optional_library("pyarrow")
    fields = []
    for column in columns:
        kind = arrow.list_(arrow.float64())
        if column.type != "list<double>":
            kind = arrow.type_for_alias("string" if column.type == "json" else column.type)
        about = {"role": column.role, "unit": column.unit, "text": column.text}
        kept = {key: text for key, text in about.items() if text}
        fields.append(arrow.field(column.name, kind, column.name != MEMBER, metadata=kept))
    return arrow.schema(fields)


def _recorded(storage: Storage) -> StudyIdentity | None:
    """Return whose dataset is there; None: there is none."""
    content = storage.read(DESCRIPTION)
    return None if content is None else StudyIdentity.read(content, storage.label(DESCRIPTION))


def _files(storage: Storage) -> list[str]:
    """Return the files of a dataset that are there, but its description."""
    names = [f"{PARTS}/{name}" for name in sorted(storage.names(PARTS)) if _PART.fullmatch(name)]
    names += [f"{LOGS}/{name}" for name in storage.names(LOGS) if _LOG.fullmatch(name)]
    return names + [name for name in storage.names() if name == JOURNAL]


def _remove(storage: Storage) -> None:
    """Remove the files of a dataset, whosever it is, and no others; the description last."""
    content = storage.read(DESCRIPTION)
    if content is not None and b'"checksum"' not in content:
        raise DatasetError(
            f"{storage.label(DESCRIPTION)} is not that of a dataset; choose another folder, or "
            "remove it"
        )
    storage.remove([*_files(storage), DESCRIPTION])
