"""Metrics of a run that is recorded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cosim.core.recorded.partial import PartialChannels
from cosim.core.recorders import Memory
from cosim.log import Log
from cosim.log.editing.joining import open_joined
from cosim.studies.metrics.binding import find_element
from cosim.studies.metrics.metrics import Metrics, parse_metrics


def metrics(
    log: str | Path | Log | Memory, expressions: Mapping[str, str]
) -> dict[str, float | None]:
    """Return metrics of a recorded run, by name; None: one has no value.

    They are those that a study has of this run, bit for bit, where the log has all of its rows.

    >>> import cosim
    >>> cosim.metrics("logs/academic.mcap", {"error": "rms(observer.delta - delta.y)"})
    {'error': 0.14566791481551514}

    Parameters
    ----------
    log : str, Path, Log or Memory
        A file of a log that was rotated is read with those before it.
    expressions : mapping of name to expression
        As [metrics] of a study has them, such as ``{"last": "last(plant.y)"}``.

    Raises
    ------
    UsageError
        If an expression is no metric, or has a signal that is not recorded.
    LogError
        If the log cannot be read.
    """
    parsed = parse_metrics(expressions)
    return parsed.of(log if isinstance(log, Memory) else open_joined(log))


def missing_rows(metrics: Metrics, log: Log) -> str:
    """Return which rows of its run a log lacks that metrics are made of; empty: none."""
    if log.status == "partial":
        return f"{log.label} is a part of the log of its run"
    channels = log.channels
    if not isinstance(channels, PartialChannels):
        return ""
    every = channels.partial.selection.every
    names = [find_element(channels, name, log.label).channel.name for name in metrics.signals]
    for name in names or channels:
        if channels[name].period != channels.partial.declared[name].period:
            return f"{log.label} has rows at every {every} steps only"
    return ""
