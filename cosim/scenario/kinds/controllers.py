"""Controllers: linear ones by their matrices, continuous or discrete in time, and PID."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cosim.blocks.pid import Pid, PidParameters
from cosim.blocks.sampled import Sampled
from cosim.blocks.state_space import DiscreteStateSpace, controller, system_matrices
from cosim.core.clock import exact_nanoseconds, whole_steps
from cosim.core.contracts import Component
from cosim.core.linear import Linear, LinearModel
from cosim.core.signals import Interface
from cosim.errors import UsageError
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.kernels import DiscreteModel, Kernel
from cosim.fmi.exporting.specifications import Exportable
from cosim.instants import StepNs, step_part, step_seconds
from cosim.native.numerics.linear import first_order_hold
from cosim.scenario.document.schema import (
    Number,
    NumberRow,
    NumberRows,
    StepTime,
    matrix,
)
from cosim.scenario.kinds.base import (
    BuildContext,
    ExportableKind,
    LinearKind,
    PeriodicKind,
    Wiring,
)
from cosim.scenario.kinds.values import Sampling


class SampledKind(PeriodicKind):
    """A controller that samples its inputs and holds them over its period, if it has one."""

    period: StepTime | None = Field(
        None,
        description="sample period [s], a multiple of the communication step; default: continuous",
    )

    offset: Number = Field(
        0.0,
        description="first sample after the start of the run [s], a multiple of the communication "
        "step, less than the period; y keeps its initial value until then",
    )

    def with_period(self, component: Component, n: int) -> Component:
        offset = self._offset_steps(n)
        if self.period is None:
            return component
        # A period of one communication step still holds u over it.
        return Sampled(component, n, hold=self._holds, offset=offset)

    def sampling(self, n: int) -> Sampling | None:
        if self.period is None:
            return None
        return Sampling(n, self._offset_steps(n), self._holds)

    def recorded_period(self, n: int) -> int:
        """Return the steps between two rows of the log: a sample is in one of them."""
        return math.gcd(n, self._offset_steps(n))

    @property
    def _holds(self) -> bool:
        """Whether its inputs have a zero-order hold over a period."""
        return True

    def _offset_steps(self, n: int) -> int:
        """Return the offset in communication steps, ``n`` of which are a period.

        Raises
        ------
        UsageError
            If there is one without a period, or it is negative or not less than the period.
        ClockError
            If it is not a whole number of them.
        """
        if not self.offset:
            return 0
        if self.period is None:
            raise UsageError(
                f"offset: expected together with period, got {self.offset} s and no period"
            )
        if not 0.0 <= self.offset < self.period:
            raise UsageError(
                f"offset: expected a time >= 0 s and below the period, {self.period} s, got "
                f"{self.offset} s"
            )
        return whole_steps(self.offset, step_part(exact_nanoseconds(self.period), n), "offset")

    def _check_exportable(self) -> None:
        """Check that an FMU can do what it does with its period.

        Raises
        ------
        UsageError
            If it cannot.
        """
        if self.offset or not self._holds:
            found = f"offset = {self.offset}" if self.offset else "input_interpolation = 'linear'"
            raise UsageError(
                "an exported controller takes its first sample at the start and holds its inputs "
                f"over a period: expected neither offset nor linear interpolation, got {found}"
            )


class ControllerKind(SampledKind, LinearKind):
    """Linear controller x' = A x + B u, y = C x + D u; with a period: sampled."""

    ports: ClassVar[str] = "u -> y, x"
    kind: Literal["controller"]
    A: NumberRows = Field(description="matrix (n, n)")
    B: NumberRows = Field(description="matrix (n, inputs)")
    C: NumberRows = Field(description="matrix (outputs, n)")
    D: NumberRows | None = Field(None, description="matrix (outputs, inputs); default: zero")
    x0: NumberRow | None = Field(None, description="x(0); default: zero")
    input_interpolation: Literal["linear", "zero-order"] | None = Field(
        None,
        description='discretization of u over a period: "zero-order" hold (default) or "linear" '
        "interpolation",
    )

    def with_period(self, component: Component, n: int) -> Component:
        if self.period is None and self.input_interpolation is not None:
            raise UsageError(
                f"input_interpolation: expected together with period, got "
                f"{self.input_interpolation!r} and no period"
            )
        return super().with_period(component, n)

    @property
    def _holds(self) -> bool:
        return self.input_interpolation != "linear"

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
        self._check_exportable()
        every = self.period_steps(name, context.step_ns)
        period = step_seconds(context.step_ns * every)
        all_held = np.ones(model.interface.n_u, np.bool_)
        discretization = first_order_hold(model.A, model.B, period, all_held)
        kernel = kernels.sampled(discretization, C=model.C, D=model.D, X0=model.X0)
        component = self.with_period(Linear(model), every)
        return _sampled_model(component.interface, kernel, context.step_ns, every)


class DiscreteStateSpaceKind(SampledKind, ExportableKind):
    """Discrete-time system x+ = A x + B u, y = C x + D u; u is sampled, y and x are held."""

    ports: ClassVar[str] = "u -> y, x"
    kind: Literal["discrete-state-space"]
    period: StepTime = Field(description="sample period [s], a multiple of the communication step")
    A: NumberRows = Field(description="matrix (n, n)")
    B: NumberRows = Field(description="matrix (n, inputs)")
    C: NumberRows = Field(description="matrix (outputs, n)")
    D: NumberRows | None = Field(None, description="matrix (outputs, inputs); default: zero")
    x0: NumberRow | None = Field(None, description="x(0); default: zero")

    def build(self, name: str, context: BuildContext) -> DiscreteStateSpace:
        system = system_matrices(
            "discrete-state-space",
            A=matrix(self.A, "A"),
            B=matrix(self.B, "B"),
            C=matrix(self.C, "C"),
            D=None if self.D is None else matrix(self.D, "D"),
            x0=None if self.x0 is None else np.array(self.x0),
        )
        return DiscreteStateSpace(system, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        component = self.build(name, context)
        system = component.system
        kernel = kernels.sampled(component.dynamics, C=system.C, D=system.D, X0=system.x0)
        self._check_exportable()
        every = self.period_steps(name, context.step_ns)
        interface = self.with_period(component, every).interface
        return _sampled_model(interface, kernel, context.step_ns, every)


class PidKind(SampledKind, ExportableKind):
    """PID controller in ISA form with limits and anti-windup; with a period: sampled."""

    ports: ClassVar[str] = "setpoint, measurement -> y, integral"
    tunable: ClassVar[tuple[str, ...]] = (
        "gain",
        "integral_time",
        "derivative_time",
        "derivative_gain_limit",
        "setpoint_weight",
        "derivative_setpoint_weight",
        "lower",
        "upper",
        "tracking_time",
    )
    kind: Literal["pid"]
    gain: Number = Field(
        description="proportional gain K: y = K (b setpoint - measurement) + integral + derivative"
    )
    integral_time: Number | None = Field(
        None, description="integral time Ti [s]; default: no integral part"
    )
    derivative_time: Number = Field(
        0.0, description="derivative time Td [s]; 0: no derivative part"
    )
    derivative_gain_limit: Number = Field(
        10.0, description="derivative filter N: time constant Td/N"
    )
    setpoint_weight: Number = Field(
        1.0, description="b: weight of the setpoint in the proportional part"
    )
    derivative_setpoint_weight: Number = Field(
        0.0, description="c: weight of the setpoint in the derivative part"
    )
    lower: Number | None = Field(None, description="lower limit of y; default: none")
    upper: Number | None = Field(None, description="upper limit of y; default: none")
    tracking_time: Number | None = Field(
        None,
        description="tracking time Tt of the anti-windup (back-calculation) [s]; default: "
        "sqrt(Ti Td), without a derivative part Ti",
    )
    initial_integral: Number = Field(
        0.0, description="integral(0), for a bumpless start; constant without integral_time"
    )

    def build(self, name: str, context: BuildContext) -> Pid:
        parameters = PidParameters(
            gain=self.gain,
            integral_time=self.integral_time,
            derivative_time=self.derivative_time,
            derivative_gain_limit=self.derivative_gain_limit,
            setpoint_weight=self.setpoint_weight,
            derivative_setpoint_weight=self.derivative_setpoint_weight,
            lower=self.lower,
            upper=self.upper,
            tracking_time=self.tracking_time,
            initial_integral=self.initial_integral,
        )
        period = None
        if self.period is not None:
            period = step_seconds(context.step_ns * self.period_steps(name, context.step_ns))
        return Pid(parameters, period=period, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        component = self.build(name, context)
        kernel = kernels.pid(component.constants, sampled=self.period is not None)
        if self.period is None:
            reason = "a controller with limits is not differentiable"
            return DiscreteModel(component.interface, kernel, 0, reason)
        self._check_exportable()
        every = self.period_steps(name, context.step_ns)
        interface = self.with_period(component, every).interface
        return _sampled_model(interface, kernel, context.step_ns, every)


def _sampled_model(
    interface: Interface, kernel: Kernel, step_ns: StepNs, every: int
) -> DiscreteModel:
    """Return a controller that samples and holds every so many communication steps."""
    reason = "a sampled controller is a discrete-time component"
    return DiscreteModel(
        interface, kernel, step_ns, reason, steps_per_sample=every, zero_order_hold=True
    )
