"""The table of the assumptions of a scenario."""

from __future__ import annotations

import re
from collections import Counter
from typing import Final

from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.scenario.assumptions.report import AssumptionReport

_EQUATION: Final = re.compile(r" \(\d+\)$")  # of the paper: a part of the name in JSON alone
_WORDS: Final = {True: "fulfilled", False: "NOT FULFILLED", None: "not decided"}


def print_assumptions(report: AssumptionReport, *, as_json: bool) -> None:
    """Print every assumption with what decides it, and how one that fails can be met."""
    if as_json:
        print_json(report.to_dict())
        return
    for component, text in report.warnings:
        print_line(f"warning: {component}: {text}", error=True)
    rows = []
    for name, verdict in report.verdicts:
        answer = ": ".join(filter(None, (_WORDS[verdict.fulfilled], verdict.verdict)))
        text = "; ".join(filter(None, (verdict.evidence, verdict.cure)))
        rows.append((name, _EQUATION.sub("", verdict.name), answer, text))
    number = Counter(verdict.fulfilled for _, verdict in report.verdicts)
    counts = f"{number[True]} of {number.total()} assumptions are fulfilled"
    if number[False]:
        counts += f", {number[False]} not"
    if number[None]:
        counts += f", {number[None]} not decided"
    print_table(new_table(f"{report.scenario}: {counts}", ("", "", "", ""), rows))
