"""What noise the residual of the best values is: one more run, which keeps its rows.

It runs in a worker as all members do. Of signals that are interpolated or held between samples, as
those of recorded data and of slow sensors are, only the rows with new samples count. The tests are
those of identification (:mod:`cosim.scenario.identification.residual`): where the residual has
structure, as a wrong model leaves it, no interval holds. Where it is colored noise, N samples say
as much as N over its largest power at a frequency, relative to white noise: that is so for
parameters whose effect is at that frequency, and for all others there is more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Final, final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Block
from cosim.core.recorded.signals import RecordedPort
from cosim.core.recorders import Nothing
from cosim.core.recording import Plan
from cosim.core.signals import samples_of
from cosim.errors import RunError
from cosim.native.numerics.expression import ConditionProgram, Program
from cosim.native.numerics.programs import RowProgram
from cosim.studies.contracts import MemberRunner, MetricValue, StudyMember, StudySubject
from cosim.studies.members.runner import open_runner
from cosim.studies.metrics.binding import find_element
from cosim.studies.metrics.language import Reduction, parse_metric_text
from cosim.studies.workers.pool import WorkerPool

LEAST_ROWS: Final = 10
TINY: Final = float(np.finfo(np.float64).tiny)
_OPENER: Final = f"{__name__}:open_residual_runner"


@dataclass(frozen=True, slots=True)
class ResidualCheck:
    """What noise a residual is.

    Parameters
    ----------
    rows : int
        Of which the rms is.
    samples : int
        Rows with new samples.
    ratio : float
        Of their rms over that of all rows: lines between samples average the noise.
    neighbours : float
        The correlation of one sample with the next.
    problem : str
        Why it is not what noise leaves; empty: it is.
    independent : int
        As many samples of white noise say as much; all of them where it is white.
    freedom : float
        Degrees of freedom with which that is known.
    """

    rows: int
    samples: int
    ratio: float
    neighbours: float
    problem: str
    independent: int
    freedom: float


def check_rows(t: Vector, residual: Vector, is_sample: Mask) -> ResidualCheck | None:
    """Return what noise a residual is.

    None: there are too few rows, or all are zero. Its mean is not removed: that of noise is 0.

    Parameters
    ----------
    t : Vector, shape (N,)
        Instants of the rows [s].
    residual : Vector, shape (N,)
    is_sample : Mask, shape (N,)
        Rows with new samples.
    """
    from cosim.scenario.identification.residual import residual_noise  # takes long to import

    rows = residual.size
    largest = float(np.abs(residual).max(initial=0.0))
    if rows < LEAST_ROWS or not 0.0 < largest < math.inf:
        return None
    whole = residual / largest
    scaled = whole[is_sample]
    samples = scaled.size
    if samples < LEAST_ROWS:
        few = f"{samples} samples are too few to tell whether noise explains the residual"
        return ResidualCheck(rows, samples, 1.0, math.nan, few, samples, math.inf)
    problem, power, freedom = residual_noise(t[is_sample], scaled)
    return ResidualCheck(
        rows=rows,
        samples=samples,
        ratio=math.sqrt(float(np.mean(scaled**2)) / float(np.mean(whole**2))),
        neighbours=float(scaled[1:] @ scaled[:-1]) / max(float(scaled @ scaled), TINY),
        problem=problem,
        independent=max(1, round(samples / power)),
        freedom=freedom,
    )


def residual_check(
    subject: StudySubject, objective: str, member: StudyMember, *, timeout: float | None = None
) -> ResidualCheck | None:
    """Return what noise the residual of a member is.

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
    """Return a runner whose metrics say what noise the first metric is the rms of."""
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
        self._sampled: list[slice] = []
        self._parts: list[tuple[Vector, Vector, Mask]] = []

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
        self._sampled = [own for own in map(_sample_columns, ports.values()) if own is not None]
        self._parts = []

    def write(self, block: Block, signals: Matrix) -> None:
        """Keep the values of the new rows."""
        assert self._values is not None
        first = 0 if not self._parts else 1
        begin = first + -(block.index + first) % self._period
        rows = np.ascontiguousarray(signals[begin : block.steps + 1 : self._period])
        times = np.ascontiguousarray(block.time[begin : block.steps + 1 : self._period])
        values = self._values.evaluate(times, rows)
        is_sample = np.full(len(rows), not self._sampled)
        for places in self._sampled:
            is_sample |= np.isfinite(rows[:, places]).any(axis=1)
        counts = ~np.isnan(values)
        if self._where is not None:
            counts &= self._where.evaluate(times, rows) > 0.5
        self._parts.append((times[counts], values[counts], is_sample[counts]))

    def values(self) -> dict[str, MetricValue]:
        """Return what is known of the rows; empty: nothing."""
        if not self._parts:
            return {}
        t, residual, is_sample = map(np.concatenate, zip(*self._parts, strict=True))
        found = check_rows(t, residual, is_sample)
        return {} if found is None else asdict(found)


def _sample_columns(port: RecordedPort) -> slice | None:
    """Return the columns that have the samples of an element; None: it has no other values."""
    name = samples_of(port.signal.name)
    columns = port.channel.signal_columns
    if name not in columns:
        return None
    whole = columns[name]
    most = (whole.stop - whole.start) // port.signal.size
    element = port.channel.start + port.columns.start - columns[port.signal.name].start
    first = whole.start + element * most
    return slice(first, first + most)


def _bound(part: Program | ConditionProgram, columns: Mapping[str, int]) -> RowProgram:
    program = part.program if isinstance(part, ConditionProgram) else part
    return RowProgram(program.with_columns([columns[name] for name in program.signals]))
