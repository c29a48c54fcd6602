"""Pictures of studies: of metrics alone, over what was varied, and in the order of a search."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.errors import UsageError, nearest, quoted
from cosim.report.plots.picture import (
    COLORS,
    STANDARD,
    WIDTH,
    PictureOptions,
    broken,
    need_plot,
    shown_text,
)
from cosim.studies import panels
from cosim.studies.layout import StudyResults, count_text, drawn_members
from cosim.studies.panels import NOTE, Scale, StudyPicture, is_logarithmic, mark_failed
from cosim.studies.search import Search
from cosim.studies.sensitivity import SobolIndices, check_has_indices, sobol_indices
from cosim.studies.statistics import (
    CONFIDENCE,
    LEAST_MEMBERS,
    PROBABILITIES,
    running_mean,
    spearman,
)

_MOST_STEPS: Final = 2000  # of a curve: more would be on one dot of it
_MOST_BARS: Final = 20  # parameters of a panel of Sobol indices
_COLORS: Final = tuple(color for color in COLORS if color != panels.FAILED_COLOR)
_MOST_PLACES: Final = 100  # values of a key that each have a place; more are put together
_MOST_QUANTITIES: Final = 7  # rows and columns of a scatter matrix
_MOST_POINTS: Final = 4000  # of a panel that are drawn one by one
_FAINT: Final = {"color": COLORS[0], "alpha": panels.FAINT, "linewidth": 0.0}
_PERCENT: Final = f"{100.0 * CONFIDENCE:g} %"


def plot_study(
    results: StudyResults,
    out: Path,
    *,
    kind: str | None = None,
    metrics: Sequence[str] = (),
    keys: Sequence[str] = (),
    options: PictureOptions = STANDARD,
    search: Search | None = None,
) -> None:
    """Draw a study into a file, whose ending is the format.

    Parameters
    ----------
    results : StudyResults
    out : Path
    kind : str, optional
        One of ``KINDS``; by default the search of a tuning, Sobol indices of a Saltelli design, a
        line or a map of a grid, else histograms.
    metrics, keys : sequence of str
        What is shown; empty: all.
    options : PictureOptions
    search : Search, optional
        Which has chosen the members.

    Raises
    ------
    UsageError
        If there is no such kind, metric or key, or the study has not what the picture shows.
    """
    need_plot(out)
    parameters = results.columns.parameters
    varied = [key for key in parameters if len(set(map(str, parameters[key].tolist()))) > 1]
    for key in keys:
        if key not in parameters:
            raise UsageError(f"the study does not vary {key!r}; {nearest(key, varied)}")
    shown = list(keys) or varied
    if kind is None:
        is_search = search is not None and not keys and set(metrics) <= {search.metric}
        kind = "search" if is_search else _standard_kind(results.layout.kind, shown)
    if kind not in KINDS:
        raise UsageError(f"no plot kind {kind!r}; {nearest(kind, KINDS)}")
    if kind == "search":
        metrics = [_objective(search, [*metrics, *keys])]
    if kind == "sobol":
        check_has_indices(results.layout)
    else:
        results = replace(results, columns=drawn_members(results.columns, results.layout))
    note = ""
    needed = {"line": 1, "map": 2}.get(kind, 0)
    if len(shown) < needed:
        found = count_text(len(shown), "varied key")
        raise UsageError(f"plot kind {kind!r}: expected {needed} with several values, got {found}")
    if needed:
        shown = shown[:2]
        results, note = _placed(results, shown)
    KINDS[kind](StudyPicture(results, out, metrics, shown, options, search, note))


def _standard_kind(design: str, keys: Sequence[str]) -> str:
    """Return the kind of picture that a design suggests."""
    if design == "grid" and keys:
        return "line" if len(keys) == 1 else "map"
    return "sobol" if design == "saltelli" else "histogram"


def _placed(results: StudyResults, keys: Sequence[str]) -> tuple[StudyResults, str]:
    """Return the members whose keys have a place at an axis, and a note of the others."""
    note = ""
    kept = np.ones(results.done, np.bool_)
    for key in keys:
        has_place = np.isfinite(Scale.of(results.columns.parameters[key]).positions)
        kept &= has_place
        if not has_place.all():
            note += f"; {count_text(int((~has_place).sum()))} without a finite {key}"
    return replace(results, columns=results.columns.only(kept)), note


def _objective(search: Search | None, shown: Sequence[str]) -> str:
    """Return what a picture of a search shows, which nothing else can be shown with."""
    start = "plot kind 'search': expected"
    if search is None:
        raise UsageError(
            f"{start} a study whose members were chosen by a search, such as a tuning, got a "
            "planned one"
        )
    for name in shown:
        if name != search.metric:
            raise UsageError(
                f"{start} the objective {quoted(search.metric)} alone, got {quoted(name)}; other "
                "kinds show other metrics, and what was varied"
            )
    return search.metric


def _plot_histograms(picture: StudyPicture) -> None:
    for panel, column, label in picture.each():
        shown = values = column.values
        low, high = np.quantile(values, [0.01, 0.99])
        reach = 3.0 * (high - low)  # beyond are single values, which would hide the others
        if reach > 0.0 and not is_logarithmic(values):
            shown = values[(values >= low - reach) & (values <= high + reach)]
        if len(shown) < len(values):
            beyond = len(values) - len(shown)
            panel.set_title(f"{panel.get_title()}, {beyond} outside of the axis", **NOTE)
        scale = Scale(shown)
        scale.draw_histogram(panel)
        scale.show(panel.xaxis, label)
        panel.set(ylabel="members", xlim=panel.get_xlim())  # a mean may be beyond it
        panel.yaxis.get_major_locator().set_params(integer=True)
        low, middle, high = np.quantile(values, PROBABILITIES)
        panel.axvline(values.mean(), color=COLORS[1], linewidth=2.0, label="mean")
        panel.axvline(middle, color="black", linewidth=WIDTH, label="median")
        for end in (low, high):
            panel.axvline(end, color="black", linewidth=WIDTH, linestyle="--", label="5 % and 95 %")
    picture.save("histograms")


def _plot_distributions(picture: StudyPicture) -> None:
    layout = picture.results.layout
    is_drawn = layout.is_drawn and layout.kind in ("random", "grid", "cases")
    for panel, column, label in picture.each():
        count = len(column.values)
        style = {"color": COLORS[0], "linewidth": WIDTH, "label": "share of members"}
        curve = panel.ecdf(column.values, **style)
        if is_drawn and layout.units_of(column.numbers) is None:
            rows = np.linspace(0, count, min(count + 1, _MOST_STEPS)).astype(np.int64)
            x, shares = curve.get_xydata()[rows].T
            reach = math.sqrt(math.log(2.0 / (1.0 - CONFIDENCE)) / (2.0 * count))
            ends = [np.clip(shares + end, 0.0, 1.0) for end in (-reach, reach)]
            words = f"{_PERCENT} band of the whole curve"
            panel.fill_between(x, *ends, step="post", label=words, **_FAINT)
        panel.set(xlabel=label, ylabel="share of members up to it", ylim=(-0.02, 1.02))
        if is_logarithmic(column.values):
            panel.set_xscale("log")
    picture.save("distributions")


def _plot_convergence(picture: StudyPicture) -> None:
    layout = picture.results.layout
    for panel, column, label in picture.each():
        running = running_mean(column, layout)
        total = len(running.counts)
        rows = np.unique(np.geomspace(1, total, _MOST_STEPS).astype(np.int64)) - 1
        counts, means = running.counts[rows], running.means[rows]
        style = {"color": COLORS[0], "linewidth": WIDTH, "marker": "." if total <= 10 else ""}
        panel.plot(counts, means, label="mean of the first", **style)
        settled = rows[min(4, total // 2) :]  # the interval of fewer would hide the rest
        middle, reach = running.means[settled], running.half_widths[settled]
        ends = (middle - reach, middle + reach)
        words = f"{_PERCENT} interval of each"
        panel.fill_between(running.counts[settled], *ends, label=words, **_FAINT)
        panel.axhline(means[-1], color="0.6", linewidth=1.0, label="mean of all")
        if counts[-1] > 100 * counts[0]:
            panel.set_xscale("log")
        else:
            panel.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
        panel.set(xlabel="members", ylabel=f"mean of {label}")
    picture.save(f"convergence of the mean; {layout.basis}")


def _plot_lines(picture: StudyPicture) -> None:
    """Draw metrics over a key, with a line for each value of a second one."""
    columns, keys = picture.results.columns, picture.keys
    scale = Scale.of(columns.parameters[keys[0]])
    is_binned = len(np.unique(scale.positions)) > _MOST_PLACES
    is_joined = is_binned or (not scale.names and picture.results.layout.kind == "grid")
    lines = _lines(picture)
    bands = False
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
                bands |= _draw_line(panel, x, values, style, is_binned=is_binned)
        mark_failed(panel, scale.positions[columns.rows_of(column.failed)])
        scale.show(panel.xaxis, picture.label(keys[0]))
        panel.set_ylabel(label)
        if is_logarithmic(column.values):
            panel.set_yscale("log")
    what = f"over {keys[0]}"
    if bands:
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
) -> bool:
    """Draw the median at each place, or in each bin of as many members; return whether a band."""
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
        return False
    color = style["color"]
    if len(x) <= _MOST_POINTS:
        panel.plot(x, values, ".", color=color, markersize=4.0, alpha=0.5, markeredgewidth=0.0)
    if is_joined:
        panel.fill_between(places, low, high, linewidth=0.0, color=color, alpha=panels.FAINT)
    else:
        panel.vlines(places, low, high, linewidth=12.0, color=color, alpha=panels.FAINT)
    return True


def _plot_maps(picture: StudyPicture) -> None:
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


def _plot_scatter(picture: StudyPicture) -> None:
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
        panel.tick_params(axis="x", labelrotation=45)
        panel.label_outer()
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
        size = 9.0 + 7.0 * abs(value)  # [points]
        panel.text(0.5, 0.5, f"{value:+z.2f}", ha="center", va="center", fontsize=size, color="0.3")


def _both(x: Scale, y: Scale) -> tuple[Vector, Vector]:
    """Return the members that have both."""
    rows = np.isfinite(x.positions) & np.isfinite(y.positions)
    return x.positions[rows], y.positions[rows]


def _plot_sobol(picture: StudyPicture) -> None:
    results = picture.results
    found: dict[str, SobolIndices] = {}
    problem: UsageError | None = None
    for column in picture.columns:
        try:
            found[column.name] = sobol_indices(results.columns, results.layout, column.name)
        except UsageError as error:
            problem = error
    if problem is not None and (picture.metrics or not found):
        raise problem
    picture.columns = [column for column in picture.columns if column.name in found]
    tallest = min(len(results.layout.parameters), _MOST_BARS)
    title = "Sobol indices"
    for panel, column, label in picture.each(2, (14.0, 2.5 + 0.9 * tallest)):
        _draw_indices(panel, found[column.name])
        panel.set_xlabel(f"share of the variance of {label}")
        if found[column.name].has_intervals:
            title = f"Sobol indices with rough {_PERCENT} intervals"
    picture.save(title)


def _draw_indices(panel: Any, indices: SobolIndices) -> None:
    """Draw the indices of a metric, the largest first."""
    order = np.argsort(-indices.total_order)[:_MOST_BARS]
    places = np.arange(len(order), dtype=np.float64)
    for values, intervals, shift, color, label in (
        (indices.first_order, indices.first_intervals, -0.2, COLORS[0], "first order"),
        (indices.total_order, indices.total_intervals, 0.2, COLORS[4], "total order"),
    ):
        ends = np.array(intervals, np.float64)[order].T
        reaches = np.maximum((values[order] - ends) * [[1.0], [-1.0]], 0.0)
        style = {"ecolor": "black", "capsize": 2.5, "error_kw": {"elinewidth": 1.0}}
        bars = {"height": 0.4, "color": color, "label": label}
        panel.barh(places + shift, values[order], xerr=reaches, **bars, **style)
    panel.set_yticks(places, [broken(shown_text(indices.parameters[k]), 28) for k in order])
    panel.invert_yaxis()
    panel.axvline(0.0, color="0.5", linewidth=1.0)
    text = indices.remark or count_text(indices.base_points, "base point")
    if len(indices.omitted):
        text += f", {len(indices.omitted)} left out"
    if len(order) < len(indices.parameters):
        text += f"; the largest {len(order)} of {len(indices.parameters)} parameters"
    panel.set_title(text, **NOTE)


def _plot_search(picture: StudyPicture) -> None:
    search, results = picture.search, picture.results
    assert search is not None
    for panel, column, label in picture.each():
        values, numbers = column.values, column.numbers
        best = (np.maximum if search.maximize else np.minimum).accumulate(values)
        x, y = np.append(numbers, results.columns.numbers[-1]), np.append(best, best[-1])
        style = {"color": COLORS[0], "linewidth": WIDTH, "drawstyle": "steps-post"}
        panel.plot(x, y, label="best so far", **style)
        panel.plot(numbers, values, "o", color="0.4", markersize=3.0, label="members")
        number = numbers[np.argmax(values == best[-1])]
        words = f"best: member {number}"
        panel.plot(number, best[-1], "o", color=COLORS[0], markersize=6.0, label=words)
        others = np.concatenate([column.without_value, column.infinite])
        places = np.concatenate([column.failed, others]).astype(np.float64)
        words = f"{panels.FAILED}, or have no finite value" if len(others) else panels.FAILED
        mark_failed(panel, places, label=words)
        _scale_objective(panel, values)
        panel.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
        panel.set(xlabel="member", ylabel=label)
    count = f"{count_text(results.done)} of at most {results.planned}"
    picture.save(f"{search.method}, {search.goal}; {count}")


def _scale_objective(panel: Any, values: Vector) -> None:
    """Give an objective an axis that shows its small values beside large ones of a search."""
    sizes = np.abs(values[values != 0.0])
    low, high = np.quantile(sizes, [0.05, 0.95]) if len(sizes) > 2 else (1.0, 1.0)
    if is_logarithmic(values):
        panel.set_yscale("log")
    elif high > 900.0 * low:
        panel.set_yscale("symlog", linthresh=low)


KINDS: Final[dict[str, Callable[[StudyPicture], None]]] = {
    "histogram": _plot_histograms,
    "distribution": _plot_distributions,
    "convergence": _plot_convergence,
    "line": _plot_lines,
    "map": _plot_maps,
    "scatter": _plot_scatter,
    "sobol": _plot_sobol,
    "search": _plot_search,
}
