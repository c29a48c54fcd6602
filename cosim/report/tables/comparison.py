"""Comparisons: two logs, several plants or estimators, replays, a component and its replacement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from cosim.core.recorded.signals import DistinctWarnings, warning_texts
from cosim.errors import quoted
from cosim.report.tables.console import (
    new_table,
    print_json,
    print_line,
    print_section,
    print_table,
)

if TYPE_CHECKING:
    from cosim.log.comparison.difference import LogDifference
    from cosim.log.comparison.event_difference import EventsDifference
    from cosim.report.comparing import Comparison, EstimatorComparison, EstimatorResult
    from cosim.report.sweep import ReplaySweep, SweepRow
    from cosim.scenario.recordings.swap_report import SwapReports

# --- logs ---


def print_difference(difference: LogDifference, *, as_json: bool) -> None:
    """Print how far two logs are apart."""
    if as_json:
        print_json(difference.to_dict())
        return
    has_own = bool(difference.tol)
    tolerance = ["tolerance"] if has_own else []
    columns = ["signal", "", *tolerance, "max |a - b|", "max |a|", "ratio", "first outside"]
    table = new_table("", columns)
    for row in difference.rows:
        outside = ""
        if row.first is not None:
            time = row.first.time_ns / 1e9
            outside = f"{row.first.signal} at {time} s: {', '.join(row.first.texts)}"
        numbers = [row.tolerance] if has_own else []
        numbers += [row.largest, row.scale, row.ratio]
        table.add_row(row.signal, row.status, *(f"{value:.3g}" for value in numbers), outside)
    print_table(table)
    for row in difference.rows:
        in_a, in_b, both = row.rows
        if row.status in ("equal", "within", "other times") and both < max(in_a, in_b):
            print_line(
                f"note: compared only where both logs have rows: {row.signal} at {both} instants "
                f"({in_a} in a, {in_b} in b)"
            )
            break
    if any(difference.events.events):
        print_line(_events_text(difference.events))
    if any(row.largest > 0.0 and row.signal.endswith(".delta") for row in difference.rows):
        print_line(
            "note: a reconstructed disturbance amplifies rounding errors of y by filter_rate; "
            "give it its own --tol"
        )


def _events_text(difference: EventsDifference) -> str:
    """Return how the jumps compare, in words."""
    in_a, in_b = difference.events
    text = f"events: {in_a} in a, {in_b} in b: "
    first = difference.first
    if first is None:
        return f"{text}{'equal' if difference.equal else 'within the tolerance'}"
    jumps = []
    for jump in (first.a, first.b):
        jumps.append("no jump" if jump is None else f"{jump.cause} {jump.value!r}")
    return (
        f"{text}{difference.outside} of {difference.jumps} jumps differ; first "
        f"{first.signal} at {first.time_ns / 1e9} s: {', '.join(jumps)}"
    )


# --- components ---


def print_dry_run(reports: SwapReports, *, as_json: bool) -> None:
    """Print how swapped components compare with those that they replace."""
    warnings = [*reports.of_run, *reports.warnings]
    if as_json:
        print_json(
            {
                "swaps": {name: report.to_dict() for name, report in reports.reports.items()},
                "problems": reports.refusals,
                "imported": dict(reports.imported),
                "warnings": [{"of": name, "text": text} for name, text in warnings],
            }
        )
        return
    for report in reports.reports.values():
        print_section(report.component, report.lines)
    for component, name in reports.imported.items():
        print_line(f"{component}: {name} was imported")
    if reports.refusals:
        return
    for component, text in warnings:
        print_line(f"warning: {component}: {text}", error=True)
    found = "no problems found"
    if reports.different:
        found = f"the scenario can run; rows that differ: {reports.different}"
    elif warnings:
        found = f"the scenario can run; warnings: {len(warnings)}"
    print_line(f"dry run: {found}")


def print_plants(comparison: Comparison, *, as_json: bool) -> None:
    """Print what a scenario estimates on several plants, and how far from the first plant's."""
    if as_json:
        print_json(comparison.to_dict())
        return
    first = next(iter(comparison.recordings), "")
    title = f"{comparison.scenario}: {comparison.component}"
    table = new_table(title, ("estimate", "truth", "plant", "value", "error", f"from {first}"))
    for rows in _plant_rows(comparison).values():
        for row in rows:
            table.add_row(*row)
        table.add_section()
    failures = [outcome for outcome in comparison.outcomes if outcome.error]
    for outcome in failures:
        table.add_row("", "", outcome.label, "failed", outcome.error.splitlines()[0], "")
    print_table(table)
    if not comparison.estimates:
        print_line(
            "no estimates to compare: the scenario has no [truth]; --out keeps the logs, and "
            "'cosim diff' compares all their signals"
        )
    for label, recording in comparison.recordings.items():
        for text in warning_texts(recording.warnings):
            print_line(f"warning: {label}: {text}", error=True)
    for outcome in failures:
        for line in outcome.error.splitlines():
            print_line(f"{outcome.label}: failed: {line}", error=True)


def _plant_rows(comparison: Comparison) -> dict[str, list[tuple[str, ...]]]:
    """Return by estimate: it, truth, plant, value, error, and distance from the first plant's."""
    from cosim.report.recorded_rows import element_names

    apart: dict[tuple[str, str], float] = {}  # by estimate or its element, and plant
    for one in comparison.differences:
        names = element_names(one.estimate, len(one.largest))
        for name, largest in zip(names, one.largest, strict=True):
            if largest is not None:
                apart[name, one.label] = largest
                whole = one.estimate, one.label
                apart[whole] = max(largest, apart.get(whole, 0.0))
    rows: dict[str, list[tuple[str, ...]]] = {}
    for label, summary in comparison.summaries.items():
        for signal in summary.signals:
            error = f"{signal.largest:.3g} for t >= {signal.since:g} s"
            distance = _number(apart.get((signal.estimate, label)))
            row = signal.estimate, signal.truth, label, "", error, distance
            rows.setdefault(signal.estimate, []).append(row)
        for own in summary.values:
            value = "no value" if own.value is None else f"{own.value:+.6f}"
            distance = _number(apart.get((own.estimate, label)))
            row = own.estimate, f"{own.truth:+g}", label, value, _number(own.error), distance
            rows.setdefault(own.estimate, []).append(row)
    return rows


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


# --- estimators ---


def print_estimators(comparison: EstimatorComparison, *, as_json: bool) -> None:
    """Print what several methods estimate from the same data."""
    if as_json:
        print_json(comparison.to_dict())
        return
    title = f"{comparison.scenario}: {comparison.component}"
    table = new_table(title, ("method", "theta", "error", "time / rest", "verdict"))
    for result in comparison.results:
        if result.failure:
            table.add_row(result.method, "failed", result.failure.partition("\n")[0], "", "")
            continue
        errors = [] if result.error is None else [_value(value, "+.2g") for value in result.error]
        verdicts = ", ".join(record.verdict for record in result.verdicts)
        ratio = _number(result.time_ratio)
        table.add_row(result.method, _theta(result), ", ".join(errors), ratio, verdicts)
    print_table(table)
    print_line("±: half width of the 95 % interval, where there is one")
    print_line("time / rest: computing time of the identifier over that of all other components")
    for result in comparison.results:
        for line in result.failure.splitlines():
            print_line(f"{result.method}: failed: {line}", error=True)


def _theta(result: EstimatorResult) -> str:
    """Return theta, with half of its 95 % interval where there is one."""
    assert result.theta is not None
    texts = []
    for value, half_width in zip(result.theta, result.half_width, strict=True):
        width = "" if np.isnan(half_width) else f" ± {half_width:.2g}"
        texts.append(f"{_value(value, '+.6f')}{width}")
    return ", ".join(texts)


def _value(value: float, form: str) -> str:
    return "no value" if np.isnan(value) else format(value, form)


# --- replays ---


def print_sweep(sweep: ReplaySweep, *, as_json: bool, quiet: bool) -> None:
    """Print what the results of a sweep say, and why some replays failed."""
    from cosim.report.sweep import ERROR, HALF_WIDTH, LARGEST_ERROR

    suffixes = {HALF_WIDTH: " ± ", ERROR: ", error "}  # of a result, in its cell
    if as_json:
        print_json(sweep.to_dict())
    elif not quiet:
        # --json has the others, too
        columns = [name for name in sweep.columns if not name.endswith(LARGEST_ERROR)]
        for suffix in suffixes:
            beside = {f"{name}{suffix}" for name in sweep.columns}
            columns = [name for name in columns if name not in beside]
        table = new_table(sweep.log, (*sweep.varied, *columns))
        for row in sweep.rows:
            table.add_row(*map(quoted, row.values.values()), *_cells(row, columns, suffixes))
        print_table(table)
        warnings = [one for row in sweep.rows if row.summary for one in row.summary.warnings]
        for text in warning_texts(DistinctWarnings(warnings)):
            print_line(f"warning: {text}", error=True)
    for number, row in enumerate(sweep.rows, start=1):
        for line in row.problem.splitlines():
            print_line(f"row {number}: failed: {line}", error=True)


def _cells(row: SweepRow, columns: Sequence[str], suffixes: Mapping[str, str]) -> list[str]:
    if row.problem:
        return ["failed", *[""] * (len(columns) - 1)] if columns else []
    cells = []
    for column in columns:
        value = row.results.get(column, "")
        text = "no value" if value is None else value
        if isinstance(text, float):
            text = f"{text:.6g}"
        for suffix, words in suffixes.items():
            beside = row.results.get(f"{column}{suffix}")
            if isinstance(beside, float):
                text += f"{words}{beside:.2g}"
        cells.append(text)
    return cells
