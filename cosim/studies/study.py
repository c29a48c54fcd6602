"""A study that has been run, or is running, as users read it."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, final

from cosim.errors import UsageError, optional_library
from cosim.studies.contracts import FAILED, StudyMember, member_of
from cosim.studies.dataset import StudyDataset
from cosim.studies.identity import ColumnRole

if TYPE_CHECKING:
    import pandas
    import polars
    import pyarrow


@final
class Study:
    """What the members of a study came to, as it was when the study was opened.

    >>> import cosim
    >>> study = cosim.open_study("studies/tolerances")
    >>> study.metrics
    ('error',)
    >>> study.to_pandas().sort_values("error").tail()

    Parameters
    ----------
    dataset : StudyDataset
    """

    def __init__(self, dataset: StudyDataset) -> None:
        self._dataset = dataset

    @property
    def name(self) -> str:
        """Return the name of the study."""
        return self._dataset.identity.name

    @property
    def text(self) -> str:
        """Return the study as it was written."""
        return self._dataset.identity.text

    @property
    def planned(self) -> int:
        """Return how many members it has in all."""
        return self._dataset.identity.members

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the names of all columns."""
        return tuple(column.name for column in self._dataset.columns)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Return the names of the columns of what is varied."""
        return self._names("parameter")

    @property
    def metrics(self) -> tuple[str, ...]:
        """Return the names of the columns of metrics and results."""
        return self._names("metric")

    @property
    def units(self) -> dict[str, str]:
        """Return the units of the columns that have one."""
        return {column.name: column.unit for column in self._dataset.columns if column.unit}

    @property
    def failures(self) -> dict[int, str]:
        """Return the reason of each member that failed, by number."""
        from pyarrow import compute

        failed = {}
        for table in self._dataset.tables(["member", "status", "reason"]):
            for row in table.filter(compute.equal(table["status"], FAILED)).to_pylist():
                failed[row["member"]] = row["reason"] or ""
        return failed

    @property
    def warnings(self) -> dict[int, list[str]]:
        """Return what each member warns of that does, by number."""
        found = {}
        for table in self._dataset.tables(["member", "warnings"]):
            for row in table.filter(table["warnings"].is_valid()).to_pylist():
                found[row["member"]] = row["warnings"].splitlines()
        return found

    @property
    def logs(self) -> dict[int, str]:
        """Return the path of each log that is kept, by number of its member."""
        return self._dataset.logs()

    def __len__(self) -> int:
        """Return how many members have an outcome, which is the number of rows."""
        return len(self._dataset)

    def __repr__(self) -> str:
        return f"<Study {self.name!r}: {len(self)} of {self.planned} members>"

    def table(
        self, columns: Iterable[str] | None = None, members: Collection[int] | None = None
    ) -> pyarrow.Table:
        """Return a row for each member that has an outcome, in the order of members.

        Parameters
        ----------
        columns : iterable of str, optional
            Without them all, and ``log``: the path of its log that was kept.
        members : collection of int, optional
            Of these only.

        Raises
        ------
        DatasetError
            If a column is unknown, or a file is damaged.
        """
        return self._dataset.read(columns, members)

    def member(self, number: int) -> StudyMember:
        """Return a member that has an outcome, with the parameters that its row has.

        Raises
        ------
        UsageError
            If there is none of that number.
        DatasetError
            If a file is damaged.
        """
        found = self.members([number])
        if not found:
            raise UsageError(
                f"no outcome of member {number}; available: {len(self)} of {self.planned} "
                "members, numbered from 0"
            )
        return found[0]

    def members(self, numbers: Collection[int]) -> list[StudyMember]:
        """Return those of some members that have an outcome, in order, as :meth:`member` does."""
        columns = [column for column in self._dataset.columns if column.role == "parameter"]
        rows = self.table(["member", *self.parameters], members=numbers).to_pylist()
        return [
            member_of(row["member"], {c.name: c.value(row[c.name]) for c in columns})
            for row in rows
        ]

    def to_pandas(self, columns: Iterable[str] | None = None) -> pandas.DataFrame:
        """Return the table as a frame of pandas, indexed by ``member``.

        Raises
        ------
        UsageError
            If there is no pandas.
        DatasetError
            If a column is unknown, or a file is damaged.
        """
        optional_library("pandas", "to_pandas needs", "pandas")
        names = None if columns is None else ["member", *columns]
        return self.table(names).to_pandas().set_index("member")

    def to_polars(self, columns: Iterable[str] | None = None) -> polars.DataFrame:
        """Return the table as a frame of polars.

        Raises
        ------
        UsageError
            If there is no polars.
        DatasetError
            If a column is unknown, or a file is damaged.
        """
        module = optional_library("polars", "to_polars needs", "polars")
        frame: polars.DataFrame = module.from_arrow(self.table(columns))
        return frame

    def _names(self, role: ColumnRole) -> tuple[str, ...]:
        return tuple(column.name for column in self._dataset.columns if column.role == role)


def open_study(place: str | Path) -> Study:
    """Open the dataset of a study for reading, also while the study runs.

    Parameters
    ----------
    place : str or Path
        Its folder, or a URL of fsspec, such as ``s3://bucket/studies/tolerances``.

    Raises
    ------
    DatasetError
        If there is none, or it is damaged.
    """
    return Study(StudyDataset.open(place))
