"""Pictures of an identification from logs: residual and spectrum, disturbance, theta over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.errors import AssumptionError
from cosim.report.plots.picture import STANDARD, Picture, color_styles, need_plot
from cosim.report.plots.runs import (
    SCIENTIFIC,
    Curve,
    draw_curves,
    draw_pair,
    error_curves,
    estimate_curves,
    limit_to_settled,
    truth_curves,
)
from cosim.report.recorded_rows import recorded_port
from cosim.scenario.running.identifying import IdentifierRecord, LogIdentification
from cosim.theory.assessment.spectrum import whiteness_spectrum
from cosim.theory.disturbed_plant import counted_values
from cosim.theory.documents import Verdict

_THIN: Final = 0.5  # width of a line of noise [points]
_PANELS: Final = 6  # for a log, in two columns


def plot_identification(identification: LogIdentification, out: Path) -> None:
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
    picture = Picture(_PANELS * len(records), STANDARD, columns=2, shares_time=False)
    for index, record in enumerate(records):
        of_log = picture.panels[_PANELS * index : _PANELS * (index + 1)]
        _draw_residual(of_log[0], identification, index)
        _draw_spectrum(of_log[1], identification, index)
        _draw_disturbance(of_log[2:4], identification, index)
        _draw_theta(of_log[4:], record)
        t = record.data.t  # the axis of time that they would share, were they alone in the picture
        margin = 0.02 * float(t[-1] - t[0])
        for panel in (of_log[0], *of_log[2:]):
            panel.set(xlim=(t[0] - margin, t[-1] + margin), xlabel="t [s]")
    picture.save(out, title="" if len(records) > 1 else records[0].log.label)


def _set_title(panel: Any, title: str) -> None:
    panel.set_title(title, fontsize="medium")


def _draw_residual(panel: Any, identification: LogIdentification, index: int) -> None:
    record = identification.records[index]
    residual = identification.assessment.fitted.responses[index].residual
    units = recorded_port(record.log, f"{identification.identified.observer}.y").measures
    curves = []
    for o, (unit, column) in enumerate(zip(units, residual.T, strict=True)):
        name = f"residual of y[{o}]" if len(units) > 1 else "residual of y"
        curves.append(Curve(name, unit, record.data.t, column))
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


def _draw_disturbance(panels: Sequence[Any], identification: LogIdentification, index: int) -> None:
    """Draw the disturbance by what was found.

    Its band is linear in the same unknowns as the intervals of theta, and holds where they do.
    """
    record = identification.records[index]
    estimate = f"{identification.identified.observer}.delta"
    try:
        smoothed = identification.smoothed(index)
    except AssumptionError as error:  # of an unstable plant
        _set_title(panels[0], "estimated disturbance")
        place = {"transform": panels[0].transAxes, "ha": "center", "wrap": True}
        panels[0].text(0.5, 0.5, str(error), **place)
        return
    unsure = [
        f"no 95 % band: {one.name} is {one.verdict}"
        for one in identification.assessment.parameters
        if one.verdict is not Verdict.IDENTIFIABLE
    ]
    band = None if unsure else smoothed.disturbance_half_width
    unit = recorded_port(record.log, estimate).measures[0]
    delta = Curve("delta", unit, smoothed.t, smoothed.disturbance, band=band)
    truth = truth_curves(record.log, estimate)
    errors = []
    if truth:
        true = truth[0].values
        if len(truth[0].times):
            true = np.interp(delta.times, truth[0].times, true)
        errors.append(replace(delta, name="error of delta", values=delta.values - true))
    beside = draw_pair(panels, [delta], truth, errors)
    _set_titles(panels, "estimated disturbance", beside, errors, "".join(unsure[:1]))


def _draw_theta(panels: Sequence[Any], record: IdentifierRecord) -> None:
    """Draw theta as it was estimated during the run, with its recorded interval."""
    estimate = f"{record.identifier}.theta"
    curves = estimate_curves(record.log, estimate)
    truth = truth_curves(record.log, estimate)
    errors = error_curves(record.log, estimate)
    beside = draw_pair(panels, curves, truth, errors)
    _set_titles(panels, "theta during the run", beside, errors)
    if truth:
        limit_to_settled(panels[0], curves, truth)
    limit_to_settled(panels[1], beside)


def _set_titles(
    panels: Sequence[Any],
    title: str,
    beside: Sequence[Curve],
    errors: Sequence[Curve],
    missing: str = "",
) -> None:
    """Say what is drawn, with its errors or half widths beside it; or why bands are missing."""
    has_band = any(one.band is not None for one in errors)
    words = missing
    if errors:
        title += "; gray: truth"
        words = "its error" + (f"; {missing}" if missing else ", and 95 % band" if has_band else "")
    elif beside:
        words = "half width of its 95 % band"
    _set_title(panels[0], f"{title}\n{missing}" if missing else title)
    _set_title(panels[1], words)
