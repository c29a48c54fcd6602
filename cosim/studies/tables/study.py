"""A study as a whole: what is done, statistics, failures, the worst members."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, TypeAlias

from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.studies.analysis.columns import MemberColumns, NumberColumn, count_text
from cosim.studies.analysis.conditions import PassedShare, passed_share
from cosim.studies.analysis.correlation import rank_correlations
from cosim.studies.analysis.extremes import best_members, worst_members
from cosim.studies.analysis.failures import (
    ReasonGroup,
    ends_by_reason,
    failures_by_reason,
    warning_lines,
    warnings_by_text,
)
from cosim.studies.analysis.results import StudyResults
from cosim.studies.analysis.statistics import MetricStatistics, study_statistics
from cosim.studies.tables.basis import print_basis
from cosim.studies.tables.correlations import print_correlations
from cosim.studies.tables.numbers import (
    members_text,
    number_text,
    percent_interval_text,
    percent_text,
    text_with_half_width,
)
from cosim.studies.tables.wall_time import median_time, wall_time_text

CommandOf: TypeAlias = Callable[[int], str]

WORST: Final = 3  # members of each metric that are shown
_DIGITS: Final = 4  # of a figure in a table of all metrics
_MOST_REASONS: Final = 20  # that are shown; --json has all
_MOST_TEXTS: Final = 5  # of a metric that is a text


def print_study(
    results: StudyResults,
    command_of: CommandOf,
    *,
    conditions: Sequence[str] = (),
    worst: int = WORST,
    as_json: bool = False,
) -> None:
    """Print what a study came to.

    Parameters
    ----------
    results : StudyResults
    command_of : callable
        Returns the command that runs a member on its own.
    conditions : sequence of str
        Such as ``rms < 0.1``: the share of members that pass each is printed.
    worst : int
        How many of the worst members of each metric are shown.
    as_json : bool

    Raises
    ------
    UsageError
        If a condition is none; nothing is printed then.
    """
    shares = [passed_share(results.columns, results.layout, text) for text in conditions]
    if as_json:
        print_json(study_content(results, command_of, shares=shares, worst=worst))
        return
    statistics = study_statistics(results.columns, results.layout)
    correlations = rank_correlations(results.columns, results.layout)
    print_line(_overview(results))
    if results.done:
        print_line(wall_time_text(results))
    _print_statistics(results, statistics)
    _print_shares(shares)
    print_basis(statistics, shares)
    print_correlations(results, correlations)
    print_failures(results, command_of)
    print_warnings(results)
    _print_groups("ended before their stop time", ends_by_reason(results.columns))
    _print_extremes(results, command_of, worst)


def study_content(
    results: StudyResults,
    command_of: CommandOf,
    *,
    shares: Sequence[PassedShare] = (),
    worst: int = WORST,
) -> dict[str, Any]:
    """Return what :func:`print_study` prints, as plain values for JSON."""
    columns = results.columns
    statistics = study_statistics(columns, results.layout)
    correlations = rank_correlations(columns, results.layout)
    extremes = {}
    for name, one in statistics.items():
        if one.count:
            extremes[name] = worst_members(columns, name, worst).tolist()
    return {
        "name": results.name,
        "design": results.layout.to_dict(),
        "members": members_content(results),
        "wall_time": float(results.wall_times.sum()),
        "median_wall_time": median_time(results),
        "statistics": {name: one.to_dict() for name, one in statistics.items()},
        "passed": [share.to_dict() for share in shares],
        "correlations": [one.to_dict() for one in correlations],
        "failures": failures_content(results, command_of),
        "warnings": [group.to_dict() for group in warnings_by_text(columns)],
        "ended_early": [group.to_dict() for group in ends_by_reason(columns)],
        "worst": extremes,
    }


def members_content(results: StudyResults) -> dict[str, int]:
    """Return how many members there are, as plain values for JSON."""
    return {
        "planned": results.planned,
        "done": results.done,
        "failed": results.failed,
        "missing": len(results.missing),
    }


def failures_content(results: StudyResults, command_of: CommandOf) -> list[dict[str, Any]]:
    """Return the failures by their reasons, as plain values for JSON."""
    failures = []
    for group in failures_by_reason(results.columns):
        failures.append({**group.to_dict(), "command": command_of(int(group.numbers[0]))})
    return failures


def print_failures(results: StudyResults, command_of: CommandOf) -> None:
    """Print the failures by their reasons, and a command for each."""
    failures = failures_by_reason(results.columns)
    _print_groups("failures", failures)
    for group in failures[:_MOST_REASONS]:
        _print_command(int(group.numbers[0]), command_of)


def print_warnings(results: StudyResults) -> None:
    """Print how many members warn of what."""
    for line in warning_lines(warnings_by_text(results.columns), results.done):
        print_line(line)


def _overview(results: StudyResults) -> str:
    missing = results.missing
    parts = [f"{results.done} of {results.planned} members done"]
    if len(missing):
        parts.append(f"{len(missing)} missing ({members_text(missing)})")
    parts.append(f"{results.failed} failed" if results.failed else "none failed")
    return f"{results.name}: {results.layout.text}; {', '.join(parts)}"


def _print_statistics(results: StudyResults, statistics: dict[str, MetricStatistics]) -> None:
    figures = [one for one in statistics.values() if one.count]
    if figures:
        heads = [percent_text(quantile.probability) for quantile in figures[0].quantiles]
        columns = ("", "members", "mean", "deviation", *heads)
        table = new_table("statistics", columns)
        for one in figures:
            table.add_row(
                results.with_unit(one.name),
                str(one.count),
                text_with_half_width(one.mean, one.mean_interval),
                number_text(one.deviation, _DIGITS),
                *(number_text(quantile.value, _DIGITS) for quantile in one.quantiles),
            )
        print_table(table)
    for one in statistics.values():
        _print_texts(one)
        _print_without(results, one)


def _print_texts(statistics: MetricStatistics) -> None:
    if not statistics.texts:
        return
    texts = [f"{count} {text}" for text, count in statistics.texts.items()]
    more = len(texts) - _MOST_TEXTS
    shown = "; ".join(texts[:_MOST_TEXTS])
    others = f"; and {count_text(more, 'other text')}" if more > 0 else ""
    print_line(f"{statistics.name}: {shown}{others}")


def _print_without(results: StudyResults, statistics: MetricStatistics) -> None:
    """Name the members that the figures of a metric are not of, but those that failed."""
    column = results.columns.metrics[statistics.name]
    for words, numbers in (("no value", column.without_value), ("infinite", column.infinite)):
        if len(numbers):
            counted = count_text(len(numbers))
            print_line(f"{statistics.name}: {words} in {counted}: {members_text(numbers)}")


def _print_shares(shares: Sequence[PassedShare]) -> None:
    if not shares:
        return
    table = new_table("passed", ("", "members", "share", "95 % interval", "not passed"))
    for share in shares:
        value = "" if share.share is None else f"{100.0 * share.share:.3g} %"
        why = [members_text(share.not_passed)] if len(share.not_passed) else []
        if share.failed:
            why.append(f"{share.failed} of them failed")
        if share.without_value:
            why.append(f"{share.without_value} of them have no value")
        table.add_row(
            share.condition,
            f"{share.passed} of {share.of}",
            value,
            percent_interval_text(share.interval),
            "; ".join(why),
        )
    print_table(table)


def _print_groups(title: str, groups: Sequence[ReasonGroup]) -> None:
    if not groups:
        return
    table = new_table(title, ("members", "first of them", "reason"))
    for group in groups[:_MOST_REASONS]:
        table.add_row(str(len(group.numbers)), members_text(group.numbers), group.reason)
    print_table(table)
    more = len(groups) - _MOST_REASONS
    if more > 0:
        print_line(f"and {count_text(more, 'other reason')}; see --json")


def _print_command(number: int, command_of: CommandOf) -> None:
    print_line(f"member {number} alone: {command_of(number)}")


def _print_extremes(results: StudyResults, command_of: CommandOf, count: int) -> None:
    columns = results.columns
    table = new_table("smallest and largest values, by member", ("", "smallest", "largest"))
    first = None
    for name, column in columns.metrics.items():
        if column.is_text or not count or not (len(column.values) or len(column.infinite)):
            continue
        largest = worst_members(columns, name, count)
        smallest = best_members(columns, name, 1)
        first = largest[0] if first is None else first
        cells = [_with_values(columns, name, numbers) for numbers in (smallest, largest)]
        table.add_row(results.with_unit(name), *cells)
    if first is not None:
        print_table(table)
        _print_command(int(first), command_of)


def _with_values(columns: MemberColumns, metric: str, numbers: NumberColumn) -> str:
    values = columns.numeric(metric)[columns.rows_of(numbers)]
    pairs = zip(numbers.tolist(), values.tolist(), strict=True)
    return ", ".join(f"{number}: {number_text(value)}" for number, value in pairs)
