"""The outcomes of members whose part is not complete yet, and the journal that keeps them."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Final

from cosim.errors import DatasetError
from cosim.log.contents.metadata import read_json
from cosim.studies.dataset.columns import WARNINGS, MemberRow
from cosim.studies.dataset.layout import PartLayout
from cosim.studies.dataset.storage import DatasetJournal, Storage

JOURNAL: Final = "_journal.jsonl"


class OpenRows:
    """Rows by part and member; what is added is in the journal, too, where there is one.

    Parameters
    ----------
    layout : PartLayout
    journal : DatasetJournal or None
        None: for reading only.
    """

    def __init__(self, layout: PartLayout, journal: DatasetJournal | None = None) -> None:
        self._layout = layout
        self._journal = journal
        self._rows: dict[int, dict[int, MemberRow]] = {}  # by the first member of the part
        self._lines = 0

    def load(self, storage: Storage, columns: Sequence[str]) -> None:
        """Take the rows of the journal; those of format 1 have no warnings.

        Parameters
        ----------
        storage : Storage
        columns : sequence of str
            Their names.

        Raises
        ------
        DatasetError
            If it is damaged elsewhere than in its last line, which a kill may have cut.
        """
        content = storage.read(JOURNAL) or b""
        lines = content[: content.rfind(b"\n") + 1].splitlines()
        for number, line in enumerate(lines, start=1):
            row = _row(line, columns)
            if row is None or not 0 <= row[0] < self._layout.total:
                raise DatasetError(
                    f"{storage.label(JOURNAL)}: line {number} is damaged; remove that line and "
                    "run the study again: its member is rerun"
                )
            part = self._layout.part_of(row[0])
            self._rows.setdefault(part.start, {})[row[0]] = row
        self._lines = len(lines)

    def forget(self, parts: Iterable[int]) -> None:
        """Leave out the rows of parts that are there, given their first members."""
        for first in parts:
            self._rows.pop(first, None)

    def add(self, part: range, row: MemberRow) -> int:
        """Add a row and return how many there are in its part.

        Raises
        ------
        DatasetWriteError
            If it cannot be written to the journal; it is not added then.
        """
        rows = self._rows.get(part.start, {})
        assert row[0] not in rows
        if self._journal is not None:
            self._journal.append(_line(row))
        self._lines += 1
        rows[row[0]] = row
        self._rows[part.start] = rows
        return len(rows)

    def of(self, part: range) -> list[MemberRow]:
        """Return the rows of a part, in the order of members."""
        rows = self._rows.get(part.start, {})
        return [rows[number] for number in sorted(rows)]

    def numbers(self, part: range) -> Collection[int]:
        """Return the members of a part that have a row."""
        return self._rows.get(part.start, {}).keys()

    def firsts(self) -> Iterator[int]:
        """Yield the first member of every part that has rows."""
        yield from self._rows

    def remove(self, part: range) -> None:
        """Drop the rows of a part, which is written now.

        The journal is written anew when more than half of its lines are of parts that are written:
        in all that costs no more than its lines.
        """
        self._rows.pop(part.start, None)
        kept = sum(len(rows) for rows in self._rows.values())
        if self._journal is not None and self._lines > 2 * kept:
            rows = (row for rows in self._rows.values() for row in rows.values())
            self._journal.replace([_line(row) for row in rows])
            self._lines = kept

    def __len__(self) -> int:
        return sum(len(rows) for rows in self._rows.values())

    def close(self) -> None:
        """Close the journal."""
        if self._journal is not None:
            self._journal.close()


def _line(row: MemberRow) -> bytes:
    return (json.dumps(row) + "\n").encode()


def _row(line: bytes, columns: Sequence[str]) -> MemberRow | None:
    """Return the row of a line; None: it is damaged."""
    try:
        row = read_json(line)
    except ValueError:
        return None
    if isinstance(row, list) and len(row) == len(columns) - 1:
        row.insert(columns.index(WARNINGS), None)
    if not isinstance(row, list) or len(row) != len(columns) or type(row[0]) is not int:
        return None
    return row
