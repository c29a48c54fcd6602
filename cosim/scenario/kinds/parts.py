"""Parts of a block diagram: without memory, with a state; sensors and controllers."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix
from cosim.blocks import arithmetic, dynamics
from cosim.blocks.late_samples import MOST_IN_A_STEP
from cosim.blocks.limited_integrator import LimitedIntegrator
from cosim.blocks.measurement import SensorParameters
from cosim.blocks.pid import Pid, PidParameters
from cosim.blocks.product import Product
from cosim.blocks.sampled import Sampled
from cosim.blocks.sensor import Sensor
from cosim.blocks.state_space import DiscreteStateSpace, controller, system_matrices
from cosim.blocks.transfer import transfer_function
from cosim.core.clock import exact_nanoseconds, nanoseconds, whole_steps
from cosim.core.contracts import Component
from cosim.core.linear import Linear, LinearModel
from cosim.core.signals import samples_of
from cosim.errors import UsageError
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.kernels import DiscreteModel, Kernel
from cosim.fmi.exporting.specifications import Exportable
from cosim.instants import step_part, step_seconds
from cosim.native.numerics.linear import first_order_hold
from cosim.scenario.document.schema import (
    Flag,
    Number,
    NumberRow,
    NumberRows,
    Size,
    StepTime,
    Whole,
    matrix,
)
from cosim.scenario.kinds.base import (
    BuildContext,
    ExportableKind,
    LinearKind,
    PeriodicKind,
    PortUnits,
    Wiring,
    unit_of,
)
from cosim.scenario.kinds.capabilities import Advising, HasSamples
from cosim.scenario.kinds.terms import seen_late
from cosim.scenario.kinds.values import LinearSystem, Sampling, StepDependence

EACH = ", one number or one per element"

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

    def advice(self, name: str, context: BuildContext, held: Mapping[str, bool]) -> list[str]:
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


# --- sensors ---


class SensorKind(PeriodicKind, HasSamples):
    """y = u with delay, jitter, bias, noise, limits, quantization, dropouts, in this order."""

    ports: ClassVar[str] = "u -> y, valid, y_samples, sample_times"
    kind: Literal["sensor"]
    delay: Number = Field(
        0.0,
        ge=0.0,
        description="y(t) samples u(t - delay) [s]; u is interpolated between communication points",
    )
    jitter: Number = Field(
        0.0,
        ge=0.0,
        description="largest deviation of the sampling instant [s], uniformly distributed, at most "
        "half a period; beyond t, u is extrapolated linearly",
    )
    bias: Number | NumberRow = Field(0.0, description=f"constant error of y{EACH}")
    noise: Number | NumberRow = Field(
        0.0, description=f"standard deviation of the Gaussian noise of y{EACH}"
    )
    lower: Number | NumberRow | None = Field(
        None, description=f"lower limit of y{EACH}; default: none"
    )
    upper: Number | NumberRow | None = Field(
        None, description=f"upper limit of y{EACH}; default: none"
    )
    resolution: Number | NumberRow | None = Field(
        None, description=f"quantization step of y{EACH}; default: none"
    )
    bits: Whole | None = Field(
        None,
        description="quantization to 2**bits levels from lower to upper, in place of resolution",
    )
    dropout: Number | None = Field(
        None,
        description="probability of losing a sample: y keeps its value, the output valid is 0; "
        "default: no losses, no output valid",
    )
    seed: Whole | None = Field(
        None,
        description="seed of noise, jitter and dropouts, required with any of them; sensors with "
        "equal seeds have equal random numbers",
    )
    period: StepTime | None = Field(
        None,
        description="sample period [s], a multiple of the communication step, with zero-order hold "
        "of y; default: one step, y interpolated like u. With period, dropout or time_stamps the "
        "outputs y_samples and sample_times give the samples alone",
    )
    time_stamps: Flag = Field(
        False,
        description="sample_times are the sampling instants t - delay + jitter, not the times of "
        "arrival",
    )
    size: Size = Field(1, description="number of elements, with independent errors")
    unit: PortUnits = Field(None, description=unit_of("u and y"))

    def with_period(self, component: Component, n: int) -> Component:
        return component

    @property
    def step_dependence(self) -> StepDependence:
        is_random = bool(np.any(self.noise)) or bool(self.jitter) or self.dropout is not None
        return StepDependence(draws=is_random and self.period is None, times=(self.delay,))

    def sampling(self, n: int) -> Sampling | None:
        return None if self.period is None else Sampling(n, 0, True)

    @property
    def _offers_samples(self) -> bool:
        """Whether y has values that are no new samples."""
        return self.period is not None or self.dropout is not None or self.time_stamps

    def samples_of(self, output: str) -> str | None:
        return samples_of(output) if output == "y" and self._offers_samples else None

    @property
    def samples_at_points(self) -> bool:
        return not self.time_stamps

    def most_in_a_step(self, name: str, context: BuildContext) -> int:
        if self.time_stamps:
            return MOST_IN_A_STEP
        return 1 if self._offers_samples else 0

    def late_steps(self, context: BuildContext) -> int:
        if not self.time_stamps:
            return 0
        latest = _in_steps(self.delay, context) + _in_steps(self.jitter, context)
        return math.floor(latest) + 1

    def build(self, name: str, context: BuildContext) -> Sensor:
        parameters = SensorParameters(
            **self.given("size", "time_stamps", "delay", "jitter", "period"),
            delay=_in_steps(self.delay, context),
            jitter=_in_steps(self.jitter, context),
            period=self.period_steps(name, context.step_ns),
        )
        return Sensor(
            parameters,
            size=self.size,
            unit=self.unit_name,
            samples=self._offers_samples,
            stamped=self.time_stamps,
            holds=self.period is not None,
        )


def _in_steps(time: float, context: BuildContext) -> float:
    """Return a time [s] in communication steps, also parts of a step."""
    return float(nanoseconds(time) / context.step_ns)


# --- controllers ---


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

    def _seconds(self, name: str, context: BuildContext) -> float:
        """Return the period [s], the double next to it."""
        return step_seconds(context.step_ns * self.period_steps(name, context.step_ns))

    def _sampled_model(
        self, name: str, component: Component, kernel: Kernel, context: BuildContext
    ) -> DiscreteModel:
        """Return what an FMU of the component is made of, with a period.

        Raises
        ------
        UsageError
            If an FMU cannot do what it does with its period.
        """
        if self.offset or not self._holds:
            found = f"offset = {self.offset}" if self.offset else "input_interpolation = 'linear'"
            raise UsageError(
                "an exported controller takes its first sample at the start and holds its inputs "
                f"over a period: expected neither offset nor linear interpolation, got {found}"
            )
        every = self.period_steps(name, context.step_ns)
        return DiscreteModel(
            self.with_period(component, every).interface,
            kernel,
            context.step_ns,
            "a sampled controller is a discrete-time component",
            steps_per_sample=every,
            zero_order_hold=True,
        )


class StateSpaceKind(SampledKind):
    """A linear controller by its matrices."""

    A: NumberRows = Field(description="matrix (n, n)")
    B: NumberRows = Field(description="matrix (n, inputs)")
    C: NumberRows = Field(description="matrix (outputs, n)")
    D: NumberRows | None = Field(None, description="matrix (outputs, inputs); default: zero")
    x0: NumberRow | None = Field(None, description="x(0); default: zero")

    @property
    def arrays(self) -> dict[str, Any]:
        """The matrices, and the initial state."""
        return {
            "A": matrix(self.A, "A"),
            "B": matrix(self.B, "B"),
            "C": matrix(self.C, "C"),
            "D": None if self.D is None else matrix(self.D, "D"),
            "x0": None if self.x0 is None else np.array(self.x0),
        }


class ControllerKind(StateSpaceKind, LinearKind):
    """Linear controller x' = A x + B u, y = C x + D u; with a period: sampled."""

    ports: ClassVar[str] = "u -> y, x"
    kind: Literal["controller"]
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
        return controller(**self.arrays, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        model = self.linear_model(name, context)
        if self.period is None:
            return model
        all_held = np.ones(model.interface.n_u, np.bool_)
        dynamics = first_order_hold(model.A, model.B, self._seconds(name, context), all_held)
        kernel = kernels.sampled(dynamics, C=model.C, D=model.D, X0=model.X0)
        return self._sampled_model(name, Linear(model), kernel, context)


class DiscreteStateSpaceKind(StateSpaceKind, ExportableKind):
    """Discrete-time system x+ = A x + B u, y = C x + D u; u is sampled, y and x are held."""

    ports: ClassVar[str] = "u -> y, x"
    kind: Literal["discrete-state-space"]
    period: StepTime = Field(description="sample period [s], a multiple of the communication step")

    def build(self, name: str, context: BuildContext) -> DiscreteStateSpace:
        system = system_matrices("discrete-state-space", **self.arrays)
        return DiscreteStateSpace(system, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        component = self.build(name, context)
        system = component.system
        kernel = kernels.sampled(component.dynamics, C=system.C, D=system.D, X0=system.x0)
        return self._sampled_model(name, component, kernel, context)


class PidKind(SampledKind, ExportableKind):
    """PID controller in ISA form with limits and anti-windup; with a period: sampled."""

    ports: ClassVar[str] = "setpoint, measurement -> y, integral"
    tunable: ClassVar[tuple[str, ...]] = tuple(
        field.name for field in fields(PidParameters) if field.name != "initial_integral"
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
        period = None if self.period is None else self._seconds(name, context)
        parameters = PidParameters(**self.given("period", "offset"))
        return Pid(parameters, period=period, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        component = self.build(name, context)
        kernel = kernels.pid(component.constants, sampled=self.period is not None)
        if self.period is None:
            reason = "a controller with limits is not differentiable"
            return DiscreteModel(component.interface, kernel, 0, reason)
        return self._sampled_model(name, component, kernel, context)
