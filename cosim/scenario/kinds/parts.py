"""Small parts that every scenario needs."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix
from cosim.blocks import arithmetic, dynamics
from cosim.blocks.controller import controller
from cosim.blocks.sampled import Sampled
from cosim.core.clock import NANOSECONDS, whole_steps
from cosim.core.contracts import Component
from cosim.core.linear import Linear, LinearModel
from cosim.core.signals import Interface
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.native.step import first_order_hold
from cosim.scenario.kinds.base import BuildContext, Exportable, Kind, Wiring
from cosim.scenario.schema import Number, NumberRow, NumberRows, Whole, matrix


class SumKind(Kind):
    """y = signs[0] u1 + signs[1] u2 + ..."""

    kind: Literal["sum"]
    signs: NumberRow = Field(description="one number an input, like [1, -1]")
    size: Whole = Field(1, ge=1, le=100_000, description="number of elements of every signal")
    unit: str | None = None

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.sum_of(self.signs, size=self.size, unit=self.unit)

    def exportable(self, name: str, context: BuildContext, place: Wiring) -> Exportable:
        return _without_state(
            self.build(name, context).interface, np.kron(np.array([self.signs]), np.eye(self.size))
        )


class GainKind(Kind):
    """y = K u."""

    kind: Literal["gain"]
    K: Number | NumberRows = Field(description="a number, or a matrix")
    unit: str | None = None

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.gain(self._matrix, unit=self.unit)

    def exportable(self, name: str, context: BuildContext, place: Wiring) -> Exportable:
        return _without_state(self.build(name, context).interface, self._matrix)

    @property
    def _matrix(self) -> Matrix:
        return np.array([[self.K]]) if isinstance(self.K, (int, float)) else matrix(self.K, "K")


class LimitKind(Kind):
    """y = u within lower and upper."""

    kind: Literal["limit"]
    lower: Number = Field(description="lower limit")
    upper: Number = Field(description="upper limit")
    size: Whole = Field(1, ge=1, le=100_000, description="number of elements")
    unit: str | None = None

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.limit(lower=self.lower, upper=self.upper, size=self.size, unit=self.unit)

    def exportable(self, name: str, context: BuildContext, place: Wiring) -> Exportable:
        face = self.build(name, context).interface
        reason = "a limit is not smooth, so it has no derivatives everywhere"
        return DiscreteModel(face, kernels.limit(float(self.lower), float(self.upper)), 0, reason)


class LagKind(Kind):
    """First-order lag: time_constant y' = u - y."""

    kind: Literal["lag"]
    time_constant: Number = Field(description="time constant [s]")
    start: Number | None = Field(None, description="y(0); left out: u(0)")
    size: Whole = Field(1, ge=1, le=100_000, description="number of elements")
    unit: str | None = None

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        return dynamics.lag(
            time_constant=self.time_constant, start=self.start, size=self.size, unit=self.unit
        )


class DelayKind(Kind):
    """y(t) = u(t - delay)."""

    kind: Literal["delay"]
    delay: Number = Field(description="a whole number of communication steps [s]")
    initial: Number | None = Field(None, description="y until then; left out: u(0)")
    size: Whole = Field(1, ge=1, le=100_000, description="number of elements")
    unit: str | None = None

    def build(self, name: str, context: BuildContext) -> Component:
        return dynamics.Delay(
            self._steps(context), initial=self.initial, size=self.size, unit=self.unit
        )

    def exportable(self, name: str, context: BuildContext, place: Wiring) -> Exportable:
        kernel = kernels.delay(self._steps(context), self.size, self.initial)
        reason = "a delay line keeps samples of the communication points, so it has no derivatives"
        return DiscreteModel(self.build(name, context).interface, kernel, context.step_ns, reason)

    def _steps(self, context: BuildContext) -> int:
        return whole_steps(self.delay, context.step_ns, "delay")


class ControllerKind(Kind):
    """Linear controller x' = A x + B u, y = C x + D u; with a period it samples u and holds it (zero-order hold)."""

    kind: Literal["controller"]
    A: NumberRows = Field(description="matrix (n, n)")
    B: NumberRows = Field(description="matrix (n, inputs)")
    C: NumberRows = Field(description="matrix (outputs, n)")
    D: NumberRows | None = Field(None, description="matrix (outputs, inputs); left out: zero")
    x0: NumberRow | None = Field(None, description="x(0); left out: zero")
    period: Number | None = Field(
        None, description="its own step [s], u sampled and held; left out: the communication step"
    )
    unit: str | None = None

    @property
    def sample_period(self) -> float | None:
        """Its period [s]."""
        return self.period

    def with_period(self, component: Component, n: int) -> Component:
        return Sampled(component, n, hold=True)

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        D = None if self.D is None else matrix(self.D, "D")
        x0 = None if self.x0 is None else np.array(self.x0)
        return controller(
            A=matrix(self.A, "A"),
            B=matrix(self.B, "B"),
            C=matrix(self.C, "C"),
            D=D,
            x0=x0,
            unit=self.unit,
        )

    def exportable(self, name: str, context: BuildContext, place: Wiring) -> Exportable:
        model = self.linear_model(name, context)
        if self.period is None:
            return model
        every = whole_steps(self.period, context.step_ns, f"period of {name!r}")
        discrete = first_order_hold(
            model.A,
            model.B,
            context.step_ns * every / NANOSECONDS,
            np.ones(model.interface.n_u, np.bool_),
        )
        return DiscreteModel(
            self.with_period(Linear(model), every).interface,
            kernels.sampled(discrete, C=model.C, D=model.D, X0=model.X0),
            context.step_ns,
            "with a period the controller samples and holds, so it lives at the communication points and has no derivatives",
            every=every,
            holds=True,
        )


def _without_state(interface: Interface, D: Matrix) -> LinearModel:
    """Give y = D u as a linear model without states."""
    p, m = D.shape
    return LinearModel(
        interface,
        (),
        np.zeros((0, 0)),
        np.zeros((0, m)),
        np.zeros((p, 0)),
        D,
        np.zeros(0),
        np.zeros((0, m)),
    )
