"""Pictures of a run; needs the extra ``[plot]``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.contracts import Recording
from cosim.errors import UsageError

POINTS = 4000  # a signal is thinned to about this many points; a picture has no more


def plot_signals(recording: Recording, signals: Sequence[str], out: Path) -> None:
    """Draw signals over time, one panel each.

    Raises
    ------
    UsageError
        If matplotlib is not there or the format of ``out`` is unknown.
    LogError
        If a signal is unknown.
    """
    figure, axes = _panels(len(signals))
    for axis, signal in zip(axes, signals, strict=True):
        _draw(axis, recording, signal)
        axis.set_ylabel(signal)
    _save(figure, axes, out)


def plot_run(recording: Recording, out: Path) -> None:
    """Draw every estimate with its truth, one panel each: the standard picture of a run."""
    truth = json.loads(recording.metadata.get("cosim.run", {}).get("truth", "{}"))
    if not truth:
        raise UsageError("the scenario has no [truth], so there is no standard picture; use 'cosim plot LOG SIGNAL...'")
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
    values = recording[signal]
    time = recording.time_ns(signal.partition(".")[0]) / 1e9
    every = max(1, len(time) // POINTS)
    axis.plot(time[::every], values[::every], **({"linewidth": 1.2} | style))


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
