"""The members that failed, by reason, and those that warn, by warning."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.arrays import Mask
from cosim.studies.analysis.columns import MemberColumns, NumberColumn, count_text

_NUMBER: Final = re.compile(r"[-+]?\d+(\.\d*)?([eE][-+]?\d+)?")
_MOST_MEMBERS: Final = 20  # that are listed in JSON
MOST_TEXTS: Final = 10  # of warnings, in lines


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
    return _of_reasons(columns, columns.failed)


def ends_by_reason(columns: MemberColumns) -> list[ReasonGroup]:
    """Return the members that were completed and ended before their stop, as the failures."""
    return _of_reasons(columns, ~columns.failed)


def warnings_by_text(columns: MemberColumns) -> list[ReasonGroup]:
    """Return the members that warn, as the failures; one with several warnings is in several."""
    pairs = []
    for number, lines in zip(columns.numbers.tolist(), columns.warnings, strict=True):
        pairs += [(number, line) for line in lines.splitlines()]
    return grouped(pairs)


def warning_lines(groups: Sequence[ReasonGroup], count: int) -> list[str]:
    """Return lines such as ``12 of 200 members warn, such as 7: observer: ...``.

    Parameters
    ----------
    groups : sequence of ReasonGroup
    count : int
        Of all members.
    """
    lines = []
    for group in groups[:MOST_TEXTS]:
        own = len(group.numbers)
        warn = "warns," if own == 1 else "warn, such as"
        lines.append(f"{own} of {count_text(count)} {warn} {group.numbers[0]}: {group.reason}")
    if len(groups) > MOST_TEXTS:
        lines.append(f"{len(groups) - MOST_TEXTS} more warnings; see the column 'warnings'")
    return lines


def _of_reasons(columns: MemberColumns, rows: Mask) -> list[ReasonGroup]:
    pairs = []
    for row in np.flatnonzero(rows).tolist():
        reason = columns.reasons[row]
        if reason or columns.failed[row]:
            pairs.append((int(columns.numbers[row]), reason))
    return grouped(pairs)


def grouped(pairs: Iterable[tuple[int, str]]) -> list[ReasonGroup]:
    """Return members with a text, in ascending order, by text but for the numbers in it."""
    members: dict[str, dict[int, None]] = {}
    texts: dict[str, str] = {}
    pattern = _remembered(lambda text: _NUMBER.sub("#", text))
    for number, text in pairs:
        kind = pattern(text)
        texts.setdefault(kind, text)
        members.setdefault(kind, {})[number] = None
    groups = []
    for kind, numbers in members.items():
        groups.append(ReasonGroup(texts[kind], np.array(list(numbers), np.int64)))
    return sorted(groups, key=lambda group: -len(group.numbers))


def _remembered(function: Callable[[str], str]) -> Callable[[str], str]:
    """Return a function that computes each value once: many members have one reason."""
    known: dict[str, str] = {}

    def remembered(text: str) -> str:
        if text not in known:
            known[text] = function(text)
        return known[text]

    return remembered
