"""Comparisons: two logs, several plants or estimators, a swapped component and the replaced one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from cosim.arrays import Vector
from cosim.core.recorded.signals import warning_texts
from cosim.report.tables.console import (
    new_table,
    print_json,
    print_line,
    print_section,
    print_table,
)

if TYPE_CHECKING:
    from cosim.log.comparison.difference import LogDifference, SignalDifference
    from cosim.log.comparison.event_difference import EventsDifference
    from cosim.report.comparing import Comparison, EstimateDifference
    from cosim.report.estimator_comparison import EstimatorComparison, EstimatorResult
    from cosim.report.summary import Summary
    from cosim.scenario.swapping.swap_report import SwapReports

PlantRow = tuple[str, str, str, str, str, str]  # estimate, truth, plant, value, error, difference
LargestDifferences = Mapping[tuple[str, str], float]  # by estimate or element, and plant


def print_difference(difference: LogDifference, *, as_json: bool) -> None:
    """Print how far two logs are apart."""
    if as_json:
        print_json(difference.to_dict())
        return
    columns = ["signal", "", "max |a - b|", "max |a|", "ratio", "first outside"]
    if difference.tol:
        columns.insert(2, "tolerance")
    table = new_table("", columns)
    for row in difference.rows:
        outside = ""
        if row.first is not None:
            time = row.first.time_ns / 1e9
            values = ", ".join(row.first.texts)
            outside = f"{row.first.signal} at {time} s: {values}"
        numbers = [f"{value:.3g}" for value in (row.largest, row.scale, row.ratio)]
        if difference.tol:
            numbers.insert(0, f"{row.tolerance:.3g}")
        table.add_row(row.signal, row.status, *numbers, outside)
    print_table(table)
    fewer = [row for row in difference.rows if _has_fewer_rows(row)]
    if fewer:
        rows_a, rows_b, both = fewer[0].rows
        print_line(
            f"note: compared only where both logs have rows: {fewer[0].signal} at {both} instants "
            f"({rows_a} in a, {rows_b} in b)"
        )
    if any(difference.events.events):
        print_line(_events_text(difference.events))
    if any(row.largest > 0.0 and row.signal.endswith(".delta") for row in difference.rows):
        print_line(
            "note: a reconstructed disturbance amplifies rounding errors of y by filter_rate; "
            "give it its own --tol"
        )


def _has_fewer_rows(row: SignalDifference) -> bool:
    """Return whether a signal, equal at common instants, has rows that the other log has not."""
    return row.status in ("equal", "within", "other times") and row.rows[2] < max(row.rows[:2])


def _events_text(difference: EventsDifference) -> str:
    """Return how the jumps compare, in words."""
    count_a, count_b = difference.events
    text = f"events: {count_a} in a, {count_b} in b: "
    first = difference.first
    if difference.equal:
        return f"{text}equal"
    if first is None:
        return f"{text}within the tolerance"
    values = ", ".join(
        "no jump" if jump is None else f"{jump.cause} {jump.value!r}" for jump in (first.a, first.b)
    )
    return (
        f"{text}{difference.outside} of {difference.jumps} jumps differ; first "
        f"{first.signal} at {first.time_ns / 1e9} s: {values}"
    )


def print_dry_run(reports: SwapReports, *, as_json: bool) -> None:
    """Print how swapped components compare with those that they replace."""
    found_before = [*reports.of_run, *reports.warnings]
    if as_json:
        swaps = {name: report.to_dict() for name, report in reports.reports.items()}
        imported = dict(reports.imported)
        warnings = [{"of": name, "text": text} for name, text in found_before]
        problems = reports.refusals
        print_json(
            {"swaps": swaps, "problems": problems, "imported": imported, "warnings": warnings}
        )
        return
    for report in reports.reports.values():
        print_section(report.component, report.lines)
    for component, name in reports.imported.items():
        print_line(f"{component}: {name} was imported")
    if not reports.refusals:
        for component, text in found_before:
            print_line(f"warning: {component}: {text}", error=True)
        found = "no problems found"
        if reports.different:
            found = f"the scenario can run; rows that differ: {reports.different}"
        elif found_before:
            found = f"the scenario can run; warnings: {len(found_before)}"
        print_line(f"dry run: {found}")


def print_plants(comparison: Comparison, *, as_json: bool) -> None:
    """Print what a scenario estimates on several plants, and how far from the first plant's."""
    if as_json:
        print_json(comparison.to_dict())
        return
    first = next(iter(comparison.recordings), "")
    title = f"{comparison.scenario}: {comparison.component}"
    table = new_table(title, ("estimate", "truth", "plant", "value", "error", f"from {first}"))
    failures = [outcome for outcome in comparison.outcomes if outcome.error]
    for rows in _rows_by_estimate(comparison).values():
        for row in rows:
            table.add_row(*row)
        table.add_section()
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
        error = "" if result.error is None else _listed(result.error, "+.2g")
        verdicts = ", ".join(record.verdict for record in result.verdicts)
        ratio = _number(result.time_ratio)
        table.add_row(result.method, _estimate(result), error, ratio, verdicts)
    print_table(table)
    print_line("±: half width of the 95 % interval, where there is one")
    print_line("time / rest: computing time of the identifier over that of all other components")
    for result in comparison.results:
        for line in result.failure.splitlines():
            print_line(f"{result.method}: failed: {line}", error=True)


def _estimate(result: EstimatorResult) -> str:
    """Return theta, with half of its 95 % interval where there is one."""
    assert result.theta is not None
    texts = []
    for value, half_width in zip(result.theta, result.half_width, strict=True):
        text = _value(value, "+.6f")
        if not np.isnan(half_width):
            text = f"{text} ± {half_width:.2g}"
        texts.append(text)
    return ", ".join(texts)


def _listed(values: Vector, form: str) -> str:
    return ", ".join(_value(value, form) for value in values)


def _value(value: float, form: str) -> str:
    return "no value" if np.isnan(value) else format(value, form)


def _rows_by_estimate(comparison: Comparison) -> dict[str, list[PlantRow]]:
    """Return the rows of all plants, those of the same estimate together."""
    differences: dict[tuple[str, str], float] = {}
    for difference in comparison.differences:
        differences |= _largest_differences(difference)
    rows: dict[str, list[PlantRow]] = {}
    for label, summary in comparison.summaries.items():
        for row in _plant_rows(label, summary, differences):
            rows.setdefault(row[0], []).append(row)
    return rows


def _largest_differences(difference: EstimateDifference) -> dict[tuple[str, str], float]:
    """Return the differences of a plant's estimate by the names of its elements, and its largest.

    Elements without a value are left out.
    """
    from cosim.report.recorded_rows import element_names

    elements: dict[tuple[str, str], float] = {}
    names = element_names(difference.estimate, len(difference.largest))
    for name, largest in zip(names, difference.largest, strict=True):
        if largest is not None:
            elements[name, difference.label] = largest
    if not elements:
        return {}
    return elements | {(difference.estimate, difference.label): max(elements.values())}


def _plant_rows(
    label: str, summary: Summary, differences: LargestDifferences
) -> Iterator[PlantRow]:
    """Yield the rows of one plant."""
    for signal in summary.signals:
        error = f"{signal.largest:.3g} for t >= {signal.since:g} s"
        apart = _number(differences.get((signal.estimate, label)))
        yield signal.estimate, signal.truth, label, "", error, apart
    for outcome in summary.values:
        value = "no value" if outcome.value is None else f"{outcome.value:+.6f}"
        error = _number(outcome.error)
        apart = _number(differences.get((outcome.estimate, label)))
        yield outcome.estimate, f"{outcome.truth:+g}", label, value, error, apart


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
