"""Small parts that every scenario needs."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix
from cosim.blocks import arithmetic, dynamics
from cosim.blocks.sampled import Sampled
from cosim.blocks.state_space import controller
from cosim.core.clock import NANOSECONDS, whole_steps
from cosim.core.contracts import Component
from cosim.core.linear import Linear, LinearModel
from cosim.core.signals import Interface
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.fmi.exporting.specifications import Exportable
from cosim.native.step import first_order_hold
from cosim.scenario.kinds.base import (
    BuildContext,
    ExportableKind,
    LinearKind,
    PeriodicKind,
    PortUnits,
    Wiring,
    unit_of,
)
from cosim.scenario.schema import Number, NumberRow, NumberRows, Whole, matrix


class SumKind(ExportableKind):
    """y = signs[0] u1 + signs[1] u2 + ..."""

    ports: ClassVar[str] = "u1, u2, ... -> y"
    kind: Literal["sum"]
    signs: NumberRow = Field(description="one number an input, like [1, -1]")
    size: Whole = Field(1, ge=1, le=100_000, description="number of elements of every signal")
    unit: PortUnits = Field(None, description=unit_of("y and all inputs"))

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.sum_of(self.signs, size=self.size, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        D = np.kron(np.array([self.signs]), np.eye(self.size))
        return _static_model(self.build(name, context).interface, D)


class GainKind(ExportableKind):
    """y = K u."""

    ports: ClassVar[str] = "u -> y"
    kind: Literal["gain"]
    K: Number | NumberRows = Field(description="a number, or a matrix")

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.gain(self._matrix, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        return _static_model(self.build(name, context).interface, self._matrix)

    @property
    def _matrix(self) -> Matrix:
        if isinstance(self.K, (int, float)):
            return np.array([[self.K]])
        return matrix(self.K, "K")


class LimitKind(ExportableKind):
    """y = u within lower and upper."""

    ports: ClassVar[str] = "u -> y"
    kind: Literal["limit"]
    lower: Number = Field(description="lower limit")
    upper: Number = Field(description="upper limit")
    size: Whole = Field(1, ge=1, le=100_000, description="number of elements")
    unit: PortUnits = Field(None, description=unit_of("u and y"))

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.limit(
            lower=self.lower, upper=self.upper, size=self.size, unit=self.unit_name
        )

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        interface = self.build(name, context).interface
        kernel = kernels.limit(float(self.lower), float(self.upper))
        reason = "a limit is not smooth, so it has no derivatives everywhere"
        return DiscreteModel(interface, kernel, 0, reason)


class LagKind(LinearKind):
    """First-order lag: time_constant y' = u - y."""

    ports: ClassVar[str] = "u -> y"
    kind: Literal["lag"]
    time_constant: Number = Field(description="time constant [s]")
    initial: Number | None = Field(None, description="y(0); default: u(0)")
    size: Whole = Field(1, ge=1, le=100_000, description="number of elements")
    unit: PortUnits = Field(None, description=unit_of("u and y"))

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        return dynamics.lag(
            time_constant=self.time_constant,
            initial=self.initial,
            size=self.size,
            unit=self.unit_name,
        )


class DelayKind(ExportableKind):
    """y(t) = u(t - delay)."""

    ports: ClassVar[str] = "u -> y"
    kind: Literal["delay"]
    delay: Number = Field(description="a whole number of communication steps [s]")
    initial: Number | None = Field(None, description="y until then; default: u(0)")
    size: Whole = Field(1, ge=1, le=100_000, description="number of elements")
    unit: PortUnits = Field(None, description=unit_of("u and y"))

    def build(self, name: str, context: BuildContext) -> Component:
        return dynamics.Delay(
            self._steps(context), initial=self.initial, size=self.size, unit=self.unit_name
        )

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        kernel = kernels.delay(self._steps(context), self.size, self.initial)
        reason = "a delay line keeps samples of the communication points, so it has no derivatives"
        return DiscreteModel(self.build(name, context).interface, kernel, context.step_ns, reason)

    def _steps(self, context: BuildContext) -> int:
        return whole_steps(self.delay, context.step_ns, "delay")


class ControllerKind(PeriodicKind, LinearKind):
    """Linear controller x' = A x + B u, y = C x + D u; with a period: zero-order hold of u."""

    ports: ClassVar[str] = "u -> y, x"
    kind: Literal["controller"]
    A: NumberRows = Field(description="matrix (n, n)")
    B: NumberRows = Field(description="matrix (n, inputs)")
    C: NumberRows = Field(description="matrix (outputs, n)")
    D: NumberRows | None = Field(None, description="matrix (outputs, inputs); default: zero")
    x0: NumberRow | None = Field(None, description="x(0); default: zero")

    def with_period(self, component: Component, n: int) -> Component:
        # A period of one communication step still holds u over it.
        return component if self.period is None else Sampled(component, n, hold=True)

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        D = None if self.D is None else matrix(self.D, "D")
        x0 = None if self.x0 is None else np.array(self.x0)
        A = matrix(self.A, "A")
        B = matrix(self.B, "B")
        C = matrix(self.C, "C")
        return controller(A=A, B=B, C=C, D=D, x0=x0, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        model = self.linear_model(name, context)
        if self.period is None:
            return model
        every = self.period_steps(name, context.step_ns)
        period = context.step_ns * every / NANOSECONDS
        all_held = np.ones(model.interface.n_u, np.bool_)
        discretization = first_order_hold(model.A, model.B, period, all_held)
        kernel = kernels.sampled(discretization, C=model.C, D=model.D, X0=model.X0)
        component = self.with_period(Linear(model), every)
        reason = (
            "with a period the controller samples and holds, so it lives at the communication "
            "points and has no derivatives"
        )
        return DiscreteModel(
            component.interface,
            kernel,
            context.step_ns,
            reason,
            steps_per_sample=every,
            zero_order_hold=True,
        )


def _static_model(interface: Interface, D: Matrix) -> LinearModel:
    """Return y = D u as a linear model without states."""
    n_y, n_u = D.shape
    A = np.zeros((0, 0))
    B = np.zeros((0, n_u))
    C = np.zeros((n_y, 0))
    X0 = np.zeros(0)
    Xu = np.zeros((0, n_u))
    return LinearModel(interface, (), A=A, B=B, C=C, D=D, X0=X0, Xu=Xu)
