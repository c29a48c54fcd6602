"""Pictures of a run; needs the extra ``[plot]``."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from cosim.arrays import Matrix
from cosim.core.contracts import Recording
from cosim.errors import UsageError
from cosim.report.recorded import (
    difference,
    has_signal,
    rows_of,
    signal_of,
    stacked_rows_of,
    time_ns_of,
)
from cosim.scenario.recorded import run_metadata, truth_of
from cosim.scenario.schema import truth_ports

if TYPE_CHECKING:
    from cosim.report.comparing import Comparison

Style: TypeAlias = Mapping[str, Any]

LINE: Style = {"linewidth": 1.2}
TRUTH: Style = {"color": "0.75", "linewidth": 3}
# Okabe and Ito, without yellow: the color-blind can distinguish them
COLORS = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#D55E00", "#0072B2", "#CC79A7")
DASHES = ("-", (0, (6, 2)), (0, (2, 2)), (0, (7, 2, 1, 2)), (0, (1, 1)))
LARGEST_DRAWN = 1e300  # an axis has margins, and the difference of its ends must be a number
NO_TRUTH = (
    "the scenario has no [truth], so there is no standard picture; use 'cosim plot LOG SIGNAL...'"
)


def need_plot(out: Path, truth: Collection[str]) -> None:
    """Refuse a picture of a run that could not be drawn, before anything is run for it.

    Raises
    ------
    UsageError
        If there is no ``truth`` or no matplotlib, or if ``out`` does not end as a picture does.
    """
    if not truth:
        raise UsageError(NO_TRUTH)
    _need_format(out)


def _need_format(out: Path) -> None:
    figure, _ = _panels(1)
    formats = figure.canvas.get_supported_filetypes()
    if out.suffix.lower().removeprefix(".") not in formats:
        known = ", ".join(sorted(formats))
        raise UsageError(f"{out}: found the ending {out.suffix!r}, needed one of: {known}")


def plot_signals(recording: Recording, signals: Sequence[str], out: Path) -> None:
    """Draw signals over time, one panel each.

    Parameters
    ----------
    recording : Recording
    signals : sequence of str
        ``component.signal``, ``component.signal[1]`` or ``component.signal[0:2]``.
    out : Path

    Raises
    ------
    UsageError
        If there is no matplotlib, the format of ``out`` is unknown, no signal is named, or one has
        values too large for an axis.
    LogError
        If a signal is unknown.
    """
    _need_format(out)
    if not signals or not all(isinstance(signal, str) for signal in signals):
        raise UsageError(f"found {signals!r}, needed names of signals, such as 'plant.y'")
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
    scenario = run_metadata(recording).get("scenario", "")
    figure.suptitle(f"{scenario}: estimates (lines) and truth (gray)")
    _save(figure, axes, out)


def plot_comparison(comparison: Comparison, out: Path) -> None:
    """Draw the estimates on several plants over their truth, and their differences to the first.

    One row for each estimate: on the left the estimates, on the right the differences.
    """
    need_plot(out, comparison.estimates)
    recordings = comparison.recordings
    first = next(iter(recordings))
    figure, grid = _panels(len(comparison.estimates), columns=2)
    styles = dict(zip(recordings, _styles(len(recordings)), strict=True))
    rows = np.reshape(np.array(grid, object), (-1, 2))
    for (left, right), (estimate, true) in zip(rows, comparison.estimates.items(), strict=True):
        _draw_estimates(left, recordings, estimate, true, styles=styles)
        _draw_differences(right, recordings, estimate, styles=styles)
        _limit_estimates(left, recordings, estimate, true)
        _limit_differences(right, recordings, estimate)
    lines = [grid[0].plot([], [], label=label, **style)[0] for label, style in styles.items()]
    lines.append(grid[0].plot([], [], label="truth", **TRUTH)[0])
    columns = min(6, len(lines))
    figure.legend(handles=lines, loc="outside upper center", ncols=columns, frameon=False)
    grid[0].set_title("estimates", fontsize="medium")
    grid[1].set_title(f"difference to {first}", fontsize="medium")
    _save(figure, grid, out, columns=2)


def _draw_estimates(
    axis: Any,
    recordings: Mapping[str, Recording],
    estimate: str,
    true: Any,
    *,
    styles: Mapping[str, Style],
) -> None:
    with_truth = _with_truth(recordings.values(), estimate, true)
    _draw_truth(axis, with_truth[0] if with_truth else None, estimate, true)
    for label, recording in recordings.items():
        if has_signal(recording, estimate):
            _draw(axis, recording, estimate, styles[label])
    axis.set_ylabel(estimate)


def _draw_differences(
    axis: Any,
    recordings: Mapping[str, Recording],
    estimate: str,
    *,
    styles: Mapping[str, Style],
) -> None:
    for label, (times, values) in _differences(recordings, estimate).items():
        axis.plot(times, values, **styles[label])
    axis.ticklabel_format(axis="y", scilimits=(-2, 3))


def _differences(
    recordings: Mapping[str, Recording], estimate: str
) -> dict[str, tuple[Matrix, Matrix]]:
    """Return instants and differences to the first recording, of those that have the estimate."""
    (_, first), *others = recordings.items()
    differences = {}
    if has_signal(first, estimate):
        for label, recording in others:
            if has_signal(recording, estimate):
                differences[label] = difference(first, recording, estimate)
    return differences


def _with_truth(recordings: Iterable[Recording], estimate: str, true: Any) -> list[Recording]:
    """Return the recordings that have the estimate, with this truth."""
    matches = []
    for recording in recordings:
        if has_signal(recording, estimate) and truth_of(recording).get(estimate) == true:
            matches.append(recording)
    return matches


def _limit_estimates(
    axis: Any, recordings: Mapping[str, Recording], estimate: str, true: Any
) -> None:
    with_truth = _with_truth(recordings.values(), estimate, true)
    if with_truth:
        _limit(axis, with_truth[0], estimate, true)


def _limit_differences(axis: Any, recordings: Mapping[str, Recording], estimate: str) -> None:
    """Limit the axis to the second half of the differences: transients would hide the rest."""
    largest = 0.0
    for _, values in _differences(recordings, estimate).values():
        second_half = values[len(values) // 2 :]
        finite = second_half[np.isfinite(second_half)]
        largest = max(largest, float(np.abs(finite).max(initial=0.0)))
    limit = 1.3 * largest or 1.0
    axis.set_ylim(-limit, limit)


def _styles(count: int) -> Iterator[Style]:
    """Yield a style for each plant; dashes and widths leave equal lines visible."""
    widths = np.linspace(2.4, 1.0, count)
    patterns = zip(widths, itertools.cycle(DASHES), itertools.cycle(COLORS), strict=False)
    for width, dashes, color in patterns:
        yield {"color": color, "linestyle": dashes, "linewidth": width}


def _draw_truth(axis: Any, recording: Recording | None, estimate: str, true: Any) -> None:
    true_ports = truth_ports(true)
    if not true_ports:
        for value in np.atleast_1d(true):
            axis.axhline(value, **TRUTH)
    elif recording is not None:
        for port in true_ports:
            _draw(axis, recording, port, TRUTH, like=estimate)


def _limit(axis: Any, recording: Recording, estimate: str, true: Any) -> None:
    """Limit the axis to the truth and the second half of an estimate: a transient would hide it."""
    true_ports = truth_ports(true)
    if true_ports:
        _, truth = stacked_rows_of(recording, true_ports, like=estimate)
    else:
        truth = np.atleast_1d(np.array(true, dtype=np.float64))
    estimates = rows_of(recording, estimate)
    second_half = estimates[-max(1, len(estimates) // 2) :]
    values = np.concatenate([truth.ravel(), second_half.ravel()])
    finite = values[np.isfinite(values)]
    low = finite.min()
    high = finite.max()
    margin = 0.15 * (high - low) or 1.0
    axis.set_ylim(low - margin, high + margin)


def _panels(count: int, columns: int = 1) -> tuple[Any, list[Any]]:
    """Return a figure of ``count`` rows, and its axes row by row.

    Raises
    ------
    UsageError
        If there is no matplotlib.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UsageError(
            "plots need matplotlib, which is not installed: pip install matplotlib, or, "
            "in a clone of cosim, pip install -e '.[plot]'"
        ) from error
    width, row_height = (9.0, 1.9) if columns == 1 else (13.0, 2.6)
    figure = Figure(figsize=(width, 1.2 + row_height * count), layout="constrained")
    return figure, list(np.ravel(figure.subplots(count, columns, sharex=True)))


def _draw(
    axis: Any, recording: Recording, port: str, style: Style = LINE, *, like: str | None = None
) -> None:
    """Draw a port as it is between two rows: linear interpolation, or zero-order hold."""
    times = time_ns_of(recording, port) / 1e9
    values = rows_of(recording, port, like=like)
    largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
    if largest > LARGEST_DRAWN:
        raise UsageError(
            f"{port}: found {largest:g}, too large to be drawn; needed at most {LARGEST_DRAWN:g}"
        )
    discrete = signal_of(recording, port).variability == "discrete"
    axis.plot(times, values, drawstyle="steps-post" if discrete else "default", **style)


def _save(figure: Any, axes: Sequence[Any], out: Path, columns: int = 1) -> None:
    for axis in axes:
        axis.grid(alpha=0.3)
    for axis in axes[-columns:]:
        axis.set_xlabel("t [s]")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=110)
    except ValueError as error:
        raise UsageError(f"{out}: {error}") from error
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror}") from error
