"""The signal in which two runs are farthest apart: both curves, and their difference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.core.recording import Recording
from cosim.log.comparison.difference import LogDifference, SignalDifference
from cosim.report.plots.curves import (
    COLORS,
    WIDTH,
    Curve,
    Style,
    curves_of,
    draw_curves,
    show_legend,
)
from cosim.report.plots.picture import Picture, PictureOptions, need_plot
from cosim.report.plots.signals import short_labels
from cosim.report.recorded_rows import difference as rows_apart
from cosim.report.recorded_rows import element_names, signal_of, units_of

_STYLES: Final[tuple[Style, Style]] = (
    {"color": COLORS[0], "linewidth": 2.0 * WIDTH},
    {"color": COLORS[1], "linewidth": WIDTH},
)  # the wider one stays visible under the other
_LIMIT: Final[Style] = {"color": "0.4", "linewidth": 0.9}
_STANDARD = PictureOptions()


def plot_difference(
    difference: LogDifference,
    runs: Sequence[Recording],
    out: Path,
    options: PictureOptions = _STANDARD,
) -> None:
    """Draw the worst signal of a comparison: the element in which both are farthest apart.

    Above both curves, below ``b - a`` at the instants that they share, with the tolerance where
    there is one, and a line at the first time outside it.

    Raises
    ------
    UsageError
        If there is no matplotlib, the format of ``out`` is unknown, or a value is too large for an
        axis.
    """
    need_plot(out)
    worst = difference.worst
    assert worst is not None
    apart = _apart(worst, runs)
    picture = Picture(2, options)
    above, below = picture.panels
    curves = []
    for run, label in zip(runs, short_labels(runs), strict=True):
        (curve,) = curves_of(run, apart.name, options)
        curves.append(replace(curve, run=label))
    draw_curves(above, curves, styles=_STYLES)
    draw_curves(below, [replace(apart, name="b - a")], styles=[{"color": COLORS[2]}])
    _draw_limits(below, worst)
    picture.save(out, title=f"{apart.name}: largest |a - b| = {worst.largest:.3g}")


def _apart(worst: SignalDifference, runs: Sequence[Recording]) -> Curve:
    """Return the difference of the element of a signal in which two runs are farthest apart."""
    with np.errstate(invalid="ignore"):  # infinity minus itself
        times, values = rows_apart(runs[0], runs[1], worst.signal)
    names = element_names(worst.signal, values.shape[1])
    if np.isfinite(worst.largest) or worst.first is None:
        number = int(np.nan_to_num(np.abs(values), nan=0.0).max(axis=0).argmax())
    else:  # where only one of both is a number
        number = names.index(worst.first.signal)
    held = signal_of(runs[0], worst.signal).variability == "discrete"
    unit = units_of(runs[0], worst.signal)[number]
    return Curve(names[number], unit, times, values[:, number], held)


def _draw_limits(panel: Any, worst: SignalDifference) -> None:
    """Draw the tolerance, where there is one, and the first time outside it."""
    if worst.tolerance > 0.0:
        panel.axhline(worst.tolerance, label="tolerance", linestyle="--", **_LIMIT)
        panel.axhline(-worst.tolerance, linestyle="--", **_LIMIT)
    if worst.first is not None:
        time = worst.first.time_ns / 1e9
        panel.axvline(time, label="first outside", linestyle=":", **_LIMIT)
    show_legend(panel)
