"""How many members pass a condition such as ``rms < 0.1 and settling <= 2``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.arrays import Mask
from cosim.errors import UsageError, quoted
from cosim.studies.analysis.columns import MemberColumns, NumberColumn
from cosim.studies.analysis.confidence import (
    NO_INTERVAL,
    ConfidenceInterval,
    effective_count,
    proportion_interval,
)
from cosim.studies.analysis.independence import StudyLayout, drawn_members, independence_of
from cosim.studies.metrics import COMPARISONS

_COMPARISONS: Final = dict(COMPARISONS.values())
_PART: Final = re.compile(r"\s*(.+?)\s*(<=|>=|==|!=|<|>)\s*(.+?)\s*")
_MOST_MEMBERS: Final = 20  # that are listed in JSON


@dataclass(frozen=True, slots=True)
class PassCondition:
    """A metric compared with a number or a text.

    Parameters
    ----------
    metric : str
    comparison : str
    value : float or str
    """

    metric: str
    comparison: str
    value: float | str

    def passed(self, columns: MemberColumns) -> Mask:
        """Return which members pass; one that failed, or has no value, does not."""
        compare = _COMPARISONS[self.comparison]
        if isinstance(self.value, str):
            is_text = columns.is_text(self.metric) & ~columns.failed
            raw = columns.raw_metrics[self.metric]
            return is_text & np.fromiter((compare(v, self.value) for v in raw), np.bool_, len(raw))
        numbers = columns.numeric(self.metric)
        return np.asarray(compare(numbers, self.value) & ~np.isnan(numbers), np.bool_)


@dataclass(frozen=True)
class PassedShare:
    """The share of members that pass.

    Parameters
    ----------
    condition : str
    passed, of : int
        Of the members that are done.
    failed, without_value : int
        Those that do not pass because they failed, or have no value for a metric of the condition.
    interval : ConfidenceInterval
        Of the share, 95 %.
    basis : str
        What the interval rests on, or why there is none.
    not_passed : NumberColumn
        The members that do not pass.
    """

    condition: str
    passed: int
    of: int
    failed: int
    without_value: int
    interval: ConfidenceInterval
    basis: str
    not_passed: NumberColumn

    @property
    def share(self) -> float | None:
        """Passed over all; None: no member is done."""
        return self.passed / self.of if self.of else None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "condition": self.condition,
            "passed": self.passed,
            "of": self.of,
            "failed": self.failed,
            "without_value": self.without_value,
            "share": self.share,
            "interval": self.interval.to_list(),
            "basis": self.basis,
            "first_not_passed": self.not_passed[:_MOST_MEMBERS].tolist(),
        }


def read_condition(text: str, columns: MemberColumns) -> tuple[PassCondition, ...]:
    """Return the comparisons of a condition, joined by ``and``.

    Raises
    ------
    UsageError
        If it is no condition, names no metric of the study, or compares texts with a number.
    """
    return tuple(_read_part(part, text, columns) for part in re.split(r"\s+and\s+", text))


def passed_share(columns: MemberColumns, layout: StudyLayout, condition: str) -> PassedShare:
    """Return the share of members that pass a condition; of a Saltelli design: of A and B.

    A member that failed, or has no value for a metric of the condition, does not pass.

    Raises
    ------
    UsageError
        As from :func:`read_condition`.
    """
    parts = read_condition(condition, columns)
    drawn = drawn_members(columns, layout)
    passed = ~drawn.failed
    has_value = np.ones(len(passed), np.bool_)
    for part in parts:
        passed &= part.passed(drawn)
        has_value &= ~np.isnan(drawn.numeric(part.metric)) | drawn.is_text(part.metric)
    of_design = independence_of(layout)
    interval = NO_INTERVAL
    if of_design.is_drawn and len(passed):
        units = of_design.units_of(drawn.numbers)
        factor = of_design.variance_factor(drawn.numbers)
        count = effective_count(passed.astype(np.float64), units, factor=factor)
        interval = proportion_interval(int(passed.sum()), len(passed), count=count)
    return PassedShare(
        condition=condition,
        passed=int(passed.sum()),
        of=len(passed),
        failed=int(drawn.failed.sum()),
        without_value=int((~has_value & ~drawn.failed).sum()),
        interval=interval,
        basis=of_design.basis,
        not_passed=drawn.numbers[~passed],
    )


def _read_part(part: str, condition: str, columns: MemberColumns) -> PassCondition:
    found = _PART.fullmatch(part)
    if found is None:
        raise UsageError(
            f"condition {quoted(condition)}: expected METRIC COMPARISON VALUE (comparisons: "
            f"{' '.join(_COMPARISONS)}), such as 'rms < 0.1'; got {quoted(part)}"
        )
    metric, comparison, value = found.groups()
    columns.check_metric(metric)
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        return _compared_with_text(metric, comparison, value, columns)
    columns.metric(metric)
    return PassCondition(metric, comparison, number)


def _compared_with_text(
    metric: str, comparison: str, value: str, columns: MemberColumns
) -> PassCondition:
    if len(columns.metrics[metric].values) or comparison not in ("==", "!="):
        raise UsageError(
            f"metric {metric!r}: expected a number, or == or != and a text for a metric that is a "
            f"text; got {comparison} {quoted(value)}"
        )
    return PassCondition(metric, comparison, value.strip("'\""))
