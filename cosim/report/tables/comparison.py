"""Comparisons: two logs, several plants or estimators, replays of one log."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from cosim.core.recorded.signals import warning_texts
from cosim.report.printable import print_notice
from cosim.report.tables.console import Shown, new_table

if TYPE_CHECKING:
    from cosim.log.comparison.difference import LogDifference
    from cosim.log.comparison.event_difference import EventsDifference
    from cosim.report.comparing import Comparison, EstimatorComparison


# --- logs ---


def show_difference(difference: LogDifference) -> Shown:
    """Show how far two logs are apart."""
    yield difference.to_dict()
    columns = ["signal", "", "tolerance", "max |a - b|", "max |a|", "ratio", "first outside"]
    rows = []
    for row in difference.rows:
        outside = ""
        if row.first is not None:
            time = row.first.time_ns / 1e9
            outside = f"{row.first.signal} at {time} s: {', '.join(row.first.texts)}"
        numbers = (row.tolerance, row.largest, row.scale, row.ratio)
        rows.append([row.signal, row.status, *map(_number, numbers), outside])
    if not difference.tol:  # of single signals
        for cells in (columns, *rows):
            del cells[2]
    yield new_table("", columns, rows)
    for row in difference.rows:
        in_a, in_b, both = row.rows
        if row.status in ("equal", "within", "other times") and both < max(in_a, in_b):
            yield (
                f"note: compared only where both logs have rows: {row.signal} at {both} instants "
                f"({in_a} in a, {in_b} in b)"
            )
            break
    if any(difference.events.events):
        yield _events_text(difference.events)
    if any(row.largest > 0.0 and row.signal.endswith(".delta") for row in difference.rows):
        yield (
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


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


# --- several runs ---


def print_failures(failures: Iterable[tuple[str, str]]) -> None:
    """Print why some of several runs failed."""
    for name, text in failures:
        for line in text.splitlines():
            print_notice(f"{name}: failed: {line}")


def show_plants(comparison: Comparison) -> Shown:
    """Show what a scenario estimates on several plants, and how far from the first plant's."""
    yield comparison.to_dict()
    failures = [(one.label, one.error) for one in comparison.outcomes if one.error]
    rows = list(_plant_rows(comparison))
    order = list(dict.fromkeys(row[0] for row in rows))
    rows.sort(key=lambda row: order.index(row[0]))
    for label, text in failures:
        rows.append(("", "", label, "failed", text.splitlines()[0], ""))
    first = next(iter(comparison.recordings), "")
    columns = ("estimate", "truth", "plant", "value", "error", f"from {first}")
    yield new_table(f"{comparison.scenario}: {comparison.component}", columns, rows)
    if not comparison.estimates:
        yield (
            "no estimates to compare: the scenario has no [truth]; --out keeps the logs, and "
            "'cosim diff' compares all their signals"
        )
    for label, recording in comparison.recordings.items():
        for text in warning_texts(recording.warnings):
            print_notice(f"warning: {label}: {text}")
    print_failures(failures)


def _plant_rows(comparison: Comparison) -> Iterator[tuple[str, ...]]:
    """Yield by plant and estimate: it, truth, plant, value, error, distance from the first's."""
    from cosim.report.recorded_rows import element_names

    apart: dict[tuple[str, str], float | None] = {}  # by estimate or its element, and plant
    for one in comparison.differences:
        names = element_names(one.estimate, len(one.largest))
        for name, largest in zip(names, one.largest, strict=True):
            apart[name, one.label] = largest
        known = [largest for largest in one.largest if largest is not None]
        apart[one.estimate, one.label] = max(known, default=None)
    for label, summary in comparison.summaries.items():
        for signal in summary.signals:
            error = f"{signal.largest:.3g} for t >= {signal.since:g} s"
            distance = _number(apart.get((signal.estimate, label)))
            yield signal.estimate, signal.truth, label, "", error, distance
        for own in summary.values:
            value = "no value" if own.value is None else f"{own.value:+.6f}"
            distance = _number(apart.get((own.estimate, label)))
            yield own.estimate, f"{own.truth:+g}", label, value, _number(own.error), distance


def show_estimators(comparison: EstimatorComparison) -> Shown:
    """Show what several methods estimate from the same data."""
    yield comparison.to_dict()
    failures = [(one.method, one.failure) for one in comparison.results if one.failure]
    rows = []
    for result in comparison.results:
        if result.theta is None:
            rows.append([result.method, "failed", result.failure.partition("\n")[0]])
            continue
        thetas = []
        for value, half_width in zip(result.theta, result.half_width, strict=True):
            width = "" if np.isnan(half_width) else f" ± {half_width:.2g}"
            thetas.append(f"{_value(value, '+.6f')}{width}")
        errors = [] if result.error is None else [_value(value, "+.2g") for value in result.error]
        verdicts = [record.verdict for record in result.verdicts]
        texts = [", ".join(texts) for texts in (thetas, errors, verdicts)]
        texts.insert(2, _number(result.time_ratio))
        rows.append([result.method, *texts])
    title = f"{comparison.scenario}: {comparison.component}"
    columns = ("method", "theta", "error", "time / rest", "verdict")
    yield new_table(title, columns, rows)
    yield "±: half width of the 95 % interval, where there is one"
    yield "time / rest: computing time of the identifier over that of all other components"
    print_failures(failures)


def _value(value: float, form: str) -> str:
    return "no value" if np.isnan(value) else format(value, form)
