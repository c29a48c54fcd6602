"""Every parameter and metric over every other one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError
from cosim.report.plots.curves import COLORS, shown_text
from cosim.report.plots.picture import PictureOptions
from cosim.studies.layout import NumberColumn, StudyResults, count_text
from cosim.studies.plots.panels import (
    FAILED,
    FAILED_COLOR,
    MOST_MARKS,
    shown_metrics,
    sized_picture,
    spread_rows,
)
from cosim.studies.plots.scales import Scale, cell_edges, check_drawable, even_edges, is_logarithmic
from cosim.studies.statistics import LEAST_MEMBERS, spearman

_MOST: Final = 7  # rows and columns
_PANEL: Final = 3.8  # cm
_MARGIN: Final = 2.0  # cm, for names and numbers
_TEXT: Final = 9.0  # [points]; a picture of all rows is made smaller to fit a page
_TICKS: Final = 3  # intervals of a linear axis, at most
_MOST_POINTS: Final = 4000  # that are drawn one by one
_CELLS: Final = 50
_FAINTEST: Final = 0.5  # members of a cell that would be white: one is not
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

    Raises
    ------
    UsageError
        If there is one parameter or metric.
    """
    names = shown_metrics(results, metrics)
    quantities = [_parameter(results, key) for key in keys]
    quantities += [_metric(results, name) for name in names]
    shown = _chosen(quantities)
    count = len(shown)
    if count < 2:
        raise UsageError(
            "plot kind 'scatter': expected at least 2 parameters or metrics, got "
            f"{count_text(count, 'parameter or metric')}"
        )
    length = _PANEL * count + _MARGIN
    picture = sized_picture(count * count, count, options, size=(length, length))
    handles = _draw_panels(results, picture.panels, shown)
    if handles:
        picture.legend(handles[:1], below=True)
    notes = [count_text(results.done)]
    if results.failed:
        notes.append(f"{results.failed} failed")
    if count < len(quantities):
        notes.append(f"{count} of {len(quantities)} parameters and metrics")
    if results.done > _MOST_POINTS:
        notes.append("the darker, the more members")
    if results.done < LEAST_MEMBERS:
        notes.append("too few members for rank correlations")
    else:
        notes.append("rank correlations above the diagonal")
    picture.save(out, title=shown_text(f"{results.name}: {', '.join(notes)}"))


def _draw_panels(
    results: StudyResults, panels: Sequence[Any], shown: Sequence[_Quantity]
) -> list[Any]:
    """Draw points below the diagonal, histograms on it, and rank correlations above it.

    Return the marks of failed members.
    """
    count = len(shown)
    matrix = np.reshape(np.array(panels, object), (count, count))
    failed = np.flatnonzero(results.columns.failed)
    marks: list[Any] = []
    for row, y in enumerate(shown):
        for column, x in enumerate(shown):
            panel = matrix[row, column]
            _share_axes(matrix, row, column)
            if column > row:
                _write_correlation(panel, x, y)
                continue
            if column == row:
                _draw_histogram(panel, x)
            else:
                _draw_points(panel, x, y)
                if not (x.is_metric or y.is_metric) and len(failed):
                    marks += _draw_failed(panel, x, y, failed)
            _label(panel, results, x, y, last=row == count - 1, first=column == 0)
    return marks


def _share_axes(panels: Any, row: int, column: int) -> None:
    """Share the axes of a panel with those below it, and left of it."""
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


def _draw_points(panel: Any, x: _Quantity, y: _Quantity) -> None:
    first, other = _both(x, y)
    if not len(first):
        return
    if len(first) > _MOST_POINTS:
        from matplotlib.colors import LogNorm

        edges = [_edges(x.scale, first), _edges(y.scale, other)]
        norm = LogNorm(vmin=_FAINTEST)
        # as dots: as paths the cells of all panels would take 12 MB
        panel.hist2d(first, other, bins=edges, cmap="Blues", cmin=1, norm=norm, rasterized=True)
    else:
        size = 2.0 if len(first) > 500 else 4.0
        panel.plot(first, other, ".", color=COLORS[0], markersize=size, alpha=0.6)


def _edges(scale: Scale, values: Vector) -> Vector:
    """Return the edges of cells: of few values halfway between these, else of one width."""
    different = np.unique(values)
    if len(different) <= _CELLS:
        return cell_edges(different, logarithmic=scale.logarithmic)
    return even_edges(values, _CELLS, logarithmic=scale.logarithmic)


def _draw_failed(panel: Any, x: _Quantity, y: _Quantity, failed: NumberColumn) -> list[Any]:
    """Mark members that failed, of many some that are spread over the study."""
    rows = failed[spread_rows(len(failed), MOST_MARKS)]
    label = FAILED
    if len(rows) < len(failed):
        label = f"{len(rows)} of the {len(failed)} {FAILED}"
    marks: list[Any] = panel.plot(
        x.scale.positions[rows],
        y.scale.positions[rows],
        "x",
        color=FAILED_COLOR,
        markersize=4.0,
        label=label,
    )
    return marks


def _draw_histogram(panel: Any, x: _Quantity) -> None:
    values = x.scale.positions[np.isfinite(x.scale.positions)]
    if not len(values):
        return
    different = len(np.unique(values))
    bins = even_edges(values, min(_BINS, max(different, 5)), logarithmic=x.scale.logarithmic)
    if x.scale.names:
        bins = np.arange(len(x.scale.names) + 1.0) - 0.5
    panel.hist(values, bins=bins, color=COLORS[5], edgecolor="white", linewidth=0.3)


def _write_correlation(panel: Any, x: _Quantity, y: _Quantity) -> None:
    """Write the rank correlation, the larger the stronger it is."""
    panel.set_axis_off()
    if x.scale.names or y.scale.names:
        return
    first, other = _both(x, y)
    value = spearman(first, other) if len(first) >= LEAST_MEMBERS else None
    if value is None:
        return
    size = _TEXT + 7.0 * abs(value)
    text = f"{value:+.2f}".replace("-0.00", "+0.00")
    panel.text(0.5, 0.5, text, ha="center", va="center", fontsize=size, color="0.3")


def _both(x: _Quantity, y: _Quantity) -> tuple[Vector, Vector]:
    """Return the values of the members that have both."""
    rows = np.isfinite(x.scale.positions) & np.isfinite(y.scale.positions)
    return x.scale.positions[rows], y.scale.positions[rows]


def _label(
    panel: Any, results: StudyResults, x: _Quantity, y: _Quantity, *, last: bool, first: bool
) -> None:
    """Write names at the outer axes only: there is no room at the others."""
    panel.tick_params(labelsize=_TEXT)
    x.scale.apply(panel, "x")
    if x is not y:
        y.scale.apply(panel, "y")
    _thin_ticks(panel.xaxis, x)
    _thin_ticks(panel.yaxis, y)
    if last:
        x.scale.label(panel.xaxis, results.with_unit(x.name))
        panel.xaxis.label.set_size(_TEXT)
        panel.tick_params(axis="x", labelrotation=45)
    else:
        panel.tick_params(axis="x", which="both", labelbottom=False)
    if x is y:  # counts of members: their scale is another in each panel
        panel.tick_params(axis="y", which="both", left=False, labelleft=False)
        if first:
            panel.set_ylabel(shown_text(results.with_unit(y.name)), fontsize=_TEXT)
    elif first:
        y.scale.label(panel.yaxis, results.with_unit(y.name))
        panel.yaxis.label.set_size(_TEXT)
    else:
        panel.tick_params(axis="y", which="both", labelleft=False)


def _thin_ticks(axis: Any, of: _Quantity) -> None:
    """Leave as many numbers at an axis as there is room for."""
    from matplotlib.ticker import NullFormatter

    if of.scale.logarithmic:
        axis.set_minor_formatter(NullFormatter())
    elif not of.scale.names:
        axis.get_major_locator().set_params(nbins=_TICKS)
