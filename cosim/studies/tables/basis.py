"""What the intervals of a study rest on, and which are to be taken with care."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from cosim.report.tables.console import print_line
from cosim.studies.analysis.conditions import PassedShare
from cosim.studies.analysis.statistics import MetricStatistics

_MOST_ROUGH: Final = 5  # metrics that a line names


def print_basis(statistics: Mapping[str, MetricStatistics], shares: Sequence[PassedShare]) -> None:
    """Print what the intervals rest on, and which are to be taken with care."""
    figures = [one for one in statistics.values() if one.count]
    bases = [one.basis for one in figures] + [share.basis for share in shares]
    if bases:
        print_line(f"±, 95 % intervals: {bases[0]}")
    rough = [one.name for one in figures if one.is_rough]
    if rough:
        names = ", ".join(rough[:_MOST_ROUGH])
        more = f", and {len(rough) - _MOST_ROUGH} more" if len(rough) > _MOST_ROUGH else ""
        print_line(f"± may be too small (few members or skewed values): {names}{more}")
