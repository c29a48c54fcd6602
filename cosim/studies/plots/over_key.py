"""Metrics over a varied key."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.report.plots.curves import COLORS, WIDTH, shown_text
from cosim.report.plots.picture import PictureOptions
from cosim.studies.analysis.columns import NumberColumn
from cosim.studies.analysis.results import StudyResults
from cosim.studies.plots.panels import FAILED_COLOR, FAINT, MetricPanels, placed
from cosim.studies.plots.scales import Scale, check_drawable, is_logarithmic

_MOST_POINTS: Final = 3000  # single members that are drawn
_MOST_LINES: Final = len(COLORS)
_BAR: Final = 12.0  # width [points]
_MOST_PLACES: Final = 100  # values of a key that each have a place; more are put together
_BINS: Final = 25  # that they are put together in
_IN_BIN: Final = 40  # members; fewer than these have fewer bins


def plot_over_key(
    results: StudyResults,
    out: Path,
    metrics: Sequence[str],
    keys: Sequence[str],
    options: PictureOptions,
) -> None:
    """Draw each metric over a key: the median, the band of 90 % of the members, and members.

    Parameters
    ----------
    results, out, metrics, options
        As of :func:`plot_study`.
    keys : sequence of str
        The key; if there is a second one of few values, each has a line of its own.
    """
    results, note = placed(results, keys)
    picture = MetricPanels(results, metrics, options)
    columns = results.columns
    scale = Scale.of(columns.parameters[keys[0]])
    lines = Scale.of(columns.parameters[keys[1]]) if len(keys) > 1 else None
    has_many = len(np.unique(scale.positions)) > _MOST_PLACES
    is_line = not scale.names and (results.layout.kind == "grid" or has_many)
    handles: list[Any] = []
    for panel, column in zip(picture.panels, picture.columns, strict=True):
        check_drawable(column.name, column.values)
        label = picture.label(panel, column)
        rows = columns.rows_of(column.numbers)
        handles = []
        for name, color, chosen in _lines(lines, rows, keys):
            x = scale.positions[rows[chosen]]
            values = column.values[chosen]
            handles += _draw(panel, x, values, is_line=is_line, color=color, name=name)
        handles += _draw_failed(panel, scale, columns.rows_of(column.failed))
        scale.apply(panel, "x")
        if is_logarithmic(column.values):
            panel.set_yscale("log")
        scale.label(panel.xaxis, results.with_unit(keys[0]))
        panel.set_ylabel(label)
    picture.legend(handles)
    picture.save(out, f"over {keys[0]}{note}")


def _lines(
    lines: Scale | None, rows: NumberColumn, keys: Sequence[str]
) -> list[tuple[str, str, NumberColumn]]:
    """Return the name, the color and the members of each line."""
    everything = [("", COLORS[0], np.arange(len(rows)))]
    if lines is None:
        return everything
    different = np.unique(lines.positions[rows])
    if len(different) > _MOST_LINES:
        return everything
    found = []
    for color, place in zip(COLORS, different, strict=False):
        text = lines.names[int(place)] if lines.names else f"{place:g}"
        chosen = np.flatnonzero(lines.positions[rows] == place)
        found.append((f"{keys[1]} = {text}", color, chosen))
    return found


def _draw(
    panel: Any, x: Vector, values: Vector, *, is_line: bool, color: str, name: str
) -> list[Any]:
    """Draw the members of a line, their median and the band that 90 % of them are in."""
    places, index = _places(x)
    order = np.argsort(index, kind="stable")
    groups = np.split(values[order], np.cumsum(np.bincount(index))[:-1])
    medians = [float(np.median(group)) for group in groups]
    single = max(map(len, groups)) == 1
    if len(values) <= _MOST_POINTS and not single:
        panel.plot(x, values, ".", color=color, markersize=3.0, alpha=0.4, markeredgewidth=0.0)
    style = {"color": color, "linewidth": WIDTH}
    if single or len(places) <= _BINS:
        style |= {"marker": ".", "markersize": 5.0}
    if not is_line and (single or len(places) <= _BINS):
        style["linestyle"] = "none"
    label = shown_text(name) or ("members" if single else "median")
    handles = list(panel.plot(places, medians, label=label, **style))
    if not single:
        band = _draw_band(panel, places, groups, color, is_line=is_line)
        if not name:
            band.set_label("5 % to 95 % of the members")
            handles.append(band)
    return handles


def _draw_band(
    panel: Any, places: Vector, groups: Sequence[Vector], color: str, *, is_line: bool
) -> Any:
    """Draw what 90 % of the members of each place are in; bars where nothing is between places."""
    lower = [float(np.quantile(group, 0.05)) for group in groups]
    upper = [float(np.quantile(group, 0.95)) for group in groups]
    if is_line:
        return panel.fill_between(places, lower, upper, color=color, alpha=FAINT, linewidth=0.0)
    return panel.vlines(places, lower, upper, color=color, alpha=FAINT, linewidth=_BAR)


def _places(x: Vector) -> tuple[Vector, NumberColumn]:
    """Return where the members of a line are put together, and the place of each."""
    different, index = np.unique(x, return_inverse=True)
    if len(different) <= _MOST_PLACES:
        return different, index.astype(np.int64)
    count = min(max(len(x) // _IN_BIN, 4), _BINS)
    edges = np.quantile(x, np.linspace(0.0, 1.0, count + 1))
    bins = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, count - 1)
    kept, index = np.unique(bins, return_inverse=True)
    centers = np.array([float(np.median(x[bins == one])) for one in kept])
    return centers, index.astype(np.int64)


def _draw_failed(panel: Any, scale: Scale, rows: NumberColumn) -> list[Any]:
    """Mark at the lower edge of a panel where members failed."""
    if not len(rows):
        return []
    places = np.unique(scale.positions[rows])[:_MOST_POINTS]
    marks: list[Any] = panel.plot(
        places,
        np.full(len(places), 0.02),
        "x",
        color=FAILED_COLOR,
        markersize=5.0,
        transform=panel.get_xaxis_transform(),
        label="failed",
    )
    return marks
