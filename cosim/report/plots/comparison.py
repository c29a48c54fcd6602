"""The estimates of one scenario on several plants or by several methods, and how they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.core.recording import Recording
from cosim.errors import UsageError
from cosim.report.plots.curves import (
    DASHES,
    TRUTH,
    Curve,
    Style,
    curves_of,
    run_styles,
    show_legend,
)
from cosim.report.plots.estimates import draw_truth, limit_to_settled, limit_to_truth
from cosim.report.plots.picture import Picture, PictureOptions, need_plot
from cosim.report.recorded_rows import difference, element_names, has_signal, units_of
from cosim.scenario.record import truth_of
from cosim.units import units_text, with_unit

if TYPE_CHECKING:
    from cosim.report.comparing import Comparison, EstimatorComparison

_STANDARD = PictureOptions()
FAR_BEYOND: Final = 10.0  # times how far most curves of a panel reach: it is not for these
_ELEMENT_COLOR = "0.3"


def plot_comparison(
    comparison: Comparison | EstimatorComparison, out: Path, options: PictureOptions = _STANDARD
) -> None:
    """Draw the estimates of several runs over their truth, and their differences to the first.

    One row for each estimate: on the left the estimates, on the right the differences. A plant, or
    a method, has its color, an element of an estimate its dashes.

    Raises
    ------
    UsageError
        If there is no matplotlib, the format of ``out`` is unknown, or no plant has an estimate.
    """
    need_plot(out)
    recordings = comparison.recordings
    if not comparison.estimates:
        raise UsageError("no run has an estimate with a [truth], so there is nothing to compare")
    picture = Picture(2 * len(comparison.estimates), options, columns=2)
    colors = dict(zip(recordings, run_styles(len(recordings)), strict=True))
    rows = np.reshape(np.array(picture.panels, object), (-1, 2))
    for (left, right), (estimate, true) in zip(rows, comparison.estimates.items(), strict=True):
        _draw_estimates(left, recordings, estimate, true, colors, options)
        _draw_differences(right, recordings, estimate, colors, options)
    first = next(iter(recordings))
    picture.panels[0].set_title("estimates", fontsize="medium")
    picture.panels[1].set_title(f"difference to {first}", fontsize="medium")
    lines = [picture.panels[0].plot([], [], label=run, **style)[0] for run, style in colors.items()]
    lines.append(picture.panels[0].plot([], [], label="truth", **TRUTH)[0])
    picture.legend(lines)
    picture.save(out)


def _draw_estimates(
    panel: Any,
    recordings: Mapping[str, Recording],
    estimate: str,
    true: Any,
    styles: Mapping[str, Style],
    options: PictureOptions,
) -> None:
    for recording in recordings.values():
        if has_signal(recording, estimate) and truth_of(recording).get(estimate) == true:
            draw_truth(panel, recording, estimate, true, options)
            limit_to_truth(panel, recording, estimate, true, options)
            break
    for run, recording in recordings.items():
        if has_signal(recording, estimate):
            _draw_elements(panel, curves_of(recording, estimate, options), styles[run])
    panel.set_ylabel(with_unit(estimate, _unit_of(recordings, estimate) or None))


def _draw_differences(
    panel: Any,
    recordings: Mapping[str, Recording],
    estimate: str,
    styles: Mapping[str, Style],
    options: PictureOptions,
) -> None:
    (_, first), *others = recordings.items()
    drawn: list[Curve] = []
    for run, recording in others:
        if has_signal(first, estimate) and has_signal(recording, estimate):
            curves = _difference_curves(first, recording, estimate, options)
            _draw_elements(panel, curves, styles[run])
            drawn += curves
    limit_to_settled(panel, near_most(drawn))
    names = list(dict.fromkeys(curve.name for curve in drawn))
    if len(names) > 1:
        for name, dashes in zip(names, _dashes(len(names)), strict=True):
            panel.plot([], [], color=_ELEMENT_COLOR, linestyle=dashes, label=name)
        show_legend(panel)


def near_most(curves: Sequence[Curve]) -> list[Curve]:
    """Return the curves without those whose second half is far beyond that of most others.

    A method that fails would hide all the others; it leaves the panel, and the left one shows it.
    """
    reaches = []
    for curve in curves:
        half = curve.values[len(curve.values) // 2 :]
        finite = half[np.isfinite(half)]
        reaches.append(float(np.abs(finite).max(initial=0.0)))
    shown = [reach for reach in reaches if reach > 0.0]
    farthest = FAR_BEYOND * float(np.median(shown)) if shown else 0.0
    return [curve for curve, reach in zip(curves, reaches, strict=True) if reach <= farthest]


def _difference_curves(
    first: Recording, other: Recording, estimate: str, options: PictureOptions
) -> list[Curve]:
    times, values = difference(first, other, estimate)
    names = element_names(estimate, values.shape[1])
    curves = []
    for name, unit, column in zip(names, units_of(first, estimate), values.T, strict=True):
        curves.append(Curve(name, unit, times, column).within(options))
    return curves


def _draw_elements(panel: Any, curves: Sequence[Curve], style: Style) -> None:
    for curve, dashes in zip(curves, _dashes(len(curves)), strict=True):
        curve.draw(panel, {**style, "linestyle": dashes})


def _dashes(count: int) -> list[object]:
    return [DASHES[i % len(DASHES)] for i in range(count)]


def _unit_of(recordings: Mapping[str, Recording], estimate: str) -> str:
    for recording in recordings.values():
        if has_signal(recording, estimate):
            return units_text(units_of(recording, estimate))
    return ""
