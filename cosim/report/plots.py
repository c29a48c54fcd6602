"""Pictures of a run; needs the extra ``[plot]``."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.core.contracts import Recording
from cosim.errors import UsageError
from cosim.report.summary import difference, has_signal, rows_of, signal_of, truth_of

if TYPE_CHECKING:
    from cosim.report.comparing import Comparison

TRUTH = {"color": "0.75", "linewidth": 3}
COLORS = (
    "#000000",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#D55E00",
    "#0072B2",
    "#CC79A7",
)  # Okabe and Ito, without yellow
DASHES = ("-", (0, (6, 2)), (0, (2, 2)), (0, (7, 2, 1, 2)), (0, (1, 1)))
NO_TRUTH = (
    "the scenario has no [truth], so there is no standard picture; use 'cosim plot LOG SIGNAL...'"
)


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
        raise UsageError(
            f"{out}: found the ending {out.suffix!r}, needed one of: {', '.join(sorted(formats))}"
        )


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
        _draw_truth(axis, recording, estimate, true)
        _draw(axis, recording, estimate)
        axis.set_ylabel(estimate)
        _limit(axis, recording, estimate, true)
    figure.suptitle(
        f"{recording.metadata['cosim.run'].get('scenario', '')}: estimates (lines) and truth (grey)"
    )
    _save(figure, axes, out)


def plot_comparison(found: Comparison, out: Path) -> None:
    """Draw the estimates of several plants over their truth, and beside them how far they are from those of the first."""
    need_plot(out, found.estimates)
    recordings, truth = found.recordings, found.estimates
    first = next(iter(recordings))
    figure, grid = _panels(len(truth), columns=2)
    styles = dict(zip(recordings, _styles(len(recordings)), strict=True))
    for (left, right), (estimate, true) in zip(
        np.reshape(grid, (-1, 2)), truth.items(), strict=True
    ):
        have = {
            label: recording
            for label, recording in recordings.items()
            if has_signal(recording, estimate)
        }
        _draw_truth(
            left,
            next((one for one in have.values() if true == truth_of(one).get(estimate)), None),
            estimate,
            true,
        )
        for label, recording in have.items():
            _draw(left, recording, estimate, **styles[label])
        left.set_ylabel(estimate)
        for label, recording in have.items():
            if label != first and first in have:
                right.plot(*difference(recordings[first], recording, estimate), **styles[label])
        right.ticklabel_format(axis="y", scilimits=(-2, 3))
    _limits(grid, recordings, truth)
    lines = [grid[0].plot([], [], label=label, **style)[0] for label, style in styles.items()]
    lines.append(grid[0].plot([], [], label="truth", **TRUTH)[0])
    figure.legend(
        handles=lines, loc="outside upper center", ncols=min(6, len(lines)), frameon=False
    )
    grid[0].set_title("estimates", fontsize="medium")
    grid[1].set_title(f"difference to {first}", fontsize="medium")
    _save(figure, grid, out, columns=2)


def _limits(
    grid: Sequence[Any], recordings: Mapping[str, Recording], truth: Mapping[str, Any]
) -> None:
    """Keep a wild start of one of the estimates from hiding the rest, in the estimates and in their differences."""
    first, *others = recordings.values()
    for (left, right), (estimate, true) in zip(
        np.reshape(np.array(grid, object), (-1, 2)), truth.items(), strict=True
    ):
        shown = [
            recording
            for recording in recordings.values()
            if truth_of(recording).get(estimate) == true
        ]
        if shown:
            _limit(left, shown[0], estimate, true)
        apart = [
            difference(first, other, estimate)[1]
            for other in others
            if has_signal(first, estimate) and has_signal(other, estimate)
        ]
        settled = [rows[len(rows) // 2 :] for rows in apart]
        largest = max(
            (float(np.abs(rows[np.isfinite(rows)]).max(initial=0.0)) for rows in settled),
            default=0.0,
        )
        right.set_ylim(-1.3 * largest or -1.0, 1.3 * largest or 1.0)


def _styles(count: int) -> Iterator[dict[str, Any]]:
    """Give a style for each plant: colors that the color-blind tell apart; dashes and widths that leave equal lines visible."""
    widths = np.linspace(2.4, 1.0, count)
    for width, dashes, color in zip(
        widths, itertools.cycle(DASHES), itertools.cycle(COLORS), strict=False
    ):
        yield {"color": color, "linestyle": dashes, "linewidth": width}


def _draw_truth(axis: Any, recording: Recording | None, estimate: str, true: Any) -> None:
    if isinstance(true, str):
        if recording is not None:
            _draw(axis, recording, true, like=estimate, **TRUTH)
        return
    for value in np.atleast_1d(true):
        axis.axhline(value, **TRUTH)


def _limit(axis: Any, recording: Recording, estimate: str, true: Any) -> None:
    """Keep a wild start of an estimate from hiding the rest."""
    truth = np.atleast_1d(
        rows_of(recording, true, like=estimate)
        if isinstance(true, str)
        else np.array(true, dtype=np.float64)
    )
    settled = recording[estimate][-max(1, len(recording[estimate]) // 2) :]
    values = np.concatenate([truth.ravel(), settled.ravel()])
    low, high = values[np.isfinite(values)].min(), values[np.isfinite(values)].max()
    margin = 0.15 * (high - low) or 1.0
    axis.set_ylim(low - margin, high + margin)


def _panels(count: int, columns: int = 1) -> tuple[Any, list[Any]]:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UsageError("plots need matplotlib: pip install 'cosim[plot]'") from error
    figure = Figure(
        figsize=(9 if columns == 1 else 13, 1.2 + (1.9 if columns == 1 else 2.6) * count),
        layout="constrained",
    )
    return figure, list(np.ravel(figure.subplots(count, columns, sharex=True)))


def _draw(
    axis: Any, recording: Recording, port: str, *, like: str | None = None, **style: Any
) -> None:
    """Draw a signal, or one element of it, as what it is between two rows: straight lines, or held values."""
    values = rows_of(recording, port, like=like)
    shape = (
        {"drawstyle": "steps-post"} if signal_of(recording, port).variability == "discrete" else {}
    )
    axis.plot(
        recording.time_ns(port.partition(".")[0]) / 1e9,
        values,
        **({"linewidth": 1.2} | shape | style),
    )


def _save(figure: Any, axes: Sequence[Any], out: Path, columns: int = 1) -> None:
    for axis in axes:
        axis.grid(alpha=0.3)
    for axis in axes[-columns:]:
        axis.set_xlabel("t [s]")
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        figure.savefig(out, dpi=110)
    except ValueError as error:
        raise UsageError(f"{out}: {error}") from error
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror}") from error
