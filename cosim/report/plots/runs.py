"""Pictures of recorded runs: signals, estimates beside their truth, and what differs.

Each element of a signal is a curve, with name, unit and band; a panel shows some of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.arrays import Vector, is_absent
from cosim.core.port import Port, named_ports
from cosim.core.recorded.selection import split_names
from cosim.core.recording import Recording
from cosim.errors import UsageError
from cosim.log.between import held_elements, values_at
from cosim.log.difference import LogDifference
from cosim.report.plots.picture import (
    COLORS,
    DASHES,
    LARGEST_DRAWN,
    STANDARD,
    Picture,
    PictureOptions,
    Style,
    distinguish_lines,
    need_plot,
    show_legend,
    shown_text,
)
from cosim.report.recorded_rows import (
    beside_truth,
    has_signal,
    recorded_port,
    rows_of,
)
from cosim.scenario.record import run_metadata, truth_of
from cosim.theory.quantiles import CONFIDENCE, normal_two_sided
from cosim.units import Unit, conversion

if TYPE_CHECKING:
    from cosim.report.comparing import Comparison, EstimatorComparison

MOST_OUTPUTS: Final = 12  # of a run without truth that a picture shows
FAR_BEYOND: Final = 10.0  # times how far most curves of a panel reach: it is not for these
_LIMIT: Final[Style] = {"color": "0.4", "linewidth": 0.9}
_WIDEST, _THINNEST = 2.6, 1.0  # lines of the first and the last of several runs [points]
TRUTH: Final[Style] = {"color": "0.75", "linewidth": 3.0}
ZERO: Final[Style] = {"color": "0.75", "linewidth": 1.0}
SCIENTIFIC: Final = (-2, 3)  # powers of ten of numbers written in full, of errors
_FAINT: Final = 0.2  # opacity of a band


# --- curves ---


@dataclass(frozen=True, slots=True)
class Curve:
    """One element of a signal over time.

    Parameters
    ----------
    name : str
    unit : Unit
    times : Vector, shape (N,)
        [s].
    values : Vector, shape (N,)
    held : bool
        Whether it has a zero-order hold between its rows; else it is interpolated linearly.
    run : str
        What tells its run from others, behind its name.
    band : Vector, shape (N,), or None
        Half width of the band around it.
    """

    name: str
    unit: Unit
    times: Vector
    values: Vector
    held: bool = False
    run: str = ""
    band: Vector | None = None

    @property
    def edges(self) -> tuple[Vector, Vector]:
        """Both edges of its band; itself where it has none."""
        band = 0.0 if self.band is None else self.band
        return self.values - band, self.values + band

    def draw(self, panel: Any, **style: Any) -> None:
        """Draw the curve as it is between two rows, and its band.

        Raises
        ------
        UsageError
            If a value is too large for an axis.
        """
        finite = self.values[np.isfinite(self.values)]
        largest = float(np.abs(finite).max(initial=0.0))
        if largest > LARGEST_DRAWN:
            raise UsageError(
                f"{self.name}{self.run}: {largest:g} is too large to be drawn; expected at most "
                f"{LARGEST_DRAWN:g}"
            )
        drawstyle = "steps-post" if self.held else "default"
        (line,) = panel.plot(self.times, self.values, drawstyle=drawstyle, **style)
        if self.band is not None:
            edges = np.clip(self.edges, -LARGEST_DRAWN, LARGEST_DRAWN)
            step = "post" if self.held else None
            look = {"color": line.get_color(), "alpha": _FAINT, "linewidth": 0.0}
            panel.fill_between(self.times, *edges, step=step, **look)

    def within(self, options: PictureOptions) -> Curve:
        """Return the part that a picture shows, with the rows next to it.

        Raises
        ------
        UsageError
            If it begins after the last time shown, or ends before the first.
        """
        start, stop = options.window
        if len(self.times) and (start > self.times[-1] or stop < self.times[0]):
            raise UsageError(
                "start, stop: no rows in this interval; expected a part of "
                f"{self.times[0]:g} s to {self.times[-1]:g} s"
            )
        first = int(np.searchsorted(self.times, start, side="right")) - 1
        shown = slice(max(0, first), int(np.searchsorted(self.times, stop, side="left")) + 1)
        band = None if self.band is None else self.band[shown]
        return replace(self, times=self.times[shown], values=self.values[shown], band=band)

    def in_unit_of(self, other: Curve) -> Curve:
        """Return the curve in the unit of another.

        Raises
        ------
        UsageError
            If the units are of different kinds.
        """
        convert = conversion(self.unit, other.unit)
        if convert is None:
            raise UsageError(
                f"{other.name}{other.run} in {other.unit.name!r} and {self.name}{self.run} in "
                f"{self.unit.name!r} cannot share an axis; give each a panel of its own"
            )
        if convert.copies:
            return self
        values = convert(self.values)
        band = None if self.band is None else convert(self.edges[1]) - values
        return replace(self, unit=other.unit, values=values, band=band)


def curves_of(recording: Recording, port: str, *, run: str = "") -> list[Curve]:
    """Return a curve for each element of a port.

    Raises
    ------
    LogError
        If there is no such component, signal or element.
    """
    elements = zip(_empty_curves(recording, port), rows_of(recording, port).T, strict=True)
    times = recording.time_ns(port) / 1e9
    curves = []
    for curve, values in elements:
        there = ~is_absent(values)
        curves.append(replace(curve, times=times[there], values=values[there], run=run))
    return curves


def _empty_curves(recording: Recording, port: str) -> list[Curve]:
    """Return the curves of a port without its rows, which are not read for that."""
    found = recorded_port(recording, port)
    names = Port.parse(port).element_names(found.size)
    held = found.signal.variability == "discrete"
    elements = zip(names, found.measures, strict=True)
    return [Curve(name, unit, np.empty(0), np.empty(0), held) for name, unit in elements]


def estimate_curves(recording: Recording, estimate: str) -> list[Curve]:
    """Return the elements of an estimate; of theta with the band of its 95 % interval.

    Where its component records no ``standard_error`` there is no band.
    """
    curves = curves_of(recording, estimate)
    component, _, signal = estimate.rpartition(".")
    error = f"{component}.standard_error"
    if signal != "theta" or not has_signal(recording, error):
        return curves
    quantile = normal_two_sided(CONFIDENCE)
    errors = curves_of(recording, error)
    if len(errors) != len(curves):  # of a component of a user
        return curves
    pairs = zip(curves, errors, strict=True)
    return [replace(curve, band=quantile * one.values) for curve, one in pairs]


def truth_curves(recording: Recording, estimate: str) -> list[Curve]:
    """Return the true signals of an estimate, or values without times; none: they are not known."""
    true = truth_of(recording).get(estimate)
    if true is None:
        return []
    own = _empty_curves(recording, estimate)
    ports = named_ports(true)
    if ports:
        signals = chain.from_iterable(curves_of(recording, port) for port in ports)
        return [one.in_unit_of(like) for one, like in zip(signals, own, strict=True)]
    values = np.atleast_1d(np.array(true, np.float64))
    return [replace(one, values=value[np.newaxis]) for one, value in zip(own, values, strict=True)]


def error_curves(recording: Recording, estimate: str) -> list[Curve]:
    """Return estimate minus truth, at the instants that they share, with the band of the estimate.

    An estimate that lags is compared with the truth that much earlier. None: there is no truth.
    """
    true = truth_of(recording).get(estimate)
    if true is None:
        return []
    curves = estimate_curves(recording, estimate)
    all_times = times = curves[0].times
    ports = named_ports(true)
    if ports:
        time_ns, rows, true = beside_truth(recording, estimate, ports)
        times = time_ns / 1e9
    else:
        rows = np.stack([curve.values for curve in curves], axis=1)
    errors = []
    for curve, values in zip(curves, (rows - np.array(true, np.float64)).T, strict=True):
        band = curve.band if len(times) == len(all_times) else None
        name = f"error of {curve.name}"
        errors.append(replace(curve, name=name, times=times, values=values, band=band))
    return errors


# --- what a panel shows ---


def draw_curves(panel: Any, curves: Sequence[Curve], runs: Sequence[str] = ()) -> None:
    """Draw curves into a panel, with their names and units.

    All are shown in the unit of the first; where elements of one signal cannot be, each in its own.
    The axis has the name of the signal, or of the element, that all are of. Of several runs each
    has its color, and their signals have the same dashes.

    Parameters
    ----------
    panel : Axes of matplotlib
    curves : sequence of Curve
    runs : sequence of str
        All runs of the picture, which has a legend of them; by default those of the curves.

    Raises
    ------
    UsageError
        If the units of several signals are of different kinds.
    """
    first = curves[0]
    names = list(dict.fromkeys(curve.name for curve in curves))
    signals = {name.partition("[")[0] for name in names}
    dashes = dict(zip(names, cycle(DASHES), strict=False))
    known = runs or list(dict.fromkeys(curve.run for curve in curves))
    has_own_units = False
    if len(signals) == len(known) == 1:
        has_own_units = any(conversion(curve.unit, first.unit) is None for curve in curves)
    distinguish_lines(panel)
    for curve in curves:
        shown = curve if has_own_units else curve.in_unit_of(first)
        unit = _bracketed(curve.unit) if has_own_units else ""
        style: dict[str, Any] = {}
        if len(known) > 1:
            style |= run_style(known.index(curve.run), len(known))
            style["linestyle"] = dashes[curve.name]
        if not runs:
            style["label"] = f"{shown_text(f'{curve.name}{curve.run}')} {unit}".rstrip()
        shown.draw(panel, **style)
    common = min(names if len(names) == 1 else signals) if len(signals) == 1 else ""
    unit = "" if has_own_units else _bracketed(first.unit)
    panel.set_ylabel(f"{shown_text(common)} {unit}".strip())
    for name in names if runs else ():
        panel.plot([], [], color="0.3", linestyle=dashes[name], label=shown_text(name))
    if len(names if runs else curves) > 1:
        show_legend(panel)


def run_style(number: int, count: int) -> Style:
    """Return color and width of one of several runs: equal curves of later ones are thinner."""
    width = float(np.linspace(_WIDEST, _THINNEST, count)[number])
    return {"color": COLORS[number % len(COLORS)], "linewidth": width}


def _bracketed(unit: Unit) -> str:
    return "" if unit.name is None else f"[{shown_text(unit.name)}]"


def draw_truth(panel: Any, truth: Sequence[Curve]) -> None:
    """Draw true signals in gray, and true values as lines all the time."""
    for one in truth:
        if len(one.times):
            one.draw(panel, **TRUTH)
        else:
            panel.axhline(one.values[0], **TRUTH)


def draw_pair(
    panels: Sequence[Any], curves: Sequence[Curve], truth: Sequence[Curve], errors: Sequence[Curve]
) -> Sequence[Curve]:
    """Draw an estimate over its truth in gray, and beside it what is returned.

    These are its errors; where they are not known, the half widths of its bands, if it has any.
    """
    left, right = panels
    draw_truth(left, truth)
    draw_curves(left, curves)
    beside = errors or [
        replace(one, name=f"95 % of {one.name}", values=one.band, band=None)
        for one in curves
        if one.band is not None
    ]
    if beside:
        draw_curves(right, beside)
        right.ticklabel_format(axis="y", scilimits=SCIENTIFIC)
    if errors:
        right.axhline(0.0, **ZERO)
    return beside


def draw_estimate(
    panels: Sequence[Any], recording: Recording, estimate: str, options: PictureOptions = STANDARD
) -> bool:
    """Draw a recorded estimate as :func:`draw_pair` does; return whether there is a truth.

    The panels are limited to what they show after transients.
    """
    curves, truth, errors = (
        [one.within(options) for one in whole(recording, estimate)]
        for whole in (estimate_curves, truth_curves, error_curves)
    )
    beside = draw_pair(panels, curves, truth, errors)
    if truth:
        limit_to_settled(panels[0], curves, truth)
    limit_to_settled(panels[1], beside)
    return bool(truth)


def limit_to_settled(panel: Any, curves: Sequence[Curve], truth: Sequence[Curve] = ()) -> None:
    """Limit a panel to the truth and the second half of curves: transients would hide these."""
    parts = [np.zeros(0), *(one.values for one in truth)]
    for curve in curves:
        parts += map(_second_half, (curve.values, *curve.edges))
    values = np.concatenate(parts)
    finite = values[np.isfinite(values)]
    if len(finite):
        margin = 0.15 * float(np.ptp(finite)) or 1.0
        panel.set_ylim(finite.min() - margin, finite.max() + margin)


def _second_half(values: Vector) -> Vector:
    """Return the second half of the values of a curve."""
    return values[len(values) // 2 :]


# --- pictures ---


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
    picture = Picture(len(signals), options)
    for panel, entry in zip(picture.panels, signals, strict=True):
        curves = [
            curve.within(options)
            for run, label in zip(runs, labels, strict=True)
            for port in split_names(entry)
            for curve in curves_of(run, port, run=label)
        ]
        draw_curves(panel, curves)
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
        names = []
        for component, channel in recording.channels.items():
            outputs = channel.interface.outputs
            shown = [signal for signal in outputs if signal.role != "state"] or outputs
            names += [f"{component}.{signal.name}" for signal in shown]
        if not names:
            raise UsageError(
                "the run has no outputs to show; name signals: cosim plot LOG SIGNAL..."
            )
        if len(names) > MOST_OUTPUTS:
            title = f"{title}: the first {MOST_OUTPUTS} of {len(names)} outputs"
        titled = options if options.title is not None else replace(options, title=title)
        plot_signals(recording, names[:MOST_OUTPUTS], out, titled)
        return
    picture = Picture(2 * len(estimates), options, columns=2)
    panels = picture.panels
    for left, right, estimate in zip(panels[::2], panels[1::2], estimates, strict=True):
        draw_estimate((left, right), recording, estimate, options)
    panels[0].set_title("estimates (lines) and truth (gray)", fontsize="medium")
    panels[1].set_title("errors", fontsize="medium")
    picture.save(out, title=title)


def plot_difference(comparison: LogDifference, runs: Sequence[Recording], out: Path) -> None:
    """Draw the worst signal of a comparison: the element in which both are farthest apart.

    Above both curves, below ``b - a`` at the instants that they share, or at those of a where b was
    interpolated, with the tolerance where there is one, and a line at the first time outside it.

    Raises
    ------
    UsageError
        If there is no matplotlib, the format of ``out`` is unknown, or a value is too large for an
        axis.
    """
    need_plot(out)
    worst = comparison.worst
    assert worst is not None
    names = (worst.signal, comparison.map.get(worst.signal, worst.signal))
    labels = _short_labels(runs)
    own, other = (
        curves_of(*each[:2], run=each[2]) for each in zip(runs, names, labels, strict=True)
    )
    pairs = [(one, two.in_unit_of(one)) for one, two in zip(own, other, strict=True)]
    if comparison.tube is not None:
        held = [
            held_elements(run, recorded_port(run, name))
            for run, name in zip(runs, names, strict=True)
        ]
        pairs = [
            (replace(one, held=of_one), replace(two, held=of_two))
            for (one, two), of_one, of_two in zip(pairs, *held, strict=True)
        ]
    with np.errstate(invalid="ignore"):  # infinity minus itself
        curves = [_apart(*pair, interpolated=comparison.tube is not None) for pair in pairs]
    largest = [np.nan_to_num(np.abs(one.values), nan=0.0).max(initial=0.0) for one in curves]
    number = int(np.argmax(largest))
    if worst.first is not None and not np.isfinite(worst.largest):  # where only one is a number
        number = [curve.name for curve in curves].index(worst.first.signal)
    apart = curves[number]
    picture = Picture(2, STANDARD)
    above, below = picture.panels
    draw_curves(above, pairs[number])
    draw_curves(below, [replace(apart, name="b - a", run="")])
    if worst.tolerance > 0.0:
        below.axhline(worst.tolerance, label="tolerance", linestyle="--", **_LIMIT)
        below.axhline(-worst.tolerance, linestyle="--", **_LIMIT)
    if worst.first is not None:
        time = worst.first.time_ns / 1e9
        below.axvline(time, label="first outside", linestyle=":", **_LIMIT)
    show_legend(below)
    picture.save(out, title=f"{apart.name}: largest |a - b| = {worst.largest:.3g}")


def _apart(first: Curve, other: Curve, *, interpolated: bool) -> Curve:
    """Return ``other - first`` at the instants of both, or of the first within the other."""
    if not interpolated:
        times, own, known = np.intersect1d(first.times, other.times, return_indices=True)
        return replace(first, times=times, values=other.values[known] - first.values[own])
    has_value = ~np.isnan(other.values)
    at, values = other.times[has_value], other.values[has_value]
    own = np.flatnonzero(
        (first.times >= at.min(initial=np.inf)) & (first.times <= at.max(initial=-np.inf))
    )
    times = first.times[own]
    if len(times):
        values = values_at(times, at, values, is_line=not (first.held or other.held))
    return replace(first, times=times, values=values[: len(times)] - first.values[own])


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
    runs = list(recordings)
    picture = Picture(2 * len(comparison.estimates), STANDARD, columns=2)
    panels = picture.panels
    rows = zip(panels[::2], panels[1::2], comparison.estimates.items(), strict=True)
    for left, right, (estimate, true) in rows:
        with_it = [run for run in runs if has_signal(recordings[run], estimate)]
        for run in with_it:
            if truth_of(recordings[run]).get(estimate) == true:
                truth = truth_curves(recordings[run], estimate)
                draw_truth(left, truth)
                limit_to_settled(left, curves_of(recordings[run], estimate), truth)
                break
        estimates: list[Curve] = []
        apart: list[Curve] = []
        for run in with_it:
            estimates += curves_of(recordings[run], estimate, run=run)
            if runs[0] in with_it and run != runs[0]:
                first = curves_of(recordings[runs[0]], estimate)
                for one, two in zip(first, curves_of(recordings[run], estimate), strict=True):
                    apart.append(replace(_apart(one, two, interpolated=False), run=run))
        for panel, drawn in ((left, estimates), (right, apart)):
            if drawn:
                draw_curves(panel, drawn, runs)
        limit_to_settled(right, _near_most(apart))
        right.ticklabel_format(axis="y", scilimits=SCIENTIFIC)
    panels[0].set_title("estimates", fontsize="medium")
    panels[1].set_title(f"difference to {runs[0]}", fontsize="medium")
    styles = {run: run_style(number, len(runs)) for number, run in enumerate(runs)}
    named = {**styles, "truth": TRUTH}
    picture.legend([panels[0].plot([], [], label=run, **named[run])[0] for run in named])
    picture.save(out)


def _near_most(curves: Sequence[Curve]) -> list[Curve]:
    """Return the curves without those whose second half is far beyond that of most others.

    A method that fails would hide all the others; it leaves the panel, and the left one shows it.
    """
    halves = [np.abs(_second_half(curve.values)) for curve in curves]
    reaches = [float(half[np.isfinite(half)].max(initial=0.0)) for half in halves]
    shown = [reach for reach in reaches if reach > 0.0]
    farthest = FAR_BEYOND * float(np.median(shown)) if shown else 0.0
    return [curve for curve, reach in zip(curves, reaches, strict=True) if reach <= farthest]


def _short_labels(recordings: Sequence[Recording]) -> list[str]:
    """Return what tells recordings apart behind the name of a signal; nothing for a single one."""
    if len(recordings) == 1:
        return [""]
    paths = [Path(recording.label) for recording in recordings]
    stems = [path.stem for path in paths]
    return [f" ({path.stem if stems.count(path.stem) == 1 else path})" for path in paths]
