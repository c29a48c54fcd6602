"""The members of a study by number, as columns: a million of them take little memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np

from cosim.errors import UsageError
from cosim.scenario.recordings.replaying import texts_in
from cosim.studies.contracts import RECORDING, SWAP, StudyMember
from cosim.studies.design.columns import (
    ColumnValues,
    DesignColumn,
    GridColumn,
    MemberLayout,
    SampleColumn,
    plain_values,
)
from cosim.studies.document.study_file import StudyFile

SampleKind: TypeAlias = Literal["grid", "cases", "random", "latin-hypercube", "sobol", "saltelli"]


@dataclass(frozen=True, slots=True)
class StudyDesign:
    """The members of a study.

    Parameters
    ----------
    study : StudyFile
    kind : {"grid", "cases", "random", "latin-hypercube", "sobol", "saltelli"}
        What its samples are; a grid has none.
    layout : MemberLayout
        How members are numbered.
    columns : mapping of name to DesignColumn
        By dotted key; ``swap.plant`` of a swap, ``recording`` of the log.
    sampled : tuple of str
        The names of those that are drawn, in the order of their dimensions.
    """

    study: StudyFile
    kind: SampleKind
    layout: MemberLayout
    columns: Mapping[str, DesignColumn] = field(repr=False)
    sampled: tuple[str, ...] = ()

    def __len__(self) -> int:
        return self.layout.members

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the columns."""
        return tuple(self.columns)

    def column(self, name: str, begin: int = 0, end: int | None = None) -> ColumnValues:
        """Return a column, or the part of it from one member to another (not included).

        Floats and integers are an array, other values a list; None: the member has the scenario's
        own value.
        """
        return self.columns[name].take(self.layout, self._numbers(begin, end))

    def texts(self) -> set[str]:
        """Return all texts that members have as values, each once."""
        texts: set[str] = set()
        for column in self.columns.values():
            if isinstance(column, GridColumn | SampleColumn) and isinstance(column.values, list):
                texts |= texts_in(column.values)
        return texts

    def member(self, number: int) -> StudyMember:
        """Return a member.

        Raises
        ------
        UsageError
            If there is none of that number.
        """
        if not 0 <= number < len(self):
            raise UsageError(f"no member {number}; the study has {len(self)}, numbered from 0")
        (member,) = self.members(number, number + 1)
        return member

    def members(self, begin: int = 0, end: int | None = None) -> list[StudyMember]:
        """Return the members from one number to another (not included)."""
        numbers = self._numbers(begin, end)
        columns = []
        for column in self.columns.values():
            columns.append(plain_values(column.take(self.layout, numbers)))
        rows = zip(*columns, strict=True) if columns else ((),) * len(numbers)
        return [
            _member(number, dict(zip(self.columns, row, strict=True)))
            for number, row in zip(numbers.tolist(), rows, strict=True)
        ]

    def _numbers(self, begin: int, end: int | None) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        last = len(self) if end is None else min(end, len(self))
        return np.arange(max(0, begin), last, dtype=np.int64)


def _member(number: int, values: dict[str, Any]) -> StudyMember:
    recording = values.pop(RECORDING, None)
    changes: dict[str, Any] = {}
    swaps: dict[str, str] = {}
    for name, value in values.items():
        if value is None:
            continue
        if name.startswith(SWAP):
            swaps[name.removeprefix(SWAP)] = value
        else:
            changes[name] = value
    return StudyMember(number, changes, swaps, recording)
