"""The members that failed, by reason."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.arrays import Mask
from cosim.studies.analysis.columns import MemberColumns, NumberColumn

_NUMBER: Final = re.compile(r"[-+]?\d+(\.\d*)?([eE][-+]?\d+)?")
_MOST_MEMBERS: Final = 20  # that are listed in JSON


@dataclass(frozen=True)
class ReasonGroup:
    """Members with one reason, but for the numbers in it.

    Parameters
    ----------
    reason : str
        Of the first of them.
    numbers : NumberColumn
        Ascending.
    """

    reason: str
    numbers: NumberColumn

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "reason": self.reason,
            "count": len(self.numbers),
            "first_members": self.numbers[:_MOST_MEMBERS].tolist(),
        }


def failures_by_reason(columns: MemberColumns) -> list[ReasonGroup]:
    """Return the members that failed, the most frequent reason first.

    Reasons that differ in numbers only, such as an instant, are one.
    """
    return _groups(columns, columns.failed)


def ends_by_reason(columns: MemberColumns) -> list[ReasonGroup]:
    """Return the members that were completed and ended before their stop, as the failures."""
    return _groups(columns, ~columns.failed)


def _groups(columns: MemberColumns, rows: Mask) -> list[ReasonGroup]:
    members: dict[str, list[int]] = {}
    reasons: dict[str, str] = {}
    pattern = _remembered(lambda reason: _NUMBER.sub("#", reason))
    for row in np.flatnonzero(rows).tolist():
        reason = columns.reasons[row]
        if not reason and not columns.failed[row]:
            continue
        kind = pattern(reason)
        reasons.setdefault(kind, reason)
        members.setdefault(kind, []).append(int(columns.numbers[row]))
    groups = []
    for kind, numbers in members.items():
        groups.append(ReasonGroup(reasons[kind], np.array(numbers, np.int64)))
    return sorted(groups, key=lambda group: -len(group.numbers))


def _remembered(function: Callable[[str], str]) -> Callable[[str], str]:
    """Return a function that computes each value once: many members have one reason."""
    known: dict[str, str] = {}

    def remembered(text: str) -> str:
        if text not in known:
            known[text] = function(text)
        return known[text]

    return remembered
