"""Parts of a block diagram: sum, gain, product, limit, switch, lag, integrator, ..."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix
from cosim.blocks import arithmetic, dynamics
from cosim.blocks.limited_integrator import LimitedIntegrator
from cosim.blocks.product import Product
from cosim.blocks.transfer import transfer_function
from cosim.core.clock import whole_steps
from cosim.core.contracts import Component
from cosim.core.linear import LinearModel
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.fmi.exporting.specifications import Exportable
from cosim.scenario.document.schema import Flag, Number, NumberRow, NumberRows, Size, matrix
from cosim.scenario.kinds.base import (
    Advising,
    BuildContext,
    ExportableKind,
    LinearKind,
    PortUnits,
    Wiring,
    unit_of,
)
from cosim.scenario.kinds.jumps import seen_late
from cosim.scenario.kinds.values import LinearSystem

# --- without memory ---


class MatrixKind(ExportableKind):
    """y = D u: an FMU of it is a linear model without states."""

    is_static: ClassVar[bool] = True

    @property
    @abstractmethod
    def gains(self) -> Matrix:
        """D, shape (n_y, n_u)."""

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        D = self.gains
        n_y, n_u = D.shape
        return LinearModel(
            self.build(name, context).interface,
            (),
            A=np.zeros((0, 0)),
            B=np.zeros((0, n_u)),
            C=np.zeros((n_y, 0)),
            D=D,
            X0=np.zeros(0),
            Xu=np.zeros((0, n_u)),
        )


class SumKind(MatrixKind):
    """y = signs[0] u1 + signs[1] u2 + ..."""

    ports: ClassVar[str] = "u1, u2, ... -> y"
    tunable: ClassVar[tuple[str, ...]] = ("signs",)
    kind: Literal["sum"]
    signs: NumberRow = Field(description="one factor per input, such as [1, -1]")
    size: Size = Field(1, description="number of elements of each signal")
    unit: PortUnits = Field(None, description=unit_of("y and all inputs"))

    @property
    def gains(self) -> Matrix:
        return np.kron(np.array([self.signs]), np.eye(self.size))

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.sum_of(self.signs, size=self.size, unit=self.unit_name)


class GainKind(MatrixKind):
    """y = K u."""

    ports: ClassVar[str] = "u -> y"
    tunable: ClassVar[tuple[str, ...]] = ("K",)
    kind: Literal["gain"]
    K: Number | NumberRows = Field(description="gain, a number or a matrix")

    @property
    def gains(self) -> Matrix:
        return matrix(self.K, "K") if isinstance(self.K, tuple) else np.array([[self.K]])

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.gain(self.gains, unit=self.unit_name)


class ProductKind(ExportableKind):
    """y = u1 u2 ... or u1/u2 ..., element by element."""

    ports: ClassVar[str] = "u1, u2, ... -> y"
    is_static: ClassVar[bool] = True
    kind: Literal["product"]
    operations: str = Field(description='* or / per input, such as "*/" for u1/u2')
    size: Size = Field(1, description="number of elements of each signal")

    def build(self, name: str, context: BuildContext) -> Product:
        return Product(self.operations, size=self.size, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        interface = self.build(name, context).interface
        return DiscreteModel(
            interface, kernels.product(self.operations), 0, "a product is nonlinear"
        )


class LimitKind(ExportableKind):
    """y = u, limited to lower and upper."""

    ports: ClassVar[str] = "u -> y"
    is_static: ClassVar[bool] = True
    tunable: ClassVar[tuple[str, ...]] = ("lower", "upper")
    kind: Literal["limit"]
    lower: Number = Field(description="lower limit")
    upper: Number = Field(description="upper limit")
    size: Size = Field(1, description="number of elements")
    unit: PortUnits = Field(None, description=unit_of("u and y"))

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.limit(**self.given(), unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        interface = self.build(name, context).interface
        kernel = kernels.limit(float(self.lower), float(self.upper))
        return DiscreteModel(interface, kernel, 0, "a limit is not differentiable")


class SwitchKind(ExportableKind, Advising):
    """y = u1 where control >= threshold, else u2."""

    ports: ClassVar[str] = "u1, u2, control -> y"
    is_static: ClassVar[bool] = True
    tunable: ClassVar[tuple[str, ...]] = ("threshold",)
    kind: Literal["switch"]
    threshold: Number = Field(0.5, description="y = u1 for control >= threshold")
    size: Size = Field(1, description="number of elements of u1, u2 and y")
    discrete: Flag = Field(
        False, description="hold y over each step; default: true if u1, u2 and control are discrete"
    )
    unit: PortUnits = Field(None, description=unit_of("u1, u2 and y"))

    def advice(
        self, name: str, context: BuildContext, *, held: Mapping[str, bool], h: float
    ) -> list[str]:
        if held["control"]:
            return []
        what = "control is interpolated linearly, and where it passes the threshold y jumps"
        way_out = "a discrete control jumps at communication points only"
        return [seen_late(what, self.discrete, way_out)]

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.switch(**self.given(), unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        interface = self.build(name, context).interface
        kernel = kernels.switch(float(self.threshold))
        return DiscreteModel(interface, kernel, 0, "a switch is not differentiable")


# --- with a state ---


class LagKind(LinearKind):
    """First-order lag: time_constant y' = u - y."""

    ports: ClassVar[str] = "u -> y"
    tunable: ClassVar[tuple[str, ...]] = ("time_constant",)
    kind: Literal["lag"]
    time_constant: Number = Field(description="time constant [s]")
    initial: Number | None = Field(None, description="initial value y(0); default: u(0)")
    size: Size = Field(1, description="number of elements")
    unit: PortUnits = Field(None, description=unit_of("u and y"))

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        return dynamics.lag(**self.given(), unit=self.unit_name)


class IntegratorKind(LinearKind):
    """y' = u; with optional limits of y."""

    ports: ClassVar[str] = "u -> y"
    tunable: ClassVar[tuple[str, ...]] = ("lower", "upper")
    kind: Literal["integrator"]
    initial: Number = Field(0.0, description="y(0)")
    lower: Number | None = Field(None, description="lower limit of y; default: none")
    upper: Number | None = Field(None, description="upper limit of y; default: none")
    size: Size = Field(1, description="number of elements")

    @property
    def _limited(self) -> LimitedIntegrator | None:
        if self.lower is None and self.upper is None:
            return None
        return LimitedIntegrator(**self.given(), unit=self.unit_name)

    def build(self, name: str, context: BuildContext) -> Component:
        return self._limited or super().build(name, context)

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        return dynamics.integrator(initial=self.initial, size=self.size, unit=self.unit_name)

    def linear_system(self, name: str, context: BuildContext) -> LinearSystem | None:
        return None if self._limited else super().linear_system(name, context)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        limited = self._limited
        if limited is None:
            return super().exportable(name, context, wiring)
        kernel = kernels.integrator(self.size, limited.lower, limited.upper, limited.initial)
        reason = "an integrator with limits is not differentiable"
        return DiscreteModel(limited.interface, kernel, 0, reason)


class TransferFunctionKind(LinearKind):
    """Y(s) = numerator(s)/denominator(s) U(s), proper."""

    ports: ClassVar[str] = "u -> y"
    kind: Literal["transfer-function"]
    numerator: NumberRow = Field(description="coefficients, highest power of s first")
    denominator: NumberRow = Field(description="coefficients, highest power of s first")
    initial: Literal["zero", "steady"] = Field(
        "zero", description='initial state: "zero", or "steady" state for u(0)'
    )

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        steady = self.initial == "steady"
        return transfer_function(
            self.numerator, self.denominator, steady=steady, unit=self.unit_name
        )


class DelayKind(ExportableKind):
    """y(t) = u(t - delay)."""

    ports: ClassVar[str] = "u -> y"
    kind: Literal["delay"]
    delay: Number = Field(description="delay [s], a multiple of the communication step")
    initial: Number | None = Field(None, description="y before t = delay; default: u(0)")
    size: Size = Field(1, description="number of elements")
    unit: PortUnits = Field(None, description=unit_of("u and y"))

    def _steps(self, context: BuildContext) -> int:
        return whole_steps(self.delay, context.step_ns, "delay")

    def build(self, name: str, context: BuildContext) -> Component:
        return dynamics.Delay(
            self._steps(context), initial=self.initial, size=self.size, unit=self.unit_name
        )

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        kernel = kernels.delay(self._steps(context), self.size, self.initial)
        reason = "a delay is a discrete-time component"
        return DiscreteModel(self.build(name, context).interface, kernel, context.step_ns, reason)
