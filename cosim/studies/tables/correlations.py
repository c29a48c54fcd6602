"""The parameters that metrics go with, as a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from cosim.report.tables.console import new_table, print_line, print_table
from cosim.studies.analysis.correlation import LEAST_MEMBERS, RankCorrelation, strongest
from cosim.studies.analysis.independence import independence_of
from cosim.studies.analysis.results import StudyResults

_MOST_PARAMETERS: Final = 3  # of a metric
_WEAKEST: Final = 0.1  # that is shown


def print_correlations(results: StudyResults, correlations: Sequence[RankCorrelation]) -> None:
    """Print the parameters that each metric goes with, but where chance alone may do that."""
    if correlations and all(one.count < LEAST_MEMBERS for one in correlations):
        print_line(f"rank correlations: none for fewer than {LEAST_MEMBERS} members")
        return
    table = new_table("rank correlation", ("", "strongest parameters"))
    for name in results.columns.raw_metrics:
        found = strongest(correlations, name)
        strong = [one for one in found if abs(one.value or 0.0) >= _WEAKEST and one.is_distinct]
        shown = strong[:_MOST_PARAMETERS]
        if shown:
            table.add_row(name, ", ".join(f"{one.parameter} {one.value:+.2f}" for one in shown))
    if table.row_count:
        print_table(table)
        if independence_of(results.layout).is_drawn:
            line = "correlations not significant at the 5 % level are omitted"
            by_chance = len(correlations) // 20
            if by_chance:
                line += (
                    f"; about {by_chance} of {len(correlations)} pairs are significant by chance"
                )
            print_line(line)
