"""Every parameter and metric over every other one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.report.plots.curves import COLORS, shown_text
from cosim.report.plots.picture import PictureOptions
from cosim.studies.analysis.correlation import spearman
from cosim.studies.analysis.results import StudyResults
from cosim.studies.plots.panels import FAILED_COLOR, shown_metrics, sized_picture
from cosim.studies.plots.scales import Scale, check_drawable, even_edges, is_logarithmic

_MOST: Final = 7  # rows and columns
_PANEL: Final = 5.0  # cm
_MOST_POINTS: Final = 4000  # that are drawn one by one
_LABEL: Final = 22  # characters of a line at an axis
_CELLS: Final = 50
_BINS: Final = 24


@dataclass(frozen=True)
class _Quantity:
    """A parameter or metric of all members; NaN: a member has none."""

    name: str
    scale: Scale
    is_metric: bool


def plot_scatter(
    results: StudyResults,
    out: Path,
    metrics: Sequence[str],
    keys: Sequence[str],
    options: PictureOptions,
) -> None:
    """Draw every parameter and metric over every other one, with rank correlations.

    Members that failed have no metric: they are marked in the panels of parameters.
    """
    names = shown_metrics(results, metrics)
    quantities = [_parameter(results, key) for key in keys]
    quantities += [_metric(results, name) for name in names]
    shown = _chosen(quantities)
    count = len(shown)
    picture = sized_picture(count, count, options, size=(_PANEL * count, _PANEL * count))
    panels = np.reshape(np.array(picture.panels, object), (count, count))
    failed = results.columns.failed
    handles: list[Any] = []
    for row, y in enumerate(shown):
        for column, x in enumerate(shown):
            panel = panels[row, column]
            _share_axes(panels, row, column)
            if column > row:
                _write_correlation(panel, x, y)
                continue
            if column == row:
                _draw_histogram(panel, x)
            else:
                handles += _draw_points(panel, x, y)
                if not (x.is_metric or y.is_metric) and failed.any():
                    handles += _draw_failed(panel, x, y, failed)
            _label(panel, results, x, y, last=row == count - 1, first=column == 0)
    unique = {handle.get_label(): handle for handle in handles}
    if unique:
        picture.legend(list(unique.values()), below=True)
    title = f"{results.name}: {results.done} members, {results.failed} failed; rank correlations"
    if count < len(quantities):
        title += f"; {count} of {len(quantities)} parameters and metrics"
    picture.save(out, title=shown_text(title))


def _share_axes(panels: Any, row: int, column: int) -> None:
    """Give a panel the axes of those below it, and left of it."""
    panel = panels[row, column]
    panel.set_axisbelow(True)
    if column > row:
        return
    if row < len(panels) - 1:
        panel.sharex(panels[-1, column])
    if 0 < column < row:
        panel.sharey(panels[row, 0])


def _parameter(results: StudyResults, key: str) -> _Quantity:
    return _Quantity(key, Scale.of(results.columns.parameters[key]), is_metric=False)


def _metric(results: StudyResults, name: str) -> _Quantity:
    values = results.columns.numeric(name)
    values = np.where(np.isfinite(values), values, np.nan)
    check_drawable(name, values[np.isfinite(values)])
    return _Quantity(name, Scale(values, logarithmic=is_logarithmic(values)), is_metric=True)


def _chosen(quantities: Sequence[_Quantity]) -> list[_Quantity]:
    """Return as many as there is room for, of parameters and metrics alike."""
    parameters = [one for one in quantities if not one.is_metric]
    metrics = [one for one in quantities if one.is_metric]
    room = max(_MOST - len(metrics), (_MOST + 1) // 2)
    kept = parameters[:room]
    return [*kept, *metrics[: _MOST - len(kept)]]


def _draw_points(panel: Any, x: _Quantity, y: _Quantity) -> list[Any]:
    first, other = _both(x, y)
    if not len(first):
        return []
    if len(first) > _MOST_POINTS:
        edges = [
            even_edges(first, _CELLS, logarithmic=x.scale.logarithmic),
            even_edges(other, _CELLS, logarithmic=y.scale.logarithmic),
        ]
        panel.hist2d(first, other, bins=edges, cmap="Blues", cmin=1, norm="log")
    else:
        size = 2.0 if len(first) > 500 else 4.0
        panel.plot(first, other, ".", color=COLORS[0], markersize=size, alpha=0.6)
    return []


def _draw_failed(panel: Any, x: _Quantity, y: _Quantity, failed: Any) -> list[Any]:
    rows = np.flatnonzero(failed)[:_MOST_POINTS]
    marks: list[Any] = panel.plot(
        x.scale.positions[rows],
        y.scale.positions[rows],
        "x",
        color=FAILED_COLOR,
        markersize=4.0,
        label="failed",
    )
    return marks


def _draw_histogram(panel: Any, x: _Quantity) -> None:
    values = x.scale.positions[np.isfinite(x.scale.positions)]
    if not len(values):
        return
    different = len(np.unique(values))
    bins = even_edges(values, min(_BINS, max(different, 5)), logarithmic=x.scale.logarithmic)
    panel.hist(values, bins=bins, color=COLORS[5], edgecolor="white", linewidth=0.3)


def _write_correlation(panel: Any, x: _Quantity, y: _Quantity) -> None:
    """Write the rank correlation, the larger the stronger it is."""
    panel.set_axis_off()
    if x.scale.names or y.scale.names:
        return
    first, other = _both(x, y)
    value = spearman(first, other)
    if value is None:
        return
    size = 8.0 + 8.0 * abs(value)
    panel.text(0.5, 0.5, f"{value:+.2f}", ha="center", va="center", fontsize=size, color="0.3")


def _both(x: _Quantity, y: _Quantity) -> tuple[Vector, Vector]:
    """Return the values of the members that have both."""
    rows = np.isfinite(x.scale.positions) & np.isfinite(y.scale.positions)
    return x.scale.positions[rows], y.scale.positions[rows]


def _label(
    panel: Any, results: StudyResults, x: _Quantity, y: _Quantity, *, last: bool, first: bool
) -> None:
    """Write names at the outer axes only: there is no room at the others."""
    panel.tick_params(labelsize="small")
    x.scale.apply(panel, "x")
    if x is not y:
        y.scale.apply(panel, "y")
    if last:
        x.scale.label(panel.xaxis, results.with_unit(x.name), width=_LABEL)
        panel.xaxis.label.set_size("small")
        panel.tick_params(axis="x", labelrotation=45)
    else:
        panel.tick_params(axis="x", which="both", labelbottom=False)
    if x is y:
        panel.tick_params(axis="y", which="both", labelleft=False)
        if first:
            text = fill(shown_text(results.with_unit(y.name)), _LABEL)
            panel.set_ylabel(text, fontsize="small")
    elif first:
        y.scale.label(panel.yaxis, results.with_unit(y.name), width=_LABEL)
        panel.yaxis.label.set_size("small")
    else:
        panel.tick_params(axis="y", which="both", labelleft=False)
