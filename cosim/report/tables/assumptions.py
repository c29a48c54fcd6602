"""The table of the assumptions of a scenario."""

from __future__ import annotations

from typing import Final

from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.scenario.assumptions.report import AssumptionReport

_WORDS: Final = {True: "fulfilled", False: "NOT FULFILLED", None: "not decided"}


def print_assumptions(report: AssumptionReport, *, as_json: bool) -> None:
    """Print every assumption with what decides it, and how one that fails can be met."""
    if as_json:
        print_json(report.to_dict())
        return
    for component, text in report.warnings:
        print_line(f"warning: {component}: {text}", error=True)
    verdicts = [verdict for _, verdict in report.verdicts]
    failing = sum(verdict.fulfilled is False for verdict in verdicts)
    open_ones = sum(verdict.fulfilled is None for verdict in verdicts)
    counts = f"{len(verdicts) - failing - open_ones} of {len(verdicts)} assumptions are fulfilled"
    if failing:
        counts += f", {failing} not"
    if open_ones:
        counts += f", {open_ones} not decided"
    table = new_table(f"{report.scenario}: {counts}", ("", "", "", ""))
    for name, verdict in report.verdicts:
        text = verdict.evidence
        if verdict.cure:
            text += f"; {verdict.cure}"
        word = _WORDS[verdict.fulfilled]
        if verdict.verdict:
            word += f": {verdict.verdict}"
        table.add_row(name, verdict.name, word, text)
    print_table(table)
