"""Pictures of an identification from logs: residual and spectrum, disturbance, theta over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import AssumptionError
from cosim.report.plots.picture import STANDARD, Picture, Style, distinguish_lines, need_plot
from cosim.report.plots.runs import (
    SCIENTIFIC,
    Curve,
    draw_curves,
    draw_estimate,
    draw_pair,
    truth_curves,
)
from cosim.report.recorded_rows import element_names, recorded_port
from cosim.scenario.running.identifying import IdentifierRecord, LogIdentification
from cosim.theory.assessment.spectrum import whiteness_spectrum
from cosim.theory.disturbed_plant import counted_values
from cosim.theory.documents import Verdict

_THIN: Final = 0.5  # width of a line of noise [points]
_TITLE: Final[Style] = {"fontsize": "medium"}
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
        residual = identification.assessment.fitted.responses[index].residual
        _draw_residual(of_log[0], identification, record, residual)
        _draw_spectrum(of_log[1], identification, record, residual)
        _draw_disturbance(of_log[2:4], identification, index)
        has_truth = draw_estimate(of_log[4:], record.log, f"{record.identifier}.theta")
        _set_titles(of_log[4:], "theta during the run", has_truth=has_truth)
        t = record.data.t  # the axis of time that they would share, were they alone in the picture
        margin = 0.02 * float(t[-1] - t[0])
        for panel in (of_log[0], *of_log[2:]):
            panel.set(xlim=(t[0] - margin, t[-1] + margin), xlabel="t [s]")
        if len(records) > 1:
            of_log[0].set_title(f"{record.log.label}: residual", **_TITLE)
    picture.save(out, title="" if len(records) > 1 else records[0].log.label)


def _draw_residual(
    panel: Any, identification: LogIdentification, record: IdentifierRecord, residual: Matrix
) -> None:
    measured = f"{identification.identified.observer}.y"
    units = recorded_port(record.log, measured).measures
    columns = zip(element_names(measured, len(units)), units, residual.T, strict=True)
    curves = [
        Curve(f"residual of {name}", unit, record.data.t, column) for name, unit, column in columns
    ]
    draw_curves(panel, curves)
    for line in panel.lines:
        line.set_linewidth(_THIN)
    panel.ticklabel_format(axis="y", scilimits=SCIENTIFIC)
    panel.set_title("residual", **_TITLE)


def _draw_spectrum(
    panel: Any, identification: LogIdentification, record: IdentifierRecord, residual: Matrix
) -> None:
    data = record.data
    noise = identification.assessment.noise
    whitened = noise.whitened(residual[:, :, np.newaxis], data.numbers)[:, :, 0]
    counted = counted_values(data.numbers, noise.order)
    panel.set(xlabel="frequency [Hz]", ylabel="over white noise")
    distinguish_lines(panel)
    for values, rows in zip(whitened.T, counted.T, strict=True):
        t = data.t[rows]
        period = float(t[-1] - t[0]) / max(len(t) - 1, 1)
        try:
            spectrum = whiteness_spectrum(values[rows][:, np.newaxis], period)
        except AssumptionError:  # of a handful of samples
            continue
        frequency = spectrum.frequency
        panel.fill_between(frequency, spectrum.lower, spectrum.upper, color="0.88", linewidth=0.0)
        panel.plot(frequency, spectrum.power[:, 0], marker=".", markersize=4.0)
        panel.set_ylim(bottom=0.5 * float(spectrum.lower.min()))
    if not panel.lines:
        panel.set_title("its spectrum: too few samples", **_TITLE)
        return
    panel.set_title("its spectrum; gray: white noise, 95 %", **_TITLE)
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
        panels[0].set_title("estimated disturbance", **_TITLE)
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
    draw_pair(panels, [delta], truth, errors)
    _set_titles(panels, "estimated disturbance", has_truth=bool(truth), note="".join(unsure[:1]))


def _set_titles(panels: Sequence[Any], title: str, *, has_truth: bool, note: str = "") -> None:
    """Say what is drawn, and what is beside it, if anything; a note stands below."""
    beside = "half width of its 95 % band" if panels[1].lines else ""
    if has_truth:
        title += "; gray: truth"
        beside = f"its error{', and 95 % band' if panels[1].collections else ''}"
    panels[0].set_title(f"{title}\n{note}".rstrip(), **_TITLE)
    panels[1].set_title(beside, **_TITLE)
