"""Pictures of metrics over what was varied: lines over a key, maps over two, scatter matrices."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.errors import UsageError
from cosim.report.plots.curves import COLORS, WIDTH
from cosim.studies import panels
from cosim.studies.layout import count_text
from cosim.studies.panels import Scale, StudyPicture, is_logarithmic, mark_failed
from cosim.studies.statistics import LEAST_MEMBERS, PROBABILITIES, spearman

_COLORS: Final = tuple(color for color in COLORS if color != panels.FAILED_COLOR)
_MOST_PLACES: Final = 100  # values of a key that each have a place; more are put together
_MOST_QUANTITIES: Final = 7  # rows and columns of a scatter matrix
_MOST_POINTS: Final = 4000  # of a panel that are drawn one by one
_TEXT: Final = 9.0  # [points] in a scatter matrix


def plot_lines(picture: StudyPicture) -> None:
    """Draw metrics over a key, with a line for each value of a second one."""
    columns, keys = picture.results.columns, picture.keys
    scale = Scale.of(columns.parameters[keys[0]])
    count = len(np.unique(scale.positions))
    is_binned = count > _MOST_PLACES
    is_joined = is_binned or (not scale.names and picture.results.layout.kind == "grid")
    lines = _lines(picture)
    for panel, column, label in picture.each():
        rows = columns.rows_of(column.numbers)
        for number, (name, of_line) in enumerate(lines):
            chosen = of_line[rows]
            shift = 0.7 * ((number + 0.5) / len(lines) - 0.5) if scale.names else 0.0
            x, values = scale.positions[rows[chosen]] + shift, column.values[chosen]
            if len(x):
                style = {"color": _COLORS[number], "label": name}
                if not is_joined:
                    style["linestyle"] = "none"
                _draw_line(panel, x, values, style, is_binned=is_binned)
        mark_failed(panel, scale.positions[columns.rows_of(column.failed)])
        scale.show(panel.xaxis, picture.label(keys[0]))
        panel.set_ylabel(label)
        if is_logarithmic(column.values):
            panel.set_yscale("log")
    what = f"over {keys[0]}"
    if count * len(lines) < picture.results.done or is_binned:
        what += f"; median and 5 % to 95 % of the members{' of each bin' if is_binned else ''}"
    picture.save(what, legend=picture.label(keys[1]) if len(lines) > 1 else "")


def _lines(picture: StudyPicture) -> list[tuple[str, Mask]]:
    """Return name and members of each line: the values of a second key, if they are few."""
    for key in picture.keys[1:]:
        scale = Scale.of(picture.results.columns.parameters[key])
        places = np.unique(scale.positions).tolist()
        if 1 < len(places) <= len(_COLORS):
            names = [scale.names[int(one)] if scale.names else f"{one:g}" for one in places]
            return [(name, scale.positions == one) for name, one in zip(names, places, strict=True)]
    return [("", np.ones(picture.results.done, np.bool_))]


def _draw_line(
    panel: Any, x: Vector, values: Vector, style: dict[str, Any], *, is_binned: bool
) -> None:
    """Draw median and band of the members at each place, or in each bin of as many members."""
    order = np.argsort(x, kind="stable")
    x, values = x[order], values[order]
    bins = min(max(len(x) // 20, 1), 40)
    starts = np.arange(1, bins) * len(x) // bins if is_binned else np.flatnonzero(np.diff(x)) + 1
    places = [float(np.median(one)) for one in np.split(x, starts)]
    quantiles = [np.quantile(one, PROBABILITIES) for one in np.split(values, starts)]
    low, middle, high = np.array(quantiles).T
    is_joined = "linestyle" not in style
    marker = "." if len(places) <= 25 or not is_joined else ""
    panel.plot(places, middle, linewidth=WIDTH, marker=marker, markersize=5.0, **style)
    if len(places) == len(x):
        return
    color = style["color"]
    if len(x) <= _MOST_POINTS:
        panel.plot(x, values, ".", color=color, markersize=4.0, alpha=0.5, markeredgewidth=0.0)
    if is_joined:
        panel.fill_between(places, low, high, linewidth=0.0, color=color, alpha=panels.FAINT)
    else:
        panel.vlines(places, low, high, linewidth=12.0, color=color, alpha=panels.FAINT)


def plot_maps(picture: StudyPicture) -> None:
    """Draw metrics over two keys, as the mean of the members in each cell."""
    from matplotlib.colors import LogNorm
    from scipy.stats import binned_statistic_2d

    columns, keys = picture.results.columns, picture.keys
    scales = [Scale.of(columns.parameters[key]) for key in keys]
    count = picture.results.done
    is_sparse = math.prod(len(np.unique(scale.positions)) for scale in scales) > 4 * count
    even = min(max(math.isqrt(count) // 2, 5), 25)  # cells
    most = 5 if is_sparse else 60  # values that each have a cell
    edges = [scale.edges(most, even) for scale in scales]
    for panel, column, label in picture.each():
        rows = columns.rows_of(column.numbers)
        x, y = (scale.positions[rows] for scale in scales)
        means = binned_statistic_2d(x, y, column.values, bins=edges).statistic.T
        is_filled = np.isfinite(means)
        norm = LogNorm() if is_logarithmic(means) else None
        mesh = panel.pcolormesh(*edges, means, cmap="viridis", norm=norm, zorder=1.0)
        words = f"mean of {label}" if len(x) > is_filled.sum() else label
        panel.figure.colorbar(mesh, ax=panel, label=words)
        if not is_filled.all():
            style = {"color": "0.88", "label": "no value", "transform": panel.transAxes}
            panel.fill([0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0], zorder=0.5, **style)
        mark_failed(panel, *(scale.positions[columns.failed] for scale in scales))
        for scale, axis, key in zip(scales, (panel.xaxis, panel.yaxis), keys, strict=True):
            scale.show(axis, picture.label(key))
    picture.save(f"over {keys[0]} and {keys[1]}")


def plot_scatter(picture: StudyPicture) -> None:
    """Draw every parameter and metric over every other one; above the diagonal correlations."""
    results = picture.results
    columns = results.columns
    room = max(_MOST_QUANTITIES - len(picture.columns), (_MOST_QUANTITIES + 1) // 2)
    shown = {key: Scale.of(columns.parameters[key]) for key in picture.keys[:room]}
    n_keys = len(shown)
    for metric in picture.columns[: _MOST_QUANTITIES - n_keys]:
        shown[metric.name] = Scale(columns.numeric(metric.name))
    count = len(shown)
    if count < 2:
        raise UsageError(
            "plot kind 'scatter': expected at least 2 parameters or metrics, got "
            f"{count_text(count, 'parameter or metric')}"
        )
    side = 3.8 + 2.0 / count  # cm, with names and numbers
    matrix = np.reshape(picture.panels(count * count, count, (side, side)), (count, count))
    names, scales = list(shown), list(shown.values())
    for (row, column), panel in np.ndenumerate(matrix):
        x, y = scales[column], scales[row]
        if column > row:
            _write_correlation(panel, x, y)
            continue
        panel.sharex(matrix[-1, column])
        if column == row:
            x.draw_histogram(panel)
            panel.set_yticks([])  # counts, whose scale is another in each panel
        else:
            panel.sharey(matrix[row, 0])
            _draw_points(panel, x, y)
            if row < n_keys:
                mark_failed(panel, x.positions[columns.failed], y.positions[columns.failed])
            y.show(panel.yaxis, "")
        x.show(panel.xaxis, picture.label(names[column]))
        panel.set_ylabel(picture.label(names[row]))
        _shorten(panel)
    total = len(picture.keys) + len(picture.columns)
    is_few = results.done < LEAST_MEMBERS
    notes = [
        count_text(results.done),
        f"{results.failed} failed" if results.failed else "",
        f"{count} of {total} parameters and metrics" if count < total else "",
        "the darker, the more members" if results.done > _MOST_POINTS else "",
        f"{'too few members for ' if is_few else ''}rank correlations above the diagonal",
    ]
    picture.save(", ".join(filter(None, notes)))


def _draw_points(panel: Any, x: Scale, y: Scale) -> None:
    """Draw the members; of many how many are in each cell."""
    from matplotlib.colors import LogNorm

    first, other = _both(x, y)
    if len(first) > _MOST_POINTS:
        bins = [x.edges(50, 50), y.edges(50, 50)]
        norm = LogNorm(vmin=0.5)  # which would be white: one is not
        panel.hist2d(first, other, bins=bins, cmap="Blues", cmin=1, norm=norm, rasterized=True)
    else:
        size = 2.0 if len(first) > 500 else 4.0
        panel.plot(first, other, ".", color=COLORS[0], markersize=size, alpha=0.6)


def _write_correlation(panel: Any, x: Scale, y: Scale) -> None:
    """Write a rank correlation, the stronger the larger."""
    panel.set_axis_off()
    first, other = _both(x, y)
    is_known = len(first) >= LEAST_MEMBERS and not x.names and not y.names
    value = spearman(first, other) if is_known else None
    if value is not None:
        size = _TEXT + 7.0 * abs(value)
        panel.text(0.5, 0.5, f"{value:+z.2f}", ha="center", va="center", fontsize=size, color="0.3")


def _both(x: Scale, y: Scale) -> tuple[Vector, Vector]:
    """Return the members that have both."""
    rows = np.isfinite(x.positions) & np.isfinite(y.positions)
    return x.positions[rows], y.positions[rows]


def _shorten(panel: Any) -> None:
    """Leave few numbers at the axes of a small panel, and none between panels."""
    from matplotlib.ticker import MaxNLocator, NullFormatter

    for axis in (panel.xaxis, panel.yaxis):
        axis.set_minor_formatter(NullFormatter())
        axis.label.set_size(_TEXT)
        if isinstance(axis.get_major_locator(), MaxNLocator):
            axis.get_major_locator().set_params(nbins=3)
    panel.tick_params(labelsize=_TEXT)
    panel.tick_params(axis="x", labelrotation=45)
    panel.label_outer()
