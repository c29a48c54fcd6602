"""Metrics of a run while it goes on, and assertions about them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import final

import numpy as np

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.recorders import Nothing, Tee
from cosim.core.recording import Plan, Recorder
from cosim.core.signals import Layout
from cosim.errors import UsageError, option
from cosim.instants import StepNs
from cosim.native.numerics.reductions import RowReductions
from cosim.native.step import DOUBLE
from cosim.scenario.recordings.recording import LiveView
from cosim.studies.metrics import (
    Metrics,
    Reduction,
    bind,
    channels_of,
    find_element,
    parse_comparisons,
    parse_metrics,
)


@final
class MetricRecorder(Nothing):
    """Computes metrics of a run while it advances, and keeps no rows.

    It takes one run after the other; each begins anew.

    Parameters
    ----------
    metrics : Metrics
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._layout: Layout | None = None
        self._step_ns: StepNs = 0
        self._groups: dict[int, tuple[Mapping[int, Reduction], RowReductions]] = {}  # by period
        self._has_rows = False

    def begin(self, plan: Plan) -> None:
        """Bind the metrics to the run, unless the one before had the same signals.

        Raises
        ------
        UsageError
            If a signal is not there, or has several elements.
        """
        if plan.layout != self._layout:
            self._layout = None
            self._metrics.check(plan.channels)
            self._bind(plan)
            self._layout = plan.layout
        for _, rows in self._groups.values():
            rows.begin(plan.step_ns)
        self._has_rows = False
        self._step_ns = plan.step_ns

    def _bind(self, plan: Plan) -> None:
        """Group the reductions by how many steps their rows are apart."""
        channels = plan.channels

        def column_of(name: str) -> int:
            port = find_element(channels, name, "the run")
            return int(port.channel.start + port.columns.start)

        def period_of(reduction: Reduction) -> int:
            return math.lcm(*(one.period for one in channels_of(reduction, channels)))

        self._groups = {
            period: (own, bind(own.values(), column_of))
            for period, own in self._metrics.grouped(period_of).items()
        }

    def write(self, block: Block, signals: Matrix) -> None:
        """Go on over the rows of a block; its first one ended the block before."""
        first = 0 if block.index == 0 and not self._has_rows else 1
        if first > block.steps:
            return
        self._has_rows = True
        if signals.strides[1] != DOUBLE:  # chosen columns
            signals = np.ascontiguousarray(signals)
        for period, (_, reductions) in self._groups.items():
            begin = first + -(block.index + first) % period
            if begin > block.steps:
                continue
            rows = slice(begin, None, period)
            step_ns = period * self._step_ns
            if isinstance(step_ns, int):
                first_ns = int(block.time_ns[begin])
                reductions.add_regular(first_ns, step_ns, block.time[rows], signals[rows])
            else:  # as of its log
                reductions.add(np.ascontiguousarray(block.time_ns[rows]), signals[rows])

    def values(self) -> dict[str, float | None]:
        """Return the metrics of the rows so far; None: one has no value."""
        if self._layout is None:
            return dict.fromkeys(self._metrics.names)
        return self._metrics.values(self._groups.values())


@final
class Assertions:
    """What the metrics of a run must fulfil.

    Parameters
    ----------
    texts : iterable of str
        Comparisons of metrics with numbers, or with each other, joined by ``and``.
    known : mapping of name to text
        Metrics of a study, whose names may stand for them.

    Attributes
    ----------
    metrics : dict of str to str
        The metrics in them by name; those that are not known are named by their texts.

    Raises
    ------
    UsageError
        If a text is something else.
    """

    def __init__(self, texts: Iterable[str], known: Mapping[str, str] | None = None) -> None:
        names = known or {}
        self._comparisons = {}
        self.metrics: dict[str, str] = {}
        for text in texts:
            try:
                self._comparisons[text] = parse_comparisons(text, names)
            except UsageError as error:
                raise UsageError(f"{option('assert')}: {error}") from error
            for left, _, right in self._comparisons[text]:
                for name in (left, right):
                    if isinstance(name, str):
                        self.metrics[name] = names.get(name, name)

    def view(self, other: LiveView | None = None) -> AssertedView:
        """Return what measures a run while it goes on, beside another view of it."""
        return AssertedView(self, other)

    def problems(self, values: Mapping[str, float | None]) -> dict[str, str]:
        """Return by assertion the values of the metrics that do not fulfil it."""
        problems = {}
        for text, comparisons in self._comparisons.items():
            found: dict[str, None] = {}
            for left, holds, right in comparisons:
                names = [name for name in (left, right) if isinstance(name, str)]
                numbers = [values[one] if isinstance(one, str) else one for one in (left, right)]
                if None in numbers or not holds(*numbers):
                    for name in names:
                        value = values[name]
                        found[f"{name} = {'no value' if value is None else repr(value)}"] = None
            if found:
                problems[text] = ", ".join(found)
        return problems


@final
class AssertedView:
    """Measures a run for its assertions."""

    def __init__(self, assertions: Assertions, other: LiveView | None = None) -> None:
        self._assertions = assertions
        self._other = other
        self._recorder = MetricRecorder(parse_metrics(assertions.metrics, f"{option('assert')} "))

    def beside(self, recorder: Recorder, kinds: Mapping[str, str]) -> Recorder:
        """Return what measures a run, and passes it on."""
        shown = recorder if self._other is None else self._other.beside(recorder, kinds)
        return Tee(self._recorder, shown)

    @property
    def problems(self) -> dict[str, str]:
        """What is not fulfilled, and the values of its metrics."""
        return self._assertions.problems(self._recorder.values())
