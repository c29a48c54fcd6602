"""Pictures of a run; needs the extra ``[plot]``."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.arrays import as_columns
from cosim.core.contracts import Recording
from cosim.errors import UsageError
from cosim.scenario.report import truth_of

NO_TRUTH = "the scenario has no [truth], so there is no standard picture; use 'cosim plot LOG SIGNAL...'"


def need_plot(out: Path, truth: Collection[str]) -> None:
    """Refuse a picture of a run that could not be drawn, before anything is run for it.

    Raises
    ------
    UsageError
        If there is no ``truth``, matplotlib is not there, or the ending of ``out`` is none of a picture.
    """
    if not truth:
        raise UsageError(NO_TRUTH)
    _need_format(out)


def _need_format(out: Path) -> None:
    figure, _ = _panels(1)
    formats = figure.canvas.get_supported_filetypes()
    if out.suffix.lower().removeprefix(".") not in formats:
        raise UsageError(f"{out}: found the ending {out.suffix!r}, needed one of: {', '.join(sorted(formats))}")


def plot_signals(recording: Recording, signals: Sequence[str], out: Path) -> None:
    """Draw signals over time, one panel each.

    Raises
    ------
    UsageError
        If matplotlib is not there or the format of ``out`` is unknown.
    LogError
        If a signal is unknown.
    """
    _need_format(out)
    figure, axes = _panels(len(signals))
    for axis, signal in zip(axes, signals, strict=True):
        _draw(axis, recording, signal)
        axis.set_ylabel(signal)
    _save(figure, axes, out)


def plot_run(recording: Recording, out: Path) -> None:
    """Draw every estimate with its truth, one panel each: the standard picture of a run."""
    truth = truth_of(recording)
    need_plot(out, truth)
    figure, axes = _panels(len(truth))
    for axis, (estimate, true) in zip(axes, truth.items(), strict=True):
        if isinstance(true, str):
            _draw(axis, recording, true, color="0.75", linewidth=3)
        else:
            for value in np.atleast_1d(true):
                axis.axhline(value, color="0.75", linewidth=3)
        _draw(axis, recording, estimate)
        axis.set_ylabel(estimate)
        _limit(axis, recording, estimate, true)
    figure.suptitle(f"{recording.metadata['cosim.run'].get('scenario', '')}: estimates (lines) and truth (grey)")
    _save(figure, axes, out)


def _limit(axis: Any, recording: Recording, estimate: str, true: Any) -> None:
    """Keep a wild start of an estimate from hiding the rest."""
    truth = np.atleast_1d(recording[true] if isinstance(true, str) else np.array(true, dtype=np.float64))
    settled = recording[estimate][-max(1, len(recording[estimate]) // 2) :]
    values = np.concatenate([truth.ravel(), settled.ravel()])
    low, high = values[np.isfinite(values)].min(), values[np.isfinite(values)].max()
    margin = 0.15 * (high - low) or 1.0
    axis.set_ylim(low - margin, high + margin)


def _panels(count: int) -> tuple[Any, list[Any]]:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UsageError("plots need matplotlib: pip install 'cosim[plot]'") from error
    figure = Figure(figsize=(9, 1.2 + 1.9 * count), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(count, 1, sharex=True)))


def _draw(axis: Any, recording: Recording, signal: str, **style: Any) -> None:
    """Draw a signal, or one element of it, as what it is between two rows: straight lines, or held values."""
    component, element = signal.partition(".")[0], re.fullmatch(r"(.*)\[(\d+)\]", signal)
    known = {f"{name}.{s.name}": s for name, channel in recording.channels.items() for s in channel.signals}
    if element is not None and signal not in known and element[1] in known and int(element[2]) < known[element[1]].size:
        values, found = as_columns(recording[element[1]])[:, int(element[2])], known[element[1]]
    else:
        values = recording[signal]
        found = known[signal]
    shape = {"drawstyle": "steps-post"} if found.variability == "discrete" else {}
    axis.plot(recording.time_ns(component) / 1e9, values, **({"linewidth": 1.2} | shape | style))


def _save(figure: Any, axes: Sequence[Any], out: Path) -> None:
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("t [s]")
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        figure.savefig(out, dpi=110)
    except ValueError as error:
        raise UsageError(f"{out}: {error}") from error
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror}") from error
