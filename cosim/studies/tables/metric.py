"""One metric of a study, with every figure and its interval."""

from __future__ import annotations

from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.studies.analysis.correlation import rank_correlations, strongest
from cosim.studies.analysis.extremes import best_members, worst_members
from cosim.studies.analysis.results import StudyResults
from cosim.studies.analysis.statistics import study_statistics
from cosim.studies.tables.numbers import interval_text, members_text, number_text, percent_text


def print_metric(results: StudyResults, name: str, *, as_json: bool = False) -> None:
    """Print the statistics of a metric with all intervals, its extremes and correlations.

    Raises
    ------
    UsageError
        If there is no such metric, or it is a text.
    """
    columns = results.columns
    column = columns.metric(name)
    statistics = study_statistics(columns, results.layout)[name]
    correlations = strongest(rank_correlations(columns, results.layout), name)
    if as_json:
        content = {
            **statistics.to_dict(),
            "correlations": [one.to_dict() for one in correlations],
            "worst": worst_members(columns, name, 20).tolist(),
            "best": best_members(columns, name, 20).tolist(),
        }
        print_json(content)
        return
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
    smallest = best_members(columns, name, 5)
    largest = worst_members(columns, name, 5)
    table.add_row("smallest", number_text(statistics.minimum), f"members {members_text(smallest)}")
    table.add_row("largest", number_text(statistics.maximum), f"members {members_text(largest)}")
    for one in correlations:
        label = f"rank correlation with {one.parameter}"
        table.add_row(label, f"{one.value:+.3f}", interval_text(one.interval))
    print_table(table)
    print_line(f"intervals: {statistics.basis}")
    for words, numbers in (("no value", column.without_value), ("infinite", column.infinite)):
        if len(numbers):
            print_line(f"{words} in members {members_text(numbers)}")
