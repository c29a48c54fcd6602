"""How the means of metrics converge with the number of members."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.report.plots.curves import COLORS, WIDTH
from cosim.report.plots.picture import PictureOptions
from cosim.studies.layout import StudyResults, independence_of
from cosim.studies.plots.panels import FAINT, MetricPanels
from cosim.studies.plots.scales import check_drawable
from cosim.studies.statistics import CONFIDENCE, RunningMean, running_mean

_MOST_ROWS: Final = 2000  # of a curve
_MARKED: Final = 10  # rows, of which a line alone would show little, or nothing
_PERCENT: Final = f"{100.0 * CONFIDENCE:g} %"
_FIRST: Final = 5  # units: the interval of fewer would hide the rest


def plot_convergence(
    results: StudyResults, out: Path, metrics: Sequence[str], options: PictureOptions
) -> None:
    """Draw the mean of each metric over the members, with its 95 % interval.

    Raises
    ------
    UsageError
        If the members of the study were not drawn.
    """
    picture = MetricPanels(results, metrics, options)
    independence = independence_of(results.layout)
    handles: list[Any] = []
    for panel, column in zip(picture.panels, picture.columns, strict=True):
        check_drawable(column.name, column.values)
        label = picture.label(panel, column, "mean of {}")
        means = _thinned(running_mean(column, independence))
        handles = _draw(panel, means)
        panel.set_xlabel("members")
        panel.set_ylabel(label)
    picture.legend(handles)
    picture.save(out, f"convergence of the mean; {independence.basis}")


def _draw(panel: Any, means: RunningMean) -> list[Any]:
    lower = means.means - means.half_widths
    upper = means.means + means.half_widths
    color = COLORS[0]
    band = panel.fill_between(
        means.counts,
        lower,
        upper,
        color=color,
        alpha=FAINT,
        linewidth=0.0,
        label=f"{_PERCENT} interval of each",
    )
    style = {"marker": "."} if len(means.counts) <= _MARKED else {}
    (line,) = panel.plot(
        means.counts, means.means, color=color, linewidth=WIDTH, label="mean of the first", **style
    )
    last = panel.axhline(means.means[-1], color="0.6", linewidth=1.0, label="mean of all")
    if means.counts[-1] > 100 * means.counts[0]:
        panel.set_xscale("log")
    else:
        panel.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
    settled = slice(min(_FIRST, len(lower) // 2), None)
    shown = np.concatenate([lower[settled], upper[settled], means.means[settled]])
    shown = shown[np.isfinite(shown)]
    if len(shown) and np.ptp(shown) > 0.0:
        margin = 0.05 * float(np.ptp(shown))
        panel.set_ylim(float(shown.min()) - margin, float(shown.max()) + margin)
    return [line, band, last]


def _thinned(means: RunningMean) -> RunningMean:
    """Return as many rows as can be told apart, with one factor between them."""
    count = len(means.counts)
    if count <= _MOST_ROWS:
        return means
    rows = np.unique(np.geomspace(1, count, _MOST_ROWS).astype(np.int64) - 1)
    return RunningMean(means.counts[rows], means.means[rows], means.half_widths[rows])
