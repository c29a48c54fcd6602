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
(:mod:`cosim.scenario.identification.residual`). Where they are colored noise, N samples say as much
as N over its largest power at a frequency, relative to white noise: that is so for parameters whose
effect is at that frequency, and for all others there is more. So it is where one sample follows the
last one, too, as noise does that passes a filter of first order.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final, Self, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector, as_columns
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.recorders import Memory
from cosim.core.signals import SAMPLE_TIMES, samples_of
from cosim.errors import RunError
from cosim.native.numerics.expression import ConditionProgram, Program
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
    weighed : Vector, shape (n,)
        W' times the rows.
    are_rows : bool
        The samples are the rows.
    problem : str
        Why they are not known; empty: they are.
    """

    rows: int
    rms: float
    t: Vector
    samples: Vector
    weighed: Vector
    are_rows: bool
    problem: str = ""


@dataclass(frozen=True, eq=False)
class Lines:
    """Values at instants, on lines between those of knots, of which the ends go on: the matrix W.

    Parameters
    ----------
    before, after : array of int, shape (N,)
        The knots beside each instant.
    part : Vector, shape (N,)
        The weight of the latter.
    count : int
        Of knots.
    """

    before: NDArray[np.intp]
    after: NDArray[np.intp]
    part: Vector
    count: int

    @classmethod
    def between(cls, knots: Vector, t: Vector, *, hold: bool) -> Self:
        """Return the lines between ascending knots; with ``hold`` each value until the next."""
        before = np.maximum(np.searchsorted(knots, t, side="right") - 1, 0)
        after = np.minimum(before + 1, len(knots) - 1)
        distance = np.where(after > before, knots[after] - knots[before], 1.0)
        part = np.zeros(len(t)) if hold else ((t - knots[before]) / distance).clip(0.0, 1.0)
        return cls(before, after, part, len(knots))

    def of(self, values: Vector) -> Vector:
        """Return W times the values of knots."""
        first = values[self.before]
        step = np.where(self.part > 0.0, values[self.after] - first, 0.0)
        return np.asarray(first + self.part * step, np.float64)

    def back(self, rows: Vector) -> Vector:
        """Return W' times values at the instants."""
        first = np.bincount(self.before, (1.0 - self.part) * rows, self.count)
        return np.asarray(first + np.bincount(self.after, self.part * rows, self.count), np.float64)


# --- in the process of a member ---


def residual_of(subject: StudySubject, member: StudyMember) -> SampledResidual | None:
    """Run a member; return the residual that the first metric is the rms of, or None: it fails."""
    reduction = _reduction(subject)
    kinds = _kinds(subject, _program(reduction.values).signals)
    run = Memory()
    if opened(subject).run(member, sink=run).status != COMPLETE:
        return None
    return _Residual(run, reduction).sampled(kinds)


def _reduction(subject: StudySubject) -> Reduction:
    name, text = next(iter(subject.metrics.items()))
    return parse_metric_text(name, text).reductions[0]


def _program(part: Program | ConditionProgram) -> Program:
    return part.program if isinstance(part, ConditionProgram) else part


def _kinds(subject: StudySubject, signals: Iterable[str]) -> dict[str, str]:
    """Return the kinds of the components that signals are of, or their values at the instant."""
    map_ = subject.map if subject.swap else {}
    scenario = load_scenario(subject.scenario).edit(swap=subject.swap, map=map_, set=subject.set)
    kinds: dict[str, str] = {}
    names = [name.partition(".")[0] for name in signals]
    while names:
        name = names.pop()
        spec = scenario.specs.get(name)
        if spec is not None and name not in kinds:
            kinds[name] = spec.kind
            names += scenario.sources_of(name) if spec.is_static else []
    return kinds


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


def _instants(run: Memory, period: int) -> Vector:
    return run.grid.time(np.arange(0, run.steps + 1, period))


@final
class _Residual:
    """The residual of a reduction in a run."""

    def __init__(self, run: Memory, reduction: Reduction) -> None:
        self._run = run
        self._reduction = reduction
        names = reduction.signals
        ports = {name: find_element(run.channels, name, "the run") for name in names}
        periods = {name: port.channel.period for name, port in ports.items()}
        period = math.lcm(*periods.values())
        self._t = _instants(run, period)
        self._rows = np.stack([run[n][:: period // p] for n, p in periods.items()], axis=1)
        self._held = [port.signal.variability == "discrete" for port in ports.values()]
        found = {name: _samples(run, ports[name]) for name in _program(reduction.values).signals}
        self._samples = {name: each for name, each in found.items() if each is not None}

    def sampled(self, kinds: dict[str, str]) -> SampledResidual:
        """Return it at the samples; ``kinds`` are those of the components that it follows."""
        t = self._t
        residual = self._evaluated(self._reduction.values, t, self._rows)
        counts = ~np.isnan(residual)
        if self._reduction.where is not None:
            counts &= self._evaluated(self._reduction.where, t, self._rows) > 0.5
        own = residual[counts]
        rms = math.sqrt(float(np.mean(own**2))) if own.size else 0.0
        found = SampledResidual(own.size, rms, t[counts], own, own, are_rows=True)
        if not self._samples:
            return replace(found, problem=self._unknown(kinds))
        knots = self._knots()
        if isinstance(knots, str):
            return replace(found, problem=knots)
        instants, hold = knots
        rows = self._rows_at(instants)
        at_samples = self._evaluated(self._reduction.values, instants, rows)
        lines = Lines.between(instants, t[counts], hold=hold)
        is_used = (lines.back(np.ones(own.size)) > 0.0) & np.isfinite(at_samples)
        used = instants[is_used]
        weighed = lines.back(own)[is_used]
        are_rows = np.array_equal(used, t[counts])
        return SampledResidual(own.size, rms, used, at_samples[is_used], weighed, are_rows)

    def _evaluated(self, part: Program | ConditionProgram, t: Vector, rows: Matrix) -> Vector:
        program = _program(part)
        columns = [self._reduction.signals.index(name) for name in program.signals]
        bound = RowProgram(program.with_columns(columns))
        return bound.evaluate(np.ascontiguousarray(t), np.ascontiguousarray(rows))

    def _unknown(self, kinds: dict[str, str]) -> str:
        """Return why the rows may rest on samples that are not known; empty: they do not."""
        for name, kind in kinds.items():
            if kind == "table":
                return (
                    f"'{name}' is a table, whose samples are not in the run, so that errors of "
                    'rows between them are not known; of kind "field-data" they are'
                )
        run = self._run
        channels = [run.channels[name] for name in kinds if name in run.channels]
        for name in sorted(f"{c.name}.{s.name}" for c in channels for s in c.interface.outputs):
            samples = _samples(run, find_signal(run.channels, name, source=run.label))
            if samples is not None and not np.isin(self._t, samples[:, 1]).all():
                return (
                    f"the residual follows {name}, which has samples between the rows, through "
                    "other components, so that errors of its rows are not known; in a metric of "
                    f"{name} itself they are"
                )
        return ""

    def _knots(self) -> tuple[Vector, bool] | str:
        """Return the instants of the samples, and whether values are held between them.

        These are those of the first rows that have them, or else their own. A text says why neither
        explains the rows.
        """
        first, *others = self._samples.values()
        names = " and ".join(self._samples)
        if not len(first) or any(not np.array_equal(first[:, :2], one[:, :2]) for one in others):
            return f"{names} have no samples, or not at the same instants"
        for own, hold in product((0, 1), (False, True)):
            instants = first[:, own]
            if (np.diff(instants) <= 0.0).any():
                continue
            lines = Lines.between(instants, self._t, hold=hold)
            inside = (self._t >= instants[0]) & (self._t <= instants[-1])
            for name, samples in self._samples.items():
                rows = self._rows[:, self._reduction.signals.index(name)]
                distance = np.abs(lines.of(samples[:, 2]) - rows)[inside].max(initial=0.0)
                if distance > 1e-9 * np.abs(samples[:, 2]).max():
                    break
            else:
                return instants, hold
        return f"the values of {names} between their samples are neither on lines nor held"

    def _rows_at(self, instants: Vector) -> Matrix:
        """Return the values at the instants of samples: these, and all others between rows."""
        columns = []
        names = self._reduction.signals
        for name, held, column in zip(names, self._held, self._rows.T, strict=True):
            between = Lines.between(self._t, instants, hold=held).of(column)
            columns.append(self._samples[name][:, 2] if name in self._samples else between)
        return np.stack(columns, axis=1)


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
    from cosim.scenario.identification.residual import residual_noise  # takes long to import

    rows = residual.rows
    if residual.problem:
        return ResidualCheck(rows, 0, 1.0, math.nan, residual.problem, 0, math.inf)
    largest = float(np.abs(residual.samples).max(initial=0.0))
    if rows < LEAST_ROWS or not 0.0 < largest < math.inf or not 0.0 < residual.rms < math.inf:
        return None
    scaled = residual.samples / largest
    samples = scaled.size
    if samples < LEAST_ROWS:
        few = f"{samples} samples are too few to tell whether noise explains the residual"
        return ResidualCheck(rows, samples, 1.0, math.nan, few, samples, math.inf)
    problem, power, freedom = residual_noise(residual.t, scaled)
    neighbours = float(scaled[1:] @ scaled[:-1]) / max(float(scaled @ scaled), np.finfo(float).tiny)
    size = min(abs(neighbours), 1.0 - 1.0 / samples)
    if (
        size * math.sqrt(samples) > 2.6
    ):  # as 1 of 100 white ones has; tests of many lags let it pass
        power = max(power, (1.0 + size) / (1.0 - size))
    ratio = math.sqrt(float(np.mean(scaled**2))) / (residual.rms / largest)
    independent = max(1, round(samples / power))
    return ResidualCheck(rows, samples, ratio, neighbours, problem, independent, freedom)


def residual_at(
    subject: StudySubject, members: Sequence[StudyMember], *, timeout: float | None = None
) -> tuple[SampledResidual, Matrix | None] | None:
    """Return the residual of the first member, and how those of others differ, weighed.

    That of one column each is None where the samples are the rows, or not known; all is None where
    nothing is known of the rows.
    """
    where = _reduction(subject).where
    if where is not None and where.duration_ns:  # it depends on rows that are left out
        return None
    try:
        with LocalExecutor(subject, 1, timeout=timeout) as executor:
            ((_, found),) = executor.run(members[:1], residual_of)
            if not isinstance(found, SampledResidual):
                return None
            if found.are_rows:
                return found, None
            others = [other for _, other in executor.run(members[1:], residual_of)]
    except RunError:  # such as a file that has changed: the result of the search stays
        return None
    columns = []
    for other in others:
        if not isinstance(other, SampledResidual) or not np.array_equal(other.t, found.t):
            problem = "how the residual moves with each value is not known: not all runs beside "
            return replace(found, problem=f"{problem}the best values have the same rows"), None
        columns.append(other.weighed - found.weighed)
    return found, np.stack(columns, axis=1)
