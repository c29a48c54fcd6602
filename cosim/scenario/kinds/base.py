"""The bases of the component kinds, and what a kind may ask of the scenario while it is built."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, TypeAlias, TypeVar

import numpy as np
from pydantic import Field, PrivateAttr

from cosim.arguments import mapping_argument, swap_argument
from cosim.arrays import Mask, Vector
from cosim.blocks.replay import Replay
from cosim.core.clock import Clock, whole_steps
from cosim.core.connections import Connection, component_driving, components_driving
from cosim.core.contracts import Component
from cosim.core.linear import Linear, LinearModel
from cosim.core.port import Port
from cosim.core.recorded.signals import find_channel
from cosim.core.recording import Recording
from cosim.core.signals import Interface, PortUnit
from cosim.core.structure.cycles import reached_from
from cosim.core.structure.ports import unknown_port
from cosim.errors import UsageError, nearest
from cosim.instants import StepNs, step_seconds, step_value
from cosim.scenario.document.document import Document
from cosim.scenario.document.places import Key
from cosim.scenario.document.schema import ActionTable, AnyUnit, File, StepTime, TomlTable
from cosim.scenario.document.swaps import Map, PortNames, ports_in
from cosim.scenario.kinds.build_record import TABLES_ALONE, BuildRecord, DependsOnInvalid, Origins
from cosim.scenario.kinds.models import check_form, system_of
from cosim.scenario.kinds.values import (
    ImpliedConnection,
    KnownSignal,
    LinearSystem,
    Sampling,
    Spectrum,
    StepDependence,
)
from cosim.scenario.record import component_record
from cosim.theory.plants.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from cosim.fmi.exporting.specifications import Exportable
    from cosim.scenario.session import Session

AnyKind = TypeVar("AnyKind", bound="Kind")


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
    follows_inputs: ClassVar[bool] = True
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
    def step_dependence(self) -> StepDependence:
        """What another communication step changes, beside the error of the step."""
        return StepDependence()

    def lag(self, name: str, output: str, context: BuildContext) -> float:
        """Return how far an output lags behind what it estimates [s], as far as that is known."""
        return 0.0

    def spectrum(self, name: str, context: BuildContext) -> Spectrum | None:
        """Return what the table says of the signal that drives the component, if anything."""
        return None

    @property
    def tunable_parameters(self) -> Sequence[str]:
        """The keys that may be set in a run, which have a number or a row of numbers."""
        keys = []
        for key in self.tunable:
            value = getattr(self, key)
            row = value if isinstance(value, tuple) else (value,)
            if all(isinstance(number, int | float) for number in row):
                keys.append(key)
        return keys

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

    @abstractmethod
    def build(self, name: str, context: BuildContext) -> Component:
        """Build the component."""


class PeriodicKind(Kind):
    """A component that may have a sample period of its own, ``period``."""

    period: StepTime | None = Field(
        None,
        description="sample period [s], a multiple of the communication step; default: one step",
    )

    def period_steps(self, name: str, step_ns: StepNs) -> int:
        """Return the sample period in communication steps; 1 where there is none."""
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

    def sampling(self, n: int) -> Sampling | None:
        """Return when it takes its inputs, with a period of ``n`` steps; None: at every step."""
        return None

    def recorded_period(self, n: int) -> int:
        """Return which rows the log keeps, one in so many, with a period of ``n`` steps."""
        return n


class ExportableKind(Kind):
    """A component that can be exported as an FMU."""

    @abstractmethod
    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        """Return the model that an FMU is made of."""


class LinearNearStart(ABC):
    """It is linear near its initial state, or may be."""

    @abstractmethod
    def linear_system(self, name: str, context: BuildContext) -> LinearSystem | None:
        """Return the component near its initial state; None: it is not linear."""


class LinearKind(ExportableKind, LinearNearStart):
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


# --- the scenario, and the context of its build ---


@dataclass(frozen=True, repr=False)
class Scenario:
    """A validated scenario.

    Parameters
    ----------
    document : Document
    file : File
    specs : mapping of component name to Kind
    connections : mapping of Port to Connection
        By input, or elements of it; those that kinds imply among them.
    implied : mapping of Port to Port or None
        Inputs that [connections] leaves open, and the ones that they share their sources with;
        None: they follow from the component's own table.
    maps : mapping of component name to Map
        Of the swapped components.
    tree : mapping
        The tables as they stand in the file, edits applied.
    parse : callable
        Makes a scenario of an edited document; see :func:`cosim.scenario.building.build.parse`.
    invalid : frozenset of Key
        The tables and their entries that are wrong, so that they are missing in ``file`` or have
        values that stand for others; what rests on them cannot be checked.
    actions : mapping of number to ActionTable
        Those of [[actions]] whose tables are right.
    notes : tuple of (component name, text)
        What becomes of the inputs of components that follow none.
    starter : callable or None
        Starts the scenario (:mod:`cosim.scenario.running.execution`); None: it is only read here.
    """

    document: Document
    file: File
    specs: Mapping[str, Kind]
    connections: Mapping[Port, Connection]
    implied: Mapping[Port, Port | None]
    maps: Mapping[str, Map]
    tree: Mapping[str, Any]
    parse: Callable[[Document], Scenario] = field(compare=False)
    invalid: frozenset[Key] = frozenset()
    actions: Mapping[int, ActionTable] = field(default_factory=dict)
    notes: tuple[tuple[str, str], ...] = ()
    starter: Callable[..., Session] | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        return f"<the scenario {self.name!r}: {len(self.specs)} components>"

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.file.scenario.name

    def driver(self, to: Port) -> str | None:
        """Return the component that drives an input alone, as a whole or by its elements.

        None: nothing drives it, or sources of several components do.
        """
        return component_driving(self.connections, to)

    def sources(self, to: Port) -> frozenset[str]:
        """Return the components that drive an input, as a whole or by its elements."""
        return components_driving(self.connections, to)

    @cached_property
    def drivers(self) -> dict[str, set[str]]:
        """The components that drive any input of each component."""
        drivers: dict[str, set[str]] = {name: set() for name in self.specs}
        for to, connection in self.connections.items():
            sources = {source.component for source in connection.sources}
            drivers.setdefault(to.component, set()).update(sources)
        return drivers

    def upstream(self, component: str) -> Scenario:
        """Return the scenario of a component and of all that it depends on, without the others."""
        needed = reached_from([component], self.drivers)
        connections = {to: c for to, c in self.connections.items() if to.component in needed}
        specs = {name: spec for name, spec in self.specs.items() if name in needed}
        return replace(self, specs=specs, connections=connections)

    def edit(
        self,
        *,
        swap: Mapping[str, str | Path] | None = None,
        map: Mapping[str, PortNames] | None = None,
        set: Mapping[str, Any] | None = None,
    ) -> Scenario:
        """Return the scenario with components swapped, their ports mapped, then values set.

        Raises
        ------
        UsageError
            If one of these is no mapping, or has values of other types.
        ScenarioError
            With every problem of the file and of these edits.
        """
        paths = swap_argument(swap)
        names = mapping_argument("map", map)
        changes = mapping_argument("set", set)
        if not (paths or names or changes):
            return self
        document = self.document
        if paths or names:
            document = document.with_swaps(paths, names)
        if changes:
            document = document.with_changes(changes)
        return self.parse(document)

    def swap(self, *, map: Mapping[str, PortNames] | None = None, **paths: str | Path) -> Scenario:
        """Replace components: by an FMU (.fmu), a recorded one (.mcap), samples (.csv, ...).

        ``map`` gives the names that ports have there, such as ``{"observer.y": "out1"}``; see
        :mod:`cosim.scenario.document.swaps`.
        """
        return self.edit(swap=paths, map=map)

    def start(
        self,
        *,
        out: str | Path | None = None,
        force: bool = False,
        numbered: bool = False,
    ) -> Session:
        """Start the scenario, to advance it step by step: a context manager.

        Parameters
        ----------
        out : str or Path, optional
            Log file to write; without it nothing is recorded.
        force : bool
            Replace a log at ``out``.
        numbered : bool
            Where there is a log at ``out``, write to the next free one of ``x-2.mcap``, ...

        Raises
        ------
        CosimError
            UsageError if the scenario cannot be built or the log not be written, RunError if an
            initial value is not finite.
        """
        assert self.starter is not None, "what users load can be started"
        return self.starter(self, out, force=force, numbered=numbered)

    def set(self, changes: Mapping[str, Any]) -> Scenario:
        """Set values by dotted key, such as ``{"observer.filter_rate": 500.0}``."""
        return self.edit(set=changes)


def _first_element(port: Port) -> int:
    """Return where a port begins in its signal."""
    match port.element:
        case None:
            return 0
        case int():
            return port.element
        case range():
            return port.element.start


class BuildContext(BuildRecord):
    """What a kind may ask of the scenario while its component is built.

    All that it answers may raise ``DependsOnInvalid``.

    Parameters
    ----------
    scenario : Scenario
    resources : ExitStack
        Closes what is opened.
    origins : Origins
        Where components come from, beside their tables.
    invalid : iterable of Key
        What is known to be wrong beside ``scenario.invalid``.

    Attributes
    ----------
    invalid : set of Key
        What is known to be wrong.
    """

    def __init__(
        self,
        scenario: Scenario,
        resources: ExitStack,
        origins: Origins = TABLES_ALONE,
        invalid: Iterable[Key] = (),
    ) -> None:
        super().__init__(scenario.document.folder, resources, origins, scenario.connections)
        self.invalid = {*scenario.invalid, *invalid}
        self._scenario = scenario
        self._specs = scenario.specs

    def beside(self, scenario: Scenario, name: str) -> BuildContext:
        """Return a context of its own for one more build of a component, with another table."""
        origins = Origins(recording=self.origins.recording)
        context = BuildContext(scenario, self._resources, origins)
        context.begin(name)
        return context

    @cached_property
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""
        self._need(("scenario", "step"))
        return Clock.step_of(self._scenario.file.scenario.step)

    @property
    def h(self) -> float:
        """Communication step, the double next to it [s]."""
        return step_seconds(self.step_ns)

    @cached_property
    def clock(self) -> Clock:
        """The clock of the run, with blocks of any size."""
        for name in ("step", "start_time", "stop"):
            self._need(("scenario", name))
        return self._scenario.file.scenario.clock

    def _need(self, key: Key) -> None:
        """Check that an entry of a table is right, as far as that is known.

        Raises
        ------
        DependsOnInvalid
            If it is not, which is reported.
        """
        if not self.invalid.isdisjoint({key, key[:1]}):
            raise DependsOnInvalid

    def model(self, name: str) -> DescriptorSystem:
        """Return a model of [models], and record that it was read.

        Raises
        ------
        UsageError
            If there is none of that name, or its matrices do not fit together.
        ValueError
            If the rows of a matrix have different lengths.
        """
        self._need(("models", name))
        tables = self._scenario.file.models
        if name not in tables:
            raise UsageError(f"unknown model {name!r} in [models]; {nearest(name, tables)}")
        self.read(f"models.{name}")
        table = tables[name]

        def make() -> DescriptorSystem:
            check_form(table)
            return system_of(table, None if table.file is None else self.matrices(name, table.file))

        return self.made_once("model", name, make)

    def spec(self, name: str) -> Kind:
        """Return the table of another component, and record that it was read."""
        self.read(f"components.{name}")
        if name not in self._specs:
            raise DependsOnInvalid
        return self._specs[name]

    def driver(self, to: Port) -> str | None:
        """Return the component that drives an input alone; None: there is no such component."""
        self._need_connected(to)
        return self._scenario.driver(to)

    def sources(self, to: Port) -> list[Port]:
        """Return the outputs, or elements of these, that drive an input, one behind the other.

        None of them: nothing drives it, or a matrix mixes them.
        """
        self._need_connected(to)
        connections = self._scenario.connections
        ports = [port for port in connections if port.whole == to]
        sources: list[Port] = []
        for port in sorted(ports, key=_first_element):
            if connections[port].matrix.ndim:
                return []
            sources += connections[port].sources
        return sources

    def drivers(self, to: Port) -> Mapping[str, Kind]:
        """Return the components that drive an input, as a whole or by its elements."""
        self._need_connected(to)
        names = sorted(self._scenario.sources(to))
        return {name: self._specs[name] for name in names if name in self._specs}

    def behind(self, to: Port) -> Mapping[str, Kind]:
        """Return the components that an input follows, up to those that are not computable."""
        drivers = self._scenario.drivers
        followed = {n: drivers[n] for n, spec in self._specs.items() if spec.computable}
        reached = reached_from(self.drivers(to), followed)
        return {name: self._specs[name] for name in reached if name in self._specs}

    def _need_connected(self, to: Port) -> None:
        """Check that what drives an input is right, as far as that is known.

        Raises
        ------
        DependsOnInvalid
            If it is not, which is reported.
        """
        self._need(("connections",))
        for key in self.invalid:
            if key[0] == "connections" and to in [port.whole for port in ports_in(key[1:2])]:
                raise DependsOnInvalid

    def mapped(self, name: str) -> list[Port]:
        """Return the ports of a swapped component that its map names."""
        ports: list[Port] = []
        for renaming in self._scenario.maps.get(name, {}).values():
            ports += renaming.sources
        return ports

    def of_kind(self, kind: type[AnyKind]) -> dict[str, AnyKind]:
        """Return the tables of all components of a kind."""
        specs = self._specs.items()
        return {name: spec for name, spec in specs if isinstance(spec, kind)}

    def recorded(self, name: str) -> Interface | None:
        """Return the interface of a component that is taken from a recording; None: it is not."""
        recording = self.replayed_from(self.spec(name))  # counts as read, in a run, too
        if recording is None:
            return None
        return find_channel(recording.channels, name, source=recording.label).interface

    def replayed_from(self, spec: Kind) -> Recording | None:
        """Return the recording of a component that a log is not enough to compute; None: it is."""
        return None if spec.computable else self.origins.recording

    def lag(self, to: Port) -> float:
        """Return how far the signal that drives an input lags behind what it estimates [s].

        Signals that pass through static components on their way keep their lag. Of what is wrong in
        the file, and so reported, nothing is known.

        Raises
        ------
        UsageError
            If it is made of signals that lag differently.
        """
        connections = self._scenario.connections
        lags: dict[float, Port] = {}
        seen: set[str] = set()
        waiting = [port for port in connections if to in (port, port.whole)]
        for port in waiting:  # grows on the way
            for source in (source.whole for source in connections[port].sources):
                name = source.component
                spec = self._specs.get(name)
                if spec is None:
                    continue
                self.read(f"components.{name}")
                if not spec.hands_on_lag:
                    lags[self._lag_of(spec, source)] = source
                elif name not in seen:
                    seen.add(name)
                    waiting += [port for port in connections if port.component == name]
        if len(lags) > 1:
            sources = ", ".join(f"{source} by {lag:g} s" for lag, source in lags.items())
            raise UsageError(f"{to.name!r}: expected signals with equal lags, got {sources}")
        return next(iter(lags), 0.0)

    def _lag_of(self, spec: Kind, source: Port) -> float:
        recording = self.replayed_from(spec)
        if recording is not None:
            return component_record(recording, source.component).lags.get(source.signal, 0.0)
        with self.reported_by(source.component):
            return spec.lag(source.component, source.signal, self)

    def known(self, source: Port) -> KnownSignal | None:
        """Return an output, or an element of one, as a function of time, where that is known."""
        spec = self.spec(source.component)
        if not spec.is_known or source.component in self._scenario.maps:
            return None
        name = source.component
        component = self.made_once("source", name, lambda: self._source(name, spec))
        matched = source.find({signal.name: signal for signal in component.interface.outputs})
        if matched is None:
            raise unknown_port(source, component.interface, "output")
        signal, elements = matched
        column = component.interface.output_columns()[signal.name].start + elements.start
        if spec.is_recorded or self.replayed_from(spec) is not None:
            return _interpolated(component, column, self.clock)
        return partial(_values_at, component, column)

    def _source(self, name: str, spec: Kind) -> Component:
        """Return a component without inputs, beside that of the run."""
        recording = self.replayed_from(spec)
        if recording is not None:
            return Replay(recording, name)
        count = len(self.warnings)
        try:
            with self.reported_by(name):
                return spec.build(name, self)
        finally:
            del self.warnings[count:]  # it warns where it is built for the run

    def spectra(self, name: str) -> list[Spectrum]:
        """Return what is known of the signals of a component, by the tables of those it drives."""
        spectra = []
        for to, connection in self._scenario.connections.items():
            sources = {source.component for source in connection.sources}
            if name not in sources:
                continue
            spec = self._specs.get(to.component)
            if spec is None:
                continue
            spectrum = spec.spectrum(to.component, self)
            if spectrum is not None:
                self.read(f"components.{to.component}")
                spectra.append(spectrum)
        return spectra

    def recording(self, path: str) -> Recording:
        """Open a log with the scenario's communication step.

        Raises
        ------
        UsageError
            If it has another one, or is not to be opened; see :meth:`file`.
        LogError
            If it cannot be read.
        """
        from cosim.log import open_log

        log = open_log(self.file(path))
        if log.step_ns != self.step_ns:
            log_step = step_value(log.step_ns)
            step = step_value(self.step_ns)
            raise UsageError(
                f"log {path!r}: expected steps of {step} s as in the scenario, got {log_step} s"
            )
        return log


def _values_at(component: Component, column: int, t: Vector) -> Vector:
    """Return an output of a component without inputs, whose outputs are functions of time."""
    no_inputs = np.zeros((len(t) + 1, 0))
    ends_of_steps = np.concatenate([t[:1], t])  # where the first one begins does not matter
    values: Vector = component.advance(ends_of_steps, 0.0, no_inputs)[:, column]
    return values


def _interpolated(component: Component, column: int, clock: Clock) -> KnownSignal:
    """Return an output of a recorded component, between its rows by linear interpolation."""
    points = clock.points
    values = _values_at(component, column, points)

    def at(t: Vector) -> Vector:
        interpolated: Vector = np.interp(t, points, values)
        return interpolated

    return at
