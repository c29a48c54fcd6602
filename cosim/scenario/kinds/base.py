"""What every component kind has: its table, and what it takes to build the component."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from cosim.arrays import Mask
from cosim.blocks.sampled import Decimated
from cosim.core.contracts import Component
from cosim.core.linear import DescriptorModel, Linear, LinearModel
from cosim.errors import UsageError
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.scenario.schema import TomlTable
from cosim.theory.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from cosim.fmi.description import Description, InterfaceType
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.fmi.options import FmuOptions
    from cosim.scenario.port_comparison import NearStart

Exportable: TypeAlias = LinearModel | DiscreteModel

LINEAR = (
    "descriptor",
    "unknown-input-observer",
    "controller",
    "lag",
)  # the kinds that are linear models
EXPORTABLE = (*LINEAR, "regressor", "identifier", "delay", "gain", "sum", "limit")


class BuildContext(Protocol):
    """What a kind may know about the scenario it is built in."""

    step_ns: int
    stop: float

    def model(self, name: str) -> DescriptorSystem:
        """Give a model of [models]."""
        ...

    def spec(self, name: str) -> Kind:
        """Give the table of another component."""
        ...

    def driver(self, to: str) -> str | None:
        """Give the component that drives an input, ``component.input``."""
        ...

    def file(self, path: str) -> Path:
        """Find a file named in the scenario."""
        ...

    def recording(self, path: str) -> Any:
        """Open a log."""
        ...

    def fmu(
        self,
        name: str,
        path: str,
        options: FmuOptions,
    ) -> Component:
        """Load an FMU; it is freed when the run is over."""
        ...

    def linearization(
        self,
        name: str,
        path: str,
        *,
        at: float,
        start: Mapping[str, Any],
        inputs: Sequence[str] | None,
        outputs: Sequence[str],
    ) -> Linearization:
        """Linearize an FMU for a component, and record the result; a replay takes it from there."""
        ...

    def note(self, name: str, **metadata: Any) -> None:
        """Record metadata of a component for reports and the log."""
        ...

    def warn(self, name: str, text: str) -> None:
        """Say that a result will be right but poorly conditioned or costly."""
        ...


class Wiring(Protocol):
    """Where a component stands among the others; worked out only where it is asked for."""

    @property
    def held(self) -> Mask:
        """Which input elements keep their value over a communication step, shape (n_u,)."""
        ...


class Kind(TomlTable):
    """A component's table."""

    kind: str

    @property
    def computable(self) -> bool:
        """Whether a log alone is enough to compute it again; if not, a replay takes it from the recording."""
        return True

    @property
    def sample_period(self) -> float | None:
        """Its period [s], where it has one."""
        return None

    def advice(self, held: Mapping[str, bool], h: float) -> list[str]:
        """Warn of what will be right but costly or poor, given which inputs are held over a communication step of ``h`` [s]."""
        return []

    def with_period(self, component: Component, n: int) -> Component:
        """Put the component on a period of ``n`` communication steps: it goes on at every step and answers at every n-th."""
        return component if n == 1 else Decimated(component, n)

    def build(self, name: str, context: BuildContext) -> Component:
        """Build the component."""
        return Linear(self.linear_model(name, context))

    def description(
        self, name: str, context: BuildContext
    ) -> tuple[InterfaceType, Description] | None:
        """Give the mode and the description of the unit that it drives, where it drives one."""
        return None

    def near_start(self, name: str, context: BuildContext) -> NearStart:
        """Give poles and static gain of the component, where it is linear or linearizes."""
        from cosim.scenario.port_comparison import NearStart

        model = self.linear_model(name, context)
        return NearStart.of(model.A, model.B, model.C, model.D, error=0.0)

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        """Give the component as a linear model, where it is one: what an exact solver steps and an FMU can be made of."""
        raise UsageError(
            f"{name!r} is of kind {self.kind!r}, which is no linear model; what is: {', '.join(LINEAR)}"
        )

    def descriptor_form(self, name: str, context: BuildContext) -> DescriptorModel:
        """Give the component as a linear model with its algebraic equations, where it has some."""
        raise UsageError(
            f"{name!r} is of kind {self.kind!r}, which has no algebraic equations; what has: descriptor"
        )

    def exportable(self, name: str, context: BuildContext, place: Wiring) -> Exportable:
        """Give what an FMU is made of."""
        if self.kind not in LINEAR:
            raise UsageError(
                f"{name!r} is of kind {self.kind!r}, which cannot be exported; what can be: {', '.join(EXPORTABLE)}"
            )
        return self.linear_model(name, context)
