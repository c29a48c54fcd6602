"""One member of a study, and the command that runs it alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cosim.errors import UsageError, shortened
from cosim.report.tables.console import print_json, print_line, print_section
from cosim.studies.analysis.results import StudyResults


def print_member(
    row: Mapping[str, Any], results: StudyResults, command: str, *, as_json: bool = False
) -> None:
    """Print all of one member.

    Parameters
    ----------
    row : mapping of column to value
        Its row of the dataset.
    results : StudyResults
    command : str
        That runs it alone.
    as_json : bool
    """
    if as_json:
        print_json({**row, "command": command})
        return
    varied = (*results.columns.parameters, *results.layout.noise_seeds)
    parameters = {name: row[name] for name in varied}
    metrics = {name: row[name] for name in results.columns.raw_metrics}
    others = {name: value for name, value in row.items() if name not in (*parameters, *metrics)}
    reason = others.get("reason")
    print_line(f"member {row['member']}: {row['status']}" + (f": {reason}" if reason else ""))
    print_section("parameters", _with_units(parameters, results))
    print_section("metrics", _with_units(metrics, results, "no value"))
    shown = {}
    for name, value in others.items():
        if name not in ("member", "status", "reason", "designs") and value not in (None, ""):
            shown[results.with_unit(name)] = shortened(str(value))
    print_section("run", shown)
    print_line(f"alone: {command}")


def check_is_done(number: int, results: StudyResults) -> None:
    """Check that a member has an outcome.

    Raises
    ------
    UsageError
        If there is no such member, or it has none yet.
    """
    if not 0 <= number < results.planned:
        last = results.planned - 1
        raise UsageError(f"expected a member from 0 to {last}, got {number}")
    if number in results.missing:
        raise UsageError(f"member {number} has not run yet; run the study again to continue")


def _with_units(
    values: Mapping[str, Any], results: StudyResults, empty: str = "the scenario's own value"
) -> dict[str, Any]:
    named = {}
    for name, value in values.items():
        named[results.with_unit(name)] = empty if value is None else value
    return named
