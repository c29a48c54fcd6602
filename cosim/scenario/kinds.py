"""The component kinds of a scenario: one table class each, with what it takes to build the component."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from pydantic import Field

from cosim.arrays import Vector
from cosim.blocks import arithmetic, dynamics, source
from cosim.blocks.controller import controller
from cosim.blocks.identifier import LeastSquaresIdentifier
from cosim.blocks.observer import observer_model
from cosim.blocks.plant import descriptor_model
from cosim.blocks.regressor import Regressor
from cosim.blocks.replay import Replay
from cosim.core.clock import whole_steps
from cosim.core.contracts import Component
from cosim.core.solver import SOLVERS, Linear, LinearModel
from cosim.errors import AssumptionError, UsageError, nearest
from cosim.native.expression import Program, compile_expression
from cosim.native.step import evaluate
from cosim.scenario.schema import Flag, Number, Row, Rows, Table, Whole, matrix
from cosim.theory import estimators, observer, regression
from cosim.theory.descriptor import DescriptorSystem, ReducedSystem, reduce
from cosim.theory.disturbance import Block, family_named, group

Size = Whole
HELD_LIMIT = 0.05  # filter_rate x step from which held inputs spoil the derivative by more than 2.5 %


class Site(Protocol):
    """What a kind may know about the scenario it is built in."""

    step_ns: int
    hold: str

    def model(self, name: str) -> DescriptorSystem:
        """Give a model of [models]."""
        ...

    def spec(self, name: str) -> Kind:
        """Give the table of another component."""
        ...

    def driver(self, to: str) -> str | None:
        """Give the component that drives an input, ``component.input``."""
        ...

    def file(self, path: str) -> Path:
        """Find a file named in the scenario."""
        ...

    def recording(self, path: str) -> Any:
        """Open a log."""
        ...

    def fmu(self, name: str, spec: Fmu) -> Component:
        """Load an FMU; it is freed when the run is over."""
        ...

    def note(self, name: str, **facts: Any) -> None:
        """Record a fact about a component for reports and the log."""
        ...

    def warn(self, name: str, text: str) -> None:
        """Say that a result will be right but poorly conditioned or costly."""
        ...


class Kind(Table):
    """A component's table."""

    sampled: ClassVar[bool] = False  # with a period: True, it lives on that step; False, it only answers less often
    kind: str

    @property
    def computable(self) -> bool:
        """Whether a log alone is enough to compute it again; if not, a replay takes it from the recording."""
        return True

    @property
    def own_step(self) -> float | None:
        """Its period [s], where it has one."""
        return None

    def build(self, name: str, site: Site) -> Component:
        """Build the component."""
        return Linear(self.linear_model(name, site))

    def linear_model(self, name: str, site: Site) -> LinearModel:
        """Give the component as a linear model, where it is one: what an exact solver steps and an FMU can be made of."""
        raise UsageError(
            f"{name!r} is of kind {self.kind!r}, which is no linear model; what can be exported: {', '.join(LINEAR)}"
        )


def _vector(value: float | Sequence[float]) -> list[float]:
    return [float(value)] if isinstance(value, (int, float)) else [float(v) for v in value]


# --- sources ---


class Constant(Kind):
    """y = value."""

    kind: Literal["constant"]
    value: Number | Row = Field(description="value, or values")
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        return source.constant(_vector(self.value), unit=self.unit)


class Step(Kind):
    """y jumps from before to after at time."""

    kind: Literal["step"]
    time: Number = Field(description="when it jumps [s]")
    before: Number = 0.0
    after: Number = 1.0
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        return source.step(time=self.time, before=self.before, after=self.after, unit=self.unit)


class Ramp(Kind):
    """y = offset + slope max(0, t - start)."""

    kind: Literal["ramp"]
    slope: Number = Field(description="slope [1/s]")
    start: Number = Field(0.0, description="when it begins [s]")
    offset: Number = 0.0
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        return source.ramp(slope=self.slope, start=self.start, offset=self.offset, unit=self.unit)


class Sine(Kind):
    """y = offset + amplitude sin(rate t + phase)."""

    kind: Literal["sine"]
    amplitude: Number = 1.0
    rate: Number = Field(description="angular rate [rad/s]")
    phase: Number = Field(0.0, description="phase [rad]")
    offset: Number = 0.0
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        return source.sine(amplitude=self.amplitude, rate=self.rate, phase=self.phase, offset=self.offset, unit=self.unit)


class Chirp(Kind):
    """y = offset + amplitude sin(rate t + sweep t^2 / 2)."""

    kind: Literal["chirp"]
    amplitude: Number = 1.0
    rate: Number = Field(description="angular rate at t = 0 [rad/s]")
    sweep: Number = Field(description="growth of the rate [rad/s^2]")
    offset: Number = 0.0
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        return source.chirp(amplitude=self.amplitude, rate=self.rate, sweep=self.sweep, offset=self.offset, unit=self.unit)


class Expression(Kind):
    """y = expressions in t."""

    kind: Literal["expression"]
    y: str | tuple[str, ...] = Field(description='an expression, like "1 + 0.5*sin(2*t)", or several')
    discrete: Flag = Field(False, description="holds its value over a step")
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        texts = [self.y] if isinstance(self.y, str) else list(self.y)
        return source.Expression(texts, variability="discrete" if self.discrete else "continuous", unit=self.unit)


class TableSource(Kind):
    """y on straight lines between given points: arrays, or a CSV file with a header line."""

    kind: Literal["table"]
    t: Row | None = Field(None, description="instants [s]")
    y: Row | Rows | None = Field(None, description="values, or rows of values, at those instants")
    file: str | None = Field(None, description="CSV file instead: first line names the columns")
    time: str = Field("t", description="column of the instants")
    columns: tuple[str, ...] | None = Field(None, description="columns of the values; all others if left out")
    hold: Flag = Field(False, description="keep each value until the next instant")
    unit: str | None = None

    @property
    def computable(self) -> bool:
        """A file is not in the log."""
        return self.file is None

    def build(self, name: str, site: Site) -> Component:
        if (self.file is None) == (self.t is None or self.y is None):
            raise UsageError("table: needed either t and y, or file")
        t, y = self._read(site.file(self.file)) if self.file is not None else self._given()
        return source.Table(t, y, hold=self.hold, unit=self.unit)

    def _given(self) -> tuple[Vector, Any]:
        y = self.y or ()
        rows = [row if isinstance(row, tuple) else (row,) for row in y]
        return np.array(self.t), matrix(tuple(rows), "y")

    def _read(self, path: Path) -> tuple[Vector, Any]:
        try:
            with path.open(encoding="utf-8") as stream:
                header = [cell.strip() for cell in stream.readline().split(",")]
                values = np.loadtxt(stream, delimiter=",", ndmin=2)
        except OSError as error:
            raise UsageError(f"file {str(path)!r} cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise UsageError(f"file {str(path)!r} is no table of numbers separated by commas: {error}") from error
        wanted = list(self.columns) if self.columns is not None else [column for column in header if column != self.time]
        for column in (self.time, *wanted):
            if column not in header:
                raise UsageError(f"file {str(path)!r} has no column {column!r}; {nearest(column, header)}")
        if values.shape[1] != len(header):
            raise UsageError(f"file {str(path)!r} has {len(header)} names and {values.shape[1]} columns; needed as many of both")
        return values[:, header.index(self.time)], values[:, [header.index(column) for column in wanted]]


class Noise(Kind):
    """y = Gaussian noise, a new value at every communication point."""

    kind: Literal["noise"]
    deviation: Number = Field(ge=0.0, description="standard deviation")
    seed: Whole = Field(ge=0, description="seed of the generator")
    size: Size = Field(1, ge=1, description="number of elements")
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        return source.Noise(deviation=self.deviation, seed=self.seed, size=self.size, unit=self.unit)


class DisturbanceTerm(Table):
    """One component alpha(t) f(theta, t) of (4)."""

    alpha: str = Field("1", description="known function of t")
    family: str = Field(description="exponential or sine")
    theta: Number = Field(description="the parameter: exponent [1/s], or rate [rad/s]")
    amplitude: Number = 1.0
    phase: Number = Field(0.0, description="of a sine [rad]")


class Disturbance(Kind):
    """y = sum of alpha(t) f(theta, t), the disturbance class (4)."""

    kind: Literal["disturbance"]
    terms: tuple[DisturbanceTerm, ...] = Field(description="list of { alpha, family, theta }")
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        texts = []
        for term in self.terms:
            compile_expression(term.alpha)
            family_named(term.family)
            shape = f"exp({term.theta!r}*t)" if term.family == "exponential" else f"sin({term.theta!r}*t + {term.phase!r})"
            texts.append(f"({term.alpha})*{term.amplitude!r}*{shape}")
        site.note(name, theta=[term.theta for term in self.terms])
        return source.Expression([" + ".join(texts)], unit=self.unit)


# --- small parts ---


class Sum(Kind):
    """y = signs[0] u1 + signs[1] u2 + ..."""

    kind: Literal["sum"]
    signs: Row = Field(description="one number an input, like [1, -1]")
    size: Size = Field(1, ge=1, description="number of elements of every signal")
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        return arithmetic.sum_of(self.signs, size=self.size, unit=self.unit)


class Gain(Kind):
    """y = K u."""

    kind: Literal["gain"]
    K: Number | Rows = Field(description="a number, or a matrix")
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        K = np.array([[self.K]]) if isinstance(self.K, (int, float)) else matrix(self.K, "K")
        return arithmetic.gain(K, unit=self.unit)


class Limit(Kind):
    """y = u within lower and upper."""

    kind: Literal["limit"]
    lower: Number = Field(description="lower limit")
    upper: Number = Field(description="upper limit")
    size: Size = Field(1, ge=1, description="number of elements")
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        return arithmetic.limit(lower=self.lower, upper=self.upper, size=self.size, unit=self.unit)


class Lag(Kind):
    """First-order lag: time_constant y' = u - y."""

    kind: Literal["lag"]
    time_constant: Number = Field(description="time constant [s]")
    start: Number | None = Field(None, description="y(0); left out: u(0)")
    size: Size = Field(1, ge=1, description="number of elements")
    unit: str | None = None

    def linear_model(self, name: str, site: Site) -> LinearModel:
        return dynamics.lag(time_constant=self.time_constant, start=self.start, size=self.size, unit=self.unit)


class Delay(Kind):
    """y(t) = u(t - delay)."""

    kind: Literal["delay"]
    delay: Number = Field(description="a whole number of communication steps [s]")
    initial: Number | None = Field(None, description="y until then; left out: u(0)")
    size: Size = Field(1, ge=1, description="number of elements")
    unit: str | None = None

    def build(self, name: str, site: Site) -> Component:
        return dynamics.Delay(
            whole_steps(self.delay, site.step_ns, "delay"), initial=self.initial, size=self.size, unit=self.unit
        )


class Controller(Kind):
    """Linear controller x' = A x + B u, y = C x + D u."""

    sampled: ClassVar[bool] = True
    kind: Literal["controller"]
    A: Rows = Field(description="matrix (n, n)")
    B: Rows = Field(description="matrix (n, inputs)")
    C: Rows = Field(description="matrix (outputs, n)")
    D: Rows | None = Field(None, description="matrix (outputs, inputs); left out: zero")
    x0: Row | None = Field(None, description="x(0); left out: zero")
    period: Number | None = Field(None, description="its own step [s]; left out: the communication step")
    unit: str | None = None

    @property
    def own_step(self) -> float | None:
        """Its period [s]."""
        return self.period

    def linear_model(self, name: str, site: Site) -> LinearModel:
        D = None if self.D is None else matrix(self.D, "D")
        x0 = None if self.x0 is None else np.array(self.x0)
        return controller(A=matrix(self.A, "A"), B=matrix(self.B, "B"), C=matrix(self.C, "C"), D=D, x0=x0, unit=self.unit)


# --- plants ---


class Plant(Kind):
    """What a replay takes from the recording."""

    @property
    def computable(self) -> bool:
        """It is not."""
        return False


class Descriptor(Plant):
    """Plant generated from a descriptor model: E x' = A x + Bu u + Bd delta, y = C x."""

    kind: Literal["descriptor"]
    model: str = Field(description="name of a table in [models]")
    x_a0: Row = Field(description="dynamic states at the start")
    solver: str = Field("exact", description=f"one of: {', '.join(SOLVERS)}")

    def build(self, name: str, site: Site) -> Component:
        from cosim.fmi.generated import GeneratedUnit
        from cosim.fmi.model_exchange import ModelExchange

        if self.solver not in SOLVERS:
            raise UsageError(f"solver: found {self.solver!r}; {nearest(self.solver, SOLVERS)}")
        return ModelExchange(GeneratedUnit.of(self.linear_model(name, site), name), solver=self.solver)

    def linear_model(self, name: str, site: Site) -> LinearModel:
        return descriptor_model(site.model(self.model), self.x_a0)


class Fmu(Plant):
    """A real FMU, FMI 2.0 or 3.0."""

    sampled: ClassVar[bool] = True
    kind: Literal["fmu"]
    path: str = Field(description="path of the .fmu")
    mode: Literal["me", "cs"] | None = Field(
        None, description="model exchange or co-simulation; left out: me where it is offered"
    )
    solver: str | None = Field(None, description=f"for model exchange, one of: {', '.join(SOLVERS)}")
    start: dict[str, Number] = Field({}, description="start values by variable")
    period: Number | None = Field(None, description="its own step [s]; left out: the communication step")

    @property
    def own_step(self) -> float | None:
        """Its period [s]."""
        return self.period

    def build(self, name: str, site: Site) -> Component:
        return site.fmu(name, self)


class Recording(Plant):
    """A component out of a recorded log."""

    kind: Literal["recording"]
    log: str = Field(description="path of the .mcap")
    component: str = Field(description="name of the component in the log")

    def build(self, name: str, site: Site) -> Component:
        return Replay(site.recording(self.log), self.component)


# --- the method ---


class UnknownInputObserver(Kind):
    """Unknown-input observer with disturbance reconstruction (18)-(20)."""

    kind: Literal["unknown-input-observer"]
    model: str = Field(description="name of a table in [models]: what the observer believes")
    L: Row | Rows | None = Field(None, description="gain; or give poles")
    poles: Row | None = Field(None, description="eigenvalues of M - L C3 that L can move [1/s]")
    x_a0: Row | None = Field(None, description="first estimate; left out: consistent with y(0)")
    filter_rate: Number = Field(description="lambda_f of the derivative filter (19) [rad/s]")
    q0: Row | None = Field(None, description="start of the filter; left out: at the signal")

    def linear_model(self, name: str, site: Site) -> LinearModel:
        reduced, design = self.design(site)
        h = site.step_ns / 1e9
        site.note(
            name,
            eigenvalues=[str(complex(v)) if v.imag else float(v.real) for v in design.eigenvalues],
            fixed_modes=[str(complex(v)) if v.imag else float(v.real) for v in design.fixed_modes],
            lambda_obs=design.lambda_obs,
        )
        if site.hold == "start" and self.filter_rate * h > HELD_LIMIT:
            site.warn(
                name,
                f"filter_rate x step = {self.filter_rate * h:g} with held inputs: the derivative filter reads a ramp "
                f'{self.filter_rate * h / -math.expm1(-self.filter_rate * h) - 1.0:.0%} too high; use hold = "line"',
            )
        return observer_model(reduced, design, x_a0=self.x_a0, q0=self.q0)

    def design(self, site: Site) -> tuple[ReducedSystem, observer.ObserverDesign]:
        """Design the observer (14)-(18)."""
        reduced = reduce(site.model(self.model))
        L = None if self.L is None else np.array(self.L, dtype=np.float64)
        return reduced, observer.design(reduced, L=L, poles=self.poles, filter_rate=self.filter_rate)


class RegressorTerm(Table):
    """One component of the disturbance class (4), its parameter unknown."""

    alpha: str = Field("1", description="known function of t")
    family: str = Field(description="exponential or sine")


class RegressorKind(Kind):
    """From delta to the known signals mu of the regression (21)-(25)."""

    kind: Literal["regressor"]
    terms: tuple[RegressorTerm, ...] = Field(description="list of { alpha, family }")
    delays: Row = Field(description="D_j [s], one more than basis functions, whole communication steps")

    def build(self, name: str, site: Site) -> Component:
        blocks, terms = self.regression()
        steps = [whole_steps(delay, site.step_ns, f"delays[{j}]") for j, delay in enumerate(self.delays)]
        programs = [compile_expression(block.alpha) for block in blocks]
        if len(blocks) > 1:
            regression.collinear(terms, self._alphas(programs), [block.alpha for block in blocks])
        warning = regression.linear_route([block.size for block in blocks])
        if warning:
            site.warn(name, warning)
        return Regressor(terms, alphas=programs, steps=steps, delays=self.delays)

    def regression(self) -> tuple[tuple[Block, ...], tuple[regression.Term, ...]]:
        """Expand the determinant for the terms given."""
        families = [family_named(term.family) for term in self.terms]
        blocks = group([term.alpha for term in self.terms], families)
        sizes = tuple(block.size for block in blocks)
        regression.check_delays(self.delays, sum(sizes) + 1)
        return blocks, regression.expand(sizes)

    def _alphas(self, programs: Sequence[Program]) -> Any:
        """Sample alpha_b(t - D_j) on a grid that no period of the alphas divides."""
        grid = np.arange(512) * math.sqrt(2.0) / 7.0
        return np.array([[[evaluate(p, t - D) for p in programs] for D in self.delays] for t in grid])


class StartTable(Table):
    """Start of identification by (36)-(38)."""

    epsilon_observer: Number = Field(description="fraction of the first observer error that may remain, in (0, 1)")
    epsilon_filter: Number = Field(description="fraction of the first filter transient that may remain, in (0, 1)")


class Identifier(Kind):
    """Identifier of theta by least squares (33)-(35)."""

    kind: Literal["identifier"]
    method: Literal["least-squares"] = Field(description='how theta is estimated: "least-squares"')
    P0: Number | None = Field(None, description="P(0) = P0 I (34); left out: no prior")
    start: Number | StartTable = Field(description="T_id [s], or { epsilon_observer, epsilon_filter } for (36)-(38)")
    period: Number | None = Field(None, description="seconds between two answers; left out: every communication step")

    @property
    def own_step(self) -> float | None:
        """Its period [s]."""
        return self.period

    def build(self, name: str, site: Site) -> Component:
        source_name = site.driver(f"{name}.regressor")
        spec = site.spec(source_name) if source_name is not None else None
        if not isinstance(spec, RegressorKind):
            raise UsageError("'regressor' must be driven directly by a component of kind 'regressor', whose terms it identifies")
        assert source_name is not None
        blocks, terms = spec.regression()
        recovery = estimators.plan(terms, blocks, spec.delays)
        start = self._start(name, source_name, spec, site)
        site.note(name, P0=self.P0, unknowns=recovery.n_eta)
        return LeastSquaresIdentifier(recovery, start=start, P0=self.P0)

    def _start(self, name: str, regressor: str, spec: RegressorKind, site: Site) -> float:
        """Give the first communication point not before T_id."""
        longest = max(spec.delays)
        if isinstance(self.start, StartTable):
            observer_name = site.driver(f"{regressor}.delta")
            found = site.spec(observer_name) if observer_name is not None else None
            if not isinstance(found, UnknownInputObserver):
                raise UsageError("start: (36)-(38) need an observer that drives the regressor; give start as a time in s instead")
            _, design = found.design(site)
            times = observer.start_time(
                lambda_obs=design.lambda_obs,
                filter_rate=found.filter_rate,
                delays=spec.delays,
                epsilon_observer=self.start.epsilon_observer,
                epsilon_filter=self.start.epsilon_filter,
            )
            site.note(name, T_obs=times.T_obs, T_f=times.T_f, D_max=times.D_max, T_id=times.T_id)
            wanted = times.T_id
        else:
            wanted = float(self.start)
        if wanted < longest:
            raise AssumptionError(
                f"start: found {wanted} s, needed at least the longest delay, {longest} s: before it the regressor has no value"
            )
        first = math.ceil(round(wanted * 1e9, 3) / site.step_ns) * site.step_ns / 1e9
        site.note(name, start=first)
        return first


KINDS: Mapping[str, type[Kind]] = {
    cls.model_fields["kind"].annotation.__args__[0]: cls  # type: ignore[union-attr]
    for cls in (
        Constant, Step, Ramp, Sine, Chirp, Expression, TableSource, Noise, Disturbance, Sum, Gain, Limit, Lag, Delay, Controller,
        Descriptor, Fmu, Recording, UnknownInputObserver, RegressorKind, Identifier,
    )
}  # fmt: skip

LINEAR = ("descriptor", "unknown-input-observer", "controller", "lag")
