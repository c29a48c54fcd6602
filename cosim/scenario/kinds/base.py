"""The bases of the component kinds, and what a kind needs to build its component."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, TypeAlias, TypeVar

from pydantic import Field, PrivateAttr

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.clock import Clock, whole_steps
from cosim.core.connections import Connection
from cosim.core.contracts import Component
from cosim.core.linear import Linear, LinearModel
from cosim.core.port import Port
from cosim.core.recording import Recording
from cosim.core.signals import Interface, PortUnit, Signal
from cosim.instants import StepNs
from cosim.scenario.document.schema import AnyUnit, StepTime, TomlTable
from cosim.scenario.kinds.identified_plant import IdentifiedPlant
from cosim.scenario.kinds.initial_states import GivenStates
from cosim.theory.plants.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from cosim.blocks.field_data import FieldData
    from cosim.blocks.renaming import Renaming
    from cosim.fmi.component import Fmu
    from cosim.fmi.description import Description, InterfaceType
    from cosim.fmi.driving.model_exchange import ModelExchange
    from cosim.fmi.exporting.specifications import Exportable
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.fmi.linearizing.moving import MovingLinearization
    from cosim.fmi.linearizing.request import LinearizationRequest
    from cosim.fmi.options import FmuOptions
    from cosim.scenario.kinds.user_code import UserClass

T = TypeVar("T")
AnyKind = TypeVar("AnyKind", bound="Kind")

# a signal at instants of the run (N,) [s]
KnownSignal: TypeAlias = Callable[[Vector], Vector]


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """``x' = A x + B u``, ``y = C x + D u``: a component near its initial state.

    Parameters
    ----------
    A, B, C, D : Matrix, shapes (n_x, n_x), (n_x, n_u), (n_y, n_x), (n_y, n_u)
    error : float
        Estimate of the largest error of an entry; 0: rounding.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    error: float


@dataclass(frozen=True, slots=True)
class Spectrum:
    """What is known of a signal before the run.

    Parameters
    ----------
    amplitude : float
        Its root mean square.
    bandwidth : float
        Its highest rate [rad/s].
    source : Mapping
        What that was computed from, in plain values.
    assumption : str
        What was assumed.
    """

    amplitude: float
    bandwidth: float
    source: Mapping[str, Any]
    assumption: str


@dataclass(frozen=True, slots=True)
class Sampling:
    """At which communication points a component takes its inputs.

    Parameters
    ----------
    period : int
        Communication steps between two of them.
    offset : int
        Communication steps before the first one.
    holds : bool
        It holds the inputs of a point up to the next one; else those without a zero-order hold are
        interpolated linearly.
    """

    period: int
    offset: int
    holds: bool


@dataclass(frozen=True, slots=True, eq=False)
class ImpliedConnection:
    """A connection that [connections] does not write, for it follows from what the file does.

    Parameters
    ----------
    connection : Connection or None
        None: the origin has none either.
    origin : Port or None
        The input, or elements of it, whose connection it follows from; None: it follows from the
        component's own table.
    """

    connection: Connection | None
    origin: Port | None


def shared_connections(
    to: Port, origin: Port, connections: Mapping[Port, Connection]
) -> dict[Port, ImpliedConnection]:
    """Return the connections that an input shares with another input, as a whole or by elements."""
    shared = {}
    for port, connection in connections.items():
        if port.whole == origin:
            own = replace(port, component=to.component, signal=to.signal)
            shared[own] = ImpliedConnection(connection, port)
    return shared or {to: ImpliedConnection(None, origin)}


class BuildContext(Protocol):
    """What a kind may ask of the scenario that it is built in."""

    @property
    def clock(self) -> Clock:
        """The communication points of the run."""
        ...

    @property
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""
        ...

    @property
    def h(self) -> float:
        """Communication step, the double next to it [s]."""
        ...

    def model(self, name: str) -> DescriptorSystem:
        """Return a model of [models]."""
        ...

    def spec(self, name: str) -> Kind:
        """Return the table of another component."""
        ...

    def driver(self, to: Port) -> str | None:
        """Return the component that drives an input alone; None: there is no such component."""
        ...

    def sources(self, to: Port) -> Sequence[Port]:
        """Return the outputs, or elements of these, that drive an input, one behind the other.

        None of them: nothing drives it, or a matrix mixes them.
        """
        ...

    def file(self, path: str) -> Path:
        """Return the path of a file named in the scenario."""
        ...

    def recording(self, path: str) -> Recording:
        """Open a log."""
        ...

    def designed(self, name: str, design: Callable[[], T]) -> T:
        """Return the design of a component, which is made once in a build, whoever asks for it."""
        ...

    def field_data(self, name: str, read: Callable[[], FieldData]) -> FieldData:
        """Return the samples of a component, which are read once."""
        ...

    def mapped(self, name: str) -> Sequence[Port]:
        """Return the ports of a swapped component that its map names."""
        ...

    def of_kind(self, kind: type[AnyKind]) -> Mapping[str, AnyKind]:
        """Return the tables of all components of a kind."""
        ...

    def recorded_signals(self, name: str) -> Mapping[str, Signal]:
        """Return the signals that the recording has of a component, also of one computed again."""
        ...

    def recorded(self, name: str) -> Interface | None:
        """Return the interface of a component that is taken from a recording; None: it is not."""
        ...

    def drivers(self, to: Port) -> Mapping[str, Kind]:
        """Return the components that drive an input, as a whole or by its elements."""
        ...

    def behind(self, to: Port) -> Mapping[str, Kind]:
        """Return the components that an input follows: those that drive it, and those behind them.

        Nothing is followed through a component that is not computable.
        """
        ...

    def user_class(self, name: str, class_name: str, *, package: str | None = None) -> UserClass:
        """Import the class of a component, and record its source.

        ``package`` is the installed one that declares it, with its version; without it the module
        is looked for in the scenario's folder, then on sys.path.
        """
        ...

    def fmu(self, name: str, path: str, options: FmuOptions) -> Component:
        """Load an FMU; it is freed at the end of the run."""
        ...

    def add_states(self, name: str, component: ModelExchange) -> None:
        """Record what has the continuous states of a component, to hand them over."""
        ...

    def opened(self, name: str) -> Fmu:
        """Return the FMU that was loaded for a component."""
        ...

    def linearization(self, name: str, path: str, request: LinearizationRequest) -> Linearization:
        """Linearize an FMU for a component and record the result; a replay takes it from there."""
        ...

    def moving_linearization(
        self, name: str, path: str, request: LinearizationRequest
    ) -> MovingLinearization:
        """Return an FMU that is linearized on the way; it is freed at the end of the run."""
        ...

    def add_identified(self, name: str, identified: IdentifiedPlant) -> None:
        """Have the estimates of an identifier judged at the end of the run."""
        ...

    def add_metadata(self, name: str, metadata: Mapping[str, Any]) -> None:
        """Record metadata of a component for reports and the log."""
        ...

    def lag(self, to: Port) -> float:
        """Return how far the signal that drives an input lags behind what it estimates [s]."""
        ...

    def known(self, source: Port) -> KnownSignal | None:
        """Return an output, or an element of one, as a function of time, where that is known.

        None: only the run computes it.
        """
        ...

    def spectra(self, name: str) -> list[Spectrum]:
        """Return what is known of the signals of a component, by the tables of those it drives."""
        ...

    def chosen(
        self, name: str, request: Mapping[str, Any], choose: Callable[[], Mapping[str, Any]]
    ) -> Mapping[str, Any]:
        """Return what was chosen for a component, and record it; a replay takes it from there.

        ``request`` is what the choice rests on, ``choose`` makes it: plain values both.
        """
        ...

    def warn(self, name: str, text: str) -> None:
        """Record a warning: a component's result is right, but poorly conditioned or costly."""
        ...


class Wiring(Protocol):
    """What drives a component; computed only where it is asked for."""

    @property
    def held(self) -> Mask:
        """Which input elements keep their value over a communication step, shape (n_u,)."""
        ...


PortUnits: TypeAlias = AnyUnit | dict[str, AnyUnit | list[AnyUnit]] | None


def unit_of(ports: str) -> str:
    """Return the description of the key ``unit``, for kinds where one unit is that of ``ports``."""
    example = '{ u = "N", y = ["mm", "m/s"] }'
    return f"unit of {ports}, or units by port, of all elements or of each, such as {example}"


class Kind(TomlTable):
    """A component's table.

    Attributes
    ----------
    ports : str
        Inputs and outputs for people, such as ``u -> y``.
    is_static : bool
        Its outputs are functions of its inputs at the same instant, so that they lag as these do.
    is_function_of_time : bool
        It has no inputs, and its outputs are functions of time.
    is_recorded : bool
        It has no inputs, and its outputs are recorded.
    is_rerun : bool
        A replay can be told to compute it, though it takes it from the recording else: by its
        model, or by its FMU.
    continuous_inputs : mapping of input name to str
        Inputs that must not jump, and what can be done about one that does.
    tunable : tuple of str
        Keys with numbers that may be set in a run: another component with them, of the same kind,
        can go on from the state that this one has.
    tunable_elsewhere : str
        What else may be set in a run, in words.
    unit_port : str
        That ``unit`` is of, where it is one.
    """

    ports: ClassVar[str]
    is_static: ClassVar[bool] = False
    is_function_of_time: ClassVar[bool] = False
    is_recorded: ClassVar[bool] = False
    is_rerun: ClassVar[bool] = False
    continuous_inputs: ClassVar[Mapping[str, str]] = MappingProxyType({})
    tunable: ClassVar[tuple[str, ...]] = ()
    tunable_elsewhere: ClassVar[str] = ""
    unit_port: ClassVar[str] = "y"
    kind: str
    unit: PortUnits = Field(None, description=unit_of("y"))
    _is_allowed: bool = PrivateAttr(False)

    @property
    def unit_name(self) -> str | None:
        """The one unit of the table; None: there is none, or units by port."""
        return self.unit if isinstance(self.unit, str) else None

    @property
    def units(self) -> Mapping[str, PortUnit]:
        """The units of the table by port; of ``unit_port`` where there is one."""
        if isinstance(self.unit, str):
            return {self.unit_port: self.unit}
        return self.unit or {}

    def units_of(self, interface: Interface) -> Mapping[str, PortUnit]:
        """Return the units that the table declares of the ports of a component."""
        return self.units

    def given(self, *without: str) -> dict[str, Any]:
        """Return the values of its keys that have one, but of kind, unit and those named."""
        values = {key: getattr(self, key) for key in type(self).model_fields}
        for key in ("kind", "unit", *without):
            del values[key]
        return {key: value for key, value in values.items() if value is not None}

    @property
    def hands_on_lag(self) -> bool:
        """Whether its outputs lag as its inputs do."""
        return self.is_static

    @property
    def is_known(self) -> bool:
        """Whether its outputs are known before the run: functions of time, or recorded."""
        return self.is_function_of_time or self.is_recorded

    @property
    def computable(self) -> bool:
        """Whether a log alone is enough to compute the component again.

        If not, a replay takes it from the recording.
        """
        return True

    @property
    def code(self) -> str | None:
        """What names the code of a user that it runs, such as ``relay:Relay``; None: none."""
        return None

    def with_code(self) -> Self:
        """Return the table as that of a component that a replay computes, by files and code.

        These are no part of a log: that they are there and may be used is for the replay to see to.
        """
        allowed = self.model_copy()
        allowed._is_allowed = True
        return allowed

    @property
    def follows_inputs(self) -> bool:
        """Whether it has inputs; if not, connections to them are left out."""
        return True

    @property
    def draws_every_step(self) -> bool:
        """Whether it draws random numbers at every communication step: another step, others."""
        return False

    @property
    def jumps_at_points(self) -> bool:
        """Whether it is known to jump at communication points alone, whatever the step is.

        So does what has its instants from its table, as a period, or from what drives it.
        """
        return True

    @property
    def divided_times(self) -> tuple[float, ...]:
        """Times [s] of its table that need not be whole communication steps.

        Its error depends on the part of a step that they leave over.
        """
        return ()

    def decided(
        self, table: Mapping[str, Any], metadata: Mapping[str, Any], step_ns: StepNs
    ) -> Mapping[str, Any]:
        """Return the table with what the communication step has decided.

        With a smaller step it is the same then: an instant of a communication point, for example.

        Parameters
        ----------
        table : Mapping
            Of the component, as the scenario has it.
        metadata : Mapping
            That it has recorded while it was built.
        step_ns : int
            Communication step [ns] that it was built with.
        """
        return table

    def samples_of(self, output: str) -> str | None:
        """Return the output with another output's samples at times of their own; None: none."""
        return None

    @property
    def samples_at_points(self) -> bool:
        """Whether samples are of communication points, at most one of each."""
        return True

    def most_in_a_step(self, name: str, context: BuildContext) -> int:
        """Return for how many samples in a communication step there is a place; 0: none."""
        return 0

    def late_steps(self, context: BuildContext) -> int:
        """Return how many communication steps after its instant a sample may come."""
        return 0

    @property
    def models(self) -> tuple[str, ...]:
        """The models that a component is made of which is not computable."""
        return ()

    def advice(
        self, name: str, context: BuildContext, *, held: Mapping[str, bool], h: float
    ) -> list[str]:
        """Return warnings about what will be right but costly or poor.

        Parameters
        ----------
        name : str
            Of the component.
        context : BuildContext
            That it was built in.
        held : mapping of input name to bool
            Whether the input keeps its value over a communication step.
        h : float
            Communication step [s].
        """
        return []

    def lag(self, name: str, output: str, context: BuildContext) -> float:
        """Return how far an output lags behind what it estimates [s], as far as that is known."""
        return 0.0

    def spectrum(self, name: str, context: BuildContext) -> Spectrum | None:
        """Return what the table says of the signal that drives the component, if anything."""
        return None

    def period_steps(self, name: str, step_ns: StepNs) -> int:
        """Return the sample period in communication steps of ``step_ns``; 1 where there is none."""
        return 1

    def with_period(self, component: Component, n: int) -> Component:
        """Return the component with its sample period of ``n`` communication steps."""
        return component

    def sampling(self, n: int) -> Sampling | None:
        """Return when it takes its inputs, with a period of ``n`` steps; None: at every step."""
        return None

    def recorded_period(self, n: int) -> int:
        """Return which rows the log keeps, one in so many, with a period of ``n`` steps."""
        return n

    def tunable_parameters(self, name: str, context: BuildContext) -> Sequence[str]:
        """Return the keys that may be set in a run, which have a number or a row of numbers."""
        keys = []
        for key in self.tunable:
            value = getattr(self, key)
            row = value if isinstance(value, tuple) else (value,)
            if all(isinstance(number, int | float) for number in row):
                keys.append(key)
        return keys

    def tuned_fmu(self, name: str, context: BuildContext) -> Fmu | None:
        """Return the FMU whose parameters are set in place; None: there is none."""
        return None

    def implied_connections(
        self, name: str, connections: Mapping[Port, Connection], specs: Mapping[str, Kind]
    ) -> Mapping[Port, ImpliedConnection]:
        """Return the connections that hold where the file has none for these inputs.

        Parameters
        ----------
        name : str
            Of the component.
        connections : mapping of Port to Connection
            All of the scenario.
        specs : mapping of component name to Kind
            All of the scenario.
        """
        return {}

    def renamings(self, interface: Interface, given: Sequence[Renaming]) -> Sequence[Renaming]:
        """Return the renamings of a swap, and those that follow from them.

        Parameters
        ----------
        interface : Interface
            Of the component.
        given : sequence of Renaming
        """
        return given

    @abstractmethod
    def build(self, name: str, context: BuildContext) -> Component:
        """Build the component."""

    def description(
        self, name: str, context: BuildContext
    ) -> tuple[InterfaceType, Description] | None:
        """Return interface type and description of the FMI instance that it drives, if any."""
        return None

    def linear_system(self, name: str, context: BuildContext) -> LinearSystem | None:
        """Return the component near its initial state; None: it is not linear."""
        return None

    def given_states(self, name: str, context: BuildContext) -> GivenStates | None:
        """Return the initial states of which a run may keep a part only; None: there are none."""
        return None


class PeriodicKind(Kind):
    """A component that may have a sample period of its own, ``period``."""

    period: StepTime | None = Field(
        None,
        description="sample period [s], a multiple of the communication step; default: one step",
    )

    def period_steps(self, name: str, step_ns: StepNs) -> int:
        if self.period is None:
            return 1
        return whole_steps(self.period, step_ns, f"period of {name!r}")

    @abstractmethod
    def with_period(self, component: Component, n: int) -> Component:
        """Return what runs in place of the component, so that its sample period has an effect.

        * ``Sampled(component, n, hold=True)`` for a digital controller: it samples its inputs at
          the start of a period and holds them. Also for ``n`` = 1, unless ``period`` is None.
        * ``Sampled(component, n)`` for a component that advances by steps of a period, its inputs
          interpolated.
        * ``Decimated(component, n)`` for a component that advances by communication steps, but
          whose outputs change once a period.

        Parameters
        ----------
        component : Component
            What ``build`` returned.
        n : int
            Communication steps in a period; 1 also where ``period`` is None.
        """


class ExportableKind(Kind):
    """A component that can be exported as an FMU."""

    @abstractmethod
    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        """Return the model that an FMU is made of."""


class LinearKind(ExportableKind):
    """A component that is a linear model, which an exact solver steps."""

    @abstractmethod
    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        """Return the component as a linear model."""

    def build(self, name: str, context: BuildContext) -> Component:
        return Linear(self.linear_model(name, context))

    def linear_system(self, name: str, context: BuildContext) -> LinearSystem | None:
        model = self.linear_model(name, context)
        return LinearSystem(model.A, model.B, model.C, model.D, error=0.0)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        return self.linear_model(name, context)
