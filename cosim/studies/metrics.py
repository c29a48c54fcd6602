"""Metrics of runs: of recordings, and of runs while they advance; checked by assertions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final, final

import numpy as np

from cosim.arguments import mapping_argument
from cosim.arrays import NAN, Matrix, Nanoseconds
from cosim.core.contracts import Block
from cosim.core.passing_recorders import TwoRecorders
from cosim.core.recorded.partial import PartialChannels
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.recorders import Memory, Nothing
from cosim.core.recording import Plan, Recorder, Recording
from cosim.core.signals import Channel, Layout
from cosim.errors import UnknownSignalError, UsageError, listing, option, quoted
from cosim.instants import StepNs
from cosim.log import Log
from cosim.log.editing.joining import open_joined
from cosim.native.numerics.expression import ConditionProgram, Program
from cosim.native.numerics.reductions import KeptValues, RowReduction, RowReductions
from cosim.native.step import DOUBLE
from cosim.scenario.recordings.recording import LiveView
from cosim.studies.metric_language import Metric, Reduction, parse_comparisons, parse_metric_text


@dataclass(frozen=True, eq=False)
class BoundReductions:
    """Reductions over the same rows.

    Parameters
    ----------
    numbers : tuple of int
        Which ones of all they are.
    rows : RowReductions
    period : int
        Communication steps between the rows.
    """

    numbers: tuple[int, ...]
    rows: RowReductions
    period: int


def find_element(channels: Mapping[str, Channel], name: str, source: str) -> RecordedPort:
    """Return a signal of one element, or an element of a signal.

    Raises
    ------
    UsageError
        If there is none of that name, with the nearest, or it has several elements.
    """
    try:
        port = find_signal(channels, name, source=source)
    except UnknownSignalError as error:
        raise UsageError(str(error)) from error
    if port.size != 1:
        begin = port.columns.start + port.channel.start
        first = begin - port.channel.signal_columns[port.signal.name].start
        elements = range(first, first + port.size)
        names = [f"{port.channel.name}.{port.signal.element(i)}" for i in elements]
        raise UsageError(f"'{name}' has {port.size} elements; expected one of: {listing(names)}")
    return port


def bind_layout(reductions: Sequence[Reduction], layout: Layout) -> list[BoundReductions]:
    """Return reductions bound to the rows of a run while it advances.

    Raises
    ------
    UsageError
        If there is no such signal; :meth:`cosim.studies.metrics.Metrics.check` names all.
    """
    channels = {channel.name: channel for channel in layout.channels}

    def column_of(name: str) -> int:
        port = find_element(channels, name, "the run")
        return int(port.channel.start + port.columns.start)

    groups: dict[int, list[int]] = {}
    for number, reduction in enumerate(reductions):
        period = math.lcm(*(channel.period for channel in _channels_of(reduction, channels)))
        groups.setdefault(period, []).append(number)
    return [
        BoundReductions(tuple(numbers), _bound(reductions, numbers, column_of), period)
        for period, numbers in groups.items()
    ]


def reduce_recording(reductions: Sequence[Reduction], recording: Recording) -> list[KeptValues]:
    """Return what reductions keep of a recorded run.

    Raises
    ------
    UsageError
        If there is no such signal.
    """
    groups: dict[tuple[str, ...], list[int]] = {}
    for number, reduction in enumerate(reductions):
        names = {channel.name for channel in _channels_of(reduction, recording.channels)}
        groups.setdefault(tuple(sorted(names)), []).append(number)
    kept: dict[int, KeptValues] = {}
    for components, numbers in groups.items():
        rows = _reduced(recording, components, [reductions[number] for number in numbers])
        kept.update({number: rows.kept(place) for place, number in enumerate(numbers)})
    return [kept[number] for number in range(len(reductions))]


def _reduced(
    recording: Recording, components: Sequence[str], reductions: Sequence[Reduction]
) -> RowReductions:
    """Return reductions over the rows that some components have at the same instants."""
    time_ns = _common_instants([recording.time_ns(name) for name in components])
    columns: dict[str, int] = {}
    for reduction in reductions:
        for name in reduction.signals:
            columns.setdefault(name, len(columns))
    rows = np.empty((len(time_ns), max(len(columns), 1)))
    for name, column in columns.items():
        component = find_element(recording.channels, name, recording.label).channel.name
        own_ns = recording.time_ns(component)
        rows[:, column] = recording[name][np.searchsorted(own_ns, time_ns)]
    bound = _bound(reductions, range(len(reductions)), columns.__getitem__)
    bound.begin(recording.step_ns)
    bound.add(time_ns, rows)
    return bound


def _common_instants(times: Sequence[Nanoseconds]) -> Nanoseconds:
    """Return the instants that are in all of several increasing ones."""
    common = times[0]
    for other in times[1:]:
        if not np.array_equal(common, other):
            common = np.intersect1d(common, other, assume_unique=True)
    return np.ascontiguousarray(common)


def _channels_of(reduction: Reduction, channels: Mapping[str, Channel]) -> Iterator[Channel]:
    """Yield the channels at whose common instants a reduction has rows."""
    if not channels:
        raise UsageError("expected at least one component in the run, got none")
    if not reduction.signals:
        yield min(channels.values(), key=lambda channel: channel.period)
    for name in reduction.signals:
        yield find_element(channels, name, "the run").channel


def _bound(
    reductions: Sequence[Reduction], numbers: Sequence[int], column_of: Callable[[str], int]
) -> RowReductions:
    """Return reductions over rows in which signals have some columns."""
    bound = []
    for number in numbers:
        reduction = reductions[number]
        values = _with_columns(reduction.values, column_of)
        where = None
        if reduction.where is not None:
            where = _condition_with_columns(reduction.where, column_of)
        bound.append(RowReduction(reduction.kind.parts, values, where))
    return RowReductions(bound)


def _with_columns(
    values: Program | ConditionProgram, column_of: Callable[[str], int]
) -> Program | ConditionProgram:
    if isinstance(values, ConditionProgram):
        return _condition_with_columns(values, column_of)
    return values.with_columns([column_of(name) for name in values.signals])


def _condition_with_columns(
    condition: ConditionProgram, column_of: Callable[[str], int]
) -> ConditionProgram:
    columns = [column_of(name) for name in condition.program.signals]
    return replace(condition, program=condition.program.with_columns(columns))


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


@final
class MetricRecorder(Nothing):
    """Keeps of the rows of a run what metrics need; implements Recorder.

    It takes one run after the other: each begins anew.

    Parameters
    ----------
    metrics : Metrics
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._layout: Layout | None = None
        self._step_ns: StepNs = 0
        self._bound: list[BoundReductions] = []
        self._has_rows = False

    def begin(self, plan: Plan) -> None:
        """Begin a run.

        Raises
        ------
        UsageError
            If it has not the signals of all metrics; names all that are missing.
        """
        if plan.layout != self._layout:
            self._layout = None
            self._metrics.check(plan.channels)
            self._bound = bind_layout(self._metrics.reductions, plan.layout)
            self._layout = plan.layout
        for group in self._bound:
            group.rows.begin(plan.step_ns)
        self._has_rows = False
        self._step_ns = plan.step_ns

    def write(self, block: Block, signals: Matrix) -> None:
        """Reduce the new rows."""
        first = 0 if block.index == 0 and not self._has_rows else 1
        if first > block.steps:
            return
        self._has_rows = True
        if signals.strides[1] != DOUBLE:  # chosen columns
            signals = np.ascontiguousarray(signals)
        for group in self._bound:
            period = group.period
            begin = first + -(block.index + first) % period
            if begin > block.steps:
                continue
            rows = slice(begin, None, period)
            step_ns = period * self._step_ns
            if isinstance(step_ns, int):
                first_ns = int(block.time_ns[begin])
                group.rows.add_regular(first_ns, step_ns, block.time[rows], signals[rows])
            else:  # as of its log
                group.rows.add(np.ascontiguousarray(block.time_ns[rows]), signals[rows])

    def values(self) -> dict[str, float | None]:
        """Return the metrics of the rows so far; None: one has no value, or no run has begun."""
        if self._layout is None:
            return dict.fromkeys(self._metrics.names)
        kept: dict[int, KeptValues] = {}
        for group in self._bound:
            kept.update({n: group.rows.kept(place) for place, n in enumerate(group.numbers)})
        return self._metrics.values([kept[number] for number in range(len(kept))])


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


NO_METRICS: Final[Mapping[str, str]] = MappingProxyType({})


@final
class Assertions:
    """Assertions about a run, such as ``rms(plant.y) < 0.1 and last(plant.y) > 0``.

    Parameters
    ----------
    texts : iterable of str
    known : mapping of str to str, optional
        Metrics of a study by name, which may stand for their texts.

    Attributes
    ----------
    metrics : dict of str to str
        All metrics in them by name; of those that have none their texts are the names.

    Raises
    ------
    UsageError
        If a text is none; whether there are its signals is not known here.
    """

    def __init__(self, texts: Iterable[str], known: Mapping[str, str] = NO_METRICS) -> None:
        self._comparisons = {}
        self.metrics: dict[str, str] = {}
        for text in texts:
            try:
                self._comparisons[text] = parse_comparisons(text, known)
            except UsageError as error:
                raise UsageError(f"{option('assert')}: {error}") from error
            for one in self._comparisons[text]:
                for name in (one.left, one.right):
                    if isinstance(name, str):
                        self.metrics[name] = known.get(name, name)

    def view(self, other: LiveView | None = None) -> AssertedView:
        """Return what computes them of a run, beside what shows it."""
        return AssertedView(self, other)

    def problems(self, values: Mapping[str, float | None]) -> dict[str, str]:
        """Return why assertions are not fulfilled, by their texts; those that are are left out.

        Parameters
        ----------
        values : mapping of str to float or None
            Of all metrics.
        """
        problems = {}
        for text, comparisons in self._comparisons.items():
            found = []
            for one in comparisons:
                names = [name for name in (one.left, one.right) if isinstance(name, str)]
                left = values[one.left] if isinstance(one.left, str) else one.left
                right = values[one.right] if isinstance(one.right, str) else one.right
                if left is None or right is None or not one.holds(left, right):
                    for name in names:
                        value = values[name]
                        found.append(f"{name} = {'no value' if value is None else repr(value)}")
            if found:
                problems[text] = ", ".join(dict.fromkeys(found))
        return problems


@final
class AssertedView:
    """Computes what assertions need of a run while it goes on; a :class:`LiveView`.

    Parameters
    ----------
    assertions : Assertions
    other : LiveView or None
        What shows the run.
    """

    def __init__(self, assertions: Assertions, other: LiveView | None = None) -> None:
        self._assertions = assertions
        self._other = other
        self._recorder = MetricRecorder(parse_metrics(assertions.metrics, f"{option('assert')} "))

    def beside(self, recorder: Recorder, kinds: Mapping[str, str]) -> Recorder:
        """Return what takes the run, too; it refuses one that lacks a signal before it begins."""
        shown = recorder if self._other is None else self._other.beside(recorder, kinds)
        return TwoRecorders(self._recorder, shown)

    @property
    def problems(self) -> dict[str, str]:
        """Why assertions are not fulfilled, by their texts."""
        return self._assertions.problems(self._recorder.values())
