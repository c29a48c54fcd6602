"""The objective of each member of a search, and the best one so far."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.report.plots.curves import COLORS, WIDTH
from cosim.report.plots.picture import PictureOptions
from cosim.studies.layout import MetricColumn, StudyResults, count_text
from cosim.studies.plan import RecordedSearch
from cosim.studies.plots.panels import FAILED, MetricPanels, mark_failed
from cosim.studies.plots.scales import check_drawable, is_logarithmic, reach_beside, zero_width

_BEST: Final = COLORS[0]
_TOLD_APART: Final = 1e-5  # of a value: numbers at an axis have six digits
_WITHOUT_VALUE: Final = "members that failed, or have no finite value"


def plot_search(
    results: StudyResults,
    out: Path,
    options: PictureOptions,
    *,
    search: RecordedSearch,
) -> None:
    """Draw the objective of each member of a search, and the best one so far.

    Parameters
    ----------
    results, out, options
        As of :func:`plot_study`.
    search : RecordedSearch
        That chose the members.
    """
    picture = MetricPanels(results, [search.metric], options)
    (panel,) = picture.panels
    (column,) = picture.columns
    check_drawable(column.name, column.values)
    label = picture.label(panel, column)
    _draw(panel, column, int(results.columns.numbers[-1]), maximize=search.maximize)
    _scale(panel, column.values)
    panel.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
    panel.set_xlabel("member")
    panel.set_ylabel(label)
    picture.legend(panel.get_lines())
    count = f"{count_text(results.done)} of at most {results.planned}"
    picture.save(out, f"{search.method}, {search.goal}; {count}")


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
    panel.plot(
        numbers,
        best,
        drawstyle="steps-post",
        color=_BEST,
        linewidth=WIDTH,
        label="best so far",
    )
    panel.plot(numbers[:-1], column.values, "o", color="0.4", markersize=3.0, label="members")
    row = int(column.values.argmax() if maximize else column.values.argmin())
    number = int(column.numbers[row])
    label = f"best: member {number}"
    panel.plot(number, best[-1], "o", color=_BEST, markersize=6.0, label=label)
    others = np.concatenate([column.without_value, column.infinite])
    places = np.concatenate([column.failed, others]).astype(np.float64)
    mark_failed(panel, places, label=_WITHOUT_VALUE if len(others) else FAILED)


def _scale(panel: Any, values: Vector) -> None:
    """Show small values beside large ones; write numbers out: above the frame are marks."""
    if is_logarithmic(values):
        panel.set_yscale("log")
        return
    width = zero_width(values)
    if width is not None:
        panel.set_yscale("symlog", linthresh=width)
        return
    panel.yaxis.set_major_formatter("{x:g}")
    middle = float(np.median(values))
    if np.ptp(values) <= _TOLD_APART * abs(middle):
        reach = reach_beside(middle)
        panel.set_ylim(middle - reach, middle + reach)
