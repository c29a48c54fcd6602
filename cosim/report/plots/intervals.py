"""Bands around curves: the 95 % intervals of estimates whose standard error is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from cosim.core.recording import Recording
from cosim.report.plots.curves import LARGEST_DRAWN, Curve, Style, curves_of
from cosim.report.plots.picture import PictureOptions
from cosim.report.recorded_rows import has_signal
from cosim.theory.quantiles import CONFIDENCE, normal_two_sided

_FAINT: Final = 0.2  # opacity


def band_curves(recording: Recording, estimate: str, options: PictureOptions) -> list[Curve]:
    """Return the half widths of the 95 % intervals of an estimate; none where there is no error.

    Parameters
    ----------
    recording : Recording
    estimate : str
        A port ``component.theta``, whose component may record ``standard_error``.
    options : PictureOptions
    """
    component, _, signal = estimate.rpartition(".")
    error = f"{component}.standard_error"
    if signal != "theta" or not has_signal(recording, error):
        return []
    curves = curves_of(recording, error, options)
    quantile = normal_two_sided(CONFIDENCE)
    return [replace(curve, values=quantile * curve.values) for curve in curves]


def edges(curves: Sequence[Curve], widths: Sequence[Curve]) -> list[Curve]:
    """Return both edges of the band around each curve that has one, for the limits of a panel."""
    both = []
    for curve, width in zip(curves, widths, strict=False):
        if len(curve.times) == len(width.times):
            both.append(replace(curve, values=curve.values - width.values))
            both.append(replace(curve, values=curve.values + width.values))
    return both


def draw_bands(
    panel: Any, curves: Sequence[Curve], widths: Sequence[Curve], styles: Sequence[Style]
) -> None:
    """Draw a band around each curve that has a width, at the instants that they share."""
    for curve, width, style in zip(curves, widths, styles, strict=False):
        if len(curve.times) != len(width.times):
            continue
        lower = (curve.values - width.values).clip(-LARGEST_DRAWN, LARGEST_DRAWN)
        upper = (curve.values + width.values).clip(-LARGEST_DRAWN, LARGEST_DRAWN)
        panel.fill_between(
            curve.times,
            lower,
            upper,
            color=style["color"],
            alpha=_FAINT,
            linewidth=0.0,
            step="post" if curve.held else None,
        )
