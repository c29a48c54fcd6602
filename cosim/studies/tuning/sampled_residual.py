"""The residual of a run at the samples on which its rows rest.

Rows between samples, as recorded data and slow sensors have them, are linear combinations W of
samples: on straight lines between them, or held. Least squares over rows find values with the
errors ``C J'W e`` of the errors e of samples, and so with the covariance ``s^2 C B C``: C is the
inverse of ``J'J``, B is ``J'W W'J``. ``W'J`` follows from runs in which one value each is another;
where the samples are the rows W is 1, and none is needed.

W follows from the instants of samples that are in the run beside the rows. That the rows are W
times the samples is tested. Where they are not, or rest on samples that are not in the run, as
those of a table, nothing is known of their errors.
"""

from __future__ import annotations

import math
from base64 import b64decode, b64encode
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Final, Self, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.recorders import Nothing
from cosim.core.recording import Plan
from cosim.core.signals import SAMPLE_TIMES, samples_of
from cosim.native.numerics.expression import ConditionProgram, Program
from cosim.native.numerics.programs import RowProgram
from cosim.scenario.parsing import Scenario
from cosim.studies.contracts import MemberRunner, MetricValue, StudySubject
from cosim.studies.document.scenario_of_study import load_scenario
from cosim.studies.members.runner import open_runner
from cosim.studies.metrics import Reduction, find_element, parse_metric_text

ROUNDING: Final = 1e-9  # of the largest sample


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

    def to_metrics(self) -> dict[str, MetricValue]:
        """Return what JSON carries exactly."""
        arrays = (self.t, self.samples, self.weighed)
        t, samples, weighed = (b64encode(each.tobytes()).decode() for each in arrays)
        plain = {"rows": float(self.rows), "rms": self.rms, "are_rows": float(self.are_rows)}
        return {**plain, "t": t, "samples": samples, "weighed": weighed, "problem": self.problem}

    @classmethod
    def of_metrics(cls, metrics: Mapping[str, MetricValue]) -> Self | None:
        """Return what metrics carry; None: the run kept nothing."""
        match metrics:
            case {"rows": float(rows), "rms": float(rms), "are_rows": float(are_rows)}:
                arrays = (metrics[name] for name in ("t", "samples", "weighed"))
                t, samples, weighed = (np.frombuffer(b64decode(str(each))) for each in arrays)
                problem = str(metrics["problem"])
                return cls(int(rows), rms, t, samples, weighed, bool(are_rows), problem)
        return None


def open_residual_runner(subject: StudySubject) -> MemberRunner:
    """Return a runner whose metrics have the residual that the first metric is the rms of."""
    name, text = next(iter(subject.metrics.items()))
    reduction = parse_metric_text(name, text).reductions[0]
    scenario = load_scenario(subject.scenario).edit(
        swap=subject.swap, map=subject.map if subject.swap else {}, set=subject.set
    )
    sources = _sources(scenario, _program(reduction.values).signals)
    return open_runner(subject, sink_of=lambda: ResidualRecorder(reduction, sources))


def _sources(scenario: Scenario, signals: Iterable[str]) -> dict[str, str]:
    """Return the kinds of the components that signals are of, or their values at the instant."""
    found: dict[str, str] = {}
    names = [name.partition(".")[0] for name in signals]
    while names:
        name = names.pop()
        spec = scenario.specs.get(name)
        if spec is None or name in found:
            continue
        found[name] = spec.kind
        if spec.is_static:
            names += scenario.sources_of(name)
    return found


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
        if hold:
            return cls(before, after, np.zeros(len(t)), len(knots))
        distance = np.where(after > before, knots[after] - knots[before], 1.0)
        part = ((t - knots[before]) / distance).clip(0.0, 1.0)
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


@dataclass(frozen=True, eq=False)
class _Samples:
    """The samples of an element of a signal.

    Parameters
    ----------
    signal : str
        The element.
    places : slice
        The columns of a row that have them.
    times : slice or None
        Those with their instants; None: these are those of the rows.
    period : int
        Communication steps between the rows of its component.
    parts : list of Matrix, shape (N, 3)
        Of each sample the instant of its row, its own, and its value.
    """

    signal: str
    places: slice
    times: slice | None
    period: int
    parts: list[Matrix] = field(default_factory=list)

    @classmethod
    def of(cls, name: str, port: RecordedPort) -> Self | None:
        """Return those of the first element; None: it has no other values."""
        columns = port.channel.signal_columns
        samples = samples_of(port.signal.name)
        if samples not in columns:
            return None
        whole = columns[samples]
        most = (whole.stop - whole.start) // port.signal.size
        element = port.channel.start + port.columns.start - columns[port.signal.name].start
        places = slice(whole.start + element * most, whole.start + (element + 1) * most)
        return cls(name, places, columns.get(SAMPLE_TIMES), port.channel.period)

    def keep(self, block: Block, first: int, signals: Matrix) -> None:
        """Keep those in the rows of a block from number ``first`` on."""
        own = _rows_of(block, first, self.period)
        values = signals[own, self.places]
        t = np.repeat(block.time[own, np.newaxis], values.shape[1], axis=1)
        instants = t if self.times is None else signals[own, self.times]
        is_there = np.isfinite(values)
        self.parts.append(np.stack([each[is_there] for each in (t, instants, values)], axis=1))

    @property
    def kept(self) -> Matrix:
        """What was kept, shape (n, 3)."""
        return np.concatenate(self.parts)


@final
class ResidualRecorder(Nothing):
    """Keeps the residual of which a reduction is the rms; implements MetricSink.

    Parameters
    ----------
    reduction : Reduction
    sources : mapping of component to kind
        From which the values of the residual come at the same instant.
    """

    def __init__(self, reduction: Reduction, sources: Mapping[str, str]) -> None:
        self._reduction = reduction
        self._sources = sources
        self._period = 1
        self._columns: list[int] = []
        self._held: list[bool] = []
        self._sampled: list[_Samples] = []
        self._behind: list[_Samples] = []
        self._parts: list[tuple[Vector, Matrix]] = []

    def begin(self, plan: Plan) -> None:
        """Begin a run.

        Raises
        ------
        UsageError
            If it has not the signals of the reduction.
        """
        channels = {channel.name: channel for channel in plan.layout.channels}
        names = self._reduction.signals
        ports = {name: find_element(channels, name, "the run") for name in names}
        self._period = math.lcm(*(port.channel.period for port in ports.values()))
        self._columns = [port.channel.start + port.columns.start for port in ports.values()]
        self._held = [port.signal.variability == "discrete" for port in ports.values()]
        residual = _program(self._reduction.values).signals
        self._sampled = _with_samples({name: ports[name] for name in residual})
        behind = [
            f"{name}.{signal.name}"
            for name in self._sources.keys() & channels.keys()
            for signal in channels[name].interface.outputs
        ]
        self._behind = _with_samples(
            {name: find_signal(channels, name, source="the run") for name in sorted(behind)}
        )
        self._parts = []

    def write(self, block: Block, signals: Matrix) -> None:
        """Keep the values of the new rows, and the new samples."""
        first = 0 if not self._parts else 1
        own = _rows_of(block, first, self._period)
        self._parts.append((block.time[own].copy(), signals[own][:, self._columns]))
        for samples in (*self._sampled, *self._behind):
            samples.keep(block, first, signals)

    def values(self) -> dict[str, MetricValue]:
        """Return what is known of the rows; empty: nothing."""
        if not self._parts:
            return {}
        t, rows = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        residual = self._evaluated(self._reduction.values, t, rows)
        counts = ~np.isnan(residual)
        if self._reduction.where is not None:
            counts &= self._evaluated(self._reduction.where, t, rows) > 0.5
        own = residual[counts]
        rms = math.sqrt(float(np.mean(own**2))) if own.size else 0.0
        found = SampledResidual(own.size, rms, t[counts], own, own, are_rows=True)
        if not self._sampled:
            return replace(found, problem=self._unknown(t)).to_metrics()
        knots = self._knots(t, rows)
        if isinstance(knots, str):
            return replace(found, problem=knots).to_metrics()
        instants, hold = knots
        at_samples = self._evaluated(
            self._reduction.values, instants, self._rows_at(instants, t, rows)
        )
        lines = Lines.between(instants, t[counts], hold=hold)
        is_used = (lines.back(np.ones(own.size)) > 0.0) & np.isfinite(at_samples)
        used = instants[is_used]
        sampled = SampledResidual(
            rows=own.size,
            rms=rms,
            t=used,
            samples=at_samples[is_used],
            weighed=lines.back(own)[is_used],
            are_rows=np.array_equal(used, t[counts]),
        )
        return sampled.to_metrics()

    def _evaluated(self, part: Program | ConditionProgram, t: Vector, rows: Matrix) -> Vector:
        """Return values of kept rows."""
        program = _program(part)
        columns = [self._reduction.signals.index(name) for name in program.signals]
        bound = RowProgram(program.with_columns(columns))
        return bound.evaluate(np.ascontiguousarray(t), np.ascontiguousarray(rows))

    def _unknown(self, t: Vector) -> str:
        """Return why the rows may rest on samples that are not known; empty: they do not."""
        for name, kind in self._sources.items():
            if kind == "table":
                return (
                    f"'{name}' is a table, whose samples are not in the run, so that errors of "
                    'rows between them are not known; of kind "field-data" they are'
                )
        for samples in self._behind:
            if not np.isin(t, samples.kept[:, 1]).all():
                return (
                    f"the residual follows {samples.signal}, which has samples between the rows, "
                    "through other components, so that errors of its rows are not known; "
                    f"in a metric of {samples.signal} itself they are"
                )
        return ""

    def _knots(self, t: Vector, rows: Matrix) -> tuple[Vector, bool] | str:
        """Return the instants of the samples, and whether values are held between them.

        These are those of the first rows that have them, or else their own. A text says why neither
        explains the rows.
        """
        kept = {samples.signal: samples.kept for samples in self._sampled}
        first, *others = kept.values()
        names = " and ".join(kept)
        if not len(first) or any(not np.array_equal(first[:, :2], one[:, :2]) for one in others):
            return f"{names} have no samples, or not at the same instants"
        for own, hold in product((0, 1), (False, True)):
            instants = first[:, own]
            if (np.diff(instants) <= 0.0).any():
                continue
            lines = Lines.between(instants, t, hold=hold)
            inside = (t >= instants[0]) & (t <= instants[-1])
            if all(
                np.abs(lines.of(one[:, 2]) - rows[:, self._reduction.signals.index(name)])[
                    inside
                ].max(initial=0.0)
                <= ROUNDING * np.abs(one[:, 2]).max()
                for name, one in kept.items()
            ):
                return instants, hold
        return f"the values of {names} between their samples are neither on lines nor held"

    def _rows_at(self, instants: Vector, t: Vector, rows: Matrix) -> Matrix:
        """Return the values at the instants of samples: these, and all others between rows."""
        samples = {one.signal: one.kept[:, 2] for one in self._sampled}
        columns = []
        for name, held, column in zip(self._reduction.signals, self._held, rows.T, strict=True):
            between = Lines.between(t, instants, hold=held)
            columns.append(samples[name] if name in samples else between.of(column))
        return np.stack(columns, axis=1)


def _with_samples(ports: Mapping[str, RecordedPort]) -> list[_Samples]:
    """Return the samples of the signals that have some."""
    found = [_Samples.of(name, port) for name, port in ports.items()]
    return [samples for samples in found if samples is not None]


def _rows_of(block: Block, first: int, period: int) -> slice:
    """Return the rows of a block, from number ``first`` on, that come every ``period`` steps."""
    return slice(first + -(block.index + first) % period, block.steps + 1, period)


def _program(part: Program | ConditionProgram) -> Program:
    return part.program if isinstance(part, ConditionProgram) else part
