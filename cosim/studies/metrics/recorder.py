"""The metrics of a run while it advances: its rows are reduced as they come, and not kept."""

from __future__ import annotations

from typing import final

import numpy as np

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.recorders import Nothing
from cosim.core.recording import Plan
from cosim.core.signals import Layout
from cosim.instants import StepNs
from cosim.native.numerics.reductions import KeptValues
from cosim.native.step import DOUBLE
from cosim.studies.metrics.binding import BoundReductions, bind_layout
from cosim.studies.metrics.metrics import Metrics


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
