"""The objective of each trial of a search, and the best one so far."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError, quoted
from cosim.report.plots.curves import COLORS, WIDTH
from cosim.report.plots.picture import PictureOptions
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

    Raises
    ------
    UsageError
        If another metric than the objective is named.
    """
    for name in metrics:
        if name != search.metric:
            raise UsageError(
                f"a picture of kind 'search': found the metric {quoted(name)}, needed "
                f"{quoted(search.metric)}, which is what is searched by"
            )
    picture = MetricPanels(results, [search.metric], options)
    (panel,) = picture.panels
    (column,) = picture.columns
    check_drawable(column.name, column.values)
    label = picture.label(panel, column)
    numbers = column.numbers.astype(np.float64)
    draw_members(panel, numbers, column.values, "black", label="members")
    best = best_so_far(column.values, maximize=search.maximize)
    until = float(results.columns.numbers[-1])  # the last may have failed
    panel.plot(
        np.append(numbers, until),
        np.append(best, best[-1]),
        drawstyle="steps-post",
        color=_BEST,
        linewidth=WIDTH,
        label="best so far",
    )
    first = int(np.flatnonzero(column.values == best[-1])[0])
    panel.plot(
        numbers[first],
        best[first],
        "o",
        color=_BEST,
        markersize=6.0,
        label=f"best: member {column.numbers[first]}",
    )
    mark_failed(panel, column.failed.astype(np.float64))
    if is_logarithmic(column.values):
        panel.set_yscale("log")
    panel.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
    panel.set_xlabel("member")
    panel.set_ylabel(label)
    picture.legend(panel.get_lines())
    picture.save(out, f"{search.method}, {search.goal}")


def best_so_far(values: Vector, *, maximize: bool) -> Vector:
    """Return the best of the values up to each."""
    best: Vector = (np.maximum if maximize else np.minimum).accumulate(values)
    return best
