"""The standard picture of a run: estimates with their truth and their errors, or the outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds, Vector
from cosim.core.recording import Recording
from cosim.errors import UsageError
from cosim.report.plots.curves import TRUTH, Curve, color_styles, curves_of, draw_curves
from cosim.report.plots.intervals import band_curves, draw_bands, edges
from cosim.report.plots.picture import Picture, PictureOptions, need_plot
from cosim.report.recorded_rows import beside_truth, rows_of, stacked_units, time_ns_of
from cosim.scenario.document.schema import truth_ports
from cosim.scenario.record import run_metadata, truth_of

MOST_OUTPUTS: Final = 12  # of a run without truth that a picture shows
_STANDARD = PictureOptions()


def plot_run(recording: Recording, out: Path, options: PictureOptions = _STANDARD) -> None:
    """Draw the standard picture of a run.

    A row for each estimate: on the left with its truth, on the right its error, both with the 95 %
    interval where the standard error is recorded. For a run without
    truth a panel for each output; states only of components that have no other.

    Raises
    ------
    UsageError
        If there is no matplotlib, the format of ``out`` is unknown, there is nothing to show, or a
        value is too large for an axis.
    """
    need_plot(out)
    scenario = run_metadata(recording).get("scenario", "")
    truth = truth_of(recording)
    if truth:
        _plot_estimates(recording, truth, out, options, scenario)
    else:
        _plot_outputs(recording, out, options, scenario)


def _plot_estimates(
    recording: Recording,
    truth: dict[str, Any],
    out: Path,
    options: PictureOptions,
    scenario: str,
) -> None:
    picture = Picture(2 * len(truth), options, columns=2)
    panels = np.reshape(np.array(picture.panels, object), (-1, 2))
    for (left, right), (estimate, true) in zip(panels, truth.items(), strict=True):
        curves = curves_of(recording, estimate, options)
        styles = list(color_styles(len(curves)))
        widths = band_curves(recording, estimate, options)
        draw_truth(left, recording, estimate, true, options)
        draw_bands(left, curves, widths, styles)
        draw_curves(left, curves, styles=styles)
        limit_to_truth(left, recording, estimate, true, options)
        errors = error_curves(recording, estimate, true, options)
        draw_bands(right, errors, widths, styles)
        draw_curves(right, errors, styles=styles)
        limit_to_settled(right, [*errors, *edges(errors, widths)])
        right.axhline(0.0, color="0.75", linewidth=1.0)
    picture.panels[0].set_title("estimates (lines) and truth (gray)", fontsize="medium")
    picture.panels[1].set_title("errors", fontsize="medium")
    picture.save(out, title=scenario)


def _plot_outputs(recording: Recording, out: Path, options: PictureOptions, scenario: str) -> None:
    names = []
    for component, channel in recording.channels.items():
        outputs = channel.interface.outputs
        shown = [signal for signal in outputs if signal.role != "state"] or outputs
        names += [f"{component}.{signal.name}" for signal in shown]
    if not names:
        raise UsageError("the run has no outputs to show; name signals: cosim plot LOG SIGNAL...")
    drawn = names[:MOST_OUTPUTS]
    picture = Picture(len(drawn), options)
    for panel, name in zip(picture.panels, drawn, strict=True):
        curves = curves_of(recording, name, options)
        draw_curves(panel, curves, styles=list(color_styles(len(curves))))
    title = scenario
    if len(drawn) < len(names):
        title = f"{scenario}: the first {len(drawn)} of {len(names)} outputs"
    picture.save(out, title=title)


def draw_truth(
    panel: Any, recording: Recording, estimate: str, true: Any, options: PictureOptions
) -> None:
    """Draw the true signals, or the true values, of an estimate in gray."""
    ports = truth_ports(true)
    for curve in _true_curves(recording, estimate, ports, options):
        curve.draw(panel, TRUTH)
    if not ports:
        for value in np.atleast_1d(true):
            panel.axhline(value, **TRUTH)


def _true_curves(
    recording: Recording, estimate: str, ports: Sequence[str], options: PictureOptions
) -> list[Curve]:
    """Return the true signals of an estimate, in its units."""
    curves: list[Curve] = []
    for port, units in zip(ports, stacked_units(recording, ports, estimate), strict=True):
        curves += curves_of(recording, port, options, like=units)
    return curves


def error_curves(
    recording: Recording, estimate: str, true: Any, options: PictureOptions
) -> list[Curve]:
    """Return estimate minus truth, at the instants that they share.

    An estimate that lags is compared with the truth that much earlier.
    """
    shared, estimated, truth = _beside_truth(recording, estimate, true)
    errors = estimated - truth
    curves = []
    whole = PictureOptions()
    for curve, values in zip(curves_of(recording, estimate, whole), errors.T, strict=True):
        name = f"error of {curve.name}"
        error = replace(curve, name=name, times=shared / 1e9, values=values)
        curves.append(error.within(options))
    return curves


def _beside_truth(
    recording: Recording, estimate: str, true: Any
) -> tuple[Nanoseconds, Matrix, Matrix]:
    ports = truth_ports(true)
    if ports:
        return beside_truth(recording, estimate, ports)
    times = time_ns_of(recording, estimate)
    values = np.atleast_1d(np.array(true, np.float64))
    truth = np.broadcast_to(values, (len(times), len(values)))
    return times, rows_of(recording, estimate), truth


def limit_to_truth(
    panel: Any, recording: Recording, estimate: str, true: Any, options: PictureOptions
) -> None:
    """Limit a panel to the truth and the second half of the estimate: transients would hide it."""
    curves = [curve.values for curve in curves_of(recording, estimate, options)]
    parts = [values[len(values) // 2 :] for values in curves]
    ports = truth_ports(true)
    parts += [curve.values for curve in _true_curves(recording, estimate, ports, options)]
    if not ports:
        parts.append(np.atleast_1d(np.array(true, np.float64)))
    _limit(panel, parts)


def limit_to_settled(panel: Any, curves: list[Curve]) -> None:
    """Limit a panel to the second half of its curves: transients would hide it."""
    _limit(panel, [curve.values[len(curve.values) // 2 :] for curve in curves])
    panel.ticklabel_format(axis="y", scilimits=(-2, 3))


def _limit(panel: Any, parts: list[Vector]) -> None:
    values = np.concatenate([np.zeros(0), *parts])
    finite = values[np.isfinite(values)]
    if not len(finite):
        return
    low = float(finite.min())
    high = float(finite.max())
    margin = 0.15 * (high - low) or 1.0
    panel.set_ylim(low - margin, high + margin)
