"""What is said before a run: how swaps compare, what holds, which experiment is best."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from cosim.report.estimators import numbers_text
from cosim.report.printable import print_notice
from cosim.report.tables.console import Shown, new_table, section_tables

if TYPE_CHECKING:
    from cosim.scenario.assumptions.report import AssumptionReport
    from cosim.scenario.experiment_design.ranking import ExperimentDesign
    from cosim.scenario.recordings.swap_report import SwapReports

_EQUATION: Final = re.compile(r" \(\d+\)$")  # of the paper: a part of the name in JSON alone
_WORDS: Final = {True: "fulfilled", False: "NOT FULFILLED", None: "not decided"}
_SHOWN: Final = 3  # designs of a choice and a method
_TITLES: Final = {"scenario": "as it is"}


# --- swaps ---


def show_dry_run(reports: SwapReports) -> Shown:
    """Show how swapped components compare with those that they replace."""
    warnings = [*reports.of_run, *reports.warnings]
    yield {
        "swaps": {name: report.to_dict() for name, report in reports.reports.items()},
        "problems": reports.refusals,
        "imported": dict(reports.imported),
        "warnings": [{"of": name, "text": text} for name, text in warnings],
    }
    different = 0
    for report in reports.reports.values():
        different += sum(row.verdict == "differs" for row in report.rows)
        yield section_tables([(report.component, report.lines)])
    for component, name in reports.imported.items():
        yield f"{component}: {name} was imported"
    if reports.refusals:
        return
    for component, text in warnings:
        print_notice(f"warning: {component}: {text}")
    found = "no problems found"
    if different:
        found = f"the scenario can run; rows that differ: {different}"
    elif warnings:
        found = f"the scenario can run; warnings: {len(warnings)}"
    yield f"dry run: {found}"


# --- assumptions ---


def show_assumptions(report: AssumptionReport) -> Shown:
    """Show every assumption with what decides it, and how one that fails can be met."""
    yield report.to_dict()
    for component, text in report.warnings:
        print_notice(f"warning: {component}: {text}")
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
    yield new_table(f"{report.scenario}: {counts}", ("", "", "", ""), rows)


# --- experiments ---


def show_design(design: ExperimentDesign) -> Shown:
    """Show the best designs of every choice, or all of them as JSON."""
    yield design.to_dict()
    titles = [f"error of theta[{j}]" for j in range(len(design.theta))]
    noise = numbers_text(design.deviations.tolist())
    title = f"{design.identifier}: predicted errors, noise of y {noise} ({design.noise_source})"
    rows = []
    shown: Counter[tuple[str, str]] = Counter()
    for ranked in design.designs:
        shown[ranked.choice, ranked.method] += 1
        if shown[ranked.choice, ranked.method] <= _SHOWN:
            choice = _TITLES.get(ranked.choice, ranked.choice)
            numbers = map(_number, (*ranked.error, ranked.ratio))
            rows.append((choice, _settings(ranked.settings), ranked.method, *numbers))
    yield new_table(title, ("", "set", "method", *titles, "of bound"), rows)
    for omitted in design.omitted:
        choice = _TITLES.get(omitted.choice, omitted.choice)
        settings = ", ".join(filter(None, map(_settings, omitted.settings)))
        of_method = " ".join(filter(None, (omitted.method, settings)))
        yield ": ".join(filter(None, (choice, of_method, omitted.reason)))
    yield from design.notes


def _settings(settings: Mapping[str, Any]) -> str:
    """Write what is set as the options that set it."""
    return " ".join(f"{key}={_value(value)}" for key, value in settings.items())


def _number(error: float) -> str:
    return f"{error:.3g}" if math.isfinite(error) else "no estimate"


def _value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value).replace(" ", "")
