"""Pictures of an identification from logs: residual and spectrum, disturbance, theta over time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import AssumptionError
from cosim.report.plots.curves import COLORS, WIDTH, Curve, color_styles, curves_of
from cosim.report.plots.curves import draw_curves as draw
from cosim.report.plots.estimates import (
    draw_truth,
    error_curves,
    limit_to_settled,
    limit_to_truth,
)
from cosim.report.plots.intervals import band_curves, draw_bands, edges
from cosim.report.plots.picture import Picture, PictureOptions, need_plot
from cosim.report.recorded_rows import has_signal, stacked_rows_of, units_of
from cosim.scenario.document.schema import truth_ports
from cosim.scenario.identifying import IdentifierRecord, LogIdentification
from cosim.scenario.record import truth_of
from cosim.theory.assessment.documents import Verdict
from cosim.theory.assessment.spectrum import whiteness_spectrum
from cosim.theory.disturbed_plant import counted_values
from cosim.theory.fitted_response import FittedResponse

_STANDARD = PictureOptions()
_THIN: Final = 0.5  # width of a line of noise [points]
_ROWS: Final = 3  # of panels for a log


def plot_identification(
    identification: LogIdentification, out: Path, options: PictureOptions = _STANDARD
) -> None:
    """Draw what an identification from logs rests on.

    For each log the residual of y and its spectrum, the disturbance by what was found with its
    95 % band and its error, and theta as it was estimated during the run.

    Raises
    ------
    UsageError
        If there is no matplotlib, the format of ``out`` is unknown, or a value is too large for an
        axis.
    """
    need_plot(out)
    picture = Picture(
        2 * _ROWS * len(identification.records), options, columns=2, shares_time=False
    )
    panels = np.reshape(np.array(picture.panels, object), (-1, _ROWS, 2))
    for index, (record, of_log) in enumerate(zip(identification.records, panels, strict=True)):
        _draw_residual(of_log[0], identification, index, options)
        _draw_disturbance(of_log[1], identification, index, options)
        _draw_theta(of_log[2], record, options)
        _label_time([of_log[0, 0], *of_log[1], *of_log[2]], record, options)
    title = "" if len(identification.records) > 1 else identification.records[0].log.label
    picture.save(out, title=title)


def _set_title(panel: Any, title: str) -> None:
    panel.set_title(title, fontsize="medium")


def _label_time(panels: list[Any], record: IdentifierRecord, options: PictureOptions) -> None:
    """Give panels the axis of time that they would share, were they alone in the picture."""
    t = record.data.t
    margin = 0.02 * float(t[-1] - t[0])
    start = float(t[0]) - margin if options.start is None else options.start
    stop = float(t[-1]) + margin if options.stop is None else options.stop
    for panel in panels:
        panel.set_xlim(start, stop)
        panel.set_xlabel("t [s]")


def _draw_residual(
    panels: Any, identification: LogIdentification, index: int, options: PictureOptions
) -> None:
    over_time, spectrum = panels
    record = identification.records[index]
    identified = identification.identified
    data = record.data
    response = identification.assessment.fitted.responses[index]
    units = units_of(record.log, f"{identified.observer}.y")
    names = ["residual of y"]
    if data.y.shape[1] > 1:
        names = [f"residual of y[{o}]" for o in range(data.y.shape[1])]
    curves = []
    for name, unit, column in zip(names, units, response.residual.T, strict=True):
        curves.append(Curve(name, unit, data.t, column).within(options))
    styles = [{**style, "linewidth": _THIN} for style in color_styles(len(curves))]
    draw(over_time, curves, styles=styles)
    over_time.ticklabel_format(axis="y", scilimits=(-2, 3))
    owner = f"{record.log.label}: " if len(identification.records) > 1 else ""
    _set_title(over_time, f"{owner}residual")
    _draw_spectrum(spectrum, identification, record, response)


def _draw_spectrum(
    panel: Any,
    identification: LogIdentification,
    record: IdentifierRecord,
    response: FittedResponse,
) -> None:
    numbers = record.data.numbers
    noise = identification.assessment.noise
    whitened = noise.whitened(response.residual[:, :, np.newaxis], numbers)[:, :, 0]
    counted = counted_values(numbers, noise.order)
    panel.set_xlabel("frequency [Hz]")
    panel.set_ylabel("over white noise")
    for o, style in enumerate(color_styles(whitened.shape[1])):
        t = record.data.t[counted[:, o]]
        values = whitened[counted[:, o]][:, [o]]
        try:
            spectrum = whiteness_spectrum(values, float(t[-1] - t[0]) / max(len(t) - 1, 1))
        except AssumptionError:  # of a handful of samples
            continue
        frequency = spectrum.frequency
        panel.fill_between(frequency, spectrum.lower, spectrum.upper, color="0.88", linewidth=0.0)
        panel.plot(frequency, spectrum.power[:, 0], marker=".", markersize=4.0, **style)
        panel.set_ylim(bottom=0.5 * float(spectrum.lower.min()))
    if not panel.lines:
        _set_title(panel, "its spectrum: too few samples")
        return
    _set_title(panel, "its spectrum; gray: white noise, 95 %")
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.axhline(1.0, color="0.6", linewidth=1.0)


def _draw_disturbance(
    panels: Any, identification: LogIdentification, index: int, options: PictureOptions
) -> None:
    left, right = panels
    record = identification.records[index]
    estimate = f"{identification.identified.observer}.delta"
    unit = units_of(record.log, estimate)[0]
    try:
        smoothed = identification.smoothed(index)
    except AssumptionError as error:  # of an unstable plant
        _set_title(left, "estimated disturbance")
        left.text(0.5, 0.5, str(error), transform=left.transAxes, ha="center", wrap=True)
        return
    style = {"color": COLORS[0], "linewidth": WIDTH}
    whole = Curve("delta", unit, smoothed.t, smoothed.disturbance)
    width = replace(whole, values=smoothed.disturbance_half_width)
    true = truth_of(record.log).get(estimate)
    if true is not None:
        draw_truth(left, record.log, estimate, true, options)
    drawn = whole.within(options)
    missing = _why_no_band(identification)
    widths = [] if missing else [width.within(options)]
    draw_bands(left, [drawn], widths, [style])
    draw(left, [drawn], styles=[style])
    title = "estimated disturbance" + "; gray: truth" * (true is not None)
    _set_title(left, f"{title}\n{missing}" if missing else title)
    if true is not None:
        values = smoothed.disturbance - _true_disturbance(record, true)
        errors = [replace(whole, name="error of delta", values=values).within(options)]
        draw_bands(right, errors, widths, [style])
        draw(right, errors, styles=[style])
        right.axhline(0.0, color="0.75", linewidth=1.0)
        _set_title(right, f"its error; {missing}" if missing else "its error, and 95 % band")
    else:
        shown = [replace(one, name="half width of the 95 % band") for one in widths]
        draw(right, shown, styles=[style])
        _set_title(right, missing or "half width of its 95 % band")
    right.ticklabel_format(axis="y", scilimits=(-2, 3))


def _why_no_band(identification: LogIdentification) -> str:
    """Return why the disturbance has no 95 % band; empty where it has one.

    The band is linear in the same unknowns as the intervals of theta, and holds where they do.
    """
    for parameter in identification.assessment.parameters:
        if parameter.verdict is not Verdict.IDENTIFIABLE:
            return f"no 95 % band: {parameter.name} is {parameter.verdict}"
    return ""


def _true_disturbance(record: IdentifierRecord, true: Any) -> Vector:
    """Return the true disturbance at the samples, on straight lines between its rows."""
    ports = truth_ports(true)
    if not ports:
        return np.full(len(record.data.t), float(np.atleast_1d(true)[0]))
    estimate = f"{record.identified.observer}.delta"
    times, rows = stacked_rows_of(record.log, ports, like=estimate)
    return np.interp(record.data.t, times / 1e9, rows[:, 0])


def _draw_theta(panels: Any, record: IdentifierRecord, options: PictureOptions) -> None:
    """Draw theta as it was estimated during the run, with its recorded interval."""
    left, right = panels
    estimate = f"{record.identifier}.theta"
    curves = curves_of(record.log, estimate, options)
    styles = list(color_styles(len(curves)))
    widths = band_curves(record.log, estimate, options)
    true = truth_of(record.log).get(estimate)
    if true is not None:
        draw_truth(left, record.log, estimate, true, options)
    draw_bands(left, curves, widths, styles)
    draw(left, curves, styles=styles)
    _set_title(left, "theta during the run" + "; gray: truth" * (true is not None))
    if true is not None:
        _set_title(right, "its error, and 95 % interval" if widths else "its error")
        limit_to_truth(left, record.log, estimate, true, options)
        errors = error_curves(record.log, estimate, true, options)
        draw_bands(right, errors, widths, styles)
        draw(right, errors, styles=styles)
        limit_to_settled(right, [*errors, *edges(errors, widths)])
        right.axhline(0.0, color="0.75", linewidth=1.0)
    elif has_signal(record.log, f"{record.identifier}.standard_error"):
        _set_title(right, "half width of its 95 % interval")
        named = []
        for width, curve in zip(widths, curves, strict=True):
            named.append(replace(width, name=f"95 % of {curve.name}"))
        draw(right, named, styles=styles)
        limit_to_settled(right, named)
