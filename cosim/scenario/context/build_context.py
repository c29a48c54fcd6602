"""What kinds may ask of the scenario while their components are built."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from cosim.arrays import Vector
from cosim.blocks.replay import Replay
from cosim.core.clock import Clock
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.recorded.signals import find_channel
from cosim.core.recording import Recording
from cosim.core.signals import Interface, Signal
from cosim.core.structure.ports import unknown_port
from cosim.documents import plain
from cosim.errors import CosimError, UsageError
from cosim.instants import StepNs, step_seconds, step_value
from cosim.scenario.context.build_records import BuildRecords, KeptAnswer, LookedUpKinds
from cosim.scenario.context.fmus import NONE_AGAIN, RecordedFmu, ScenarioFmus
from cosim.scenario.context.named_files import NamedFiles
from cosim.scenario.context.scenario_models import ScenarioModels
from cosim.scenario.context.user_classes import UserClasses
from cosim.scenario.identification.model import IdentifiedPlant
from cosim.scenario.kinds import Kind
from cosim.scenario.kinds.base import AnyKind, KnownSignal, Spectrum
from cosim.scenario.parsing import Scenario
from cosim.scenario.places import Key
from cosim.scenario.record import component_record
from cosim.scenario.swaps import ports_in
from cosim.theory.plants.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from cosim.blocks.field_data import FieldData
    from cosim.fmi.component import Fmu
    from cosim.fmi.driving.model_exchange import ModelExchange
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.fmi.linearizing.moving import MovingLinearization
    from cosim.fmi.linearizing.request import LinearizationRequest
    from cosim.fmi.options import FmuOptions
    from cosim.fmi.unpacked import UnpackedFmus
    from cosim.scenario.user_kinds.user_code import UserClass

T = TypeVar("T")


def clock_of(scenario: Scenario) -> Clock:
    """Return the clock of a scenario.

    Raises
    ------
    ClockError
        If one of its times is off the grid.
    """
    settings = scenario.file.scenario
    return Clock(settings.stop, settings.step, start_time=settings.start_time)


def _first_element(port: Port) -> int:
    """Return where a port begins in its signal."""
    match port.element:
        case None:
            return 0
        case int():
            return port.element
        case range():
            return port.element.start


class DependsOnInvalid(UsageError):
    """A component cannot be checked because something that it reads is wrong and reported."""


class ScenarioBuildContext:
    """Answers what kinds ask, and records what each component reads, and what it opens.

    See :class:`cosim.scenario.kinds.BuildContext`. Where it only ``describes``, nothing of an FMU
    runs. All that it answers may raise ``DependsOnInvalid``.

    Parameters
    ----------
    scenario : Scenario
    resources : ExitStack
        Closes what is opened.
    recording : Recording or None
    named_files : collection of str
        What a replay may open.
    invalid : iterable of Key
        What is known to be wrong beside ``scenario.invalid``.
    describes : bool
    fmus_again : mapping of component name to RecordedFmu
        Those of a recorded run that a replay runs again.
    unpacked : UnpackedFmus or None
        Where FMUs are unpacked and loaded for all builds of a process; None: for this one.

    Attributes
    ----------
    invalid : set of Key
        What is known to be wrong.
    records : BuildRecords
    files : NamedFiles
    models : ScenarioModels
    fmus : ScenarioFmus
    identified : dict of identifier to IdentifiedPlant
    """

    def __init__(
        self,
        scenario: Scenario,
        resources: ExitStack,
        recording: Recording | None,
        named_files: Collection[str] = (),
        *,
        invalid: Iterable[Key] = (),
        describes: bool = False,
        fmus_again: Mapping[str, RecordedFmu] = NONE_AGAIN,
        unpacked: UnpackedFmus | None = None,
    ) -> None:
        self.invalid = {*scenario.invalid, *invalid}
        self._scenario = scenario
        self._recording = recording
        folder = scenario.document.folder
        self.records = BuildRecords()
        self._specs = LookedUpKinds(scenario.specs, self.records)
        self._folder = folder
        self.files = NamedFiles(folder, recording, named_files)
        self.models = ScenarioModels(scenario.file.models, self.files, recording)
        self.fmus = ScenarioFmus(
            self.files,
            self.records,
            resources,
            recording=recording,
            describes=describes,
            again=fmus_again,
            unpacked=unpacked,
        )
        self._classes = UserClasses(
            folder,
            scenario.specs,
            self.files,
            self.records,
            recording=recording,
            allowed=named_files,
            describes=describes,
        )
        self._field_data: dict[str, KeptAnswer[FieldData | UsageError]] = {}
        self._designs: dict[str, KeptAnswer[Any]] = {}
        self._choices: dict[str, Mapping[str, Any]] = {}
        self._sources_beside: dict[str, Component] = {}
        self.identified: dict[str, IdentifiedPlant] = {}

    # --- what a kind may ask for ---

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
        return clock_of(self._scenario)

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
        self.models.check_known(name)
        self.records.read(f"models.{name}")
        return self.models.system(name)

    def spec(self, name: str) -> Kind:
        """Return the table of another component, and record that it was read."""
        self.records.read(f"components.{name}")
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
        specs = self._specs
        return {name: specs[name] for name in sorted(self._scenario.sources(to)) if name in specs}

    def behind(self, to: Port) -> Mapping[str, Kind]:
        """Return the components that an input follows, up to those that are not computable."""
        self._need_connected(to)
        components: dict[str, Kind] = {}
        waiting = set(self._scenario.sources(to))
        while waiting:
            name = waiting.pop()
            if name in self._specs:
                spec = components[name] = self._specs[name]
                if spec.computable:
                    waiting |= self._scenario.sources_of(name) - components.keys()
        return components

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

    def designed(self, name: str, design: Callable[[], T]) -> T:
        """Return the design of a component, which is made once in a build.

        What it was made of counts as read by every component that asks for it.
        """
        if name not in self._designs:
            self._designs[name] = self.records.made_by(design)
        result: T = self.records.take(self._designs[name])
        return result

    def field_data(self, name: str, read: Callable[[], FieldData]) -> FieldData:
        """Return the samples of a component, which are read once.

        What is wrong with them is the problem of that component, which reports it itself.
        """

        def read_or_problem() -> FieldData | UsageError:
            try:
                return read()
            except UsageError as error:
                return error

        if name not in self._field_data:
            self._field_data[name] = self.records.made_by(read_or_problem)
        kept = self._field_data[name]
        self.records.look_up(*kept.looked_up)
        data = kept.made
        if isinstance(data, UsageError):
            if name != self.records.current:
                raise DependsOnInvalid(str(data)) from data
            raise data
        return data

    def mapped(self, name: str) -> list[Port]:
        """Return the ports of a swapped component that its map names."""
        ports: list[Port] = []
        for entry in self._scenario.maps.get(name, []):
            ports += entry.renaming.sources
        return ports

    def of_kind(self, kind: type[AnyKind]) -> dict[str, AnyKind]:
        """Return the tables of all components of a kind."""
        specs = self._specs.items()
        return {name: spec for name, spec in specs if isinstance(spec, kind)}

    def recorded(self, name: str) -> Interface | None:
        """Return the interface of a component that is taken from a recording; None: it is not."""
        spec = self.spec(name)  # counts as read, in a run as in a replay
        if self._recording is None or spec.computable:
            return None
        return find_channel(self._recording.channels, name, source=self._recording.label).interface

    def recorded_signals(self, name: str) -> Mapping[str, Signal]:
        """Return the signals that the recording has of a component, also of one computed again."""
        channel = None if self._recording is None else self._recording.channels.get(name)
        return {} if channel is None else channel.by_name

    def lag(self, to: Port) -> float:
        """Return how far the signal that drives an input lags behind what it estimates [s].

        Signals that pass through static components on their way keep their lag. Of what is wrong in
        the file, and so reported, nothing is known.

        Raises
        ------
        UsageError
            If it is made of signals that lag differently.
        """
        lags: dict[float, Port] = {}
        seen: set[str] = set()
        waiting = [to]
        while waiting:
            for source in self._sources(waiting.pop()):
                name = source.component
                spec = self._specs.get(name)
                if spec is None:
                    continue
                self.records.read(f"components.{name}")
                if not spec.hands_on_lag:
                    lags[self._lag_of(spec, source)] = source
                elif name not in seen:
                    seen.add(name)
                    waiting += self._inputs(name)
        if len(lags) > 1:
            sources = ", ".join(f"{source} by {lag:g} s" for lag, source in lags.items())
            raise UsageError(f"{to.name!r}: expected signals with equal lags, got {sources}")
        return next(iter(lags), 0.0)

    def _lag_of(self, spec: Kind, source: Port) -> float:
        if self._recording is not None and not spec.computable:
            record = component_record(self._recording, source.component)
            return record.lags.get(source.signal, 0.0)
        try:
            return spec.lag(source.component, source.signal, self)
        except CosimError as error:  # the problem of that component, which reports it itself
            raise DependsOnInvalid(str(error)) from error

    def _sources(self, to: Port) -> list[Port]:
        """Return the outputs that drive an input or its elements."""
        sources: list[Port] = []
        for port, connection in self._scenario.connections.items():
            if port.component == to.component and to in (port, port.whole):
                sources += [source.whole for source in connection.sources]
        return sources

    def _inputs(self, name: str) -> list[Port]:
        """Return the inputs of a component that something drives."""
        ports = {port.whole for port in self._scenario.connections if port.component == name}
        return sorted(ports, key=str)

    def known(self, source: Port) -> KnownSignal | None:
        """Return an output, or an element of one, as a function of time, where that is known."""
        spec = self.spec(source.component)
        if not spec.is_known or source.component in self._scenario.maps:
            return None
        if source.component not in self._sources_beside:
            self._sources_beside[source.component] = self._source(source.component, spec)
        component = self._sources_beside[source.component]
        matched = source.find({signal.name: signal for signal in component.interface.outputs})
        if matched is None:
            raise unknown_port(source, component.interface, "output")
        signal, elements = matched
        column = component.interface.output_columns()[signal.name].start + elements.start
        if spec.is_recorded or self._is_replayed(spec):
            return _interpolated(component, column, self.clock)
        return partial(_values_at, component, column)

    def _is_replayed(self, spec: Kind) -> bool:
        return self._recording is not None and not spec.computable

    def _source(self, name: str, spec: Kind) -> Component:
        """Return a component without inputs, beside that of the run."""
        if self._recording is not None and self._is_replayed(spec):
            return Replay(self._recording, name)
        count = len(self.records.warned)
        try:
            return spec.build(name, self)
        except CosimError as error:  # the problem of that component, which reports it itself
            raise DependsOnInvalid(str(error)) from error
        finally:
            del self.records.warned[count:]  # it warns where it is built for the run

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
                self.records.read(f"components.{to.component}")
                spectra.append(spectrum)
        return spectra

    def chosen(
        self, name: str, request: Mapping[str, Any], choose: Callable[[], Mapping[str, Any]]
    ) -> Mapping[str, Any]:
        """Return what was chosen for a component, or the recorded choice of the same request."""
        if name not in self._choices:
            recorded = None
            if self._recording is not None:
                recorded = component_record(self._recording, name).choice
            if recorded is not None and recorded.request == request:
                result: Mapping[str, Any] = plain(recorded.result)
            else:
                result = choose()
            self._choices[name] = result
            self.add_metadata(name, {"choice": {"request": request, "result": result}})
        return self._choices[name]

    def file(self, path: str) -> Path:
        """Return the path of a file named in the scenario; see :meth:`NamedFiles.path`."""
        return self.files.path(path)

    def recording(self, path: str) -> Recording:
        """Open a log with the scenario's communication step.

        Raises
        ------
        UsageError
            If it has another one, or is not to be opened; see :meth:`NamedFiles.path`.
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

    def user_class(self, name: str, class_name: str, *, package: str | None = None) -> UserClass:
        """Import the class of a component; see :meth:`UserClasses.load`."""
        return self._classes.load(name, class_name, package)

    def fmu(self, name: str, path: str, options: FmuOptions) -> Component:
        """Load an FMU; see :meth:`ScenarioFmus.component`.

        What a recording has as signals of their own is no vector: of different units, it once was
        none. An input has the one of its names that is connected.
        """
        connected = [port for port in self._scenario.connections if port.component == name]
        called = {text for port in connected for text in (port.name, port.signal)}
        options = replace(options, apart=self.recorded_signals(name), called=called)
        return self.fmus.component(name, path, options)

    def add_states(self, name: str, component: ModelExchange) -> None:
        """Record what has the continuous states of a component, to hand them over."""
        self.fmus.model_exchange[name] = component

    def opened(self, name: str) -> Fmu:
        """Return the FMU that was loaded for a component; see :meth:`ScenarioFmus.of`."""
        return self.fmus.of(name)

    def linearization(self, name: str, path: str, request: LinearizationRequest) -> Linearization:
        """Linearize an FMU for a component; see :meth:`ScenarioFmus.linearization`."""
        return self.fmus.linearization(name, path, request)

    def moving_linearization(
        self, name: str, path: str, request: LinearizationRequest
    ) -> MovingLinearization:
        """Return an FMU to linearize; see :meth:`ScenarioFmus.moving_linearization`."""
        return self.fmus.moving_linearization(name, path, request)

    def add_identified(self, name: str, identified: IdentifiedPlant) -> None:
        """Have the estimates of an identifier judged at the end of the run."""
        self.identified[name] = identified

    def add_metadata(self, name: str, metadata: Mapping[str, Any]) -> None:
        """Record metadata of a component."""
        self.records.add_metadata(name, metadata)

    def warn(self, name: str, text: str) -> None:
        """Record a warning about a component; the log, which is sent to others, has it too."""
        self.records.warn(name, text.replace(f"{self._folder}{os.sep}", ""))


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
