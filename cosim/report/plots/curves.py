"""Curves of recorded signals, with names, units and bands, and how a panel shows them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.port import Port
from cosim.core.recording import Recording
from cosim.errors import UsageError
from cosim.report.plots.picture import (
    LARGEST_DRAWN,
    PictureOptions,
    Style,
    color_styles,
    show_legend,
    shown_text,
)
from cosim.report.recorded_rows import (
    beside_truth,
    difference,
    has_signal,
    recorded_port,
    rows_of,
    stacked_units,
)
from cosim.scenario.document.schema import truth_ports
from cosim.scenario.record import truth_of
from cosim.theory.quantiles import CONFIDENCE, normal_two_sided
from cosim.units import Unit, conversion

TRUTH: Final[Style] = {"color": "0.75", "linewidth": 3.0}
ZERO: Final[Style] = {"color": "0.75", "linewidth": 1.0}
SCIENTIFIC: Final = (-2, 3)  # powers of ten of numbers written in full, of errors
_FAINT: Final = 0.2  # opacity of a band


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

    def draw(self, panel: Any, style: Style, *, label: str | None = None) -> None:
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
        panel.plot(self.times, self.values, drawstyle=drawstyle, label=label, **style)
        if self.band is not None:
            edges = np.clip(self.edges, -LARGEST_DRAWN, LARGEST_DRAWN)
            step = "post" if self.held else None
            look = {"color": style["color"], "alpha": _FAINT, "linewidth": 0.0}
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


def curves_of(
    recording: Recording, port: str, *, like: Sequence[Unit] | None = None, run: str = ""
) -> list[Curve]:
    """Return a curve for each element of a port; in the units ``like``, if given.

    Raises
    ------
    LogError
        If there is no such component, signal or element.
    """
    found = recorded_port(recording, port)
    rows = rows_of(recording, port, like=like)
    times = recording.time_ns(found.channel.name) / 1e9
    names = Port.parse(port).element_names(found.size)
    held = found.signal.variability == "discrete"
    elements = zip(names, like or found.measures, rows.T, strict=True)
    return [Curve(name, unit, times, values, held, run) for name, unit, values in elements]


def difference_curves(first: Recording, other: Recording, port: str) -> list[Curve]:
    """Return ``other - first`` of each element of a port, at the instants that they share."""
    times, values = difference(first, other, port)
    pairs = zip(curves_of(first, port), values.T, strict=True)
    return [replace(curve, times=times, values=column) for curve, column in pairs]


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
    """Return the true signals of an estimate, or its true values all the time; none: not known."""
    true = truth_of(recording).get(estimate)
    if true is None:
        return []
    ports = truth_ports(true)
    if ports:
        units = stacked_units(recording, ports, estimate)
        pairs = zip(ports, units, strict=True)
        return [one for port, like in pairs for one in curves_of(recording, port, like=like)]
    values = np.atleast_1d(np.array(true, np.float64))
    elements = zip(curves_of(recording, estimate), values, strict=True)
    return [replace(one, values=np.full(len(one.times), value)) for one, value in elements]


def error_curves(recording: Recording, estimate: str) -> list[Curve]:
    """Return estimate minus truth, at the instants that they share, with the band of the estimate.

    An estimate that lags is compared with the truth that much earlier. None: there is no truth.
    """
    true = truth_of(recording).get(estimate)
    if true is None:
        return []
    curves = estimate_curves(recording, estimate)
    times = curves[0].times
    rows = rows_of(recording, estimate)
    ports = truth_ports(true)
    if ports:
        time_ns, rows, true = beside_truth(recording, estimate, ports)
        times = time_ns / 1e9
    has_all = len(times) == len(curves[0].times)
    return [
        replace(
            curve,
            name=f"error of {curve.name}",
            times=times,
            values=values,
            band=curve.band if has_all else None,
        )
        for curve, values in zip(curves, (rows - np.array(true, np.float64)).T, strict=True)
    ]


# --- what a panel shows ---


def draw_curves(panel: Any, curves: Sequence[Curve], styles: Sequence[Style] | None = None) -> None:
    """Draw curves into a panel, with their names and units; by default in the standard styles.

    All are shown in the unit of the first; where elements of one signal cannot be, each in its own.
    The axis has the name of the signal, or of the element, that all are of.

    Raises
    ------
    UsageError
        If the units of several signals are of different kinds.
    """
    first = curves[0]
    names = {curve.name for curve in curves}
    signals = {name.partition("[")[0] for name in names}
    has_own_units = False
    if len(signals) == 1 and len({curve.run for curve in curves}) == 1:
        has_own_units = any(conversion(curve.unit, first.unit) is None for curve in curves)
    for curve, style in zip(curves, styles or color_styles(len(curves)), strict=True):
        shown = curve if has_own_units else curve.in_unit_of(first)
        unit = _bracketed(curve.unit) if has_own_units else ""
        shown.draw(panel, style, label=f"{shown_text(f'{curve.name}{curve.run}')} {unit}".rstrip())
    common = ""
    if len(signals) == 1:
        common = first.name if len(names) == 1 else first.name.partition("[")[0]
    unit = "" if has_own_units else _bracketed(first.unit)
    panel.set_ylabel(f"{shown_text(common)} {unit}".strip())
    if len(curves) > 1:
        show_legend(panel)


def _bracketed(unit: Unit) -> str:
    return "" if unit.name is None else f"[{shown_text(unit.name)}]"


def draw_pair(
    panels: Sequence[Any], curves: Sequence[Curve], truth: Sequence[Curve], errors: Sequence[Curve]
) -> Sequence[Curve]:
    """Draw an estimate over its truth in gray, and beside it what is returned.

    These are its errors; where they are not known, the half widths of its bands, if it has any.
    """
    left, right = panels
    for one in truth:
        one.draw(left, TRUTH)
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


def limit_to_settled(panel: Any, curves: Sequence[Curve], truth: Sequence[Curve] = ()) -> None:
    """Limit a panel to the truth and the second half of curves: transients would hide these."""
    parts = [np.zeros(0), *(one.values for one in truth)]
    for curve in curves:
        parts += map(second_half, (curve.values, *curve.edges))
    values = np.concatenate(parts)
    finite = values[np.isfinite(values)]
    if len(finite):
        margin = 0.15 * float(np.ptp(finite)) or 1.0
        panel.set_ylim(finite.min() - margin, finite.max() + margin)


def second_half(values: Vector) -> Vector:
    """Return the second half of the values of a curve."""
    return values[len(values) // 2 :]
