"""Statistics for each value of a varied key, as tables."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.errors import quoted
from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.studies.analysis.groups import MemberGroup, statistics_by
from cosim.studies.analysis.results import StudyResults
from cosim.studies.tables.numbers import number_text, percent_text, text_with_half_width


def print_groups(
    results: StudyResults, key: str, metrics: Sequence[str] = (), *, as_json: bool = False
) -> None:
    """Print a table for each metric, with a row for each value of a key.

    Parameters
    ----------
    results : StudyResults
    key : str
    metrics : sequence of str
        Empty: all that have values.
    as_json : bool

    Raises
    ------
    UsageError
        If there is no such metric or key, or it has too many values; nothing is printed then.
    """
    columns = results.columns
    for name in metrics:
        columns.metric(name)
    groups = statistics_by(columns, results.layout, key)
    if as_json:
        print_json({"key": key, "groups": [group.to_dict() for group in groups]})
        return
    with_values = [name for name, column in columns.metrics.items() if len(column.values)]
    for name in metrics or with_values:
        _print_metric(results, key, name, groups)
    if groups and groups[0].statistics:
        basis = next(iter(groups[0].statistics.values())).basis
        print_line(f"±, 95 % intervals: {basis}")
    shown = metrics or with_values
    if any(_is_rough(group, shown) for group in groups):
        print_line("± may be too small for groups of few members or with skewed values")


def _is_rough(group: MemberGroup, metrics: Sequence[str]) -> bool:
    return any(group.statistics[name].is_rough for name in metrics)


def _print_metric(
    results: StudyResults, key: str, name: str, groups: Sequence[MemberGroup]
) -> None:
    shown = [group.statistics[name] for group in groups]
    heads: list[str] = []
    for one in shown:
        heads = heads or [percent_text(quantile.probability) for quantile in one.quantiles]
    columns = (results.with_unit(key), "members", "failed", "mean", "deviation", *heads)
    table = new_table(results.with_unit(name), columns)
    for group, one in zip(groups, shown, strict=True):
        figures = [number_text(quantile.value, 5) for quantile in one.quantiles]
        table.add_row(
            group.value if isinstance(group.value, str) else quoted(group.value),
            str(one.count),
            str(group.failed) if group.failed else "",
            text_with_half_width(one.mean, one.mean_interval),
            number_text(one.deviation, 4),
            *(figures or [""] * len(heads)),
        )
    print_table(table)
