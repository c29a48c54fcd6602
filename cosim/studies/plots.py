"""Pictures of studies: of the values of metrics, their means, Sobol indices and searches."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError, nearest, quoted
from cosim.report.plots.curves import COLORS, WIDTH, shown_text
from cosim.report.plots.fitting import broken
from cosim.report.plots.picture import PictureOptions, need_plot
from cosim.studies import panels
from cosim.studies.layout import StudyResults, count_text, drawn_members
from cosim.studies.over_keys import plot_lines, plot_maps, plot_scatter
from cosim.studies.panels import NOTE, StudyPicture, is_logarithmic, reach_beside
from cosim.studies.plan import RecordedSearch
from cosim.studies.sensitivity import SobolIndices, check_has_indices, sobol_indices
from cosim.studies.statistics import CONFIDENCE, NO_INTERVAL, PROBABILITIES, running_mean

_STANDARD: Final = PictureOptions()
_MOST_STEPS: Final = 2000  # of a curve: more would be on one dot of it
_MOST_BARS: Final = 20  # parameters of a panel of Sobol indices
_FAINT: Final = {"color": COLORS[0], "alpha": panels.FAINT, "linewidth": 0.0}
_PERCENT: Final = f"{100.0 * CONFIDENCE:g} %"


def plot_study(
    results: StudyResults,
    out: Path,
    *,
    kind: str | None = None,
    metrics: Sequence[str] = (),
    keys: Sequence[str] = (),
    options: PictureOptions = _STANDARD,
    search: RecordedSearch | None = None,
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
    search : RecordedSearch, optional
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
        kind = _standard_kind(results.layout.kind, shown)
        if search is not None and not keys and set(metrics) <= {search.metric}:
            kind = "search"
    if kind not in KINDS:
        raise UsageError(f"no plot kind {kind!r}; {nearest(kind, KINDS)}")
    needed = {"line": 1, "map": 2}.get(kind, 0)
    if len(shown) < needed:
        found = count_text(len(shown), "varied key")
        raise UsageError(f"plot kind {kind!r}: expected {needed} with several values, got {found}")
    if kind == "search":
        metrics = [_checked_search(search, [*metrics, *keys]).metric]
    if kind == "sobol":
        check_has_indices(results.layout)
    else:
        results = replace(results, columns=drawn_members(results.columns, results.layout))
    note = ""
    if needed:
        shown = shown[:2]
        results, note = panels.placed(results, shown)
    KINDS[kind](StudyPicture(results, out, metrics, shown, options, search, note))


def _standard_kind(design: str, keys: Sequence[str]) -> str:
    """Return the kind of picture that a design suggests."""
    if design == "grid" and keys:
        return "line" if len(keys) == 1 else "map"
    return "sobol" if design == "saltelli" else "histogram"


def _checked_search(search: RecordedSearch | None, shown: Collection[str]) -> RecordedSearch:
    """Return the search that a picture of it shows, with its objective only."""
    if search is None:
        raise UsageError(
            "plot kind 'search': expected a study whose members were chosen by a search, such as "
            "a tuning, got a planned one"
        )
    others = [quoted(name) for name in shown if name != search.metric]
    if others:
        raise UsageError(
            f"plot kind 'search': expected the objective {quoted(search.metric)} alone, got "
            f"{others[0]}; other kinds show other metrics, and what was varied"
        )
    return search


def _plot_histograms(picture: StudyPicture) -> None:
    handles: list[Any] = []
    for panel, column, label in picture:
        shown = values = column.values
        logarithmic = is_logarithmic(values)
        low, high = np.quantile(values, [0.01, 0.99])
        reach = 3.0 * (high - low)  # beyond are single values, which would hide the others
        if reach > 0.0 and not logarithmic:
            shown = values[(values >= low - reach) & (values <= high + reach)]
        if len(shown) < len(values):
            beyond = len(values) - len(shown)
            panel.set_title(f"{panel.get_title()}, {beyond} outside of the axis", **NOTE)
        bins = np.exp(_bins(np.log(shown))) if logarithmic else _bins(shown)
        panel.hist(shown, bins=bins, color=COLORS[5], edgecolor="white", linewidth=0.3)
        if logarithmic:
            panel.set_xscale("log")
        panel.set(xlabel=label, ylabel="members", xlim=panel.get_xlim())  # a mean may be beyond it
        panel.yaxis.get_major_locator().set_params(integer=True)
        low, middle, high = np.quantile(values, PROBABILITIES)
        dashes = {"color": "black", "linewidth": WIDTH, "linestyle": "--", "label": "5 % and 95 %"}
        handles = [
            panel.axvline(values.mean(), color=COLORS[1], linewidth=2.0, label="mean"),
            panel.axvline(middle, color="black", linewidth=WIDTH, label="median"),
            *(panel.axvline(end, **dashes) for end in (low, high)),
        ]
    picture.save("histograms", handles)


def _bins(values: Vector) -> Vector:
    """Return edges of bins by the rule of Freedman and Diaconis; at least those of Sturges."""
    low, lower, upper, high = np.quantile(values, [0.0, 0.25, 0.75, 1.0])
    if low == high:
        return np.linspace(low - reach_beside(low), high + reach_beside(high), 12)
    width = 2.0 * (upper - lower) / len(values) ** (1.0 / 3.0)
    count = max((high - low) / width if width > 0.0 else 0.0, math.log2(len(values)) + 1.0, 5.0)
    return np.linspace(low, high, math.ceil(min(count, 80.0)) + 1)


def _plot_distributions(picture: StudyPicture) -> None:
    layout = picture.results.layout
    is_drawn = layout.is_drawn and layout.kind in ("random", "grid", "cases")
    handles: list[Any] = []
    for panel, column, label in picture:
        count = len(column.values)
        style = {"color": COLORS[0], "linewidth": WIDTH, "label": "share of members"}
        curve = panel.ecdf(column.values, **style)
        handles.append(curve)
        if is_drawn and layout.units_of(column.numbers) is None:
            x, shares = curve.get_xydata()[panels.spread_rows(count + 1, _MOST_STEPS)].T
            reach = math.sqrt(math.log(2.0 / (1.0 - CONFIDENCE)) / (2.0 * count))
            ends = [np.clip(shares + end, 0.0, 1.0) for end in (-reach, reach)]
            words = f"{_PERCENT} band of the whole curve"
            handles.append(panel.fill_between(x, *ends, step="post", label=words, **_FAINT))
        panel.set(xlabel=label, ylabel="share of members up to it", ylim=(-0.02, 1.02))
        if is_logarithmic(column.values):
            panel.set_xscale("log")
    picture.save("distributions", handles)


def _plot_convergence(picture: StudyPicture) -> None:
    layout = picture.results.layout
    handles: list[Any] = []
    for panel, column, label in picture:
        running = running_mean(column, layout)
        total = len(running.counts)
        rows = np.unique(np.geomspace(1, total, _MOST_STEPS).astype(np.int64)) - 1
        columns = (running.counts, running.means, running.half_widths)
        counts, means, reaches = (one[rows] for one in columns)
        style = {"color": COLORS[0], "linewidth": WIDTH, "marker": "." if total <= 10 else ""}
        handles = panel.plot(counts, means, label="mean of the first", **style)
        words = f"{_PERCENT} interval of each"
        band = panel.fill_between(counts, means - reaches, means + reaches, label=words, **_FAINT)
        last = panel.axhline(means[-1], color="0.6", linewidth=1.0, label="mean of all")
        handles += [band, last]
        if counts[-1] > 100 * counts[0]:
            panel.set_xscale("log")
        else:
            panel.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
        settled = slice(min(5, total // 2), None)  # the interval of fewer would hide the rest
        shown = np.concatenate([means - reaches, means, means + reaches]).reshape(3, -1)[:, settled]
        low, high = np.nanmin(shown), np.nanmax(shown)
        if high > low:
            panel.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
        panel.set(xlabel="members", ylabel=f"mean of {label}")
    picture.save(f"convergence of the mean; {layout.basis}", handles)


def _plot_sobol(picture: StudyPicture) -> None:
    results = picture.results
    found: list[SobolIndices] = []
    problem: UsageError | None = None
    for column in picture.columns:
        try:
            found.append(sobol_indices(results.columns, results.layout, column.name))
        except UsageError as error:
            problem = error
    if problem is not None and (picture.metrics or not found):
        raise problem
    shown = found[: panels.MOST_PANELS]
    size = (14.0, 2.5 + 0.9 * min(len(shown[0].parameters), _MOST_BARS))
    places = picture.panels(len(shown), min(2, len(shown)), size)
    *_, handles = [_draw_indices(*pair) for pair in zip(places, shown, strict=True)]
    title = "Sobol indices"
    if any(indices.first_intervals[0] != NO_INTERVAL for indices in shown):
        title += f" with rough {_PERCENT} intervals"
    if len(shown) < len(found):
        title += f" of the first {len(shown)} of {len(found)} metrics"
    picture.save(title, handles)


def _draw_indices(panel: Any, indices: SobolIndices) -> list[Any]:
    """Draw the indices of a metric, the largest first."""
    order = np.argsort(-indices.total_order)[:_MOST_BARS]
    places = np.arange(len(order), dtype=np.float64)
    handles = []
    for values, intervals, shift, color, label in (
        (indices.first_order, indices.first_intervals, -0.2, COLORS[0], "first order"),
        (indices.total_order, indices.total_intervals, 0.2, COLORS[4], "total order"),
    ):
        chosen = values[order]
        ends = np.array([[intervals[k].lower, intervals[k].upper] for k in order], np.float64)
        reaches = np.maximum([chosen - ends[:, 0], ends[:, 1] - chosen], 0.0)
        handles.append(panel.barh(places + shift, chosen, 0.4, color=color, label=label))
        style = {"ecolor": "black", "elinewidth": 1.0, "capsize": 2.5}
        panel.errorbar(chosen, places + shift, xerr=reaches, fmt="none", **style)
    panel.set_yticks(places, [broken(shown_text(indices.parameters[k]), 28) for k in order])
    panel.invert_yaxis()
    panel.axvline(0.0, color="0.5", linewidth=1.0)
    panel.set_xlabel(f"share of the variance of {shown_text(indices.metric)}")
    text = indices.remark or count_text(indices.base_points, "base point")
    if len(indices.omitted):
        text += f", {len(indices.omitted)} left out"
    if len(order) < len(indices.parameters):
        text += f"; the largest {len(order)} of {len(indices.parameters)} parameters"
    panel.set_title(text, **NOTE)
    return handles


def _plot_search(picture: StudyPicture) -> None:
    search, results = picture.search, picture.results
    assert search is not None
    handles: list[Any] = []
    for panel, column, label in picture:
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
        panels.mark_failed(panel, places, label=words)
        _scale_objective(panel, values)
        panel.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
        panel.set(xlabel="member", ylabel=label)
        handles = panel.get_lines()
    count = f"{count_text(results.done)} of at most {results.planned}"
    picture.save(f"{search.method}, {search.goal}; {count}", handles)


def _scale_objective(panel: Any, values: Vector) -> None:
    """Give an objective an axis that shows its small values beside large ones of a search."""
    sizes = np.abs(values[values != 0.0])
    low, high = np.quantile(sizes, [0.05, 0.95]) if len(sizes) > 2 else (1.0, 1.0)
    if is_logarithmic(values):
        panel.set_yscale("log")
    elif high > 900.0 * low:
        panel.set_yscale("symlog", linthresh=low)
    else:
        panel.yaxis.set_major_formatter("{x:g}")
        middle = float(np.median(values))
        if np.ptp(values) <= 1e-5 * abs(middle):  # numbers at the axis have six digits
            panel.set_ylim(middle - reach_beside(middle), middle + reach_beside(middle))


KINDS: Final[dict[str, Callable[[StudyPicture], None]]] = {
    "histogram": _plot_histograms,
    "distribution": _plot_distributions,
    "convergence": _plot_convergence,
    "line": plot_lines,
    "map": plot_maps,
    "scatter": plot_scatter,
    "sobol": _plot_sobol,
    "search": _plot_search,
}
