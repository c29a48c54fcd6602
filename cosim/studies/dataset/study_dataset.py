"""The dataset of a study, written and read.

::

    study.json        whose dataset it is, and how members are divided into parts
    parts/part-0000000000-0000000999.parquet ...
    _journal.jsonl    outcomes of members whose part is not complete yet
    _lock             held by who writes (in folders)
    logs/7.mcap       logs of members that are kept; made after the study, so no part names them
    _logs.jsonl       how these came to be

An outcome is in the journal first. When the last member of a part has come, the part is written,
and its lines in the journal no longer count. So there is always one place from which the outcome
is read: the part where there is one, else the journal.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self, final

import numpy as np

from cosim.errors import DatasetError, command, flag
from cosim.studies.contracts import FAILED, MemberOutcome, MemberResult, StudyMember
from cosim.studies.dataset.columns import MEMBER, RowMaker, StudyColumn, pyarrow
from cosim.studies.dataset.contents import DatasetContents, recorded_files
from cosim.studies.dataset.design_check import PlannedColumns, check_part
from cosim.studies.dataset.identity import (
    DESCRIPTION,
    DatasetDescription,
    StudyIdentity,
    check_is_dataset,
    differences,
)
from cosim.studies.dataset.layout import PARTS, PartLayout
from cosim.studies.dataset.log_files import LOGS, LogFiles
from cosim.studies.dataset.open_rows import JOURNAL
from cosim.studies.dataset.storage import Storage, open_storage


@final
class StudyDataset:
    """The outcomes of a study; a context manager that closes it.

    Made by :meth:`create`, :meth:`open` and :meth:`open_or_create`.
    """

    def __init__(
        self, storage: Storage, description: DatasetDescription, *, is_writing: bool
    ) -> None:
        self._storage = storage
        self._description = description
        self._maker = RowMaker(description.columns)
        journal = storage.journal(JOURNAL) if is_writing else None
        self._contents = DatasetContents(storage, description, journal)
        self._layout = description.layout
        self._is_writing = is_writing
        if is_writing:
            self._write_complete_parts()

    @staticmethod
    def is_at(place: str | Path) -> bool:
        """Return whether the description of a dataset is there.

        Raises
        ------
        DatasetError
            If it is damaged or out of reach.
        """
        pyarrow()
        return _description(open_storage(place)) is not None

    @classmethod
    def open(cls, place: str | Path, *, sha256: str | None = None) -> Self:
        """Open a dataset for reading, also while a study writes it, or for :meth:`write_part`.

        Parameters
        ----------
        place : str or Path
        sha256 : str, optional
            That of the dataset that is meant: ``dataset.sha256``.

        Raises
        ------
        DatasetError
            If there is none, it is damaged, or another one.
        """
        pyarrow()
        storage = open_storage(place)
        description = _description(storage)
        if description is None:
            raise DatasetError(
                f"{storage.label()}: no {DESCRIPTION} there; expected the dataset of a study, as "
                f"written by {command('study')}"
            )
        if sha256 is not None and sha256 != description.sha256:
            raise DatasetError(
                f"{storage.label()} now holds the dataset of another study; use one folder per "
                "study"
            )
        return cls(storage, description, is_writing=False)

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
            The planned values of the parameters: see :meth:`check_design`.
        new : bool
            Remove the dataset that is there first: files of a dataset only.

        Raises
        ------
        DatasetError
            If another study's is there, it is damaged, or another process writes there.
        """
        pyarrow()
        fresh = DatasetDescription.of(identity)
        _ = fresh.columns  # two of one name are refused before anything is made
        storage = open_storage(place)
        storage.lock()
        try:
            if new:
                check_is_dataset(storage.read(DESCRIPTION), storage.label(DESCRIPTION))
                _remove(storage)
            recorded = _description(storage)
            if recorded is None:
                _check_empty(storage)
                description = fresh
            else:
                description = _grown(cls, storage, recorded, identity, design)
            if description != recorded:
                storage.write(DESCRIPTION, description.to_json())
            return cls(storage, description, is_writing=True)
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
        _grown(cls, dataset._storage, dataset._description, identity, design)

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
        """Release the lock; the journal keeps what has no part yet. Twice does no harm."""
        if self._is_writing:
            self._is_writing = False
            try:
                self._contents.open.close()
            finally:
                self._storage.close()

    @property
    def label(self) -> str:
        """Return its place."""
        return self._storage.label()

    @property
    def identity(self) -> StudyIdentity:
        """Return what the study is about, as it was planned last."""
        return self._description.identity

    @property
    def sha256(self) -> str:
        """Return what tells it from the datasets of other studies."""
        return self._description.sha256

    @property
    def columns(self) -> tuple[StudyColumn, ...]:
        """Return the columns of a part, in order."""
        return self._description.columns

    @property
    def layout(self) -> PartLayout:
        """Return how members are divided into parts."""
        return self._layout

    def __len__(self) -> int:
        """Return how many members have an outcome."""
        return len(self._contents)

    @property
    def failed(self) -> int:
        """Return how many members have failed."""
        if not len(self):
            return 0
        from pyarrow import compute  # takes as long as ten members

        count = 0
        for table in self._contents.tables(["status"]):
            count += compute.sum(compute.equal(table["status"], FAILED)).as_py() or 0
        return count

    # --- writing ---

    def missing(self, total: int | None = None) -> list[range]:
        """Return the members without an outcome, as ranges in order.

        Parameters
        ----------
        total : int, optional
            Of the first so many members; without it, of all that are planned.
        """
        return self._contents.missing(self._layout.total if total is None else total)

    def empty_parts(self) -> list[range]:
        """Return the members of every part without any outcome: what a task can write whole."""
        begun = {*self._contents.parts, *self._contents.open.firsts()}
        return [part for part in self._layout.parts() if part.start not in begun]

    def add(self, member: StudyMember, outcome: MemberOutcome) -> None:
        """Add the outcome of a member that has none; its part is written when it is complete.

        Raises
        ------
        DatasetWriteError
            If it cannot be written; what was written before is there.
        """
        assert self._is_writing
        assert member.number == outcome.number
        part = self._layout.part_of(member.number)
        assert part.start not in self._contents.parts
        count = self._contents.open.add(part, self._maker.row(member, outcome))
        if count == len(part):
            self._write(part)

    def write_part(self, first: int, results: Iterable[MemberResult]) -> None:
        """Write a part of which a task has run all members; done twice it replaces itself.

        Parameters
        ----------
        first : int
            Its first member.
        results : iterable of (StudyMember, MemberOutcome)
            One of each member of the part, in any order.

        Raises
        ------
        DatasetWriteError
            If it cannot be written.
        """
        part = self._layout.part_of(first)
        rows = {member.number: self._maker.row(member, outcome) for member, outcome in results}
        assert sorted(rows) == list(part)
        self._contents.files.write(part, [rows[number] for number in part])
        self.note_part(first)

    def note_part(self, first: int) -> None:
        """Take notice of a part that a task elsewhere has written."""
        part = self._layout.part_of(first)
        self._contents.parts[part.start] = part
        self._contents.open.remove(part)

    def check_design(self, design: PlannedColumns) -> None:
        """Check that recorded members have the parameters that are planned for their numbers.

        Parameters
        ----------
        design : PlannedColumns
            Such as the study's design.

        Raises
        ------
        DatasetError
            If one has others; names the first, and its parameter.
        """
        parameters = [column for column in self.columns if column.role == "parameter"]
        names = [MEMBER, *(column.name for column in parameters)]
        for table in self._contents.tables(names):
            check_part(self.label, parameters, table, design)

    def _write(self, part: range) -> None:
        self._contents.files.write(part, self._contents.open.of(part))
        self.note_part(part.start)

    def _write_complete_parts(self) -> None:
        """Write parts that are complete in the journal: a kill or a full disk left them so."""
        for first in list(self._contents.open.firsts()):
            part = self._layout.part_of(first)
            if len(self._contents.open.of(part)) == len(part):
                self._write(part)

    # --- reading ---

    def read(
        self,
        columns: Iterable[str] | None = None,
        members: Collection[int] | None = None,
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
        return self._contents.read(columns, members)

    def tables(
        self, columns: Iterable[str] | None = None, members: Collection[int] | None = None
    ) -> Iterator[Any]:
        """Yield what :meth:`read` returns part by part, in memory for one of them.

        Raises
        ------
        DatasetError
            If a column is unknown, or a part is damaged.
        """
        chosen = None if members is None else np.asarray(members, np.int64)
        yield from self._contents.tables(self._contents.names(columns), chosen)

    def row_of(self, member: StudyMember, outcome: MemberOutcome) -> dict[str, Any]:
        """Return the row of an outcome as it would be read when it was added; nothing is."""
        table = self._contents.files.table([self._maker.row(member, outcome)])
        (row,) = table.to_pylist()
        return dict(row)

    def log_files(self) -> LogFiles:
        """Return the logs that are kept, for who writes them."""
        return LogFiles(self._storage)

    def logs(self) -> dict[int, str]:
        """Return the places of the logs that are kept, by member."""
        return self._contents.logs()


def _description(storage: Storage) -> DatasetDescription | None:
    content = storage.read(DESCRIPTION)
    if content is None:
        return None
    return DatasetDescription.from_json(content, storage.label(DESCRIPTION))


def _check_empty(storage: Storage) -> None:
    """Check that there are no files of a dataset of which nobody knows whose it is.

    Raises
    ------
    DatasetError
        If there are.
    """
    found = recorded_files(storage)
    if found:
        raise DatasetError(
            f"{storage.label(found[0])} belongs to a dataset, but no {DESCRIPTION} says to which; "
            f"choose another folder, or use {flag('new')} to delete it and start over"
        )


def _grown(
    kind: type[StudyDataset],
    storage: Storage,
    recorded: DatasetDescription,
    identity: StudyIdentity,
    design: PlannedColumns | None,
) -> DatasetDescription:
    """Return the description of a dataset that goes on with a study.

    Raises
    ------
    DatasetError
        If it is of another study, or its members are.
    """
    found = differences(recorded.identity, identity)
    if found:
        raise DatasetError(
            f"{storage.label()} holds the dataset of another study: {found}; choose another "
            f"folder, or use {flag('new')} to delete it and start over"
        )
    DatasetContents(storage, recorded).check_total(identity.members)
    if design is not None:
        kind(storage, recorded, is_writing=False).check_design(design)
    return recorded.grown(identity)


def _remove(storage: Storage) -> None:
    """Remove the files of a dataset, whosever it is, and no others.

    The description goes last: until then what is left is a dataset.
    """
    storage.remove([*recorded_files(storage), DESCRIPTION], [PARTS, LOGS])
