"""Pictures of recorded runs: signals, estimates beside their truth, and what differs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.port import named_ports
from cosim.core.recorded.selection import split_names
from cosim.core.recording import Recording
from cosim.errors import UsageError
from cosim.log.comparison.difference import LogDifference, SignalDifference
from cosim.report.plots.curves import (
    COLORS,
    DASHES,
    TRUTH,
    WIDTH,
    Curve,
    Style,
    color_styles,
    curves_of,
    draw_curves,
    show_legend,
)
from cosim.report.plots.picture import Picture, PictureOptions, need_plot
from cosim.report.recorded_rows import (
    beside_truth,
    difference,
    element_names,
    has_signal,
    rows_of,
    signal_of,
    stacked_units,
    time_ns_of,
    units_of,
)
from cosim.scenario.record import run_metadata, truth_of
from cosim.theory.quantiles import CONFIDENCE, normal_two_sided
from cosim.units import units_text, with_unit

if TYPE_CHECKING:
    from cosim.report.comparing import Comparison, EstimatorComparison

MOST_OUTPUTS: Final = 12  # of a run without truth that a picture shows
FAR_BEYOND: Final = 10.0  # times how far most curves of a panel reach: it is not for these
ZERO: Final[Style] = {"color": "0.75", "linewidth": 1.0}
_LIMIT: Final[Style] = {"color": "0.4", "linewidth": 0.9}
_PAIR: Final[tuple[Style, Style]] = (
    {"color": COLORS[0], "linewidth": 2.0 * WIDTH},
    {"color": COLORS[1], "linewidth": WIDTH},
)  # the wider one stays visible under the other
SCIENTIFIC: Final = (-2, 3)  # powers of ten of numbers written in full, of errors
_STANDARD: Final = PictureOptions()


def plot_signals(
    recordings: Recording | Sequence[Recording],
    signals: Sequence[str],
    out: Path,
    options: PictureOptions = _STANDARD,
) -> None:
    """Draw signals over time, one panel for each entry of ``signals``.

    Parameters
    ----------
    recordings : Recording, or sequence of them
        Several are drawn into the same panels.
    signals : sequence of str
        ``component.signal``, ``component.signal[1]`` or ``component.signal[0:2]``; several of them,
        with commas between, share a panel.
    out : Path
    options : PictureOptions

    Raises
    ------
    UsageError
        If there is no matplotlib, the format of ``out`` is unknown, no signal is named, one has
        values too large for an axis, or units of different kinds share a panel.
    LogError
        If a signal is unknown.
    """
    need_plot(out)
    if not signals or not all(isinstance(signal, str) for signal in signals):
        raise UsageError(f"expected names of signals, such as 'plant.y', got {signals!r}")
    runs = list(recordings) if isinstance(recordings, Sequence) else [recordings]
    labels = _short_labels(runs)
    lines: list[Style] = [{}]  # of each run, so that equal ones stay visible
    if len(runs) > 1:
        widths = np.linspace(2.4, 1.0, len(runs))
        lines = [{"linestyle": one, "linewidth": w} for one, w in zip(cycle(DASHES), widths)]
    picture = Picture(len(signals), options)
    for panel, entry in zip(picture.panels, signals, strict=True):
        curves: list[Curve] = []
        styles: list[Style] = []
        for run, label, line in zip(runs, labels, lines, strict=True):
            for port in split_names(entry):
                curves += curves_of(run, port, options, run=label)
            styles += [line] * (len(curves) - len(styles))
        colored = zip(color_styles(len(curves)), styles, strict=True)
        draw_curves(panel, curves, [{**color, **line} for color, line in colored])
    picture.save(out)


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
    title = run_metadata(recording).get("scenario", "")
    estimates = list(truth_of(recording))
    if not estimates:
        _plot_outputs(recording, out, options, title)
        return
    picture = Picture(2 * len(estimates), options, columns=2)
    panels = picture.panels
    for left, right, estimate in zip(panels[::2], panels[1::2], estimates, strict=True):
        curves = estimate_curves(recording, estimate, options)
        truth = draw_truth(left, recording, estimate, options)
        draw_curves(left, curves)
        limit_to_settled(left, curves, truth)
        errors = error_curves(recording, estimate, options)
        draw_curves(right, errors)
        limit_to_settled(right, errors)
        right.ticklabel_format(axis="y", scilimits=SCIENTIFIC)
        right.axhline(0.0, **ZERO)
    panels[0].set_title("estimates (lines) and truth (gray)", fontsize="medium")
    panels[1].set_title("errors", fontsize="medium")
    picture.save(out, title=title)


def _plot_outputs(recording: Recording, out: Path, options: PictureOptions, title: str) -> None:
    names = []
    for component, channel in recording.channels.items():
        outputs = channel.interface.outputs
        shown = [signal for signal in outputs if signal.role != "state"] or outputs
        names += [f"{component}.{signal.name}" for signal in shown]
    if not names:
        raise UsageError("the run has no outputs to show; name signals: cosim plot LOG SIGNAL...")
    if len(names) > MOST_OUTPUTS:
        title = f"{title}: the first {MOST_OUTPUTS} of {len(names)} outputs"
    picture = Picture(min(len(names), MOST_OUTPUTS), options)
    for panel, name in zip(picture.panels, names, strict=False):
        draw_curves(panel, curves_of(recording, name, options))
    picture.save(out, title=title)


def plot_difference(
    comparison: LogDifference,
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
    worst = comparison.worst
    assert worst is not None
    apart = _apart(worst, runs)
    picture = Picture(2, options)
    above, below = picture.panels
    curves = []
    for run, label in zip(runs, _short_labels(runs), strict=True):
        curves += curves_of(run, apart.name, options, run=label)
    draw_curves(above, curves, _PAIR)
    draw_curves(below, [replace(apart, name="b - a")], [{"color": COLORS[2]}])
    if worst.tolerance > 0.0:
        below.axhline(worst.tolerance, label="tolerance", linestyle="--", **_LIMIT)
        below.axhline(-worst.tolerance, linestyle="--", **_LIMIT)
    if worst.first is not None:
        time = worst.first.time_ns / 1e9
        below.axvline(time, label="first outside", linestyle=":", **_LIMIT)
    show_legend(below)
    picture.save(out, title=f"{apart.name}: largest |a - b| = {worst.largest:.3g}")


def _apart(worst: SignalDifference, runs: Sequence[Recording]) -> Curve:
    """Return the difference of the element of a signal in which two runs are farthest apart."""
    with np.errstate(invalid="ignore"):  # infinity minus itself
        curves = _difference_curves(runs[0], runs[1], worst.signal)
    if np.isfinite(worst.largest) or worst.first is None:
        reaches = [np.nan_to_num(np.abs(curve.values), nan=0.0).max() for curve in curves]
        return curves[int(np.argmax(reaches))]
    names = [curve.name for curve in curves]
    return curves[names.index(worst.first.signal)]  # where only one of both is a number


def _difference_curves(first: Recording, other: Recording, port: str) -> list[Curve]:
    times, values = difference(first, other, port)
    names = element_names(port, values.shape[1])
    held = signal_of(first, port).variability == "discrete"
    curves = []
    for name, unit, column in zip(names, units_of(first, port), values.T, strict=True):
        curves.append(Curve(name, unit, times, column, held))
    return curves


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
    styles: dict[str, Style] = {}
    widths = np.linspace(2.8, 1.0, len(recordings))  # leave equal lines visible
    for run, color, width in zip(recordings, cycle(COLORS), widths):
        styles[run] = {"color": color, "linewidth": width}
    picture = Picture(2 * len(comparison.estimates), options, columns=2)
    panels = picture.panels
    rows = zip(panels[::2], panels[1::2], comparison.estimates.items(), strict=True)
    for left, right, (estimate, true) in rows:
        runs = {run: one for run, one in recordings.items() if has_signal(one, estimate)}
        for recording in runs.values():
            if truth_of(recording).get(estimate) == true:
                truth = draw_truth(left, recording, estimate, options)
                limit_to_settled(left, curves_of(recording, estimate, options), truth)
                break
        for run, recording in runs.items():
            _draw_elements(left, curves_of(recording, estimate, options), styles[run])
            left.set_ylabel(with_unit(estimate, units_text(units_of(recording, estimate)) or None))
        _draw_differences(right, recordings, estimate, styles, options)
    panels[0].set_title("estimates", fontsize="medium")
    panels[1].set_title(f"difference to {next(iter(recordings))}", fontsize="medium")
    named = {**styles, "truth": TRUTH}
    picture.legend([panels[0].plot([], [], label=run, **named[run])[0] for run in named])
    picture.save(out)


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
            whole = _difference_curves(first, recording, estimate)
            curves = [curve.within(options) for curve in whole]
            _draw_elements(panel, curves, styles[run])
            drawn += curves
    limit_to_settled(panel, near_most(drawn))
    panel.ticklabel_format(axis="y", scilimits=SCIENTIFIC)
    names = list(dict.fromkeys(curve.name for curve in drawn))
    if len(names) > 1:
        for name, dashes in zip(names, cycle(DASHES)):
            panel.plot([], [], color="0.3", linestyle=dashes, label=name)
        show_legend(panel)


def near_most(curves: Sequence[Curve]) -> list[Curve]:
    """Return the curves without those whose second half is far beyond that of most others.

    A method that fails would hide all the others; it leaves the panel, and the left one shows it.
    """
    halves = [np.abs(_second_half(curve.values)) for curve in curves]
    reaches = [float(half[np.isfinite(half)].max(initial=0.0)) for half in halves]
    shown = [reach for reach in reaches if reach > 0.0]
    farthest = FAR_BEYOND * float(np.median(shown)) if shown else 0.0
    return [curve for curve, reach in zip(curves, reaches, strict=True) if reach <= farthest]


def _draw_elements(panel: Any, curves: Sequence[Curve], style: Style) -> None:
    for curve, dashes in zip(curves, cycle(DASHES)):
        curve.draw(panel, {**style, "linestyle": dashes})


def _short_labels(recordings: Sequence[Recording]) -> list[str]:
    """Return what tells recordings apart behind the name of a signal; nothing for a single one."""
    if len(recordings) == 1:
        return [""]
    paths = [Path(recording.label) for recording in recordings]
    stems = [path.stem for path in paths]
    return [f" ({path.stem if stems.count(path.stem) == 1 else path})" for path in paths]


# --- estimates, which other pictures show too ---


def estimate_curves(recording: Recording, estimate: str, options: PictureOptions) -> list[Curve]:
    """Return the elements of an estimate; of theta with the band of its 95 % interval.

    Where its component records no ``standard_error`` there is no band.
    """
    curves = curves_of(recording, estimate, options)
    component, _, signal = estimate.rpartition(".")
    error = f"{component}.standard_error"
    if signal != "theta" or not has_signal(recording, error):
        return curves
    quantile = normal_two_sided(CONFIDENCE)
    errors = curves_of(recording, error, options)
    if len(errors) != len(curves):  # of a component of a user
        return curves
    pairs = zip(curves, errors, strict=True)
    return [replace(curve, band=quantile * one.values) for curve, one in pairs]


def error_curves(recording: Recording, estimate: str, options: PictureOptions) -> list[Curve]:
    """Return estimate minus truth, at the instants that they share, with the band of the estimate.

    An estimate that lags is compared with the truth that much earlier.
    """
    true = truth_of(recording)[estimate]
    ports = named_ports(true)
    if ports:
        times, estimated, truth = beside_truth(recording, estimate, ports)
    else:
        times = time_ns_of(recording, estimate)
        estimated = rows_of(recording, estimate)
        truth = np.atleast_2d(np.array(true, np.float64))
    curves = []
    whole = estimate_curves(recording, estimate, PictureOptions())
    for curve, values in zip(whole, (estimated - truth).T, strict=True):
        band = curve.band if len(times) == len(curve.times) else None
        name = f"error of {curve.name}"
        error = replace(curve, name=name, times=times / 1e9, values=values, band=band)
        curves.append(error.within(options))
    return curves


def draw_truth(
    panel: Any, recording: Recording, estimate: str, options: PictureOptions
) -> list[Vector]:
    """Draw the true signals, or values, of an estimate in gray; return what is drawn."""
    true = truth_of(recording)[estimate]
    ports = named_ports(true)
    drawn: list[Vector] = []
    for port, units in zip(ports, stacked_units(recording, ports, estimate), strict=True):
        for curve in curves_of(recording, port, options, like=units):
            curve.draw(panel, TRUTH)
            drawn.append(curve.values)
    if not ports:
        drawn.append(np.atleast_1d(np.array(true, np.float64)))
        for value in drawn[0]:
            panel.axhline(value, **TRUTH)
    return drawn


def limit_to_settled(panel: Any, curves: Sequence[Curve], truth: Sequence[Vector] = ()) -> None:
    """Limit a panel to the truth and the second half of curves: transients would hide these."""
    parts = [np.zeros(0), *truth]
    for curve in curves:
        parts += map(_second_half, (curve.values, *curve.edges))
    values = np.concatenate(parts)
    finite = values[np.isfinite(values)]
    if len(finite):
        margin = 0.15 * float(np.ptp(finite)) or 1.0
        panel.set_ylim(finite.min() - margin, finite.max() + margin)


def _second_half(values: Vector) -> Vector:
    return values[len(values) // 2 :]
