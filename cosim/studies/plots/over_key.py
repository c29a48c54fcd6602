"""Metrics over a varied key."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.report.plots.curves import COLORS, WIDTH, shown_text
from cosim.report.plots.picture import PictureOptions
from cosim.studies.layout import NumberColumn, StudyResults
from cosim.studies.plots.panels import (
    FAILED,
    FAILED_COLOR,
    FAINT,
    MetricPanels,
    mark_failed,
    placed,
)
from cosim.studies.plots.scales import Scale, check_drawable, is_logarithmic

_COLORS: Final = tuple(color for color in COLORS if color != FAILED_COLOR)
_MOST_POINTS: Final = 3000  # single members that are drawn
_MOST_LINES: Final = len(_COLORS)
_BAR: Final = 12.0  # width [points]
_MOST_MARKED: Final = 25  # places of a line that have a mark each
_MOST_PLACES: Final = 100  # values of a key that each have a place; more are put together
_MOST_BINS: Final = 40  # that they are put together in
_IN_BIN: Final = 20  # members; fewer than these have fewer bins
_SIDE_BY_SIDE: Final = 0.7  # of the room of a name, for all lines
_BAND: Final = "5 % to 95 % of the members"


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
    lines = _lines(results, keys)
    shifts = _shifts(len(lines)) if scale.names else np.zeros(len(lines))
    is_binned = len(np.unique(scale.positions)) > _MOST_PLACES
    is_line = not scale.names and results.layout.kind == "grid"
    handles: list[Any] = []
    for panel, column in zip(picture.panels, picture.columns, strict=True):
        check_drawable(column.name, column.values)
        label = picture.label(panel, column)
        rows = columns.rows_of(column.numbers)
        for (name, color, is_of_line), shift in zip(lines, shifts, strict=True):
            chosen = is_of_line[rows]
            x = scale.positions[rows[chosen]] + shift
            values = column.values[chosen]
            if not len(values):
                continue
            if is_binned:
                handles += _draw_bins(panel, x, values, color=color, name=name)
            else:
                handles += _draw_places(panel, x, values, is_line=is_line, color=color, name=name)
        handles += mark_failed(panel, scale.positions[columns.rows_of(column.failed)])
        scale.apply(panel, "x")
        if is_logarithmic(column.values):
            panel.set_yscale("log")
        scale.label(panel.xaxis, results.with_unit(keys[0]))
        panel.set_ylabel(label)
    title = shown_text(results.with_unit(keys[1])) if len(lines) > 1 else ""
    picture.legend(_in_order(handles, len(lines)), title=title)
    picture.save(out, f"over {keys[0]}{note}")


def _lines(results: StudyResults, keys: Sequence[str]) -> list[tuple[str, str, Mask]]:
    """Return the name, the color and the members of each line, the same in all panels."""
    everything = [("", _COLORS[0], np.ones(results.done, np.bool_))]
    if len(keys) < 2:
        return everything
    scale = Scale.of(results.columns.parameters[keys[1]])
    different = np.unique(scale.positions)
    if not 1 < len(different) <= _MOST_LINES:
        return everything
    found = []
    for color, place in zip(_COLORS, different, strict=False):
        text = scale.names[int(place)] if scale.names else f"{place:g}"
        found.append((text, color, scale.positions == place))
    return found


def _in_order(handles: Sequence[Any], lines: int) -> list[Any]:
    """Return the handles of a legend: what all lines have comes behind their names, in gray."""
    from matplotlib.patches import Patch

    bands = [handle for handle in handles if handle.get_label() == _BAND]
    marks = [handle for handle in handles if handle.get_label() == FAILED]
    named = [handle for handle in handles if handle not in bands and handle not in marks]
    if bands and lines > 1:
        bands = [Patch(color="0.8", label=_BAND)]
    return [*named, *bands, *marks]


def _shifts(count: int) -> Vector:
    """Return where the bars of lines stand side by side around a name."""
    places: Vector = np.arange(float(count)) - 0.5 * (count - 1)
    return _SIDE_BY_SIDE / count * places


def _draw_places(
    panel: Any, x: Vector, values: Vector, *, is_line: bool, color: str, name: str
) -> list[Any]:
    """Draw the members at each value of a key, their median, and the band of 90 % of them."""
    places, index = np.unique(x, return_inverse=True)
    groups = _groups(values, index)
    medians = [float(np.median(group)) for group in groups]
    is_single = max(map(len, groups)) == 1
    style: dict[str, Any] = {"color": color, "linewidth": WIDTH}
    if len(places) <= _MOST_MARKED or not is_line:
        style |= {"marker": ".", "markersize": 5.0}
    if not is_line:
        style["linestyle"] = "none"
    label = shown_text(name) or ("members" if is_single else "median")
    handles = list(panel.plot(places, medians, label=label, **style))
    if is_single:
        return handles
    if len(values) <= _MOST_POINTS:
        _draw_members(panel, x, values, color)
    lower = [float(np.quantile(group, 0.05)) for group in groups]
    upper = [float(np.quantile(group, 0.95)) for group in groups]
    faint = {"color": color, "alpha": FAINT, "label": _BAND}
    if is_line:
        band = panel.fill_between(places, lower, upper, linewidth=0.0, **faint)
    else:  # bars: nothing is between the places
        band = panel.vlines(places, lower, upper, linewidth=_BAR, **faint)
    return [*handles, band]


def _draw_bins(panel: Any, x: Vector, values: Vector, *, color: str, name: str) -> list[Any]:
    """Draw the median of the members in each bin of a key, and members, or 90 % of them.

    A band of wide bins would show what the key changes within them, and not what other keys do.
    """
    edges = _bin_edges(x)
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    kept, index = np.unique(index, return_inverse=True)
    groups = _groups(values, index)
    medians = np.full(len(edges) - 1, np.nan)
    medians[kept] = [float(np.median(group)) for group in groups]
    label = shown_text(name) or "median of each bin"
    handles = [
        panel.stairs(medians, edges, baseline=None, color=color, linewidth=WIDTH, label=label)
    ]
    if len(values) <= _MOST_POINTS:
        _draw_members(panel, x, values, color)
        return handles
    lower = np.full(len(medians), np.nan)
    upper = np.full(len(medians), np.nan)
    lower[kept] = [float(np.quantile(group, 0.05)) for group in groups]
    upper[kept] = [float(np.quantile(group, 0.95)) for group in groups]
    band = panel.fill_between(
        np.repeat(edges, 2)[1:-1],
        np.repeat(lower, 2),
        np.repeat(upper, 2),
        color=color,
        alpha=FAINT,
        linewidth=0.0,
        label=_BAND,
    )
    return [*handles, band]


def _draw_members(panel: Any, x: Vector, values: Vector, color: str) -> None:
    panel.plot(x, values, ".", color=color, markersize=4.0, alpha=0.5, markeredgewidth=0.0)


def _groups(values: Vector, index: NumberColumn) -> list[Vector]:
    """Return the values of each place."""
    order = np.argsort(index, kind="stable")
    return np.split(values[order], np.cumsum(np.bincount(index))[:-1])


def _bin_edges(x: Vector) -> Vector:
    """Return the edges of bins with as many members in each."""
    count = min(max(len(x) // _IN_BIN, 1), _MOST_BINS)
    edges: Vector = np.unique(np.quantile(x, np.linspace(0.0, 1.0, count + 1)))
    return edges if len(edges) > 1 else np.concatenate([edges, edges])
