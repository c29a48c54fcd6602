"""Whether the residual of the best values is white: one more run, which keeps its rows.

It runs in a worker as all members do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block
from cosim.core.recorders import Nothing
from cosim.core.recording import Plan
from cosim.native.numerics.expression import ConditionProgram, Program
from cosim.native.numerics.programs import RowProgram
from cosim.studies.contracts import MemberRunner, MetricValue, StudyMember, StudySubject
from cosim.studies.members.runner import open_runner
from cosim.studies.metrics.binding import find_element
from cosim.studies.metrics.language import Reduction, parse_metric_text
from cosim.studies.workers.pool import WorkerPool

LAG_1: Final = "lag 1"
_OPENER: Final = f"{__name__}:open_residual_runner"


def residual_correlation(
    subject: StudySubject, objective: str, member: StudyMember
) -> float | None:
    """Return how neighbours of the residual of a member correlate.

    None: it is not known, as the run failed, or its rows are chosen by a condition with a duration.

    Parameters
    ----------
    subject : StudySubject
    objective : str
        The name of its metric that is the rms of the residual.
    member : StudyMember
    """
    reduction = parse_metric_text(objective, subject.metrics[objective]).reductions[0]
    if reduction.where is not None and reduction.where.duration_ns:
        return None
    with WorkerPool(_OPENER, subject, 1) as pool:
        for outcome in pool.run([member]):
            value = outcome.metrics.get(LAG_1)
            return value if isinstance(value, float) else None
    return None


def open_residual_runner(subject: StudySubject) -> MemberRunner:
    """Return a runner whose metric is the correlation of neighbours of the first metric's rows."""
    name, text = next(iter(subject.metrics.items()))
    reduction = parse_metric_text(name, text).reductions[0]
    return open_runner(subject, sink_of=lambda: ResidualRecorder(reduction))


@final
class ResidualRecorder(Nothing):
    """Keeps the values of which a reduction is; implements MetricSink.

    Parameters
    ----------
    reduction : Reduction
    """

    def __init__(self, reduction: Reduction) -> None:
        self._reduction = reduction
        self._period = 1
        self._values: RowProgram | None = None
        self._where: RowProgram | None = None
        self._parts: list[Vector] = []

    def begin(self, plan: Plan) -> None:
        """Begin a run.

        Raises
        ------
        UsageError
            If it has not the signals of the reduction.
        """
        channels = {channel.name: channel for channel in plan.layout.channels}
        ports = {name: find_element(channels, name, "the run") for name in self._reduction.signals}
        self._period = math.lcm(*(port.channel.period for port in ports.values()))
        columns = {
            name: int(port.channel.start + port.columns.start) for name, port in ports.items()
        }
        self._values = _bound(self._reduction.values, columns)
        where = self._reduction.where
        self._where = None if where is None else _bound(where, columns)
        self._parts = []

    def write(self, block: Block, signals: Matrix) -> None:
        """Keep the values of the new rows."""
        assert self._values is not None
        first = 0 if not self._parts else 1
        begin = first + -(block.index + first) % self._period
        rows = np.ascontiguousarray(signals[begin : block.steps + 1 : self._period])
        times = np.ascontiguousarray(block.time[begin : block.steps + 1 : self._period])
        values = self._values.evaluate(times, rows)
        if self._where is not None:
            values = values[self._where.evaluate(times, rows) > 0.5]
        self._parts.append(values)

    def values(self) -> dict[str, MetricValue]:
        """Return the correlation; None: the values do not vary."""
        residual = np.concatenate([*self._parts, np.empty(0)])
        squares = float(residual @ residual)
        if not squares > 0.0:
            return {LAG_1: None}
        return {LAG_1: float(residual[1:] @ residual[:-1]) / squares}


def _bound(part: Program | ConditionProgram, columns: Mapping[str, int]) -> RowProgram:
    program = part.program if isinstance(part, ConditionProgram) else part
    return RowProgram(program.with_columns([columns[name] for name in program.signals]))
