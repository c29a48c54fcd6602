"""Metrics of a study, with every figure and its interval."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from rich.table import Table

from cosim.errors import listing
from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.studies.analysis.columns import MemberColumns
from cosim.studies.analysis.confidence import NO_INTERVAL
from cosim.studies.analysis.correlation import (
    LEAST_MEMBERS,
    RankCorrelation,
    rank_correlations,
    strongest,
)
from cosim.studies.analysis.extremes import best_members, worst_members
from cosim.studies.analysis.results import StudyResults
from cosim.studies.analysis.statistics import MetricStatistics, study_statistics
from cosim.studies.tables.numbers import interval_text, members_text, number_text, percent_text

_METHODS: Final = (
    "mean: Student's t; standard deviation: Bonett; quantiles: order statistics; rank "
    "correlations: Fisher's z"
)
_MOST_MEMBERS: Final = 20  # with the largest and smallest values, in JSON


def print_metrics(results: StudyResults, names: Sequence[str], *, as_json: bool = False) -> None:
    """Print the statistics of metrics with all intervals, their extremes and correlations.

    Raises
    ------
    UsageError
        If there is no such metric, or it is a text; nothing is printed then.
    """
    columns = results.columns
    for name in names:
        columns.metric(name)
    statistics = study_statistics(columns, results.layout)
    correlations = rank_correlations(columns, results.layout)
    if as_json:
        content = {}
        for name in names:
            content[name] = {
                **statistics[name].to_dict(),
                "correlations": [one.to_dict() for one in strongest(correlations, name)],
                "largest": worst_members(columns, name, _MOST_MEMBERS).tolist(),
                "smallest": best_members(columns, name, _MOST_MEMBERS).tolist(),
            }
        print_json(content)
        return
    for name in names:
        of_metric = [one for one in correlations if one.metric == name]
        _print_metric(results, statistics[name], of_metric)


def _print_metric(
    results: StudyResults, statistics: MetricStatistics, correlations: Sequence[RankCorrelation]
) -> None:
    columns = results.columns
    name = statistics.name
    table = new_table(results.with_unit(name), ("", "", "95 % interval"))
    table.add_row("members", str(statistics.count), "")
    for words, count in (
        ("failed", statistics.failed),
        ("no value", statistics.without_value),
        ("infinite", statistics.infinite),
    ):
        if count:
            table.add_row(words, str(count), "")
    table.add_row("mean", number_text(statistics.mean), interval_text(statistics.mean_interval))
    deviation = interval_text(statistics.deviation_interval)
    table.add_row("standard deviation", number_text(statistics.deviation), deviation)
    for quantile in statistics.quantiles:
        head = percent_text(quantile.probability)
        table.add_row(head, number_text(quantile.value), interval_text(quantile.interval))
    _add_extremes(table, columns, name)
    for one in strongest(correlations, name):
        label = f"rank correlation with {one.parameter}"
        table.add_row(label, f"{one.value:+.3f}", interval_text(one.interval))
    print_table(table)
    for line in _notes(results, statistics, correlations):
        print_line(line)


def _notes(
    results: StudyResults, statistics: MetricStatistics, correlations: Sequence[RankCorrelation]
) -> Iterator[str]:
    """Yield what the figures are of, and what is missing."""
    column = results.columns.metrics[statistics.name]
    if results.layout.kind == "saltelli":
        yield (
            "statistics: members of matrices A and B; smallest, largest and missing values: all "
            "members"
        )
    yield f"95 % intervals: {statistics.basis}"
    if statistics.mean_interval != NO_INTERVAL:
        yield _METHODS
    if statistics.is_rough:
        yield "the interval of the mean may be too narrow (few members or skewed values)"
    few = [one.parameter for one in correlations if one.count < LEAST_MEMBERS]
    if few:
        which = "" if len(few) == len(correlations) else f" with {listing(few)}"
        yield f"rank correlations{which}: none for fewer than {LEAST_MEMBERS} members"
    for words, numbers in (("no value", column.without_value), ("infinite", column.infinite)):
        if len(numbers):
            yield f"{words} in members {members_text(numbers)}"


def _add_extremes(table: Table, columns: MemberColumns, name: str) -> None:
    """Add the smallest and the largest value of all members, and whose they are."""
    for words, numbers in (
        ("smallest", best_members(columns, name, 5)),
        ("largest", worst_members(columns, name, 5)),
    ):
        values = columns.numeric(name)[columns.rows_of(numbers[:1])]
        text = number_text(float(values[0])) if len(values) else ""
        table.add_row(words, text, f"members {members_text(numbers)}" if text else "")
