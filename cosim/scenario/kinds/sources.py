"""Sources: signals that are functions of time, expressions, noise, disturbances."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from itertools import chain
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cosim.blocks import source
from cosim.blocks.derived import derived, signals_of
from cosim.blocks.linear_source import LinearSource
from cosim.blocks.modulated_source import ModulatedSource, Modulation
from cosim.blocks.regressor import alpha_signals
from cosim.blocks.sampled import Sampled
from cosim.core.connections import Connection
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import SignalType, Variability
from cosim.errors import GraphError, UsageError
from cosim.native.blocks.functions import LinearResponse
from cosim.native.estimation.alphas import AlphaSignal
from cosim.native.numerics.expression import FUNCTIONS, compile_expression
from cosim.native.numerics.jumps import depends_on_time, jumps, jumps_with_signals
from cosim.scenario.document.schema import Flag, Number, NumberRow, Size, Whole
from cosim.scenario.kinds.base import BuildContext, Kind, PeriodicKind
from cosim.scenario.kinds.capabilities import Advising
from cosim.scenario.kinds.terms import (
    ALPHA,
    LINEAR,
    ValuedTerm,
    alpha_connections,
    alphas_of,
    check_continuous,
    check_sampled,
    element_count,
    function_text,
    naming,
    seen_late,
)
from cosim.scenario.kinds.values import ImpliedConnection, StepDependence

EXPRESSION_WAY_OUT = (
    "set discrete = true, or use a continuous form, such as max(0, t - 1) for (t - 1)*step(t - 1)"
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
        values = np.atleast_1d(np.array(self.value, np.float64)).tolist()
        return source.constant(values, unit=self.unit_name, signal_type=signal_type)


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
        return source.ramp(**self.given(), unit=self.unit_name)


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
        return source.sine(**self.given(), unit=self.unit_name)


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
        return source.chirp(**self.given(), unit=self.unit_name)


class ExpressionKind(Kind, Advising):
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
    def step_dependence(self) -> StepDependence:
        if self._signals:
            at_points = not any(map(jumps_with_signals, self._texts))
        else:
            all_jumps = chain.from_iterable(map(jumps, self._texts))
            at_points = all(jump.instant is not None for jump in all_jumps)
        return StepDependence(jumps_at_points=at_points)

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

    def advice(self, name: str, context: BuildContext, held: Mapping[str, bool]) -> list[str]:
        jumping = [text for text in self._texts if self._signals and jumps_with_signals(text)]
        if not jumping or all(held.values()):
            return []
        what = (
            f"{', '.join(jumping)}: jumps with its signals, where these are interpolated linearly"
        )
        return [seen_late(what, self.discrete, "with discrete = true it shows at the second")]

    def build(self, name: str, context: BuildContext) -> Component:
        signals = signals_of(self._texts)
        variability: Variability = "discrete" if self.discrete else "continuous"
        if signals:
            for signal in signals:
                Port.parse(signal)
            # with t in it a signal of discrete ones is none
            if not self.discrete and not any(map(depends_on_time, self._texts)):
                variability = "inherited"
            return derived(
                self._texts, variability=variability, optional=self.optional, unit=self.unit_name
            )
        if self.optional:
            raise UsageError("optional: expected a signal in y that may have no value, got none")
        for text in self._texts:
            if self.discrete:
                for note in check_sampled(text, context.clock):
                    context.warn(name, note)
            else:
                check_continuous(text, context.clock, EXPRESSION_WAY_OUT)
        return source.Expression(self._texts, variability=variability, unit=self.unit_name)


class NoiseKind(PeriodicKind):
    """y = Gaussian noise, held over each period."""

    ports: ClassVar[str] = "-> y"
    tunable: ClassVar[tuple[str, ...]] = ("deviation",)
    kind: Literal["noise"]
    deviation: Number = Field(ge=0.0, description="standard deviation of y")
    seed: Whole = Field(ge=0, description="seed of the random numbers")
    size: Size = Field(1, description="number of elements")

    @property
    def step_dependence(self) -> StepDependence:
        return StepDependence(draws=self.period is None and self.deviation > 0.0)

    def with_period(self, component: Component, n: int) -> Component:
        return component if n == 1 else Sampled(component, n)

    def build(self, name: str, context: BuildContext) -> Component:
        return source.Noise(**self.given("period"), unit=self.unit_name)


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
        theta: list[float] = []
        texts: list[list[str]] = [[] for _ in range(element_count(self.terms))]
        responses: list[LinearResponse] = []
        modulations: list[Modulation] = []
        for number, (term, alpha) in enumerate(zip(self.terms, alphas, strict=True)):
            with naming(number):
                family = term.generator()
                own = term.values(family)
                constants = term.constant_values(family)
            theta += own
            element = term.element
            factor = alpha.text
            if isinstance(alpha, AlphaSignal):  # an element behind those of y, to be multiplied
                modulations.append(Modulation(element, alpha.element))
                element = len(texts)
                factor = "1"
                texts.append([])
            if family.name != LINEAR:
                texts[element].append(f"({factor})*{function_text(family, own, constants)}")
                continue
            response = LinearResponse(
                factor=compile_expression(factor),
                G=family.G(np.array(own)),
                c=family.c,
                beta=np.array(constants),
                element=element,
            )
            responses.append(response)
        context.add_metadata(name, {"theta": theta})
        unit = None if modulations else self.unit_name
        sum_of_texts = source.Expression(
            [" + ".join(element) or "0" for element in texts], unit=unit
        )
        component: Component = sum_of_texts
        if responses:
            component = LinearSource(sum_of_texts.programs, responses, unit=unit)
        if modulations:
            signals = alpha_signals(alphas)
            component = ModulatedSource(component, modulations, signals, self.unit_name)
        return component
