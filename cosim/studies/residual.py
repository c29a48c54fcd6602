"""The residual at the samples on which its rows rest, and whether noise explains it.

Rows between samples, as recorded data and slow sensors have them, are linear combinations W of
samples: on straight lines between them, or held. Least squares over rows find values with the
errors ``C J'W e`` of the errors e of samples, and so with the covariance ``s^2 C B C``: C is the
inverse of ``J'J``, B is ``J'W W'J``. ``W'J`` follows from runs in which one value each is another;
where the samples are the rows W is 1, and none is needed.

W follows from the instants of samples that are in the run beside the rows. That the rows are W
times the samples is tested. Where they are not, or rest on samples that are not in the run, as
those of a table, nothing is known of their errors.

Where the samples have structure, as a wrong model leaves it, no interval holds
(:mod:`cosim.scenario.recordings.verdicts`). Where they are colored noise, N samples say as much
as N over its largest power at a frequency, relative to white noise: that is so for parameters whose
effect is at that frequency, and for all others there is more. So it is where one sample follows the
last one, too, as noise does that passes a filter of first order.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final, final

import numpy as np

from cosim.arrays import Matrix, Vector, as_columns
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.recorders import Memory
from cosim.core.signals import SAMPLE_TIMES, samples_of
from cosim.errors import RunError
from cosim.native.numerics.expression import Program
from cosim.native.numerics.programs import RowProgram
from cosim.studies.contracts import COMPLETE, StudyMember, StudySubject
from cosim.studies.members import opened
from cosim.studies.metrics import Reduction, find_element, parse_metric_text
from cosim.studies.study_file import load_scenario
from cosim.studies.workers import LocalExecutor

LEAST_ROWS: Final = 10


@dataclass(frozen=True, eq=False)
class SampledResidual:
    """The residual of a run at its samples.

    Parameters
    ----------
    rows : int
        Of which the rms is.
    rms : float
    t : Vector, shape (n,)
        Instants of the samples on which these rows rest [s].
    samples : Vector, shape (n,)
        The residual there.
    weighed : Vector, shape (n,), or None
        W' times the rows; None: the samples are the rows.
    problem : str
        Why they are not known; empty: they are.
    """

    rows: int
    rms: float
    t: Vector
    samples: Vector
    weighed: Vector | None = None
    problem: str = ""


@final
class Lines:
    """Values at instants, on lines between those of knots, of which the ends go on: the matrix W.

    Parameters
    ----------
    knots : Vector, shape (n,)
        Ascending.
    t : Vector, shape (N,)
        The instants.
    hold : bool
        Each value holds until the next one.
    """

    def __init__(self, knots: Vector, t: Vector, *, hold: bool) -> None:
        self._count = len(knots)
        self._before = np.maximum(np.searchsorted(knots, t, side="right") - 1, 0)
        self._after = np.minimum(self._before + 1, len(knots) - 1)
        first = knots[self._before]
        distance = np.where(self._after > self._before, knots[self._after] - first, 1.0)
        self._part = np.zeros(len(t)) if hold else ((t - first) / distance).clip(0.0, 1.0)

    def of(self, values: Vector) -> Vector:
        """Return W times the values of knots."""
        first = values[self._before]
        step = np.where(self._part > 0.0, values[self._after] - first, 0.0)
        return np.asarray(first + self._part * step, np.float64)

    def back(self, rows: Vector) -> Vector:
        """Return W' times values at the instants."""
        first = np.bincount(self._before, (1.0 - self._part) * rows, self._count)
        return np.asarray(first + np.bincount(self._after, self._part * rows, self._count))


# --- in the process of a member ---


def residual_of(subject: StudySubject, member: StudyMember) -> SampledResidual | None:
    """Run a member; return the residual that the first metric is the rms of, or None: it fails."""
    run = Memory()
    if opened(subject).run(member, sink=run).status != COMPLETE:
        return None
    reduction = _reduction(subject)
    of_residual = reduction.values
    assert isinstance(of_residual, Program)  # as of every rms
    ports = {name: find_element(run.channels, name, "the run") for name in reduction.signals}
    period = math.lcm(*(port.channel.period for port in ports.values()))
    t = _instants(run, period)
    values = {name: run[name][:: period // port.channel.period] for name, port in ports.items()}
    residual = _evaluated(of_residual, t, values)
    counts = ~np.isnan(residual)
    if reduction.where is not None:
        counts &= _evaluated(reduction.where.program, t, values) > 0.5
    own = residual[counts]
    rms = math.sqrt(float(np.mean(own**2))) if own.size else 0.0
    found = SampledResidual(own.size, rms, t[counts], own)

    each = {name: _samples(run, ports[name]) for name in of_residual.signals}
    samples = {name: columns for name, columns in each.items() if columns is not None}
    if not samples:
        return replace(found, problem=_unknown_samples(subject, run, each, t))
    knots = _knots(samples, t, values)
    if knots is None:
        names = " and ".join(samples)
        problem = f"the values of {names} are neither held nor on lines between common samples"
        return replace(found, problem=problem)
    instants, hold = knots
    at_samples = {}  # also of signals that have none: between the rows
    for name, port in ports.items():
        between = Lines(t, instants, hold=port.signal.variability == "discrete").of(values[name])
        at_samples[name] = samples[name][:, 2] if name in samples else between
    residual = _evaluated(of_residual, instants, at_samples)
    lines = Lines(instants, t[counts], hold=hold)
    is_used = (lines.back(np.ones(own.size)) > 0.0) & np.isfinite(residual)
    used = instants[is_used]
    weighed = None if np.array_equal(used, t[counts]) else lines.back(own)[is_used]
    return SampledResidual(own.size, rms, used, residual[is_used], weighed)


def _reduction(subject: StudySubject) -> Reduction:
    name, text = next(iter(subject.metrics.items()))
    return parse_metric_text(name, text).reductions[0]


def _evaluated(program: Program, t: Vector, values: Mapping[str, Vector]) -> Vector:
    rows = np.stack(list(values.values()), axis=1)
    columns = [list(values).index(name) for name in program.signals]
    bound = RowProgram(program.with_columns(columns))
    return bound.evaluate(np.ascontiguousarray(t), np.ascontiguousarray(rows))


def _instants(run: Memory, period: int) -> Vector:
    return run.grid.time(np.arange(0, run.steps + 1, period))


def _samples(run: Memory, port: RecordedPort) -> Matrix | None:
    """Return the samples of an element, shape (n, 3); None: it has no other values.

    Of each the instant of its row, its own, and its value.
    """
    channel, signal = port.channel, port.signal
    own = channel.by_name.get(samples_of(signal.name))
    if own is None:
        return None
    most = own.size // signal.size
    first = (channel.start + port.columns.start - channel.signal_columns[signal.name].start) * most
    values = as_columns(run[f"{channel.name}.{own.name}"])[:, first : first + most]
    rows = instants = np.repeat(_instants(run, channel.period)[:, np.newaxis], most, axis=1)
    if SAMPLE_TIMES in channel.by_name:
        instants = as_columns(run[f"{channel.name}.{SAMPLE_TIMES}"])
    is_there = np.isfinite(values)
    return np.stack([each[is_there] for each in (rows, instants, values)], axis=1)


def _unknown_samples(subject: StudySubject, run: Memory, signals: Iterable[str], t: Vector) -> str:
    """Return why rows of signals may rest on samples that are not known; empty: they do not.

    Signals follow those of other components, where theirs are values at the instant.
    """
    map_ = subject.map if subject.swap else {}
    scenario = load_scenario(subject.scenario).edit(swap=subject.swap, map=map_, set=subject.set)
    followed: set[str] = set()
    names = [name.partition(".")[0] for name in signals]
    while names:
        name = names.pop()
        spec = scenario.specs.get(name)
        if spec is None or name in followed:
            continue
        if spec.kind == "table":
            return (
                f"'{name}' is a table, whose samples are not in the run, so that errors of "
                'rows between them are not known; of kind "field-data" they are'
            )
        followed.add(name)
        names += scenario.drivers[name] if spec.hands_on_lag else []
    channels = [run.channels[name] for name in followed.intersection(run.channels)]
    for name in sorted(f"{c.name}.{s.name}" for c in channels for s in c.interface.outputs):
        samples = _samples(run, find_signal(run.channels, name, source=run.label))
        if samples is not None and not np.isin(t, samples[:, 1]).all():
            return (
                f"the residual follows {name}, which has samples between the rows, through "
                "other components, so that errors of its rows are not known; in a metric of "
                f"{name} itself they are"
            )
    return ""


def _knots(
    samples: Mapping[str, Matrix], t: Vector, rows: Mapping[str, Vector]
) -> tuple[Vector, bool] | None:
    """Return the instants of samples, and whether values are held between them, if rows show that.

    They are those of the first rows that have the samples, or else their own.
    """
    first, *others = samples.values()
    if not len(first) or any(not np.array_equal(first[:, :2], one[:, :2]) for one in others):
        return None
    for instants, hold in product(first[:, :2].T, (False, True)):
        if (np.diff(instants) <= 0.0).any():
            continue
        lines = Lines(instants, t, hold=hold)
        inside = (t >= instants[0]) & (t <= instants[-1])
        for name, each in samples.items():
            distance = np.abs(lines.of(each[:, 2]) - rows[name])[inside].max(initial=0.0)
            if distance > 1e-9 * np.abs(each[:, 2]).max():
                break
        else:
            return instants, hold
    return None


# --- of the best values ---


@dataclass(frozen=True, slots=True)
class ResidualCheck:
    """What noise a residual is.

    Parameters
    ----------
    rows : int
        Of which the rms is.
    samples : int
        On which they rest; 0: these are not known.
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


def check_residual(residual: SampledResidual) -> ResidualCheck | None:
    """Return what noise a residual is; None: it has hardly any rows, or is no noise at all."""
    from cosim.scenario.recordings.verdicts import residual_noise

    rows, samples = residual.rows, residual.samples.size
    if residual.problem:
        return ResidualCheck(rows, 0, 1.0, math.nan, residual.problem, 0, math.inf)
    largest = float(np.abs(residual.samples).max(initial=0.0))
    if rows < LEAST_ROWS or not 0.0 < largest < math.inf or not 0.0 < residual.rms < math.inf:
        return None
    if samples < LEAST_ROWS:
        few = f"{samples} samples are too few to tell whether noise explains the residual"
        return ResidualCheck(rows, samples, 1.0, math.nan, few, samples, math.inf)
    scaled = residual.samples / largest
    problem, power, freedom = residual_noise(residual.t, scaled)
    neighbours = float(scaled[1:] @ scaled[:-1]) / max(float(scaled @ scaled), np.finfo(float).tiny)
    size = min(abs(neighbours), 1.0 - 1.0 / samples)
    if size * math.sqrt(samples) > 2.6:  # 1 of 100 white ones: tests of many lags let it pass
        power = max(power, (1.0 + size) / (1.0 - size))
    ratio = math.sqrt(float(np.mean(scaled**2))) / (residual.rms / largest)
    independent = max(1, round(samples / power))
    return ResidualCheck(rows, samples, ratio, neighbours, problem, independent, freedom)


def residual_at(
    subject: StudySubject, members: Sequence[StudyMember], *, timeout: float | None = None
) -> tuple[ResidualCheck | None, Matrix | None]:
    """Return what noise the residual of the first member is, and how those of others differ.

    Returns
    -------
    ResidualCheck or None
        None: nothing is known of the rows.
    Matrix, shape (n, others), or None
        The differences, weighed; None: the samples are the rows, or not known.
    """
    where = _reduction(subject).where
    if where is not None and where.duration_ns:  # it depends on rows that are left out
        return None, None
    try:
        with LocalExecutor(subject, 1, timeout=timeout) as executor:
            ((_, found),) = executor.run(members[:1], residual_of)
            if not isinstance(found, SampledResidual):
                return None, None
            own = found.weighed
            if own is None:
                return check_residual(found), None
            others = [other for _, other in executor.run(members[1:], residual_of)]
    except RunError:  # such as a file that has changed: the result of the search stays
        return None, None
    columns = []
    for other in others:
        weighed = other.weighed if isinstance(other, SampledResidual) else None
        if weighed is None or not np.array_equal(other.t, found.t):
            problem = "how the residual moves with each value is not known: not all runs beside "
            found = replace(found, problem=f"{problem}the best values have the same rows")
            return check_residual(found), None
        columns.append(weighed - own)
    return check_residual(found), np.stack(columns, axis=1)
