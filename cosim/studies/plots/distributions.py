"""How the values of metrics are distributed: histograms, and the share of members below."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.report.plots.curves import COLORS, WIDTH
from cosim.report.plots.picture import PictureOptions
from cosim.studies.layout import StudyResults, independence_of
from cosim.studies.plots.panels import FAINT, MetricPanels, spread_rows
from cosim.studies.plots.scales import check_drawable, is_logarithmic, reach_beside
from cosim.studies.statistics import CONFIDENCE, PROBABILITIES

_MOST_BINS: Final = 80
_MOST_STEPS: Final = 2000  # of a curve: more would be on one dot of it
_FAR: Final = 3.0  # times the range of 98 % of the values: beyond are none or single ones
_DRAWN_ALONE: Final = ("random", "grid", "cases")  # members of it, where they are drawn


def plot_histograms(
    results: StudyResults, out: Path, metrics: Sequence[str], options: PictureOptions
) -> None:
    """Draw a histogram of each metric with its mean and quantiles."""
    picture = MetricPanels(results, metrics, options)
    handles: list[Any] = []
    for panel, column in zip(picture.panels, picture.columns, strict=True):
        check_drawable(column.name, column.values)
        label = picture.label(panel, column)
        shown, beyond = _without_outliers(column.values)
        if is_logarithmic(shown):
            panel.set_xscale("log")
        edges = _bins(shown)
        panel.hist(shown, bins=edges, color=COLORS[5], edgecolor="white", linewidth=0.3)
        panel.set_xlabel(label)
        panel.set_ylabel("members")
        panel.yaxis.get_major_locator().set_params(integer=True)
        if beyond:
            panel.set_title(f"{panel.get_title()}, {beyond} outside of the axis", color="0.3")
            panel.title.set_fontsize("small")
        limits = panel.get_xlim()
        handles = _draw_figures(panel, column.values)
        panel.set_xlim(limits)  # a mean beyond the axis, as of values far off, moves it
    picture.legend(handles)
    picture.save(out, "histograms")


def plot_distributions(
    results: StudyResults, out: Path, metrics: Sequence[str], options: PictureOptions
) -> None:
    """Draw the share of members below each value, with a band that holds all of the true one.

    The band is that of Dvoretzky, Kiefer and Wolfowitz with the constant of Massart (Annals of
    Probability 18, 1990), whatever the distribution; of members that were drawn one by one.
    """
    picture = MetricPanels(results, metrics, options)
    independence = independence_of(results.layout)
    handles: list[Any] = []
    for panel, column in zip(picture.panels, picture.columns, strict=True):
        check_drawable(column.name, column.values)
        label = picture.label(panel, column)
        values, shares = _steps(column.values)
        if is_logarithmic(column.values):
            panel.set_xscale("log")
        handles = panel.plot(
            values,
            shares,
            drawstyle="steps-post",
            color=COLORS[0],
            linewidth=WIDTH,
            label="share of members",
        )
        is_single = independence.units_of(column.numbers) is None
        if independence.is_drawn and is_single and results.layout.kind in _DRAWN_ALONE:
            reach = math.sqrt(math.log(2.0 / (1.0 - CONFIDENCE)) / (2.0 * len(column.values)))
            band = panel.fill_between(
                values,
                np.clip(shares - reach, 0.0, 1.0),
                np.clip(shares + reach, 0.0, 1.0),
                step="post",
                color=COLORS[0],
                alpha=FAINT,
                linewidth=0.0,
                label="95 % band of the whole curve",
            )
            handles = [*handles, band]
        panel.set_ylim(-0.02, 1.02)
        panel.set_xlabel(label)
        panel.set_ylabel("share of members up to it")
    picture.legend(handles)
    picture.save(out, "distributions")


def _draw_figures(panel: Any, values: Vector) -> list[Any]:
    """Draw the mean and the quantiles."""
    handles = [
        panel.axvline(values.mean(), color=COLORS[1], linewidth=2.0, label="mean"),
    ]
    low, middle, high = np.quantile(values, PROBABILITIES)
    handles.append(panel.axvline(middle, color="black", linewidth=WIDTH, label="median"))
    dashes = {"color": "black", "linewidth": WIDTH, "linestyle": "--"}
    handles.append(panel.axvline(low, label="5 % and 95 %", **dashes))
    panel.axvline(high, **dashes)
    return handles


def _without_outliers(values: Vector) -> tuple[Vector, int]:
    """Return the values without single ones far off, which would hide the others, and how many."""
    low, high = np.quantile(values, [0.01, 0.99])
    reach = _FAR * (high - low)
    near = (values >= low - reach) & (values <= high + reach)
    if reach <= 0.0 or is_logarithmic(values):
        return values, 0
    return values[near], int((~near).sum())


def _bins(values: Vector) -> Vector:
    """Return the edges of bins as of Freedman and Diaconis; on a log axis those of logarithms."""
    if is_logarithmic(values):
        return np.exp(_bins_of(np.log(values)))
    return _bins_of(values)


def _bins_of(values: Vector) -> Vector:
    low, high = float(values.min()), float(values.max())
    if low == high:
        reach = reach_beside(low)
        return np.linspace(low - reach, high + reach, 12)
    lower, upper = np.quantile(values, [0.25, 0.75])
    width = 2.0 * float(upper - lower) / len(values) ** (1.0 / 3.0)
    least = math.ceil(math.log2(len(values)) + 1.0)  # the rule of Sturges
    count = math.ceil((high - low) / width) if width > 0.0 else least
    return np.linspace(low, high, min(max(count, least, 5), _MOST_BINS) + 1)


def _steps(values: Vector) -> tuple[Vector, Vector]:
    """Return the values, ascending, and the share of members up to each; thinned out if many."""
    ordered = np.sort(values)
    shares = np.arange(1.0, len(ordered) + 1.0) / len(ordered)
    rows = spread_rows(len(ordered), _MOST_STEPS)
    steps = np.insert(ordered[rows], 0, ordered[0])
    return steps, np.insert(shares[rows], 0, 0.0)
