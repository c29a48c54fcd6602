"""The metrics of a study: parsed, checked against signals, and computed of a recorded run."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, final

import numpy as np

from cosim.arguments import mapping_argument
from cosim.arrays import NAN
from cosim.core.recording import Recording
from cosim.core.signals import Channel
from cosim.errors import UsageError, quoted
from cosim.native.numerics.reductions import KeptValues
from cosim.studies.metrics.binding import find_element, reduce_recording
from cosim.studies.metrics.language import Metric, Reduction, parse_metric_text

PLACE: Final = "metrics."  # the table of a study that has them


@final
class Metrics:
    """The metrics of a study.

    Parameters
    ----------
    metrics : sequence of Metric
    place : str
        Before the name of a metric, in messages.

    Attributes
    ----------
    reductions : tuple of Reduction
        Those of all metrics, one behind the other.
    """

    def __init__(self, metrics: Sequence[Metric], place: str = PLACE) -> None:
        self._metrics = tuple(metrics)
        self._place = place
        reductions: list[Reduction] = []
        for metric in metrics:
            reductions += metric.reductions
        self.reductions = tuple(reductions)

    @property
    def names(self) -> tuple[str, ...]:
        """Their names, in their order."""
        return tuple(metric.name for metric in self._metrics)

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals in them as they are written, each once."""
        names: dict[str, None] = {}
        for reduction in self.reductions:
            names.update(dict.fromkeys(reduction.signals))
        return tuple(names)

    def check(self, channels: Mapping[str, Channel], *, source: str = "the run") -> None:
        """Check that there are the signals of all metrics.

        Parameters
        ----------
        channels : mapping of component name to Channel
            Those of a layout, or of a recording.
        source : str
            What has them, for messages.

        Raises
        ------
        UsageError
            With all problems, a line each: signals that are not there, with the nearest, and those
            of several elements.
        """
        problems: list[str] = []
        for metric in self._metrics:
            for problem in _problems(metric, channels, source):
                problems.append(f"{self._place}{metric.name}: {problem}")
        if problems:
            raise UsageError("\n".join(problems))

    def of(self, recording: Recording) -> dict[str, float | None]:
        """Return the metrics of a recorded run; None: one has no value.

        Raises
        ------
        UsageError
            As from :meth:`check`.
        LogError
            If a recording cannot be read.
        """
        self.check(recording.channels, source=recording.label)
        return self.values(reduce_recording(self.reductions, recording))

    def values(self, kept: Sequence[KeptValues]) -> dict[str, float | None]:
        """Return the metrics for what was kept of a run for each reduction."""
        values = {}
        first = 0
        for metric in self._metrics:
            last = first + len(metric.reductions)
            values[metric.name] = _value(metric, kept[first:last])
            first = last
        return values


def parse_metrics(texts: Mapping[str, str], place: str = PLACE) -> Metrics:
    """Return metrics by their names and texts, such as ``{"error": "rms(a.y - b.y)"}``.

    Raises
    ------
    UsageError
        With all problems, a line each: texts that are no metric.
    """
    metrics = []
    problems = []
    for name, text in mapping_argument("metrics", texts).items():
        try:
            metrics.append(_parsed(name, text))
        except UsageError as error:
            problems.append(f"{place}{name}: {error}")
    if problems:
        raise UsageError("\n".join(problems))
    return Metrics(metrics, place)


def _parsed(name: object, text: object) -> Metric:
    if not isinstance(name, str) or not name:
        raise UsageError("expected a name that is not empty")
    if not isinstance(text, str):
        raise UsageError(f"expected an expression such as 'max(abs(plant.y))', got {quoted(text)}")
    return parse_metric_text(name, text)


def _problems(metric: Metric, channels: Mapping[str, Channel], source: str) -> Iterator[str]:
    """Yield what is wrong with the signals of a metric, each once."""
    names: dict[str, None] = {}
    for reduction in metric.reductions:
        names.update(dict.fromkeys(reduction.signals))
    for name in names:
        try:
            find_element(channels, name, source)
        except UsageError as error:
            yield str(error)


def _value(metric: Metric, kept: Sequence[KeptValues]) -> float | None:
    """Return the value of a metric; None: it has none."""
    values = np.full(len(kept), NAN)
    for number, (reduction, part) in enumerate(zip(metric.reductions, kept, strict=True)):
        if part.number:
            band = None if reduction.band is None else reduction.band.value(values)
            values[number] = reduction.kind.value(part, band)
        else:
            values[number] = reduction.kind.without_values
    value = metric.arithmetic.value(values)
    return value if math.isfinite(value) else None
