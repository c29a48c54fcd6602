"""Plants: generated, real FMUs, recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, StrictBool, StrictInt, StrictStr

from cosim.blocks.plant import descriptor_form, descriptor_model
from cosim.blocks.replay import Replay
from cosim.blocks.sampled import Sampled
from cosim.core.contracts import Component
from cosim.core.linear import DescriptorModel, LinearModel
from cosim.errors import UsageError, nearest
from cosim.fmi.driving.solvers import SOLVERS, STEPPING
from cosim.scenario.kinds.base import BuildContext, Kind
from cosim.scenario.schema import Number, NumberRow

if TYPE_CHECKING:
    from cosim.fmi.description import Description, InterfaceType
    from cosim.scenario.port_comparison import NearStart

Scalar = StrictBool | StrictInt | Number | StrictStr
StartField = Scalar | list[Scalar] | list[list[Scalar]] | list[list[list[Scalar]]]


class PlantKind(Kind):
    """What a replay takes from the recording."""

    @property
    def computable(self) -> bool:
        """It is not."""
        return False


class DescriptorKind(PlantKind):
    """Plant generated from a descriptor model: E x' = A x + Bu u + Bd delta, y = C x."""

    kind: Literal["descriptor"]
    model: str = Field(description="name of a table in [models]")
    x_a0: NumberRow = Field(description="dynamic states at the start")
    solver: str = Field("exact", description=f"one of: {', '.join(SOLVERS)}")

    def build(self, name: str, context: BuildContext) -> Component:
        from cosim.fmi.driving.model_exchange import ModelExchange
        from cosim.fmi.generated import GeneratedInstance

        if self.solver not in SOLVERS:
            raise UsageError(f"solver: found {self.solver!r}; {nearest(self.solver, SOLVERS)}")
        return ModelExchange(
            GeneratedInstance.of(self.linear_model(name, context), name), solver=self.solver
        )

    def description(
        self, name: str, context: BuildContext
    ) -> tuple[InterfaceType, Description] | None:
        from cosim.fmi.generated import GeneratedInstance

        return "me", GeneratedInstance.of(self.linear_model(name, context), name).description

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        return descriptor_model(context.model(self.model), self.x_a0)

    def descriptor_form(self, name: str, context: BuildContext) -> DescriptorModel:
        return descriptor_form(context.model(self.model), self.x_a0)


class FmuKind(PlantKind):
    """A real FMU, FMI 1.0, 2.0 or 3.0."""

    kind: Literal["fmu"]
    path: str = Field(description="path of the .fmu")
    interface_type: Literal["me", "cs"] | None = Field(
        None, description="model exchange or co-simulation; left out: me where it is offered"
    )
    solver: str | None = Field(
        None, description=f"for model exchange, one of: {', '.join(STEPPING)}"
    )
    tolerance: Number | None = Field(
        None,
        description="relative tolerance of the states, for solvers that keep one; left out: 1e-9",
    )
    dae: Literal["ode", "residual"] = Field(
        "ode",
        description="with a residual form (FMI-LS-DAE), for model exchange: whether the FMU or this solver solves for it",
    )
    start: dict[str, StartField] = Field(
        {},
        description="start values by variable: number, Boolean, item of an enumeration, text (a Binary in hexadecimal), list",
    )
    period: Number | None = Field(
        None, description="its own step [s]; left out: the communication step"
    )

    @property
    def sample_period(self) -> float | None:
        """Its period [s]."""
        return self.period

    def with_period(self, component: Component, n: int) -> Component:
        return component if n == 1 else Sampled(component, n)

    def build(self, name: str, context: BuildContext) -> Component:
        from cosim.fmi.options import FmuOptions

        options = FmuOptions(
            interface_type=self.interface_type,
            solver=self.solver,
            tolerance=self.tolerance,
            dae=self.dae,
            start=self.start,
        )
        return context.fmu(name, self.path, options)

    def description(
        self, name: str, context: BuildContext
    ) -> tuple[InterfaceType, Description] | None:
        from cosim.fmi.description import INTERFACE_TYPES
        from cosim.fmi.reading.model_description import read

        found = read(context.file(self.path)).description
        there: InterfaceType = next(
            interface_type
            for interface_type in INTERFACE_TYPES
            if interface_type in found.capabilities
        )
        return self.interface_type or there, found

    def near_start(self, name: str, context: BuildContext) -> NearStart:
        from cosim.fmi.linearizing.linearize import linearize
        from cosim.fmi.reading.model_description import read
        from cosim.scenario.port_comparison import NearStart

        path = context.file(self.path)
        if any(able.once_per_process for able in read(path).description.capabilities.values()):
            raise UsageError(f"{path}: there can be one instance only, which is in use")
        start = {
            variable: float(value)
            for variable, value in self.start.items()
            if isinstance(value, (int, float))
        }
        if len(start) < len(self.start):
            raise UsageError(f"{path}: can be linearized with numbers as start values only")
        found = linearize(path, start=start)
        error = max((one or 0.0 for one in found.errors.values()), default=0.0)
        return NearStart.of(found.A, found.B, found.C, found.D, error=error)


class RecordingKind(PlantKind):
    """A component out of a recorded log."""

    kind: Literal["recording"]
    log: str = Field(description="path of the .mcap")
    component: str = Field(description="name of the component in the log")

    def build(self, name: str, context: BuildContext) -> Component:
        recording = context.recording(self.log)
        if recording.end_ns / 1e9 < context.stop:
            raise UsageError(
                f"log {self.log!r} ends at {recording.end_ns / 1e9} s; needed {context.stop} s, the whole run"
            )
        return Replay(recording, self.component)
