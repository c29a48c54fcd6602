"""Pictures of recorded runs: signals, estimates beside their truth, and what differs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.core.recorded.selection import split_names
from cosim.core.recording import Recording
from cosim.errors import UsageError
from cosim.log.comparison.difference import LogDifference
from cosim.report.plots.curves import (
    SCIENTIFIC,
    TRUTH,
    Curve,
    curves_of,
    difference_curves,
    draw_curves,
    draw_pair,
    error_curves,
    estimate_curves,
    limit_to_settled,
    second_half,
    truth_curves,
)
from cosim.report.plots.picture import (
    COLORS,
    DASHES,
    STANDARD,
    WIDTH,
    Picture,
    PictureOptions,
    Style,
    color_styles,
    need_plot,
    show_legend,
)
from cosim.report.recorded_rows import has_signal, recorded_port
from cosim.scenario.record import run_metadata, truth_of
from cosim.units import units_text, with_unit

if TYPE_CHECKING:
    from cosim.report.comparing import Comparison, EstimatorComparison

MOST_OUTPUTS: Final = 12  # of a run without truth that a picture shows
FAR_BEYOND: Final = 10.0  # times how far most curves of a panel reach: it is not for these
_LIMIT: Final[Style] = {"color": "0.4", "linewidth": 0.9}
_PAIR: Final[tuple[Style, Style]] = (
    {"color": COLORS[0], "linewidth": 2.0 * WIDTH},
    {"color": COLORS[1], "linewidth": WIDTH},
)  # the wider one stays visible under the other


def plot_signals(
    recordings: Recording | Sequence[Recording],
    signals: Sequence[str],
    out: Path,
    options: PictureOptions = STANDARD,
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
                curves += [one.within(options) for one in curves_of(run, port, run=label)]
            styles += [line] * (len(curves) - len(styles))
        colored = zip(color_styles(len(curves)), styles, strict=True)
        draw_curves(panel, curves, [{**color, **line} for color, line in colored])
    picture.save(out)


def plot_run(recording: Recording, out: Path, options: PictureOptions = STANDARD) -> None:
    """Draw the standard picture of a run.

    A row for each estimate: on the left with its truth, on the right its error, both with the 95 %
    interval where the standard error is recorded. For a run without truth a panel for each output;
    states only of components that have no other.

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
        curves, truth, errors = (
            [one.within(options) for one in whole(recording, estimate)]
            for whole in (estimate_curves, truth_curves, error_curves)
        )
        draw_pair((left, right), curves, truth, errors)
        limit_to_settled(left, curves, truth)
        limit_to_settled(right, errors)
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
        draw_curves(panel, [one.within(options) for one in curves_of(recording, name)])
    picture.save(out, title=title)


def plot_difference(comparison: LogDifference, runs: Sequence[Recording], out: Path) -> None:
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
    with np.errstate(invalid="ignore"):  # infinity minus itself
        curves = difference_curves(runs[0], runs[1], worst.signal)
    apart = max(curves, key=lambda one: np.nan_to_num(np.abs(one.values), nan=0.0).max(initial=0.0))
    if worst.first is not None and not np.isfinite(worst.largest):  # where only one is a number
        apart = next(curve for curve in curves if curve.name == worst.first.signal)
    picture = Picture(2, STANDARD)
    above, below = picture.panels
    both: list[Curve] = []
    for run, label in zip(runs, _short_labels(runs), strict=True):
        both += curves_of(run, apart.name, run=label)
    draw_curves(above, both, _PAIR)
    draw_curves(below, [replace(apart, name="b - a")], [{"color": COLORS[2]}])
    if worst.tolerance > 0.0:
        below.axhline(worst.tolerance, label="tolerance", linestyle="--", **_LIMIT)
        below.axhline(-worst.tolerance, linestyle="--", **_LIMIT)
    if worst.first is not None:
        time = worst.first.time_ns / 1e9
        below.axvline(time, label="first outside", linestyle=":", **_LIMIT)
    show_legend(below)
    picture.save(out, title=f"{apart.name}: largest |a - b| = {worst.largest:.3g}")


def plot_comparison(comparison: Comparison | EstimatorComparison, out: Path) -> None:
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
    widths = np.linspace(2.8, 1.0, len(recordings))  # leave equal lines visible
    styles: dict[str, Style] = {
        run: {"color": color, "linewidth": width}
        for run, color, width in zip(recordings, cycle(COLORS), widths)
    }
    first = next(iter(recordings))
    picture = Picture(2 * len(comparison.estimates), STANDARD, columns=2)
    panels = picture.panels
    rows = zip(panels[::2], panels[1::2], comparison.estimates.items(), strict=True)
    for left, right, (estimate, true) in rows:
        runs = {run: one for run, one in recordings.items() if has_signal(one, estimate)}
        for recording in runs.values():
            if truth_of(recording).get(estimate) == true:
                truth = truth_curves(recording, estimate)
                for curve in truth:
                    curve.draw(left, TRUTH)
                limit_to_settled(left, curves_of(recording, estimate), truth)
                break
        drawn: list[Curve] = []
        for run, recording in runs.items():
            _draw_elements(left, curves_of(recording, estimate), styles[run])
            measures = recorded_port(recording, estimate).measures
            left.set_ylabel(with_unit(estimate, units_text(measures) or None))
            if first in runs and run != first:
                curves = difference_curves(recordings[first], recording, estimate)
                _draw_elements(right, curves, styles[run])
                drawn += curves
        limit_to_settled(right, near_most(drawn))
        right.ticklabel_format(axis="y", scilimits=SCIENTIFIC)
        names = list(dict.fromkeys(curve.name for curve in drawn))
        if len(names) > 1:
            for name, dashes in zip(names, cycle(DASHES)):
                right.plot([], [], color="0.3", linestyle=dashes, label=name)
            show_legend(right)
    panels[0].set_title("estimates", fontsize="medium")
    panels[1].set_title(f"difference to {first}", fontsize="medium")
    named = {**styles, "truth": TRUTH}
    picture.legend([panels[0].plot([], [], label=run, **named[run])[0] for run in named])
    picture.save(out)


def near_most(curves: Sequence[Curve]) -> list[Curve]:
    """Return the curves without those whose second half is far beyond that of most others.

    A method that fails would hide all the others; it leaves the panel, and the left one shows it.
    """
    halves = [np.abs(second_half(curve.values)) for curve in curves]
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
