"""Sobol indices of a study as tables."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.errors import UsageError
from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.studies.analysis.columns import count_text
from cosim.studies.analysis.confidence import ConfidenceInterval
from cosim.studies.analysis.results import StudyResults
from cosim.studies.analysis.sensitivity import SobolIndices, check_has_indices, sobol_indices
from cosim.studies.tables.numbers import members_text


def print_sobol(
    results: StudyResults, metrics: Sequence[str] = (), *, as_json: bool = False
) -> None:
    """Print the Sobol indices of metrics; of all that are numbers where none are named.

    Raises
    ------
    UsageError
        If the design of the study is none of Saltelli's, or a metric that is named, or each metric,
        has no indices.
    """
    check_has_indices(results.layout)
    found: list[SobolIndices] = []
    without: list[str] = []
    for name in metrics or results.columns.raw_metrics:
        try:
            found.append(sobol_indices(results.columns, results.layout, name))
        except UsageError as error:
            if metrics:
                raise
            without.append(str(error))
    if without and not found:
        raise UsageError("; ".join(without))
    if as_json:
        print_json({indices.metric: indices.to_dict() for indices in found})
        return
    for indices in found:
        _print_indices(indices, results)
    for text in without:
        print_line(text, error=True)


def _print_indices(indices: SobolIndices, results: StudyResults) -> None:
    columns = ("", "first order", "95 % interval", "total order", "95 % interval")
    table = new_table(f"Sobol indices of {results.with_unit(indices.metric)}", columns)
    order = sorted(range(len(indices.parameters)), key=lambda k: -float(indices.total_order[k]))
    for k in order:
        table.add_row(
            indices.parameters[k],
            f"{indices.first_order[k]:.3f}",
            _ends(indices.first_intervals[k]),
            f"{indices.total_order[k]:.3f}",
            _ends(indices.total_intervals[k]),
        )
    total = f"{indices.first_order.sum():.3f}"
    table.add_row("sum", total, "", f"{indices.total_order.sum():.3f}", "")
    print_table(table)
    has_intervals = indices.first_intervals[0].lower is not None
    basis = "rough (bootstrap)" if has_intervals else "none (too few)"
    points = count_text(indices.base_points, "base point")
    print_line(f"of {points}; 95 % intervals: {basis}")
    if indices.remark:
        print_line(indices.remark)
    if len(indices.omitted):
        left_out = count_text(len(indices.omitted), "base point")
        print_line(
            f"omitted: {left_out} with a member that failed, has no value or is missing: "
            f"{members_text(indices.omitted)}; the indices are biased if this depends on the "
            "parameters"
        )


def _ends(interval: ConfidenceInterval) -> str:
    if interval.lower is None or interval.upper is None:
        return ""
    return f"{interval.lower:.3f} to {interval.upper:.3f}"
