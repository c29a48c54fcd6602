"""Whether the residual of the best values is white: one more run, which keeps its rows.

It runs in a worker as all members do. The test is that of Ljung and Box [1]_. How many samples
count as independent is their number over the integrated autocorrelation time, summed up to the
first lag that is five times as long [2]_: so it is for parameters that change the output slowly.

References
----------
.. [1] G. M. Ljung, G. E. P. Box, "On a measure of lack of fit in time series models", Biometrika 65
   (1978).
.. [2] A. Sokal, "Monte Carlo methods in statistical mechanics", 1996, section 3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Final, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block
from cosim.core.recorders import Nothing
from cosim.core.recording import Plan
from cosim.errors import RunError
from cosim.native.numerics.expression import ConditionProgram, Program
from cosim.native.numerics.programs import RowProgram
from cosim.studies.contracts import MemberRunner, MetricValue, StudyMember, StudySubject
from cosim.studies.members.runner import open_runner
from cosim.studies.metrics.binding import find_element
from cosim.studies.metrics.language import Reduction, parse_metric_text
from cosim.studies.workers.pool import WorkerPool

MOST_LAGS: Final = 20  # of the test
LEAST_ROWS: Final = 10
_WINDOW: Final = 5.0  # autocorrelation times
_OPENER: Final = f"{__name__}:open_residual_runner"


@dataclass(frozen=True, slots=True)
class ResidualCheck:
    """How the rows of a residual depend on each other.

    Parameters
    ----------
    rows : int
    neighbours : float
        Their correlation.
    lags : int
        Of the test.
    probability : float
        Of autocorrelations as large as these, if the rows were white.
    independent : int
        As many rows of white noise say as much of a mean.
    """

    rows: int
    neighbours: float
    lags: int
    probability: float
    independent: int


def check_rows(residual: Vector) -> ResidualCheck | None:
    """Return how the rows of a residual depend on each other.

    None: there are too few, or all are zero. Its mean is not removed: that of the noise is zero.
    """
    from scipy.stats import chi2

    rows = residual.size
    largest = float(np.abs(residual).max(initial=0.0))
    if rows < LEAST_ROWS or not 0.0 < largest < math.inf:
        return None
    padded = np.fft.rfft(residual / largest, 2 * rows)
    products = np.fft.irfft(np.abs(padded) ** 2, 2 * rows)[:rows]
    correlations = products[1:] / products[0]
    lags = min(MOST_LAGS, rows // 5)
    squares = correlations[:lags] ** 2 / (rows - np.arange(1, lags + 1))
    statistic = rows * (rows + 2) * float(squares.sum())
    times = 1.0 + 2.0 * np.cumsum(correlations)
    is_wide = np.arange(1, rows) >= _WINDOW * times
    time = float(times[int(is_wide.argmax()) if is_wide.any() else -1])
    return ResidualCheck(
        rows=rows,
        neighbours=float(correlations[0]),
        lags=lags,
        probability=float(chi2.sf(statistic, lags)),
        independent=max(1, round(rows / max(time, 1.0))),
    )


def residual_check(
    subject: StudySubject, objective: str, member: StudyMember, *, timeout: float | None = None
) -> ResidualCheck | None:
    """Return how the rows of the residual of a member depend on each other.

    None: it is not known, as the run failed or could not begin, its rows are chosen by a condition
    with a duration, or they are too few.

    Parameters
    ----------
    subject : StudySubject
    objective : str
        The name of its metric that is the rms of the residual.
    member : StudyMember
    timeout : float, optional
        Wall time that the run may take [s].
    """
    reduction = parse_metric_text(objective, subject.metrics[objective]).reductions[0]
    if reduction.where is not None and reduction.where.duration_ns:
        return None
    try:
        with WorkerPool(_OPENER, subject, 1, timeout=timeout) as pool:
            ((_, outcome),) = pool.run([member])
    except RunError:  # such as a file that has changed: the result of the search stays
        return None
    found = {name: value for name, value in outcome.metrics.items() if name in _FIELDS}
    return ResidualCheck(**found) if len(found) == len(_FIELDS) else None  # type: ignore[arg-type]


def open_residual_runner(subject: StudySubject) -> MemberRunner:
    """Return a runner whose metrics say how rows of the first metric depend on each other."""
    name, text = next(iter(subject.metrics.items()))
    reduction = parse_metric_text(name, text).reductions[0]
    return open_runner(subject, sink_of=lambda: ResidualRecorder(reduction))


_FIELDS: Final = tuple(field.name for field in fields(ResidualCheck))


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
        """Return what is known of the rows; empty: nothing."""
        residual = np.concatenate([*self._parts, np.empty(0)])
        found = check_rows(residual[~np.isnan(residual)])
        return {} if found is None else asdict(found)


def _bound(part: Program | ConditionProgram, columns: Mapping[str, int]) -> RowProgram:
    program = part.program if isinstance(part, ConditionProgram) else part
    return RowProgram(program.with_columns([columns[name] for name in program.signals]))
