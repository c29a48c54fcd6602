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
from cosim.studies.panels import Scale, StudyPicture, cell_edges, is_logarithmic, mark_failed
from cosim.studies.statistics import LEAST_MEMBERS, spearman

_COLORS: Final = tuple(color for color in COLORS if color != panels.FAILED_COLOR)
_MOST_PLACES: Final = 100  # values of a key that each have a place; more are put together
_MOST_QUANTITIES: Final = 7  # rows and columns of a scatter matrix
_MOST_POINTS: Final = 4000  # of a panel of it that are drawn one by one
_TEXT: Final = 9.0  # [points] in it
_CORRELATIONS: Final = "rank correlations above the diagonal"
_BAND: Final = "5 % to 95 % of the members"


def plot_lines(picture: StudyPicture) -> None:
    """Draw metrics over a key, with a line for each value of a second one."""
    from matplotlib.patches import Patch

    results, keys = picture.results, picture.keys
    scale = Scale.of(results.columns.parameters[keys[0]])
    is_binned = len(np.unique(scale.positions)) > _MOST_PLACES
    is_joined = not scale.names and results.layout.kind == "grid"
    lines = _lines(picture)
    handles: list[Any] = []
    marks: list[Any] = []
    for panel, column, label in picture:
        rows = results.columns.rows_of(column.numbers)
        for number, (name, of_line) in enumerate(lines):
            chosen = of_line[rows]
            shift = 0.7 * ((number + 0.5) / len(lines) - 0.5) if scale.names else 0.0
            x, values = scale.positions[rows[chosen]] + shift, column.values[chosen]
            if len(x):
                draw = _draw_bins if is_binned else _draw_places
                handles += draw(panel, x, values, name, _COLORS[number], is_joined)
        marks += mark_failed(panel, scale.positions[results.columns.rows_of(column.failed)])
        scale.show(panel.xaxis, picture.label(keys[0]))
        panel.set_ylabel(label)
        if is_logarithmic(column.values):
            panel.set_yscale("log")
    named = [handle for handle in handles if handle.get_label() != _BAND]
    if len(named) < len(handles):
        color = _COLORS[0] if len(lines) == 1 else "0.2"
        named.append(Patch(color=color, alpha=panels.FAINT, linewidth=0.0, label=_BAND))
    legend = picture.label(keys[1]) if len(lines) > 1 else ""
    picture.save(f"over {keys[0]}", [*named, *marks], legend=legend)


def _lines(picture: StudyPicture) -> list[tuple[str, Mask]]:
    """Return name and members of each line: the values of a second key, if they are few."""
    for key in picture.keys[1:]:
        scale = Scale.of(picture.results.columns.parameters[key])
        places = np.unique(scale.positions).tolist()
        if 1 < len(places) <= len(_COLORS):
            names = [scale.names[int(one)] if scale.names else f"{one:g}" for one in places]
            return [(name, scale.positions == one) for name, one in zip(names, places, strict=True)]
    return [("", np.ones(picture.results.done, np.bool_))]


def _draw_places(
    panel: Any, x: Vector, values: Vector, name: str, color: str, is_joined: bool
) -> list[Any]:
    """Draw median and band of the members at each place; return what the legend names."""
    places, index = np.unique(x, return_inverse=True)
    low, middle, high = _quantiles(values, index)
    is_single = len(places) == len(values)
    style: dict[str, Any] = {} if is_joined else {"linestyle": "none"}
    if len(places) <= 25 or not is_joined:
        style |= {"marker": ".", "markersize": 5.0}
    label = name or ("members" if is_single else "median")
    style |= {"color": color, "linewidth": WIDTH, "label": label}
    handles: list[Any] = panel.plot(places, middle, **style)
    if is_single:
        return handles
    _draw_members(panel, x, values, color)
    faint = {"color": color, "alpha": panels.FAINT, "label": _BAND}
    if is_joined:
        return [*handles, panel.fill_between(places, low, high, linewidth=0.0, **faint)]
    return [*handles, panel.vlines(places, low, high, linewidth=12.0, **faint)]


def _draw_bins(panel: Any, x: Vector, values: Vector, name: str, color: str, _: bool) -> list[Any]:
    """Draw the median of each bin of as many members, with its band if these are not drawn."""
    count = min(max(len(x) // 20, 1), 40)
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, count + 1), method="higher"))
    edges = edges if len(edges) > 1 else edges.repeat(2)
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    low, middle, high = _quantiles(values, index)
    label = name or "median of each bin"
    steps = panel.stairs(middle, edges, baseline=None, color=color, linewidth=WIDTH, label=label)
    if _draw_members(panel, x, values, color):
        return [steps]
    ends = [np.append(one, one[-1]) for one in (low, high)]
    faint = {"color": color, "alpha": panels.FAINT, "linewidth": 0.0, "label": _BAND}
    return [steps, panel.fill_between(edges, *ends, step="post", **faint)]


def _quantiles(values: Vector, index: Any) -> Any:
    """Return 5 %, 50 % and 95 % quantiles of each group, shape (3, n)."""
    groups = np.split(values[np.argsort(index, kind="stable")], np.cumsum(np.bincount(index))[:-1])
    return np.array([np.quantile(group, [0.05, 0.5, 0.95]) for group in groups]).T


def _draw_members(panel: Any, x: Vector, values: Vector, color: str) -> bool:
    """Draw members one by one, unless there are too many."""
    if len(values) > 3000:
        return False
    panel.plot(x, values, ".", color=color, markersize=4.0, alpha=0.5, markeredgewidth=0.0)
    return True


def plot_maps(picture: StudyPicture) -> None:
    """Draw metrics over two keys, as the mean of the members in each cell."""
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Patch

    columns, keys = picture.results.columns, picture.keys
    scales = [Scale.of(columns.parameters[key]) for key in keys]
    count = picture.results.done
    is_sparse = math.prod(len(np.unique(scale.positions)) for scale in scales) > 4 * count
    even = min(max(math.isqrt(count) // 2, 5), 25)  # cells
    most = 5 if is_sparse else 60  # values that each have a cell
    edges = [cell_edges(scale, scale.positions, most, even) for scale in scales]
    handles: list[Any] = []
    for panel, column, label in picture:
        rows = columns.rows_of(column.numbers)
        x, y = (scale.positions[rows] for scale in scales)
        counts, _, _ = np.histogram2d(x, y, bins=edges)
        sums, _, _ = np.histogram2d(x, y, bins=edges, weights=column.values)
        means = np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)
        norm = LogNorm() if is_logarithmic(means[counts > 0]) else None
        mesh = panel.pcolormesh(*edges, means.T, cmap="viridis", norm=norm, zorder=1.0)
        words = f"mean of {label}" if counts.max() > 1 else label
        panel.figure.colorbar(mesh, ax=panel, label=words)
        if not counts.all():
            panel.set_facecolor("0.88")  # no color of the map
            handles.append(Patch(color="0.88", label="no value"))
        handles += mark_failed(panel, *(scale.positions[columns.failed] for scale in scales))
        for scale, axis, key in zip(scales, (panel.xaxis, panel.yaxis), keys, strict=True):
            scale.show(axis, picture.label(key))
    picture.save(f"over {keys[0]} and {keys[1]}", handles)


def plot_scatter(picture: StudyPicture) -> None:
    """Draw every parameter and metric over every other one; above the diagonal correlations."""
    results = picture.results
    columns = results.columns
    room = max(_MOST_QUANTITIES - len(picture.columns), (_MOST_QUANTITIES + 1) // 2)
    shown = [(key, Scale.of(columns.parameters[key])) for key in picture.keys[:room]]
    keys = len(shown)
    for metric in picture.columns[: _MOST_QUANTITIES - keys]:
        values = columns.numeric(metric.name)
        values[np.isinf(values)] = np.nan
        shown.append((metric.name, Scale(values, logarithmic=is_logarithmic(values))))
    count = len(shown)
    if count < 2:
        found = count_text(count, "parameter or metric")
        raise UsageError(
            f"plot kind 'scatter': expected at least 2 parameters or metrics, got {found}"
        )
    side = 3.8 + 2.0 / count  # cm, with names and numbers
    matrix = np.array(picture.panels(count * count, count, (side, side)), object)
    matrix = matrix.reshape(count, count)
    marks: list[Any] = []
    for (row, column), panel in np.ndenumerate(matrix):
        (name, x), (of_row, y) = shown[column], shown[row]
        if column > row:
            _write_correlation(panel, x, y)
            continue
        panel.sharex(matrix[-1, column])
        if column == row:
            _draw_histogram(panel, x)
        else:
            panel.sharey(matrix[row, 0])
            _draw_points(panel, x, y)
            if row < keys:
                marks += mark_failed(panel, *(one.positions[columns.failed] for one in (x, y)))
            y.show(panel.yaxis, "")
        x.show(panel.xaxis, picture.label(name))
        panel.set_ylabel(picture.label(of_row))
        _shorten(panel)
    total = len(picture.keys) + len(picture.columns)
    is_few = results.done < LEAST_MEMBERS
    notes = [
        count_text(results.done),
        f"{results.failed} failed" if results.failed else "",
        f"{count} of {total} parameters and metrics" if count < total else "",
        "the darker, the more members" if results.done > _MOST_POINTS else "",
        "too few members for rank correlations" if is_few else _CORRELATIONS,
    ]
    picture.save(", ".join(filter(None, notes)), marks[:1])


def _draw_points(panel: Any, x: Scale, y: Scale) -> None:
    """Draw the members; of many how many are in each cell."""
    from matplotlib.colors import LogNorm

    first, other = _both(x, y)
    if len(first) > _MOST_POINTS:
        edges = [cell_edges(x, first, 50, 50), cell_edges(y, other, 50, 50)]
        norm = LogNorm(vmin=0.5)  # which would be white: one is not
        panel.hist2d(first, other, bins=edges, cmap="Blues", cmin=1, norm=norm, rasterized=True)
    else:
        size = 2.0 if len(first) > 500 else 4.0
        panel.plot(first, other, ".", color=COLORS[0], markersize=size, alpha=0.6)


def _draw_histogram(panel: Any, scale: Scale) -> None:
    values = scale.positions[np.isfinite(scale.positions)]
    if len(values):
        edges = cell_edges(scale, values, 0, min(max(len(np.unique(values)), 5), 24))
        panel.hist(values, bins=edges, color=COLORS[5], edgecolor="white", linewidth=0.3)
    panel.set_yticks([])  # counts, whose scale is another in each panel


def _write_correlation(panel: Any, x: Scale, y: Scale) -> None:
    """Write a rank correlation, the stronger the larger."""
    panel.set_axis_off()
    first, other = _both(x, y)
    is_known = len(first) >= LEAST_MEMBERS and not x.names and not y.names
    value = spearman(first, other) if is_known else None
    if value is not None:
        size = _TEXT + 7.0 * abs(value)
        text = f"{value:+.2f}".replace("-0.00", "+0.00")
        panel.text(0.5, 0.5, text, ha="center", va="center", fontsize=size, color="0.3")


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
