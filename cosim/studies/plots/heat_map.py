"""Metrics over two varied keys, as colors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.report.plots.picture import PictureOptions
from cosim.studies.layout import NumberColumn, StudyResults
from cosim.studies.plots.panels import FAILED, FAILED_COLOR, MetricPanels, placed
from cosim.studies.plots.scales import (
    Scale,
    cell_edges,
    check_drawable,
    even_edges,
    is_logarithmic,
)

_MOST_CELLS: Final = 60  # along an axis; more values are put together
_EVEN_CELLS: Final = 25  # that they are put together in; fewer of few members
_EMPTY: Final = "0.88"  # no color of the map: no member of a cell has a value
_MARK: Final = 5.0  # [points]
_AXIS: Final = 150.0  # [points], about: marks of many cells are smaller


def plot_heat_maps(
    results: StudyResults,
    out: Path,
    metrics: Sequence[str],
    keys: Sequence[str],
    options: PictureOptions,
) -> None:
    """Draw the mean of each metric over two keys, and mark where members failed."""
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Patch

    results, note = placed(results, keys)
    picture = MetricPanels(results, metrics, options)
    scales = [Scale.of(results.columns.parameters[key]) for key in keys]
    edges = [_edges(scale) for scale in scales]
    failed = np.flatnonzero(results.columns.failed)
    handles: list[Any] = []
    for panel, column in zip(picture.panels, picture.columns, strict=True):
        check_drawable(column.name, column.values)
        rows = results.columns.rows_of(column.numbers)
        means, counts = cell_means(column.values, _at(scales, rows), edges)
        words = "mean of {}" if counts.max(initial=0) > 1 else "{}"
        label = picture.label(panel, column, words)
        is_known = np.isfinite(means)
        norm = LogNorm() if is_logarithmic(means[is_known]) else None
        mesh = panel.pcolormesh(edges[0], edges[1], means.T, cmap="viridis", norm=norm, zorder=1.0)
        panel.figure.colorbar(mesh, ax=panel, label=label)
        if not is_known.all():
            panel.set_facecolor(_EMPTY)
            handles.append(Patch(color=_EMPTY, label="no value"))
        if len(failed):
            handles += _draw_failed(panel, _at(scales, failed), edges)
        for scale, direction, axis, key in zip(
            scales, "xy", (panel.xaxis, panel.yaxis), keys, strict=True
        ):
            scale.apply(panel, direction)
            scale.label(axis, results.with_unit(key))
    picture.legend(handles)
    picture.save(out, f"over {keys[0]} and {keys[1]}{note}")


def _at(scales: Sequence[Scale], rows: NumberColumn) -> list[Vector]:
    """Return where members stand on both axes."""
    return [scale.positions[rows] for scale in scales]


def _edges(scale: Scale) -> Vector:
    different = np.unique(scale.positions)
    if len(different) <= _MOST_CELLS:
        return cell_edges(different, logarithmic=scale.logarithmic)
    count = min(max(math.isqrt(len(scale.positions)) // 2, 5), _EVEN_CELLS)
    return even_edges(scale.positions, count, logarithmic=scale.logarithmic)


def cell_means(
    values: Vector, places: Sequence[Vector], edges: Sequence[Vector]
) -> tuple[Vector, NumberColumn]:
    """Return the mean of the members in each cell, and how many these are.

    Both have the shape (columns, rows); the mean of none is NaN.
    """
    shape = [len(one) - 1 for one in edges]
    cells = _cells(places, edges)
    total = int(np.prod(shape))
    sums = np.bincount(cells, weights=values, minlength=total)
    counts = np.bincount(cells, minlength=total)
    with np.errstate(invalid="ignore"):
        return (sums / counts).reshape(shape), counts.reshape(shape)


def _cells(places: Sequence[Vector], edges: Sequence[Vector]) -> NumberColumn:
    """Return the cell of each member, numbered column by column."""
    cells = np.zeros(len(places[0]), np.int64)
    for position, edge in zip(places, edges, strict=True):
        count = len(edge) - 1
        index = np.clip(np.searchsorted(edge, position, side="right") - 1, 0, count - 1)
        cells = cells * count + index
    return cells


def _draw_failed(panel: Any, places: Sequence[Vector], edges: Sequence[Vector]) -> list[Any]:
    """Mark each cell in which members failed, once."""
    _, index = np.unique(_cells(places, edges), return_inverse=True)
    counts = np.bincount(index)
    x, y = (np.bincount(index, weights=place) / counts for place in places)
    most = max(len(edge) - 1 for edge in edges)
    marks: list[Any] = panel.plot(
        x,
        y,
        "x",
        color=FAILED_COLOR,
        markersize=min(_MARK, _AXIS / most),
        clip_on=False,
        label=FAILED,
    )
    return marks
