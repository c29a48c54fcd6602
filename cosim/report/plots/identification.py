"""Pictures of an identification from logs: residual and spectrum, disturbance, theta over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.port import named_ports
from cosim.errors import AssumptionError
from cosim.report.plots.curves import Curve, color_styles, draw_curves
from cosim.report.plots.picture import Picture, PictureOptions, need_plot
from cosim.report.plots.runs import (
    SCIENTIFIC,
    ZERO,
    draw_truth,
    error_curves,
    estimate_curves,
    limit_to_settled,
)
from cosim.report.recorded_rows import stacked_rows_of, units_of
from cosim.scenario.record import truth_of
from cosim.scenario.running.identifying import IdentifierRecord, LogIdentification
from cosim.theory.assessment.spectrum import whiteness_spectrum
from cosim.theory.disturbed_plant import counted_values
from cosim.theory.documents import Verdict

_STANDARD = PictureOptions()
_THIN: Final = 0.5  # width of a line of noise [points]
_PANELS: Final = 6  # for a log, in two columns


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
    records = identification.records
    picture = Picture(_PANELS * len(records), options, columns=2, shares_time=False)
    for index, record in enumerate(records):
        of_log = picture.panels[_PANELS * index : _PANELS * (index + 1)]
        _draw_residual(of_log[0], identification, index, options)
        _draw_spectrum(of_log[1], identification, index)
        _draw_disturbance(of_log[2:4], identification, index, options)
        _draw_theta(of_log[4:], record, options)
        t = record.data.t  # the axis of time that they would share, were they alone in the picture
        margin = 0.02 * float(t[-1] - t[0])
        start = float(t[0]) - margin if options.start is None else options.start
        stop = float(t[-1]) + margin if options.stop is None else options.stop
        for panel in (of_log[0], *of_log[2:]):
            panel.set(xlim=(start, stop), xlabel="t [s]")
    picture.save(out, title="" if len(records) > 1 else records[0].log.label)


def _set_title(panel: Any, title: str) -> None:
    panel.set_title(title, fontsize="medium")


def _draw_residual(
    panel: Any, identification: LogIdentification, index: int, options: PictureOptions
) -> None:
    record = identification.records[index]
    residual = identification.assessment.fitted.responses[index].residual
    units = units_of(record.log, f"{identification.identified.observer}.y")
    curves = []
    for o, (unit, column) in enumerate(zip(units, residual.T, strict=True)):
        name = f"residual of y[{o}]" if len(units) > 1 else "residual of y"
        curves.append(Curve(name, unit, record.data.t, column).within(options))
    draw_curves(panel, curves, [{**one, "linewidth": _THIN} for one in color_styles(len(curves))])
    panel.ticklabel_format(axis="y", scilimits=SCIENTIFIC)
    owner = f"{record.log.label}: " if len(identification.records) > 1 else ""
    _set_title(panel, f"{owner}residual")


def _draw_spectrum(panel: Any, identification: LogIdentification, index: int) -> None:
    data = identification.records[index].data
    residual = identification.assessment.fitted.responses[index].residual
    noise = identification.assessment.noise
    whitened = noise.whitened(residual[:, :, np.newaxis], data.numbers)[:, :, 0]
    counted = counted_values(data.numbers, noise.order)
    panel.set(xlabel="frequency [Hz]", ylabel="over white noise")
    for o, style in enumerate(color_styles(whitened.shape[1])):
        t = data.t[counted[:, o]]
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
    panel.set(xscale="log", yscale="log")
    panel.axhline(1.0, color="0.6", linewidth=1.0)


def _draw_disturbance(
    panels: Sequence[Any],
    identification: LogIdentification,
    index: int,
    options: PictureOptions,
) -> None:
    record = identification.records[index]
    estimate = f"{identification.identified.observer}.delta"
    title = "estimated disturbance"
    try:
        smoothed = identification.smoothed(index)
    except AssumptionError as error:  # of an unstable plant
        _set_title(panels[0], title)
        place = {"transform": panels[0].transAxes, "ha": "center", "wrap": True}
        panels[0].text(0.5, 0.5, str(error), **place)
        return
    missing = _why_no_band(identification)
    band = None if missing else smoothed.disturbance_half_width
    unit = units_of(record.log, estimate)[0]
    whole = Curve("delta", unit, smoothed.t, smoothed.disturbance, band=band)
    errors = []
    true = truth_of(record.log).get(estimate)
    if true is not None:
        draw_truth(panels[0], record.log, estimate, options)
        values = smoothed.disturbance - _true_disturbance(record, true)
        errors.append(replace(whole, name="error of delta", values=values).within(options))
    _draw_pair(panels, [whole.within(options)], errors, title, missing)


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
    ports = named_ports(true)
    if not ports:
        return np.full(len(record.data.t), float(np.atleast_1d(true)[0]))
    estimate = f"{record.identified.observer}.delta"
    times, rows = stacked_rows_of(record.log, ports, like=estimate)
    return np.interp(record.data.t, times / 1e9, rows[:, 0])


def _draw_theta(panels: Sequence[Any], record: IdentifierRecord, options: PictureOptions) -> None:
    """Draw theta as it was estimated during the run, with its recorded interval."""
    estimate = f"{record.identifier}.theta"
    curves = estimate_curves(record.log, estimate, options)
    errors: list[Curve] = []
    if estimate in truth_of(record.log):
        truth = draw_truth(panels[0], record.log, estimate, options)
        limit_to_settled(panels[0], curves, truth)
        errors = error_curves(record.log, estimate, options)
    drawn = _draw_pair(panels, curves, errors, "theta during the run")
    limit_to_settled(panels[1], drawn)


def _draw_pair(
    panels: Sequence[Any],
    curves: Sequence[Curve],
    errors: Sequence[Curve],
    title: str,
    missing: str = "",
) -> Sequence[Curve]:
    """Draw curves, and beside them their errors; where these are not known, how wide bands are.

    ``missing`` is why there are no bands. Return what is drawn on the right.
    """
    left, right = panels
    draw_curves(left, curves)
    widths = [replace(one, values=one.band, band=None) for one in curves if one.band is not None]
    drawn = errors or [replace(one, name=f"95 % of {one.name}") for one in widths]
    words = missing or ("95 % band" if widths else "")
    if drawn:
        draw_curves(right, drawn)
        right.ticklabel_format(axis="y", scilimits=SCIENTIFIC)
    if errors:
        title += "; gray: truth"
        words = ("; " if missing else ", and ").join(filter(None, ("its error", words)))
        right.axhline(0.0, **ZERO)
    elif widths:
        words = f"half width of its {words}"
    _set_title(right, words)
    _set_title(left, f"{title}\n{missing}" if missing else title)
    return drawn
