"""The table of a sweep: what the results say, a row for each combination of values."""

from __future__ import annotations

from typing import Final

from cosim.core.recorded.signals import DistinctWarnings, warning_texts
from cosim.errors import quoted
from cosim.report.sweep import ERROR, HALF_WIDTH, LARGEST_ERROR, ReplaySweep, SweepRow, SweepValue
from cosim.report.tables.console import new_table, print_json, print_line, print_table

_BESIDE: Final = {HALF_WIDTH: " ± ", ERROR: ", error "}  # a value, in its cell


def print_sweep(sweep: ReplaySweep, *, as_json: bool, quiet: bool) -> None:
    """Print what the results of a sweep say, and why some replays failed."""
    if as_json:
        print_json(sweep.to_dict())
    elif not quiet:
        columns = _columns(sweep)
        table = new_table(sweep.log, (*sweep.varied, *columns))
        for row in sweep.rows:
            values = [quoted(value) for value in row.values.values()]
            table.add_row(*values, *_cells(row, columns))
        print_table(table)
        warnings = [one for row in sweep.rows if row.summary for one in row.summary.warnings]
        for text in warning_texts(DistinctWarnings(warnings)):
            print_line(f"warning: {text}", error=True)
    for number, row in enumerate(sweep.rows, start=1):
        for line in row.problem.splitlines():
            print_line(f"row {number}: failed: {line}", error=True)


def _columns(sweep: ReplaySweep) -> list[str]:
    """Return the results that have a column of their own; --json has the others, too."""
    hidden = {name for name in sweep.columns if name.endswith(LARGEST_ERROR)}
    for name in sweep.columns:
        hidden |= {f"{name}{suffix}" for suffix in _BESIDE}
    return [name for name in sweep.columns if name not in hidden]


def _cells(row: SweepRow, columns: list[str]) -> list[str]:
    if row.problem:
        return ["failed", *[""] * (len(columns) - 1)] if columns else []
    results = row.results
    cells = []
    for column in columns:
        text = _text(results[column]) if column in results else ""
        for suffix, words in _BESIDE.items():
            beside = results.get(f"{column}{suffix}")
            if isinstance(beside, float):
                text += f"{words}{beside:.2g}"
        cells.append(text)
    return cells


def _text(value: SweepValue) -> str:
    match value:
        case None:
            return "no value"
        case str():
            return value
        case _:
            return f"{value:.6g}"
