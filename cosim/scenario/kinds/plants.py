"""Plants: generated, real FMUs, recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, StrictBool, StrictInt, StrictStr

from cosim.blocks.plant import descriptor_form, descriptor_model
from cosim.blocks.replay import Replay
from cosim.blocks.sampled import Sampled
from cosim.core.contracts import Component
from cosim.core.solver import SOLVERS, STEPPING, DescriptorModel, LinearModel
from cosim.errors import UsageError, nearest
from cosim.scenario.kinds.base import Kind, Site
from cosim.scenario.schema import Number, Row

if TYPE_CHECKING:
    from cosim.fmi.compare import NearStart
    from cosim.fmi.description import Description, Mode

Scalar = StrictBool | StrictInt | Number | StrictStr
Start = Scalar | list[Scalar] | list[list[Scalar]] | list[list[list[Scalar]]]


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
        from cosim.fmi.driving.model_exchange import ModelExchange
        from cosim.fmi.generated import GeneratedUnit

        if self.solver not in SOLVERS:
            raise UsageError(f"solver: found {self.solver!r}; {nearest(self.solver, SOLVERS)}")
        return ModelExchange(GeneratedUnit.of(self.linear_model(name, site), name), solver=self.solver)

    def description(self, name: str, site: Site) -> tuple[Mode, Description] | None:
        from cosim.fmi.generated import GeneratedUnit

        return "me", GeneratedUnit.of(self.linear_model(name, site), name).description

    def linear_model(self, name: str, site: Site) -> LinearModel:
        return descriptor_model(site.model(self.model), self.x_a0)

    def descriptor_form(self, name: str, site: Site) -> DescriptorModel:
        return descriptor_form(site.model(self.model), self.x_a0)


class Fmu(Plant):
    """A real FMU, FMI 1.0, 2.0 or 3.0."""

    kind: Literal["fmu"]
    path: str = Field(description="path of the .fmu")
    mode: Literal["me", "cs"] | None = Field(
        None, description="model exchange or co-simulation; left out: me where it is offered"
    )
    solver: str | None = Field(None, description=f"for model exchange, one of: {', '.join(STEPPING)}")
    tolerance: Number | None = Field(
        None, description="relative tolerance of the states, for solvers that keep one; left out: 1e-9"
    )
    dae: Literal["ode", "residual"] = Field(
        "ode", description="with a residual form (FMI-LS-DAE), for model exchange: whether the FMU or this solver solves for it"
    )
    start: dict[str, Start] = Field(
        {},
        description="start values by variable: number, Boolean, item of an enumeration, text (a Binary in hexadecimal), list",
    )
    period: Number | None = Field(None, description="its own step [s]; left out: the communication step")

    @property
    def own_step(self) -> float | None:
        """Its period [s]."""
        return self.period

    def slowed(self, component: Component, n: int) -> Component:
        return component if n == 1 else Sampled(component, n)

    def build(self, name: str, site: Site) -> Component:
        return site.fmu(
            name,
            self.path,
            mode=self.mode,
            solver=self.solver,
            tolerance=self.tolerance,
            dae=self.dae,
            start=self.start,
        )

    def description(self, name: str, site: Site) -> tuple[Mode, Description] | None:
        from cosim.fmi.description import MODES
        from cosim.fmi.reading.model_description import read

        found = read(site.file(self.path)).description
        there: Mode = next(mode for mode in MODES if mode in found.capabilities)
        return self.mode or there, found

    def near_start(self, name: str, site: Site) -> NearStart:
        from cosim.fmi.compare import NearStart
        from cosim.fmi.linearising.linearise import linearize
        from cosim.fmi.reading.model_description import read

        path = site.file(self.path)
        if any(able.once_per_process for able in read(path).description.capabilities.values()):
            raise UsageError(f"{path}: there can be one instance only, which is in use")
        start = {variable: float(value) for variable, value in self.start.items() if isinstance(value, (int, float))}
        if len(start) < len(self.start):
            raise UsageError(f"{path}: can be linearised with numbers as start values only")
        found = linearize(path, start=start)
        error = max((one or 0.0 for one in found.errors.values()), default=0.0)
        return NearStart.of(found.A, found.B, found.C, found.D, error=error)


class Recording(Plant):
    """A component out of a recorded log."""

    kind: Literal["recording"]
    log: str = Field(description="path of the .mcap")
    component: str = Field(description="name of the component in the log")

    def build(self, name: str, site: Site) -> Component:
        recording = site.recording(self.log)
        if recording.end_ns / 1e9 < site.stop:
            raise UsageError(f"log {self.log!r} ends at {recording.end_ns / 1e9} s; needed {site.stop} s, the whole run")
        return Replay(recording, self.component)
