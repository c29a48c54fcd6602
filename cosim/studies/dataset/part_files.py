"""Parts of a dataset as Parquet files, and rows as tables.

Numbers are not stored as dictionaries: these would merge both zeros.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, Final

from cosim.errors import DatasetError
from cosim.studies.dataset.columns import (
    WARNINGS,
    MemberRow,
    StudyColumn,
    arrow_schema,
    pyarrow,
)
from cosim.studies.dataset.layout import part_name
from cosim.studies.dataset.open_rows import JOURNAL
from cosim.studies.dataset.storage import Storage

_STUDY: Final = "cosim.study"
_TEXTS: Final = ("string", "json")


class PartFiles:
    """Writes and reads the parts of a dataset.

    Parameters
    ----------
    storage : Storage
    columns : sequence of StudyColumn
        All of them, in order.
    sha256 : str
        Of the study: another's part is refused.
    """

    def __init__(self, storage: Storage, columns: Sequence[StudyColumn], sha256: str) -> None:
        self._storage = storage
        self._columns = columns
        self._sha256 = sha256
        self.schema = arrow_schema(columns, {_STUDY: sha256})

    def table(self, rows: Sequence[MemberRow]) -> Any:
        """Return rows as a table.

        Raises
        ------
        DatasetError
            If one has values of other types, as one that nobody recorded.
        """
        arrow = pyarrow()
        try:
            arrays = [
                arrow.array([row[number] for row in rows], field.type)
                for number, field in enumerate(self.schema)
            ]
        except (arrow.ArrowException, TypeError, ValueError, OverflowError) as error:
            raise DatasetError(
                f"{self._storage.label(JOURNAL)}: a row is damaged; remove the file and run the "
                "study again: its members are rerun"
            ) from error
        return arrow.Table.from_arrays(arrays, schema=self.schema)

    def write(self, part: range, rows: Sequence[MemberRow]) -> None:
        """Write the rows of a part, in the order of its members.

        Raises
        ------
        DatasetWriteError
            If it cannot be written.
        """
        from pyarrow import parquet

        stream = io.BytesIO()
        texts = [column.name for column in self._columns if column.type in _TEXTS]
        options = {"compression": "zstd", "use_dictionary": texts, "write_page_checksum": True}
        parquet.write_table(self.table(rows), stream, **options)
        self._storage.write(part_name(part), stream.getvalue())

    def read(self, part: range, names: Sequence[str]) -> Any:
        """Return columns of a part.

        Raises
        ------
        DatasetError
            If it is damaged, or that of another study.
        """
        from pyarrow import parquet

        arrow = pyarrow()
        name = part_name(part)
        content = self._storage.read(name)
        if content is None:
            raise DatasetError(f"{self._storage.label(name)}: removed while it was being read")
        try:
            file = parquet.ParquetFile(io.BytesIO(content), page_checksum_verification=True)
            self._check_study(name, file.schema_arrow.metadata or {})
            there = file.schema_arrow.names
            lacking = [] if WARNINGS in there else [self.schema.field(WARNINGS)]  # of format 1
            expected = arrow.schema([field for field in self.schema if field not in lacking])
            if not file.schema_arrow.equals(expected):  # whichever columns are asked for
                raise self._damaged(name)
            table = file.read([column for column in names if column in there], use_threads=False)
            for field in lacking:
                table = table.append_column(field, arrow.nulls(len(part), field.type))
            table = table.select(list(names))
            table.validate(full=True)  # texts too
        except (arrow.ArrowException, OSError, KeyError, UnicodeDecodeError) as error:
            raise self._damaged(name) from error
        if len(table) != len(part):
            raise self._damaged(name)
        return table

    def _check_study(self, name: str, metadata: dict[bytes, bytes]) -> None:
        found = metadata.get(_STUDY.encode(), b"").decode(errors="replace")
        if found != self._sha256:
            raise DatasetError(
                f"{self._storage.label(name)} is a part of another study; remove it and run the "
                "study again: its members are rerun"
            )

    def _damaged(self, name: str) -> DatasetError:
        return DatasetError(
            f"{self._storage.label(name)} is damaged; remove it and run the study again: its "
            "members are rerun"
        )
