"""Plants: generated, real FMUs, recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator, Field, StrictStr

from cosim.blocks.plant import descriptor_form, descriptor_model
from cosim.blocks.replay import Replay
from cosim.blocks.sampled import Sampled
from cosim.core.contracts import Component
from cosim.core.linear import DescriptorModel, LinearModel
from cosim.errors import UsageError, nearest
from cosim.fmi.driving.solvers import SOLVERS, STEPPING
from cosim.instants import NANOSECONDS, Grid
from cosim.scenario.document.schema import Flag, Number, NumberRow, Whole
from cosim.scenario.kinds.base import BuildContext, Kind, LinearKind, LinearNearStart, PeriodicKind
from cosim.scenario.kinds.capabilities import GivenStates, HasDescription, HasGivenStates
from cosim.scenario.kinds.values import LinearSystem, Sampling, StepDependence
from cosim.scenario.record import component_record
from cosim.theory.plants.descriptor import DescriptorSystem, reduce

if TYPE_CHECKING:
    from cosim.fmi.description import Description, InterfaceType
    from cosim.fmi.generated import GeneratedInstance

Scalar = Flag | Whole | Number | StrictStr
StartField = Scalar | list[Scalar] | list[list[Scalar]] | list[list[list[Scalar]]]


def _dotted(value: Any) -> Any:
    """Return start values by the names of variables: of ``damper.d`` TOML makes tables."""
    if not isinstance(value, dict):
        return value
    names: dict[Any, Any] = {}
    for name, inner in value.items():
        found = {name: inner}
        if isinstance(inner, dict) and inner:
            found = {f"{name}.{part}": entry for part, entry in _dotted(inner).items()}
        twice = names.keys() & found
        if twice:
            raise ValueError(f"{min(twice)!r} is given twice, with dots and in quotes")
        names |= found
    return names


StartFields = Annotated[dict[str, StartField], BeforeValidator(_dotted)]


class PlantKind(Kind):
    """A component that a replay takes from the recording."""

    @property
    def computable(self) -> bool:
        """It is not, unless a replay is told to compute it."""
        return self._is_allowed


class DescriptorKind(PlantKind, LinearKind, HasDescription, HasGivenStates):
    """Plant of a descriptor model: E x' = A x + Bu u + Bd delta, y = C x + Du u + Dd delta.

    Where the model has n_a its states are x_a and x_b, else x.
    """

    ports: ClassVar[str] = "u, delta -> y, x_a, x_b, or y, x of a general model"
    is_rerun: ClassVar[bool] = True
    kind: Literal["descriptor"]
    model: str = Field(description="name of a table in [models]")
    x_a0: NumberRow | None = Field(
        None, description="initial dynamic states; required with a model with n_a"
    )
    x0: NumberRow | None = Field(
        None,
        description="initial states; required with any other model; E x0 is used, algebraic states "
        "follow from it, u and delta",
    )
    solver: str = Field("exact", description=f"solver: {', '.join(SOLVERS)}")

    def build(self, name: str, context: BuildContext) -> Component:
        from cosim.fmi.driving.model_exchange import ModelExchange

        if self.solver not in SOLVERS:
            raise UsageError(f"unknown solver {self.solver!r}; {nearest(self.solver, SOLVERS)}")
        component = ModelExchange(self._instance(name, context), solver=self.solver)
        inaccuracy = reduce(context.model(self.model)).inaccuracy
        if inaccuracy:
            context.warn(name, inaccuracy)
        context.add_metadata(name, component.metadata)
        context.model_exchange[name] = component
        return component

    def description(self, name: str, context: BuildContext) -> tuple[InterfaceType, Description]:
        return "me", self._instance(name, context).description

    def _instance(self, name: str, context: BuildContext) -> GeneratedInstance:
        from cosim.fmi.generated import GeneratedInstance

        return GeneratedInstance.of(self.linear_model(name, context), name)

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        system = context.model(self.model)
        return descriptor_model(system, self._initial(system))

    def descriptor_form(self, context: BuildContext) -> DescriptorModel:
        """Return the component as a linear model with its algebraic equations."""
        system = context.model(self.model)
        return descriptor_form(system, self._initial(system))

    def given_states(self, name: str, context: BuildContext) -> GivenStates | None:
        system = context.model(self.model)
        coordinates = reduce(system).coordinates
        if coordinates is None:
            return None
        return GivenStates(np.array(self._initial(system), np.float64), coordinates)

    def _initial(self, system: DescriptorSystem) -> NumberRow:
        """Return the initial states; raise UsageError if they are missing, or of another form."""
        values = initial_in_form(
            self.model, is_general=system.n_a is None, x0=self.x0, x_a0=self.x_a0
        )
        if values is None:
            key = "x0" if system.n_a is None else "x_a0"
            n = system.n_a or len(system.A)
            raise UsageError(
                f"{key} is missing; expected {n} numbers, the states of {self.model!r}"
            )
        return values


def initial_in_form(
    model: str, *, is_general: bool, x0: NumberRow | None, x_a0: NumberRow | None
) -> NumberRow | None:
    """Return x0 of a model in the general form, x_a0 of one with n_a.

    Raises
    ------
    UsageError
        If the table has the other one.
    """
    if is_general and x_a0 is not None:
        raise UsageError(f"x_a0: the model {model!r} has the states x; expected x0")
    if not is_general and x0 is not None:
        raise UsageError(
            f"x0: the model {model!r} has n_a: its states are x_a and x_b; expected x_a0"
        )
    return x0 if is_general else x_a0


class FmuKind(PlantKind, PeriodicKind, HasDescription, LinearNearStart):
    """An FMU of FMI 1.0, 2.0 or 3.0."""

    ports: ClassVar[str] = "those of the FMU"
    is_rerun: ClassVar[bool] = True
    tunable_elsewhere: ClassVar[str] = (
        "parameters that the FMU declares tunable; 'cosim info' lists them"
    )
    kind: Literal["fmu"]
    path: str = Field(description="path of the .fmu file")
    interface_type: Literal["me", "cs"] | None = Field(
        None, description='"me" (model exchange) or "cs" (co-simulation); default: me if available'
    )
    solver: str | None = Field(
        None, description=f"model exchange: {', '.join(STEPPING)}; default: RK45"
    )
    tolerance: Number | None = Field(
        None, description="relative tolerance of variable-step solvers; default: 1e-9"
    )
    max_step: Number | None = Field(
        None,
        description="model exchange: longest step of the solver [s], shorter than what may be "
        "over within one step, such as a pulse; default: none",
    )
    dae: Literal["ode", "residual"] = Field(
        "ode",
        description="model exchange with a residual form (FMI-LS-DAE): solved by the FMU "
        '("ode") or by the solver ("residual")',
    )
    start: StartFields = Field(
        {},
        description="start values by variable: number, Boolean, enumeration item, string "
        "(Binary as hexadecimal), list",
    )
    outputs: list[StrictStr] = Field(
        [],
        description="local variables and parameters to add to the outputs, or patterns such as "
        "\"damper.*\"; 'cosim info' lists them",
    )

    input_interpolation: Literal["linear", "zero-order"] | None = Field(
        None,
        description='inputs within a step, or a period: "linear" (of co-simulation without input '
        'derivatives: the mean of both ends), or over a period "zero-order" hold; default: '
        '"linear", and the latest value where co-simulation without input derivatives follows '
        "what may jump",
    )

    @property
    def step_dependence(self) -> StepDependence:
        return StepDependence(jumps_at_points=self.period is not None)

    def with_period(self, component: Component, n: int) -> Component:
        hold = self.input_interpolation == "zero-order"
        if self.period is None and hold:
            raise UsageError(
                'input_interpolation: expected "linear" where there is no period, got '
                '"zero-order"; with the communication step as its period it holds its inputs'
            )
        return component if n == 1 and not hold else Sampled(component, n, hold=hold)

    def sampling(self, n: int) -> Sampling | None:
        if self.period is None:
            return None
        return Sampling(n, 0, self.input_interpolation == "zero-order")

    def build(self, name: str, context: BuildContext) -> Component:
        from cosim.fmi.options import FmuOptions

        keys = self.given("path", "period", "input_interpolation")
        options = FmuOptions(**keys, step=float(self.period or context.h))
        return context.fmu(name, self.path, options)

    def description(self, name: str, context: BuildContext) -> tuple[InterfaceType, Description]:
        fmu = context.opened(name)
        return fmu.interface_type, fmu.description

    def linear_system(self, name: str, context: BuildContext) -> LinearSystem:
        """Linearize the FMU at its initial state.

        An FMU that was loaded for model exchange is reset before and after; one for co-simulation
        that is for both is loaded once more.

        Raises
        ------
        FmuError
            If it cannot be linearized.
        """
        from cosim.fmi.linearizing.linearize import linearize

        fmu = context.opened(name)
        outputs = []  # states among them
        for _, variables in fmu.description.ports("output"):
            for variable in variables:
                is_smooth = (variable.signal_type, variable.variability) == ("real", "continuous")
                is_state = variable.name in fmu.description.local_states
                if is_smooth and (is_state or variable.causality == "output"):
                    outputs.append(variable.name)
        which = fmu.instance if fmu.interface_type == "me" else context.file(self.path)
        found = linearize(which, start=self.start, outputs=outputs)
        errors = [error or 0.0 for error in found.errors.values()]
        return LinearSystem(found.A, found.B, found.C, found.D, error=max(errors, default=0.0))


class RecordingKind(PlantKind):
    """A component of a recorded log."""

    ports: ClassVar[str] = "-> outputs of the recording"
    is_recorded: ClassVar[bool] = True
    kind: Literal["recording"]
    log: str = Field(description="path of the .mcap log")
    component: str = Field(description="name of the component in the log")

    def build(self, name: str, context: BuildContext) -> Component:
        from cosim.log.foreign.topics import is_foreign  # rarely needed

        if is_foreign(context.file(self.log)):
            raise UsageError(
                f"log {self.log!r} was written by another tool; swap in '{self.log}#samples', or "
                'use kind = "field-data" with path in place of log'
            )
        recording = context.recording(self.log)
        replay = Replay(recording, self.component, unrecorded=True)
        clock = context.clock
        begin_ns = int(recording.time_ns(self.component)[0])
        begin = begin_ns / NANOSECONDS
        end = recording.end_ns / NANOSECONDS
        if begin_ns > clock.start_ns or recording.end_ns < clock.grid.stamp(clock.steps):
            raise UsageError(
                f"log {self.log!r}: expected rows from {clock.start_time} s to {clock.stop} s (the "
                f"run), got {begin} s to {end} s"
            )
        recorded = Grid(begin_ns, clock.step_ns)
        if recorded.stamp(recorded.number(clock.start_ns)) != clock.start_ns:
            raise UsageError(
                f"log {self.log!r}: expected a row at start_time, {clock.start_time} s, got rows "
                f"at {begin} s and multiples of {clock.h} s after it"
            )
        lags = component_record(recording, self.component).lags
        if lags:
            context.add_metadata(name, {"lags": lags})
        outputs = {f"{self.component}.{signal.name}" for signal in replay.interface.outputs}
        events = recording.events()
        substeps = recording.substeps()
        # a row has one value, here that before a jump
        jumps = {event.time_ns / NANOSECONDS for event in events if event.signal in outputs}
        ends = {one.end for one in substeps if one.accepted and one.event == self.component}
        for what, times, shown in (
            ("jump(s)", jumps, "what it drives gets a ramp of a step instead"),
            ("event(s) between communication points", ends, "between its rows it is linear here"),
        ):
            if times:
                context.warn(
                    name,
                    f"{self.component!r} of {self.log} has {len(times)} {what}, the first at t = "
                    f"{min(times)} s: {shown}; a replay of that log itself has them",
                )
        return replay

    def lag(self, name: str, output: str, context: BuildContext) -> float:
        record = component_record(context.recording(self.log), self.component)
        return record.lags.get(output, 0.0)
