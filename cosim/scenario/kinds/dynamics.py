"""Parts with a state: lag, integrator, transfer function, delay."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from cosim.blocks import dynamics
from cosim.blocks.limited_integrator import LimitedIntegrator
from cosim.blocks.transfer import transfer_function
from cosim.core.clock import whole_steps
from cosim.core.contracts import Component
from cosim.core.linear import LinearModel
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.fmi.exporting.specifications import Exportable
from cosim.native.blocks.control import LARGEST_NUMBER
from cosim.scenario.document.schema import Number, NumberRow, Size
from cosim.scenario.kinds.base import (
    BuildContext,
    ExportableKind,
    LinearKind,
    PortUnits,
    Wiring,
    unit_of,
)
from cosim.scenario.kinds.values import LinearSystem


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
        return dynamics.lag(
            time_constant=self.time_constant,
            initial=self.initial,
            size=self.size,
            unit=self.unit_name,
        )


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
    def _is_limited(self) -> bool:
        return self.lower is not None or self.upper is not None

    def build(self, name: str, context: BuildContext) -> Component:
        return self._limited() if self._is_limited else super().build(name, context)

    def _limited(self) -> LimitedIntegrator:
        return LimitedIntegrator(
            lower=-LARGEST_NUMBER if self.lower is None else self.lower,
            upper=LARGEST_NUMBER if self.upper is None else self.upper,
            initial=self.initial,
            size=self.size,
            unit=self.unit_name,
        )

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        return dynamics.integrator(initial=self.initial, size=self.size, unit=self.unit_name)

    def linear_system(self, name: str, context: BuildContext) -> LinearSystem | None:
        return None if self._is_limited else super().linear_system(name, context)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        if not self._is_limited:
            return super().exportable(name, context, wiring)
        limited = self._limited()
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
        return transfer_function(
            self.numerator,
            self.denominator,
            steady=self.initial == "steady",
            unit=self.unit_name,
        )


class DelayKind(ExportableKind):
    """y(t) = u(t - delay)."""

    ports: ClassVar[str] = "u -> y"
    kind: Literal["delay"]
    delay: Number = Field(description="delay [s], a multiple of the communication step")
    initial: Number | None = Field(None, description="y before t = delay; default: u(0)")
    size: Size = Field(1, description="number of elements")
    unit: PortUnits = Field(None, description=unit_of("u and y"))

    def build(self, name: str, context: BuildContext) -> Component:
        return dynamics.Delay(
            self._steps(context), initial=self.initial, size=self.size, unit=self.unit_name
        )

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        kernel = kernels.delay(self._steps(context), self.size, self.initial)
        reason = "a delay is a discrete-time component"
        return DiscreteModel(self.build(name, context).interface, kernel, context.step_ns, reason)

    def _steps(self, context: BuildContext) -> int:
        return whole_steps(self.delay, context.step_ns, "delay")
