"""Statistics for each value of a varied key: of a grid with seeds, at each of its points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.errors import UsageError, nearest
from cosim.studies.analysis.columns import MemberColumns, NumberColumn
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.analysis.statistics import MetricStatistics, study_statistics

MOST_GROUPS: Final = 200


@dataclass(frozen=True)
class MemberGroup:
    """The members that have one value of a key.

    Parameters
    ----------
    value : object
        As Python has it.
    members, failed : int
        That are done, and those of them that failed.
    statistics : mapping of metric to MetricStatistics
    """

    value: Any
    members: int
    failed: int
    statistics: Mapping[str, MetricStatistics]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "value": self.value,
            "members": self.members,
            "failed": self.failed,
            "statistics": {name: one.to_dict() for name, one in self.statistics.items()},
        }


def statistics_by(columns: MemberColumns, layout: StudyLayout, key: str) -> list[MemberGroup]:
    """Return the statistics of the members with each value of a key, numbers in ascending order.

    Raises
    ------
    UsageError
        If the key is not varied, or has more than ``MOST_GROUPS`` values, as one that is drawn
        from a continuous distribution.
    """
    if key not in columns.parameters:
        known = list(columns.parameters)
        raise UsageError(f"the study does not vary {key!r}; {nearest(key, known)}")
    values, groups = _groups(columns.parameters[key].tolist())
    if len(values) > MOST_GROUPS:
        raise UsageError(
            f"{key!r}: expected at most {MOST_GROUPS} values, as of a grid key, got {len(values)}"
        )
    found = []
    for value, rows in zip(values, groups, strict=True):
        chosen = np.zeros(len(columns.numbers), np.bool_)
        chosen[rows] = True
        part = columns.only(chosen)
        statistics = study_statistics(part, layout)
        found.append(MemberGroup(value, len(rows), int(part.failed.sum()), statistics))
    return found


def _groups(values: Sequence[Any]) -> tuple[list[Any], list[NumberColumn]]:
    """Return the different values, and the rows of each; lists and texts as they come."""
    places: dict[str, int] = {}
    different: list[Any] = []
    index = np.empty(len(values), np.int64)
    for row, value in enumerate(values):
        text = repr(value)
        if text not in places:
            places[text] = len(different)
            different.append(value)
        index[row] = places[text]
    order = np.argsort(index, kind="stable")
    counts = np.bincount(index, minlength=len(different))
    rows = np.split(order, np.cumsum(counts)[:-1]) if different else []
    if all(isinstance(value, int | float) for value in different):
        ascending = sorted(range(len(different)), key=lambda place: different[place])
        return [different[place] for place in ascending], [rows[place] for place in ascending]
    return different, rows
