"""Signals of one or several runs over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.core.recorded.selection import split_names
from cosim.core.recording import Recording
from cosim.errors import UsageError
from cosim.report.plots.curves import DASHES, Curve, Style, color_styles, curves_of, draw_curves
from cosim.report.plots.picture import Picture, PictureOptions, need_plot

_STANDARD = PictureOptions()


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
    labels = short_labels(runs)
    picture = Picture(len(signals), options)
    for panel, entry in zip(picture.panels, signals, strict=True):
        ports = split_names(entry)
        curves: list[Curve] = []
        styles: list[Style] = []
        for run, label, line in zip(runs, labels, _lines(len(runs)), strict=True):
            for curve in _curves_of_run(run, ports, options):
                curves.append(replace(curve, run=label))
                styles.append(line)
        colored = zip(color_styles(len(curves)), styles, strict=True)
        draw_curves(panel, curves, styles=[{**color, **line} for color, line in colored])
    picture.save(out)


def _curves_of_run(
    recording: Recording, ports: Sequence[str], options: PictureOptions
) -> list[Curve]:
    curves: list[Curve] = []
    for port in ports:
        curves += curves_of(recording, port, options)
    return curves


def short_labels(recordings: Sequence[Recording]) -> list[str]:
    """Return what tells recordings apart behind the name of a signal; nothing for a single one."""
    if len(recordings) == 1:
        return [""]
    paths = [Path(recording.label) for recording in recordings]
    stems = [path.stem for path in paths]
    labels = []
    for path in paths:
        label = path.stem if stems.count(path.stem) == 1 else str(path)
        labels.append(f" ({label})")
    return labels


def _lines(count: int) -> list[Style]:
    """Return dashes and width of the lines of each run, so that equal lines stay visible."""
    if count == 1:
        return [{}]
    widths = np.linspace(2.4, 1.0, count)
    lines: list[Style] = []
    for i, width in enumerate(widths):
        lines.append({"linestyle": DASHES[i % len(DASHES)], "linewidth": width})
    return lines
