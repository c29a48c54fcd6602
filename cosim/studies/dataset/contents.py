"""What a dataset holds: parts, and the rows whose part is not complete, read as one table."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, final

import numpy as np

from cosim.errors import DatasetError, flag, nearest
from cosim.studies.dataset.columns import LOG, MEMBER, pyarrow
from cosim.studies.dataset.identity import DatasetDescription
from cosim.studies.dataset.layout import PARTS, PartLayout, part_members
from cosim.studies.dataset.log_files import log_names, log_places
from cosim.studies.dataset.open_rows import JOURNAL, OpenRows
from cosim.studies.dataset.part_files import PartFiles
from cosim.studies.dataset.storage import DatasetJournal, Storage


@final
class DatasetContents:
    """The outcomes that are recorded, by parts.

    Parameters
    ----------
    storage : Storage
    description : DatasetDescription
    journal : DatasetJournal or None
        Where rows are to be added.

    Raises
    ------
    DatasetError
        If it is damaged.
    """

    def __init__(
        self,
        storage: Storage,
        description: DatasetDescription,
        journal: DatasetJournal | None = None,
    ) -> None:
        columns = description.columns
        self._storage = storage
        self.layout = description.layout
        self.files = PartFiles(storage, columns, description.sha256)
        self.open = OpenRows(self.layout, journal)
        # The journal first: a row that moves into a part meanwhile is in both, not in neither.
        self.open.load(storage, [column.name for column in columns])
        self.parts = _recorded_parts(storage, self.layout)
        self.open.forget(self.parts)

    def __len__(self) -> int:
        """Return how many members have an outcome."""
        return sum(len(part) for part in self.parts.values()) + len(self.open)

    def missing(self, total: int) -> list[range]:
        """Return those of the first ``total`` members that have no outcome."""
        found: list[range] = []
        for part in self.layout.parts():
            if part.start >= total:
                break
            for absent in self._missing_of(part):
                _join(found, range(absent.start, min(absent.stop, total)))
        return [absent for absent in found if absent]

    def check_total(self, total: int) -> None:
        """Check that no member from ``total`` on has an outcome.

        Raises
        ------
        DatasetError
            If one has.
        """
        last = -1
        for first in self._firsts():
            part = self.layout.part_of(first)
            last = part.stop - 1 if first in self.parts else self.open.of(part)[-1][0]
        if last >= total:
            raise DatasetError(
                f"{self._storage.label()}: member {last} is recorded, but only {total} members "
                "are planned; a study can only grow: plan at least as many, choose another "
                f"folder, or use {flag('new')} to delete the dataset and start over"
            )

    def names(self, columns: Iterable[str] | None) -> list[str]:
        """Return the names of columns to read.

        Raises
        ------
        DatasetError
            If one is unknown.
        """
        known = [*self.files.schema.names, LOG]
        if columns is None:
            return known
        names = list(columns)
        for name in names:
            if name not in known:
                raise DatasetError(
                    f"{self._storage.label()}: there is no column {name!r}; {nearest(name, known)}"
                )
        return names

    def read(self, columns: Iterable[str] | None, members: Collection[int] | None) -> Any:
        """Return columns of members as one table, in the order of members."""
        arrow = pyarrow()
        names = self.names(columns)
        chosen = None if members is None else np.asarray(list(members), np.int64)
        tables = list(self.tables(names, chosen))
        return arrow.concat_tables([self._schema(names).empty_table(), *tables])

    def tables(self, names: list[str], members: Any = None) -> Iterator[Any]:
        """Yield columns of the members of each part, in order: little memory is needed.

        Parameters
        ----------
        names : list of str
        members : array of int64, optional
            Of these only.

        Raises
        ------
        DatasetError
            If a part is damaged.
        """
        arrow = pyarrow()
        stored = list(dict.fromkeys([MEMBER, *(name for name in names if name != LOG)]))
        logs = self.logs() if LOG in names else {}
        schema = self._schema(names)
        for first in self._firsts():
            part = self.layout.part_of(first)
            if members is not None and not np.any((members >= first) & (members < part.stop)):
                continue
            table = self._part_table(part, stored)
            if members is not None:
                table = table.filter(arrow.array(np.isin(table[MEMBER].to_numpy(), members)))
            columns = [
                _log_column(table[MEMBER], logs) if name == LOG else table[name] for name in names
            ]
            yield arrow.Table.from_arrays(columns, schema=schema)

    def logs(self) -> dict[int, str]:
        """Return the paths of the logs that are kept, by member."""
        return log_places(self._storage)

    def _part_table(self, part: range, names: list[str]) -> Any:
        if part.start in self.parts:
            return self.files.read(part, names)
        return self.files.table(self.open.of(part)).select(names)

    def _firsts(self) -> list[int]:
        """Return the first member of every part of which something is recorded, in order."""
        return sorted({*self.parts, *self.open.firsts()})

    def _schema(self, names: Iterable[str]) -> Any:
        arrow = pyarrow()
        log = arrow.field(LOG, arrow.string())
        schema = self.files.schema
        return arrow.schema([log if name == LOG else schema.field(name) for name in names])

    def _missing_of(self, part: range) -> Iterator[range]:
        if part.start in self.parts:
            return
        present = self.open.numbers(part)
        if not present:
            yield part
            return
        for number in part:
            if number not in present:
                yield range(number, number + 1)


def _log_column(members: Any, logs: Mapping[int, str]) -> Any:
    """Return the place of the log of each member, null where there is none."""
    from pyarrow import compute

    arrow = pyarrow()
    places = arrow.array(list(logs.values()), arrow.string())
    rows = compute.index_in(members, value_set=arrow.array(list(logs), arrow.int64()))
    return places.take(rows)


def recorded_files(storage: Storage) -> list[str]:
    """Return the names of all files that hold outcomes or logs, whosever they are."""
    names = [f"{PARTS}/{name}" for name in storage.names(PARTS) if part_members(name)]
    names += log_names(storage)
    names += [JOURNAL] if JOURNAL in storage.names("") else []
    return names


def _recorded_parts(storage: Storage, layout: PartLayout) -> dict[int, range]:
    """Return the parts that are there, by their first members.

    Raises
    ------
    DatasetError
        If one is not a part of this division.
    """
    found = {}
    for name in storage.names(PARTS):
        part = part_members(name)
        if part is None:
            continue
        if part.start >= layout.total or layout.part_of(part.start) != part:
            raise DatasetError(
                f"{storage.label(f'{PARTS}/{name}')}: not a part of this dataset; remove it and "
                "run the study again"
            )
        found[part.start] = part
    return found


def _join(ranges: list[range], added: range) -> None:
    """Add a range behind the others, to the last one where they touch."""
    if ranges and ranges[-1].stop == added.start:
        ranges[-1] = range(ranges[-1].start, added.stop)
    else:
        ranges.append(added)
