"""A study whose members a search chose: how far it is, and the best of them.

Such members are no sample of anything: statistics, and correlations with what the search varied,
would say how it searched.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.studies.analysis.columns import count_text
from cosim.studies.analysis.extremes import best_members, worst_members
from cosim.studies.analysis.failures import warnings_by_text
from cosim.studies.analysis.results import StudyResults
from cosim.studies.contracts import RECORDING
from cosim.studies.running.recorded_study import RecordedSearch
from cosim.studies.tables.numbers import number_text
from cosim.studies.tables.study import (
    CommandOf,
    failures_content,
    members_content,
    print_failures,
    print_warnings,
)
from cosim.studies.tables.wall_time import wall_time_text


def print_search(
    results: StudyResults,
    search: RecordedSearch,
    command_of: CommandOf,
    *,
    count: int,
    as_json: bool = False,
) -> None:
    """Print the best members, and what failed.

    Parameters
    ----------
    results : StudyResults
    search : RecordedSearch
    command_of : callable
        Returns the command that runs a member on its own.
    count : int
        How many of the best members are shown.
    as_json : bool
    """
    chosen = worst_members if search.maximize else best_members
    best = chosen(results.columns, search.metric, count).tolist()
    if as_json:
        print_json(_content(results, search, command_of, best))
        return
    failed = f"{results.failed} failed" if results.failed else "none failed"
    print_line(
        f"{results.name}: {search.method}, {search.goal}; {count_text(results.done)} of at most "
        f"{results.planned}, {failed}"
    )
    if results.done:
        print_line(wall_time_text(results))
    keys = [key for key in results.columns.parameters if key != RECORDING]  # one of all
    table = new_table("best members", ("member", search.metric, *keys))
    for number in best:
        objective, values = _values(results, search, number)
        cells = []
        for key in keys:
            value = values[key]
            cells.append(number_text(value) if isinstance(value, float) else str(value))
        table.add_row(str(number), number_text(objective), *cells)
    if table.row_count:
        print_table(table)
    elif results.done > results.failed:
        print_line(f"{search.metric}: no member has a finite value")
    print_failures(results, command_of)
    print_warnings(results)
    if best:
        print_line(f"member {best[0]} alone: {command_of(best[0])}")


def _content(
    results: StudyResults, search: RecordedSearch, command_of: CommandOf, best: list[int]
) -> dict[str, Any]:
    """Return what is printed, as plain values for JSON."""
    shown = []
    for number in best:
        objective, values = _values(results, search, number)
        found = {"member": number, "objective": objective, "values": values}
        shown.append({**found, "command": command_of(number)})
    return {
        "name": results.name,
        "search": asdict(search),
        "members": members_content(results),
        "best": shown,
        "failures": failures_content(results, command_of),
        "warnings": [group.to_dict() for group in warnings_by_text(results.columns)],
    }


def _values(
    results: StudyResults, search: RecordedSearch, number: int
) -> tuple[float, dict[str, Any]]:
    """Return the objective of a member, and what was varied."""
    columns = results.columns
    (row,) = columns.rows_of(np.array([number]))
    values = {}
    for key, column in columns.parameters.items():
        values[key] = column[row : row + 1].tolist()[0]
    return float(columns.numeric(search.metric)[row]), values
