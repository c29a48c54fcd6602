"""Sources: kinds without inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from decimal import Decimal
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix, Vector
from cosim.blocks import source
from cosim.blocks.derived import derived, signals_of
from cosim.blocks.regressor import alpha_signals
from cosim.blocks.sampled import Sampled
from cosim.core.connections import Connection
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import SignalType, Variability
from cosim.errors import GraphError, UsageError
from cosim.native.blocks.functions import LinearResponse
from cosim.native.estimation.alphas import Alpha, AlphaSignal
from cosim.native.numerics.expression import FUNCTIONS, compile_expression
from cosim.native.numerics.jumps import depends_on_time, jumps, jumps_with_signals
from cosim.scenario.document.schema import (
    Flag,
    Number,
    NumberRow,
    NumberRows,
    Size,
    Whole,
    matrix,
)
from cosim.scenario.kinds.alphas import ALPHA, alpha_connections, alphas_of, naming
from cosim.scenario.kinds.base import BuildContext, ImpliedConnection, Kind, PeriodicKind
from cosim.scenario.kinds.jumps import (
    check_continuous,
    check_sampled,
    held_from_points,
    unseen_rows,
)
from cosim.scenario.kinds.table_keys import TableKeys
from cosim.scenario.kinds.terms import LINEAR, ValuedTerm, element_count, function_text

if TYPE_CHECKING:
    from cosim.blocks.modulated_source import Modulation


def _vector(value: float | Sequence[float]) -> list[float]:
    if isinstance(value, (int, float)):
        return [float(value)]
    return [float(element) for element in value]


EXPRESSION_WAY_OUT = (
    "set discrete = true, or use a continuous form, such as max(0, t - 1) for (t - 1)*step(t - 1)"
)
RAMP = (
    "{}: jumps with its signals, where these are interpolated linearly: between two communication "
    "points the jump becomes a ramp over that step, an error of first order in the step; with "
    "discrete = true it shows at the second"
)
LATE = (
    "{}: jumps with its signals, where these are interpolated linearly: between two communication "
    "points that shows at the second, an error of first order in the step"
)
DISTURBANCE_WAY_OUT = "expected continuous alphas; for jumps use a component of kind 'expression'"


class ConstantKind(Kind):
    """y = value."""

    ports: ClassVar[str] = "-> y"
    is_function_of_time: ClassVar[bool] = True
    tunable: ClassVar[tuple[str, ...]] = ("value",)
    kind: Literal["constant"]
    value: Flag | Number | NumberRow = Field(description="number, list of numbers, or Boolean")

    def build(self, name: str, context: BuildContext) -> Component:
        signal_type: SignalType = "boolean" if isinstance(self.value, bool) else "real"
        return source.constant(_vector(self.value), unit=self.unit_name, signal_type=signal_type)


class StepKind(Kind):
    """y jumps from before to after at time."""

    ports: ClassVar[str] = "-> y"
    tunable: ClassVar[tuple[str, ...]] = ("before", "after")
    kind: Literal["step"]
    time: Number = Field(description="time of the jump [s]")
    before: Number = Field(0.0, description="y for t < time")
    after: Number = Field(1.0, description="y for t >= time")

    def build(self, name: str, context: BuildContext) -> Component:
        context.clock.steps_until(self.time, "time")
        time = float(context.clock.at_points(np.array([self.time]))[0])
        return source.step(time=time, before=self.before, after=self.after, unit=self.unit_name)


class RampKind(Kind):
    """y = offset + slope max(0, t - start_time)."""

    ports: ClassVar[str] = "-> y"
    is_function_of_time: ClassVar[bool] = True
    tunable: ClassVar[tuple[str, ...]] = ("slope", "offset")
    kind: Literal["ramp"]
    slope: Number = Field(description="slope of y [1/s]")
    start_time: Number = Field(0.0, description="start of the ramp [s]")
    offset: Number = Field(0.0, description="initial value of y")

    def build(self, name: str, context: BuildContext) -> Component:
        return source.ramp(
            slope=self.slope, start_time=self.start_time, offset=self.offset, unit=self.unit_name
        )


class SineKind(Kind):
    """y = offset + amplitude sin(rate t + phase)."""

    ports: ClassVar[str] = "-> y"
    is_function_of_time: ClassVar[bool] = True
    tunable: ClassVar[tuple[str, ...]] = ("amplitude", "rate", "phase", "offset")
    kind: Literal["sine"]
    amplitude: Number = Field(1.0, description="amplitude")
    rate: Number = Field(description="angular rate [rad/s]")
    phase: Number = Field(0.0, description="phase [rad]")
    offset: Number = Field(0.0, description="constant part of y")

    def build(self, name: str, context: BuildContext) -> Component:
        return source.sine(
            amplitude=self.amplitude,
            rate=self.rate,
            phase=self.phase,
            offset=self.offset,
            unit=self.unit_name,
        )


class ChirpKind(Kind):
    """y = offset + amplitude sin(rate t + sweep t^2 / 2)."""

    ports: ClassVar[str] = "-> y"
    is_function_of_time: ClassVar[bool] = True
    tunable: ClassVar[tuple[str, ...]] = ("amplitude", "rate", "sweep", "offset")
    kind: Literal["chirp"]
    amplitude: Number = Field(1.0, description="amplitude")
    rate: Number = Field(description="angular rate at t = 0 [rad/s]")
    sweep: Number = Field(description="increase of the rate [rad/s^2]")
    offset: Number = Field(0.0, description="constant part of y")

    def build(self, name: str, context: BuildContext) -> Component:
        return source.chirp(
            amplitude=self.amplitude,
            rate=self.rate,
            sweep=self.sweep,
            offset=self.offset,
            unit=self.unit_name,
        )


class ExpressionKind(Kind):
    """y = expressions in t and in signals of other components."""

    ports: ClassVar[str] = "[u1], [u2], ... -> y"
    kind: Literal["expression"]
    y: str | tuple[str, ...] = Field(
        description='an expression, such as "1 + 0.5*sin(2*t)" or "observer.delta - delta.y", or '
        "a list of them: numbers, t, pi, e, outputs of components, + - * / **, min, max, "
        f"{', '.join(FUNCTIONS)}"
    )
    discrete: Flag = Field(
        False,
        description="evaluate at the communication points and hold over each step; required if y "
        "jumps; default with signals: true if all of them are discrete",
    )
    optional: Flag = Field(False, description="y has no value where one of its signals has none")

    @property
    def _texts(self) -> list[str]:
        return [self.y] if isinstance(self.y, str) else list(self.y)

    @property
    def _signals(self) -> tuple[str, ...]:
        """The signals of other components; none where that is not known, as a text is wrong."""
        with suppress(UsageError):
            return signals_of(self._texts)
        return ()

    @property
    def is_known(self) -> bool:
        return not self._signals

    @property
    def jumps_at_points(self) -> bool:
        if self._signals:
            return not any(jumps_with_signals(text) for text in self._texts)
        all_jumps = chain.from_iterable(map(jumps, self._texts))
        return all(jump.instant is not None for jump in all_jumps)

    @property
    def hands_on_lag(self) -> bool:
        return bool(self._signals)

    def implied_connections(
        self, name: str, connections: Mapping[Port, Connection], specs: Mapping[str, Kind]
    ) -> Mapping[Port, ImpliedConnection]:
        implied = {}
        for number, signal in enumerate(self._signals, start=1):
            with suppress(GraphError):  # no port, of which the build tells
                connection = Connection(signal)
                implied[Port(name, f"u{number}")] = ImpliedConnection(connection, None)
        return implied

    def advice(
        self, name: str, context: BuildContext, *, held: Mapping[str, bool], h: float
    ) -> list[str]:
        jumping = [text for text in self._texts if self._signals and jumps_with_signals(text)]
        if not jumping or all(held.values()):
            return []
        return [(LATE if self.discrete else RAMP).format(", ".join(jumping))]

    def build(self, name: str, context: BuildContext) -> Component:
        signals = signals_of(self._texts)
        if signals:
            return self._derived(signals)
        if self.optional:
            raise UsageError("optional: expected a signal in y that may have no value, got none")
        variability: Variability = "discrete" if self.discrete else "continuous"
        for text in self._texts:
            if self.discrete:
                for note in check_sampled(text, context.clock):
                    context.warn(name, note)
            else:
                check_continuous(text, context.clock, EXPRESSION_WAY_OUT)
        return source.Expression(self._texts, variability=variability, unit=self.unit_name)

    def _derived(self, signals: Sequence[str]) -> Component:
        for signal in signals:
            Port.parse(signal)
        # with t in it a signal of discrete ones is none
        variability: Variability = "inherited"
        if any(depends_on_time(text) for text in self._texts):
            variability = "continuous"
        if self.discrete:
            variability = "discrete"
        return derived(
            self._texts, variability=variability, optional=self.optional, unit=self.unit_name
        )


class TableKind(TableKeys, Kind):
    """y = interpolated points from arrays or a CSV file with a header line."""

    ports: ClassVar[str] = "-> y"
    is_function_of_time: ClassVar[bool] = True
    kind: Literal["table"]
    t: NumberRow | None = Field(
        None,
        description='times [s], increasing; with "zero-order" two may be equal: a jump',
    )
    y: NumberRow | NumberRows | None = Field(
        None, description="values at these times, or rows of values"
    )
    file: str | None = Field(
        None,
        description="CSV file in place of t and y; its first line names the columns, also with "
        "units, such as t [ms]",
    )
    time: str = Field("t", description="column of the times")
    columns: tuple[str, ...] | None = Field(
        None, description="columns of the values; default: all others"
    )
    interpolation: Literal["linear", "zero-order"] = Field(
        "linear",
        description='between the times: "linear" interpolation, or "zero-order" hold',
    )
    extrapolation: Literal["error", "hold"] = Field(
        "error",
        description='before the first and after the last time: "error", or "hold" (nearest value)',
    )

    @property
    def computable(self) -> bool:
        """A file is not in the log."""
        return self.file is None or self._is_allowed

    def build(self, name: str, context: BuildContext) -> Component:
        if (self.file is None) == (self.t is None or self.y is None):
            raise UsageError("table: expected either t and y, or file")
        unit: str | tuple[str, ...] | None = None
        if self.file is not None:
            t, y, unit = self._read(context.file(self.file))
        else:
            t, y = self._arrays()
        hold = self.interpolation == "zero-order"
        clock = context.clock
        source.check_points(t, y, hold=hold)
        t = clock.at_points(t)
        if hold:
            t = held_from_points(t, y, clock)
        else:
            for note in unseen_rows(t, y, clock):
                context.warn(name, note)
        extrapolate = self.extrapolation == "hold"
        covers = t[0] <= clock.start_time <= clock.stop <= t[-1]
        if not (extrapolate or covers):
            raise UsageError(
                f"table: expected times from {clock.start_time} s to {clock.stop} s (the run), got "
                f'{t[0]} s to {t[-1]} s; extrapolation = "hold" keeps the nearest value'
            )
        unit = self.unit_name if unit is None else unit
        return source.Table(t, y, hold=hold, extrapolate=extrapolate, unit=unit)

    def _arrays(self) -> tuple[Vector, Matrix]:
        rows = [row if isinstance(row, tuple) else (row,) for row in self.y or ()]
        return np.array(self.t), matrix(tuple(rows), "y")

    def _read(self, path: Path) -> tuple[Vector, Matrix, str | tuple[str, ...] | None]:
        """Return times [s], values and their units."""
        # rarely needed
        from cosim.scenario.data_files.table import second_of, unit_of
        from cosim.scenario.data_files.tables import read_table

        table = read_table(path, self.form)
        (clock,) = table.find([self.time])
        parts = [header for header in table.find(self.columns) if header != clock]
        second = second_of(table.label, clock)
        t = table.columns([clock])[:, 0]
        if second != 1:
            t = np.array([float(Decimal(repr(time)) * second) for time in t.tolist()])
        return t, table.columns(parts), unit_of(table.label, "y", parts)


class NoiseKind(PeriodicKind):
    """y = Gaussian noise, held over each period."""

    ports: ClassVar[str] = "-> y"
    tunable: ClassVar[tuple[str, ...]] = ("deviation",)
    kind: Literal["noise"]
    deviation: Number = Field(ge=0.0, description="standard deviation of y")
    seed: Whole = Field(ge=0, description="seed of the random numbers")
    size: Size = Field(1, description="number of elements")

    @property
    def draws_every_step(self) -> bool:
        return self.period is None and self.deviation > 0.0

    def with_period(self, component: Component, n: int) -> Component:
        return component if n == 1 else Sampled(component, n)

    def build(self, name: str, context: BuildContext) -> Component:
        return source.Noise(
            deviation=self.deviation, seed=self.seed, size=self.size, unit=self.unit_name
        )


class DisturbanceKind(Kind):
    """y = sum of alpha(t) f(theta, t): a disturbance of known form."""

    ports: ClassVar[str] = "[alpha] -> y"
    continuous_inputs: ClassVar[Mapping[str, str]] = {ALPHA: DISTURBANCE_WAY_OUT}
    kind: Literal["disturbance"]
    terms: tuple[ValuedTerm, ...] = Field(
        min_length=1,
        description="list of { alpha, family, theta } with the constants of the family",
    )

    def implied_connections(
        self, name: str, connections: Mapping[Port, Connection], specs: Mapping[str, Kind]
    ) -> Mapping[Port, ImpliedConnection]:
        """Return the connections of the alphas that are signals."""
        return alpha_connections(name, [term.alpha for term in self.terms])

    def build(self, name: str, context: BuildContext) -> Component:
        alphas = alphas_of(name, [term.alpha for term in self.terms], context, DISTURBANCE_WAY_OUT)
        sum_of_terms = _TermSum(element_count(self.terms))
        theta: list[float] = []
        for number, (term, alpha) in enumerate(zip(self.terms, alphas, strict=True)):
            with naming(number):
                theta += sum_of_terms.add(term, alpha)
        context.add_metadata(name, {"theta": theta})
        return sum_of_terms.component(alphas, self.unit_name)


class _TermSum:
    """The elements of a disturbance, and behind them factors of the alphas that are signals.

    Parameters
    ----------
    elements : int
    """

    def __init__(self, elements: int) -> None:
        self._texts: list[list[str]] = [[] for _ in range(elements)]
        self._responses: list[LinearResponse] = []
        self._modulations: list[Modulation] = []

    def add(self, term: ValuedTerm, alpha: Alpha) -> tuple[float, ...]:
        """Add a term; return its parameters."""
        family = term.generator()
        own = term.values(family)
        constants = term.constant_values(family)
        element = term.element
        factor = alpha.text
        if isinstance(alpha, AlphaSignal):
            from cosim.blocks.modulated_source import Modulation  # rarely needed

            self._modulations.append(Modulation(element, alpha.element))
            element = len(self._texts)
            factor = "1"
            self._texts.append([])
        if family.name == LINEAR:
            response = LinearResponse(
                factor=compile_expression(factor),
                G=family.G(np.array(own)),
                c=family.c,
                beta=np.array(constants),
                element=element,
            )
            self._responses.append(response)
        else:
            self._texts[element].append(f"({factor})*{function_text(family, own, constants)}")
        return own

    def component(self, alphas: Sequence[Alpha], unit: str | None) -> Component:
        """Return what computes the sum."""
        if not self._modulations:
            return self._source(unit)
        from cosim.blocks.modulated_source import ModulatedSource  # rarely needed

        return ModulatedSource(self._source(None), self._modulations, alpha_signals(alphas), unit)

    def _source(self, unit: str | None) -> Component:
        texts = [" + ".join(element) or "0" for element in self._texts]
        if not self._responses:
            return source.Expression(texts, unit=unit)
        from cosim.blocks.linear_source import LinearSource  # rarely needed

        programs = [compile_expression(text) for text in texts]
        return LinearSource(programs, self._responses, unit=unit)
