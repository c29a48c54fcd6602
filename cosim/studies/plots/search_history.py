"""The objective of each member of a search, and the best one so far."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError, quoted
from cosim.report.plots.curves import COLORS, WIDTH
from cosim.report.plots.picture import PictureOptions
from cosim.studies.analysis.columns import MetricColumn
from cosim.studies.analysis.results import StudyResults
from cosim.studies.plots.panels import MetricPanels, draw_members, mark_failed
from cosim.studies.plots.scales import check_drawable, is_logarithmic
from cosim.studies.running.recorded_study import RecordedSearch

_BEST: Final = COLORS[0]


def plot_search(
    results: StudyResults,
    out: Path,
    metrics: Sequence[str],
    options: PictureOptions,
    *,
    search: RecordedSearch,
) -> None:
    """Draw the objective of each member of a search, and the best one so far.

    Parameters
    ----------
    results, out, metrics, options
        As of :func:`plot_study`.
    search : RecordedSearch
        That chose the members.

    Raises
    ------
    UsageError
        If another metric than the objective is named.
    """
    for name in metrics:
        if name != search.metric:
            raise UsageError(
                f"a picture of kind 'search': found the metric {quoted(name)}, needed "
                f"{quoted(search.metric)}, by which is searched; other kinds show other metrics"
            )
    picture = MetricPanels(results, [search.metric], options)
    (panel,) = picture.panels
    (column,) = picture.columns
    check_drawable(column.name, column.values)
    label = picture.label(panel, column)
    _draw(panel, column, int(results.columns.numbers[-1]), maximize=search.maximize)
    if is_logarithmic(column.values):
        panel.set_yscale("log")
    panel.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
    panel.set_xlabel("member")
    panel.set_ylabel(label)
    picture.legend(panel.get_lines())
    picture.save(out, f"{search.method}, {search.goal}")


def best_so_far(column: MetricColumn, last: int, *, maximize: bool) -> tuple[Vector, Vector]:
    """Return the numbers of members, and the best value up to each.

    From the first that has a value to the last of all, which may have failed.
    """
    accumulate = (np.maximum if maximize else np.minimum).accumulate
    best = accumulate(column.values)
    return np.append(column.numbers.astype(np.float64), last), np.append(best, best[-1])


def _draw(panel: Any, column: MetricColumn, last: int, *, maximize: bool) -> None:
    """Draw members, those that failed, the best value so far, and whose the best of all is."""
    numbers, best = best_so_far(column, last, maximize=maximize)
    draw_members(panel, numbers[:-1], column.values, "black", label="members")
    panel.plot(
        numbers,
        best,
        drawstyle="steps-post",
        color=_BEST,
        linewidth=WIDTH,
        label="best so far",
    )
    row = int(column.values.argmax() if maximize else column.values.argmin())
    number = int(column.numbers[row])
    label = f"best: member {number}"
    panel.plot(number, best[-1], "o", color=_BEST, markersize=6.0, label=label)
    mark_failed(panel, column.failed.astype(np.float64))
