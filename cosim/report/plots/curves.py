"""Curves of recorded signals, with names, units and bands, and how a panel shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, TypeAlias

import numpy as np

from cosim.arrays import Vector
from cosim.core.recording import Recording
from cosim.errors import UsageError
from cosim.report.plots.picture import PictureOptions
from cosim.report.printable import printable_line
from cosim.report.recorded_rows import element_names, rows_of, signal_of, time_ns_of, units_of
from cosim.units import Unit, conversion

Style: TypeAlias = Mapping[str, Any]

TRUTH: Final[Style] = {"color": "0.75", "linewidth": 3.0}
WIDTH: Final = 1.2  # of a line [points]
MOST_NAMES: Final = 24  # in the legend of a panel
_NAMES_IN_COLUMN: Final = 8  # of it, at the standard height of a panel
_FAINT: Final = 0.2  # opacity of a band
# Okabe and Ito, without yellow: the color-blind can distinguish them
COLORS: Final = ("#0072B2", "#D55E00", "#000000", "#009E73", "#E69F00", "#56B4E9", "#CC79A7")
DASHES: Final = ("-", (0, (6, 2)), (0, (2, 2)), (0, (7, 2, 1, 2)), (0, (1, 1)))
LARGEST_DRAWN: Final = 1e300  # an axis has margins: the difference of its ends must be a number


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
    def label(self) -> str:
        """Its name, with its run."""
        return f"{self.name}{self.run}"

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
                f"{self.label}: {largest:g} is too large to be drawn; expected at most "
                f"{LARGEST_DRAWN:g}"
            )
        drawstyle = "steps-post" if self.held else "default"
        panel.plot(self.times, self.values, drawstyle=drawstyle, label=label, **style)
        if self.band is not None:
            panel.fill_between(
                self.times,
                *np.clip(self.edges, -LARGEST_DRAWN, LARGEST_DRAWN),
                color=style["color"],
                alpha=_FAINT,
                linewidth=0.0,
                step="post" if self.held else None,
            )

    def within(self, options: PictureOptions) -> Curve:
        """Return the part that a picture shows, with the rows next to it."""
        start, stop = options.window
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
                f"{other.label} in {other.unit.name!r} and {self.label} in {self.unit.name!r} "
                "cannot share an axis; give each a panel of its own"
            )
        if convert.copies:
            return self
        values = convert(self.values)
        band = None if self.band is None else convert(self.edges[1]) - values
        return replace(self, unit=other.unit, values=values, band=band)


def curves_of(
    recording: Recording,
    port: str,
    options: PictureOptions,
    *,
    like: Sequence[Unit] | None = None,
    run: str = "",
) -> list[Curve]:
    """Return a curve for each element of a port; in the units ``like``, if given.

    Raises
    ------
    LogError
        If there is no such component, signal or element.
    UsageError
        If the port begins after the last time shown, or ends before the first.
    """
    rows = rows_of(recording, port, like=like)
    times = time_ns_of(recording, port) / 1e9
    start, stop = options.window
    if len(times) and (start > times[-1] or stop < times[0]):
        raise UsageError(
            "start, stop: no rows in this interval; expected a part of "
            f"{times[0]:g} s to {times[-1]:g} s"
        )
    units = units_of(recording, port) if like is None else like
    names = element_names(port, rows.shape[1])
    held = signal_of(recording, port).variability == "discrete"
    curves = []
    for name, unit, values in zip(names, units, rows.T, strict=True):
        curves.append(Curve(name, unit, times, values, held, run).within(options))
    return curves


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
        label = shown_text(curve.label)
        if has_own_units:
            curve.draw(panel, style, label=f"{label} {_bracketed(curve.unit)}")
        else:
            curve.in_unit_of(first).draw(panel, style, label=label)
    common = ""
    if len(signals) == 1:
        common = first.name if len(names) == 1 else first.name.partition("[")[0]
    unit = "" if has_own_units else _bracketed(first.unit)
    panel.set_ylabel(f"{shown_text(common)} {unit}".strip())
    if len(curves) > 1:
        show_legend(panel)


def _bracketed(unit: Unit) -> str:
    return "" if unit.name is None else f"[{shown_text(unit.name)}]"


def show_legend(panel: Any) -> None:
    """Name the curves of a panel beside it, where they hide nothing; of many only the first."""
    lines, names = panel.get_legend_handles_labels()
    shown = lines[:MOST_NAMES]
    panel.legend(
        shown,
        names[:MOST_NAMES],
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        frameon=False,
        fontsize="small",
        ncols=-(-len(shown) // _NAMES_IN_COLUMN),  # rounded up
        title=f"the first {len(shown)} of {len(lines)}" if len(shown) < len(lines) else None,
        title_fontsize="small",
    )


def color_styles(count: int) -> list[Style]:
    """Return a style for each of several curves: colors, then dashes too."""
    styles: list[Style] = []
    for i in range(count):
        color = COLORS[i % len(COLORS)]
        dashes = DASHES[i // len(COLORS) % len(DASHES)]
        styles.append({"color": color, "linestyle": dashes, "linewidth": WIDTH})
    return styles


def shown_text(name: str) -> str:
    """Return a name as matplotlib shows it: no mathematics, no control characters."""
    return printable_line(name).replace("$", r"\$")
