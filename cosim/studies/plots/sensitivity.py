"""Sobol indices as bars with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError
from cosim.report.plots.curves import COLORS, shown_text
from cosim.report.plots.fitting import broken
from cosim.report.plots.picture import PictureOptions
from cosim.studies.layout import StudyResults, count_text
from cosim.studies.plots.panels import MOST_PANELS, shown_metrics, sized_picture
from cosim.studies.sensitivity import SobolIndices, check_has_indices, sobol_indices
from cosim.studies.statistics import CONFIDENCE, NO_INTERVAL, ConfidenceInterval

_BAR: Final = 0.4  # of the room of a parameter
_MOST_BARS: Final = 20  # parameters of a panel
_WIDTH: Final = 14.0  # cm of a panel
_NAME: Final = 28  # characters of a line of a name


def plot_sobol(
    results: StudyResults, out: Path, metrics: Sequence[str], options: PictureOptions
) -> None:
    """Draw first and total order indices of each metric with their 95 % intervals.

    Raises
    ------
    UsageError
        If the design of the study is none of Saltelli's, or a metric that is named has no indices.
    """
    check_has_indices(results.layout)
    found: list[SobolIndices] = []
    reason = "no metric of the study has a value"
    for name in shown_metrics(results, metrics):
        try:
            found.append(sobol_indices(results.columns, results.layout, name))
        except UsageError as error:
            if metrics:
                raise
            reason = str(error)
    if not found:
        raise UsageError(reason)
    shown = found[:MOST_PANELS]
    across = min(2, len(shown))
    down = -(-len(shown) // across)
    bars = min(len(shown[0].parameters), _MOST_BARS)
    size = (_WIDTH * across, (2.5 + 0.9 * bars) * down)
    picture = sized_picture(len(shown), across, options, size=size)
    handles: list[Any] = []
    for panel, indices in zip(picture.panels, shown, strict=True):
        handles = _draw(panel, indices)
    picture.legend(handles, below=True)
    title = f"{results.name}: Sobol indices"
    if any(indices.first_intervals[0] != NO_INTERVAL for indices in shown):
        title += f" with rough {100.0 * CONFIDENCE:g} % intervals"
    if len(shown) < len(found):
        title += f" of the first {len(shown)} of {len(found)} metrics"
    picture.save(out, title=shown_text(title))


def _draw(panel: Any, indices: SobolIndices) -> list[Any]:
    order = np.argsort(-indices.total_order)[:_MOST_BARS]
    places = np.arange(len(order), dtype=np.float64)
    handles = []
    for values, intervals, shift, color, label in (
        (indices.first_order, indices.first_intervals, -0.5, COLORS[0], "first order"),
        (indices.total_order, indices.total_intervals, 0.5, COLORS[4], "total order"),
    ):
        chosen = values[order]
        bars = panel.barh(places + shift * _BAR, chosen, _BAR, color=color, label=label)
        panel.errorbar(
            chosen,
            places + shift * _BAR,
            xerr=_reaches(chosen, [intervals[k] for k in order]),
            fmt="none",
            ecolor="black",
            elinewidth=1.0,
            capsize=2.5,
        )
        handles.append(bars)
    names = [broken(shown_text(indices.parameters[k]), _NAME) for k in order]
    panel.set_axisbelow(True)
    panel.set_yticks(places, labels=names)
    panel.invert_yaxis()
    panel.axvline(0.0, color="0.5", linewidth=1.0)
    panel.set_xlabel(f"share of the variance of {shown_text(indices.metric)}")
    text = indices.remark or count_text(indices.base_points, "base point")
    if len(indices.omitted):
        text += f", {len(indices.omitted)} left out"
    if len(order) < len(indices.parameters):
        text += f"; the largest {len(order)} of {len(indices.parameters)} parameters"
    panel.set_title(text, fontsize="small", color="0.3")
    return handles


def _reaches(values: Vector, intervals: Sequence[ConfidenceInterval]) -> Vector:
    """Return how far intervals reach to both sides; NaN: there is none.

    One of a bootstrap may not hold the value.
    """
    lower = np.array([interval.lower for interval in intervals], np.float64)
    upper = np.array([interval.upper for interval in intervals], np.float64)
    return np.maximum(np.stack([values - lower, upper - values]), 0.0)
