"""Metrics over two varied keys, as colors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.report.plots.picture import PictureOptions
from cosim.studies.analysis.columns import NumberColumn
from cosim.studies.analysis.results import StudyResults
from cosim.studies.plots.panels import FAILED_COLOR, MetricPanels, placed
from cosim.studies.plots.scales import (
    Scale,
    cell_edges,
    check_drawable,
    even_edges,
    is_logarithmic,
)

_MOST_CELLS: Final = 60  # along an axis; more values are put together
_EVEN_CELLS: Final = 25  # that they are put together in; fewer of few members
_MOST_MARKS: Final = 2000


def plot_heat_maps(
    results: StudyResults,
    out: Path,
    metrics: Sequence[str],
    keys: Sequence[str],
    options: PictureOptions,
) -> None:
    """Draw the mean of each metric over two keys, and mark where members failed."""
    from matplotlib.colors import LogNorm

    results, note = placed(results, keys)
    picture = MetricPanels(results, metrics, options)
    scales = [Scale.of(results.columns.parameters[key]) for key in keys]
    edges = [_edges(scale) for scale in scales]
    failed = np.flatnonzero(results.columns.failed)
    handles: list[Any] = []
    for panel, column in zip(picture.panels, picture.columns, strict=True):
        check_drawable(column.name, column.values)
        label = picture.label(panel, column)
        rows = results.columns.rows_of(column.numbers)
        means = cell_means(column.values, [scale.positions[rows] for scale in scales], edges)
        shown = means[np.isfinite(means)]
        norm = LogNorm() if is_logarithmic(shown) else None
        mesh = panel.pcolormesh(edges[0], edges[1], means.T, cmap="viridis", norm=norm, zorder=1.0)
        panel.figure.colorbar(mesh, ax=panel, label=label)
        handles = _draw_failed(panel, scales, failed)
        for scale, direction, axis, key in zip(
            scales, "xy", (panel.xaxis, panel.yaxis), keys, strict=True
        ):
            scale.apply(panel, direction)
            scale.label(axis, results.with_unit(key))
    if handles:
        picture.legend(handles)
    picture.save(out, f"mean over {keys[0]} and {keys[1]}{note}")


def _edges(scale: Scale) -> Vector:
    different = np.unique(scale.positions)
    if len(different) <= _MOST_CELLS:
        return cell_edges(different, logarithmic=scale.logarithmic)
    count = min(max(math.isqrt(len(scale.positions)) // 2, 5), _EVEN_CELLS)
    return even_edges(scale.positions, count, logarithmic=scale.logarithmic)


def cell_means(values: Vector, places: Sequence[Vector], edges: Sequence[Vector]) -> Vector:
    """Return the mean of the members in each cell, shape (columns, rows); NaN: there are none."""
    shape = [len(one) - 1 for one in edges]
    cells = np.zeros(len(values), np.int64)
    for position, edge, count in zip(places, edges, shape, strict=True):
        index = np.clip(np.searchsorted(edge, position, side="right") - 1, 0, count - 1)
        cells = cells * count + index
    total = int(np.prod(shape))
    sums = np.bincount(cells, weights=values, minlength=total)
    counts = np.bincount(cells, minlength=total)
    with np.errstate(invalid="ignore"):
        return (sums / counts).reshape(shape)


def _draw_failed(panel: Any, scales: Sequence[Scale], rows: NumberColumn) -> list[Any]:
    if not len(rows):
        return []
    chosen = rows[:_MOST_MARKS]
    marks: list[Any] = panel.plot(
        scales[0].positions[chosen],
        scales[1].positions[chosen],
        "x",
        color=FAILED_COLOR,
        markersize=5.0,
        label="failed",
    )
    return marks
