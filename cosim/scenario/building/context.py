"""What kinds may ask of the scenario while their components are built, and what that records."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import numpy as np

from cosim.arguments import check_path
from cosim.arrays import Matrix, Vector
from cosim.blocks.replay import Replay
from cosim.core.clock import Clock
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.recorded.signals import find_channel
from cosim.core.recording import Recording
from cosim.core.signals import Interface, Signal
from cosim.core.structure.ports import unknown_port
from cosim.documents import plain
from cosim.errors import CosimError, LogError, UsageError, nearest, option, quoted
from cosim.files import expanded
from cosim.instants import StepNs, step_seconds, step_value
from cosim.scenario.building.models import LETTERS, system_of, system_of_file
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.document.document import short
from cosim.scenario.document.places import Key
from cosim.scenario.document.problems import TableProblems
from cosim.scenario.document.swaps import ports_in
from cosim.scenario.kinds import Kind
from cosim.scenario.kinds.base import AnyKind, KnownSignal, Spectrum
from cosim.scenario.kinds.identified_plant import IdentifiedPlant
from cosim.scenario.record import CodeRecord, component_record, recorded_models
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
    from cosim.scenario.kinds.user_code import UserClass

T = TypeVar("T")
_NOT_IMPORTED: Final = (
    "defined by its class, which is not imported here; 'cosim run SCENARIO --dry-run' imports it "
    "in a separate process"
)


class DependsOnInvalid(UsageError):
    """A component cannot be checked because something that it reads is wrong and reported."""


class NotImported(UsageError):
    """A component is of code that does not run here, so that nobody knows its ports."""


@dataclass(frozen=True, slots=True)
class RecordedFmu:
    """The FMU of a recorded run, which is run again.

    Parameters
    ----------
    copy : Path
        A file with the bytes that the run had.
    path : str
        Where it was then.
    means : bool
        Whether every input with one value over a step had the mean of both ends, where it moved:
        in a log that does not tell which had it.
    """

    copy: Path
    path: str
    means: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Origins:
    """Where the components of a scenario come from, beside its tables.

    Parameters
    ----------
    recording : Recording or None
        Every component that cannot be computed again from the log is taken from it: plants, FMUs,
        files.
    named : collection of str
        With a recording: the files that may be opened, and the classes that are taken as they are
        now, all the same.
    left_out : collection of str
        With a recording: components that are taken from it although they could be computed.
    fmus_again : mapping of component name to RecordedFmu
        With a recording: FMUs of its run that are run again.
    describes : bool
        Nothing of an FMU or a user's class runs: what is built shows what there is, and cannot run.
    unpacked : UnpackedFmus or None
        Where FMUs are unpacked and loaded for all builds of a process; None: for this one.
    """

    recording: Recording | None = None
    named: Collection[str] = ()
    left_out: Collection[str] = ()
    fmus_again: Mapping[str, RecordedFmu] = field(default_factory=dict)
    describes: bool = False
    unpacked: UnpackedFmus | None = None

    def copies(self, name: str, spec: Kind) -> bool:
        """Return whether a component is taken from the recording."""
        return self.recording is not None and (not spec.computable or name in self.left_out)


TABLES_ALONE: Final = Origins()


@dataclass(frozen=True, slots=True)
class KeptAnswer(Generic[T]):
    """Something that is made once in a build, and the tables read and looked up for it."""

    made: T
    reads: frozenset[str]
    looked_up: frozenset[str]


class _LookedUpKinds(Mapping[str, Kind]):
    """The tables of the components of a scenario, which notes whose are looked up."""

    def __init__(self, specs: Mapping[str, Kind], look_up: Callable[[str], None]) -> None:
        self._specs = specs
        self._look_up = look_up

    def __getitem__(self, name: str) -> Kind:
        self._look_up(name)
        return self._specs[name]

    def __contains__(self, name: object) -> bool:
        return name in self._specs

    def __iter__(self) -> Iterator[str]:
        return iter(self._specs)

    def __len__(self) -> int:
        return len(self._specs)


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


class ScenarioBuildContext:
    """Answers what kinds ask, and records what each component reads, opens and says.

    See :class:`cosim.scenario.kinds.BuildContext`. All that it answers may raise
    ``DependsOnInvalid``.

    Parameters
    ----------
    scenario : Scenario
    resources : ExitStack
        Closes what is opened.
    origins : Origins
    invalid : iterable of Key
        What is known to be wrong beside ``scenario.invalid``.

    Attributes
    ----------
    invalid : set of Key
        What is known to be wrong.
    current : str
        The component that is being built.
    metadata : dict of component name to plain values
    warned : list of (name, (component, text))
        Warnings, with the component that was being built.
    reads : dict of component name to names of tables
        That were read to build the component, and its design rests on.
    looked_up : dict of component name to set of names of components
        Whose tables were looked up to build the component, whatever was asked of them; all that it
        was made of, at least.
    attachments : dict of file name to text
        For the log.
    files : set of Path
        Those that are read.
    modules : set of Path
        Those of the classes of users.
    model_records : dict of name to plain values
        For the log, of the models that were read from files.
    fmus : dict of component name to Fmu
        Those that were loaded.
    fmu_files : dict of SHA-256 to Path
        Of those that were loaded for components.
    model_exchange : dict of component name to ModelExchange
        What has the continuous states of a component.
    identified : dict of identifier to IdentifiedPlant
    """

    def __init__(
        self,
        scenario: Scenario,
        resources: ExitStack,
        origins: Origins = TABLES_ALONE,
        invalid: Iterable[Key] = (),
    ) -> None:
        self.invalid = {*scenario.invalid, *invalid}
        self.origins = origins
        self._scenario = scenario
        self._resources = resources
        self._folder = scenario.document.folder
        self._specs = _LookedUpKinds(scenario.specs, self.look_up)
        self.current = ""
        self.metadata: dict[str, dict[str, Any]] = {}
        self.warned: list[tuple[str, tuple[str, str]]] = []
        self.reads: dict[str, frozenset[str]] = {"": frozenset()}
        self.looked_up: dict[str, set[str]] = {"": set()}
        self.attachments: dict[str, str] = {}
        self.files: set[Path] = set()
        self.modules: set[Path] = set()
        self.model_records: dict[str, dict[str, Any]] = {}
        self.fmus: dict[str, Fmu] = {}
        self.fmu_files: dict[str, Path] = {}
        self.model_exchange: dict[str, ModelExchange] = {}
        self.identified: dict[str, IdentifiedPlant] = {}
        self._models: dict[str, DescriptorSystem] = {}
        self._linearized: dict[str, Linearization] = {}
        self._field_data: dict[str, KeptAnswer[FieldData | UsageError]] = {}
        self._designs: dict[str, KeptAnswer[Any]] = {}
        self._choices: dict[str, Mapping[str, Any]] = {}
        self._sources_beside: dict[str, Component] = {}

    def beside(self, scenario: Scenario, name: str) -> ScenarioBuildContext:
        """Return a context of its own for one more build of a component, with another table."""
        origins = Origins(recording=self.origins.recording, unpacked=self.origins.unpacked)
        context = ScenarioBuildContext(scenario, self._resources, origins)
        context.begin(name)
        return context

    # --- what is recorded ---

    def begin(self, name: str) -> None:
        """Record what is read from now on for a component."""
        self.current = name
        self.reads[name] = frozenset()
        self.looked_up[name] = set()

    def read(self, *tables: str) -> None:
        """Record that tables are read."""
        self.reads[self.current] |= set(tables)

    def look_up(self, *components: str) -> None:
        """Record that tables of components are looked up."""
        self.looked_up[self.current].update(components)

    def made_by(self, make: Callable[[], T]) -> KeptAnswer[T]:
        """Make something; return it with the tables that were read and looked up for it."""
        current = self.current
        reads = self.reads[current]
        looked_up = self.looked_up[current]
        self.reads[current] = frozenset()
        self.looked_up[current] = set()
        try:
            made = make()
            return KeptAnswer(made, self.reads[current], frozenset(self.looked_up[current]))
        finally:
            self.reads[current] |= reads
            self.looked_up[current] |= looked_up

    def take(self, answer: KeptAnswer[T]) -> T:
        """Return what was made before, for which the same tables were read and looked up."""
        self.read(*answer.reads)
        self.look_up(*answer.looked_up)
        return answer.made

    def add_metadata(self, name: str, metadata: Mapping[str, Any]) -> None:
        """Record metadata of a component."""
        self.metadata.setdefault(name, {}).update(metadata)

    def warn(self, name: str, text: str) -> None:
        """Record a warning about a component; the log, which is sent to others, has it too."""
        text = text.replace(f"{self._folder}{os.sep}", "")
        self.warned.append((self.current, (name, text)))

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """The warnings, each of a component and its text."""
        return [warning for _, warning in self.warned]

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
        tables = self._scenario.file.models
        if name not in tables:
            raise UsageError(f"unknown model {name!r} in [models]; {nearest(name, tables)}")
        self.read(f"models.{name}")
        if name not in self._models:
            table = tables[name]
            if table.file is None:
                self._models[name] = system_of(table)
            else:
                self._models[name] = system_of_file(table, self._matrices(name, table.file))
        return self._models[name]

    def _matrices(self, name: str, path: str) -> Mapping[str, Matrix]:
        """Return the matrices of a model's file, and record them; a replay takes them from there.

        Raises
        ------
        UsageError
            If the file cannot be read, or is not to be opened.
        LogError
            If the recorded matrices cannot be understood.
        """
        if self.origins.recording is not None:
            record = recorded_models(self.origins.recording).get(name)
            if record is not None and record.file == path:
                self.model_records[name] = plain(record)
                return record.arrays
        # rarely needed
        from cosim.scenario.data_files.mat_file import missing_text, read_model_file

        content = read_model_file(self.file(path), LETTERS)
        missing = [letter for letter in ("A", "C") if letter not in content.matrices]
        if missing:
            raise UsageError(missing_text(path, content, missing))
        matrices = {letter: rows.tolist() for letter, rows in content.matrices.items()}
        self.model_records[name] = {"file": path, "sha256": content.sha256, "matrices": matrices}
        return content.matrices

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
            self._designs[name] = self.made_by(design)
        result: T = self.take(self._designs[name])
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
            self._field_data[name] = self.made_by(read_or_problem)
        kept = self._field_data[name]
        self.look_up(*kept.looked_up)
        data = kept.made
        if isinstance(data, UsageError):
            if name != self.current:
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
        if self.origins.recording is None or spec.computable:
            return None
        return find_channel(
            self.origins.recording.channels, name, source=self.origins.recording.label
        ).interface

    def recorded_signals(self, name: str) -> Mapping[str, Signal]:
        """Return the signals that the recording has of a component, also of one computed again."""
        channel = (
            None if self.origins.recording is None else self.origins.recording.channels.get(name)
        )
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
                self.read(f"components.{name}")
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
        if self.origins.recording is not None and not spec.computable:
            record = component_record(self.origins.recording, source.component)
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
        return self.origins.recording is not None and not spec.computable

    def _source(self, name: str, spec: Kind) -> Component:
        """Return a component without inputs, beside that of the run."""
        if self.origins.recording is not None and self._is_replayed(spec):
            return Replay(self.origins.recording, name)
        count = len(self.warned)
        try:
            return spec.build(name, self)
        except CosimError as error:  # the problem of that component, which reports it itself
            raise DependsOnInvalid(str(error)) from error
        finally:
            del self.warned[count:]  # it warns where it is built for the run

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

    def chosen(
        self, name: str, request: Mapping[str, Any], choose: Callable[[], Mapping[str, Any]]
    ) -> Mapping[str, Any]:
        """Return what was chosen for a component, or the recorded choice of the same request."""
        if name not in self._choices:
            recorded = None
            if self.origins.recording is not None:
                recorded = component_record(self.origins.recording, name).choice
            if recorded is not None and recorded.request == request:
                result: Mapping[str, Any] = plain(recorded.result)
            else:
                result = choose()
            self._choices[name] = result
            self.add_metadata(name, {"choice": {"request": request, "result": result}})
        return self._choices[name]

    def file(self, name: str) -> Path:
        """Return the path of a file, and record that it is read.

        Raises
        ------
        UsageError
            In a replay, if the log alone names it: a log from elsewhere must not choose the files
            that are opened here, the libraries in an FMU least of all. Or if no file can have it.
        """
        if self.origins.recording is not None and name not in self.origins.named:
            raise UsageError(
                f"{quoted(name)}: a replay opens no files that only the log names; name it "
                f"yourself by {option('set')}, or run the scenario"
            )
        check_path(name)
        path = self._folder / expanded(name)
        if ".." in path.parts:  # of a swap beside the folder
            path = path.parent.resolve() / path.name
        if not name.isprintable() and not path.exists():
            raise UsageError(
                f"there is no file {quoted(name)}; in double quotes a backslash begins an escape: "
                "write a path in single quotes"
            )
        self.files.add(path.resolve())
        return path

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

    # --- code: classes of users, FMUs ---

    def user_class(self, name: str, class_name: str, *, package: str | None = None) -> UserClass:
        """Import the class of a component, and record its source.

        Parameters
        ----------
        name : str
            Of the component.
        class_name : str
            ``package.module:Class``.
        package : str or None
            The installed one that declares it; None: it is looked for in the folder first.

        Raises
        ------
        NotImported
            If only descriptions are read.
        TableProblems
            If it cannot be imported; what was raised is the cause.
        UsageError
            In a replay, if its source is not that of the recorded run: what is computed would be of
            another component than the log says.
        """
        from cosim.scenario.kinds.user_code import OtherSource, load_class

        if self.origins.describes:
            self.add_metadata(name, {"class": class_name, "ports": _NOT_IMPORTED})
            raise NotImported(class_name)
        folder = self._folder if package is None else None
        needed = None
        recorded: CodeRecord | None = None
        recording = self.origins.recording
        is_replayed = (
            recording is not None and self._scenario.specs[name].code not in self.origins.named
        )
        if recording is not None and is_replayed:
            recorded = component_record(recording, name).code
            needed = {} if recorded is None else recorded.sources
        try:
            user_class = load_class(class_name, folder, distribution=package, needed=needed)
        except OtherSource as other:
            sources = {other.file: other.found}
            own = CodeRecord.model_validate({"class": class_name, "sources": sources})
            raise _other_code(name, recorded, own) from other
        except UsageError as error:
            key = "class" if package is None else "kind"
            raise TableProblems([((key,), str(error))]) from error.__cause__
        code = {
            "class": class_name,
            "sources": dict(user_class.sources),
            "distribution": user_class.distribution,
        }
        own = CodeRecord.model_validate(code)
        if is_replayed and own != recorded:
            raise _other_code(name, recorded, own)
        self.add_metadata(name, {"code": code})
        self.modules.update(user_class.files)
        return user_class

    def fmu(self, name: str, path: str, options: FmuOptions) -> Component:
        """Load an FMU; it is freed at the end of the run.

        Only its description is read where nothing is to run. What a recording has as signals of
        their own is no vector: of different units, it once was none. An input has the one of its
        names that is connected.
        """
        from cosim.fmi.component import describe

        connected = [port for port in self._scenario.connections if port.component == name]
        called = {text for port in connected for text in (port.name, port.signal)}
        options = replace(options, apart=self.recorded_signals(name), called=called)

        if self.origins.describes:
            described = describe(self.file(path), options)
            self.add_metadata(name, self._with_path(name, described.metadata))
            return described
        loaded = self._resources.enter_context(self._load(name, path, options))
        self.attachments[f"{name}/modelDescription.xml"] = loaded.model_description
        self.add_metadata(name, self._with_path(name, loaded.metadata))
        for note in loaded.notes:
            self.warn(name, note)
        self.fmus[name] = loaded
        self.fmu_files[loaded.metadata["sha256"]] = Path(loaded.metadata["path"])
        if loaded.model_exchange is not None:
            self.model_exchange[name] = loaded.model_exchange
        return loaded.component

    def _with_path(self, name: str, metadata: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the metadata of an FMU, its path from the working folder: a log is sent to others.

        That of a recorded run stays as it is.
        """
        if name in self.origins.fmus_again:
            return metadata
        return {**metadata, "path": os.path.relpath(metadata["path"])}

    def _load(self, name: str, path: str, options: FmuOptions) -> Fmu:
        """Load an FMU, or the one of the recorded run, which is known by where it was then."""
        from cosim.fmi.component import load
        from cosim.fmi.reading.model_description import read

        again = self.origins.fmus_again.get(name)
        if again is None:
            return load(
                self.file(path), options, instance_name=name, unpacked=self.origins.unpacked
            )
        archive = replace(read(again.copy), path=Path(again.path))
        return load(again.copy, options, instance_name=name, archive=archive)

    def opened(self, name: str) -> Fmu:
        """Return the FMU that was loaded for a component.

        Raises
        ------
        UsageError
            If only its description is read.
        """
        self._need_run(name)
        return self.fmus[name]

    def linearization(self, name: str, path: str, request: LinearizationRequest) -> Linearization:
        """Linearize an FMU for a component, or take the recorded result of the same request.

        Raises
        ------
        NotImported
            If the FMU would have to be run where nothing is to run.
        UsageError
            If it is not to be opened; see :meth:`file`.
        FmuError
            If it cannot be linearized as is asked for.
        RunError
            If it cannot go on.
        LogError
            If the recorded result cannot be understood.
        """
        from cosim.fmi.linearizing.linearization import Linearization

        if name not in self._linearized:
            self._need_run(path)
            request_record = {"fmu": path, **request.to_dict()}
            recorded = None
            if self.origins.recording is not None:
                recorded = component_record(self.origins.recording, name).linearization
            if recorded is not None and recorded.request == request_record:
                record = recorded.model_dump()
            else:
                record = {"request": request_record, **self._linearize(path, request)}
            try:
                linearization = Linearization.of(record["result"])
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise LogError(
                    f"the recorded linearization of {path!r} is invalid: {error}"
                ) from error
            self._linearized[name] = linearization
            self.add_metadata(name, {"linearization": record})
            for note in linearization.notes:
                self.warn(name, note)
        return self._linearized[name]

    def moving_linearization(
        self, name: str, path: str, request: LinearizationRequest
    ) -> MovingLinearization:
        """Return an FMU that is linearized on the way; it is freed at the end of the run.

        Raises
        ------
        NotImported
            If only descriptions are read.
        UsageError
            If it is not to be opened; see :meth:`file`.
        FmuError
            If it cannot be linearized as is asked for.
        RunError
            If it does not reach its operating point.
        """
        from cosim.fmi.linearizing.linearize import open_for_linearization
        from cosim.fmi.linearizing.moving import MovingLinearization
        from cosim.fmi.reading.model_description import read

        self._need_run(path)
        archive = read(self.file(path))
        opened = self._resources.enter_context(open_for_linearization(archive, request.start))
        self.fmus[name] = opened
        return MovingLinearization(opened.instance, request)

    def _need_run(self, fmu: str) -> None:
        """Refuse what needs the code of an FMU, where nothing is to run.

        Raises
        ------
        NotImported
            If only descriptions are read.
        """
        if self.origins.describes:
            raise NotImported(fmu)

    def _linearize(self, path: str, request: LinearizationRequest) -> dict[str, Any]:
        from cosim.fmi.linearizing.linearize import linearize_archive
        from cosim.fmi.reading.model_description import read

        archive = read(self.file(path))
        result = linearize_archive(archive, request)
        return {"sha256": archive.sha256, "result": result.to_dict()}

    def add_states(self, name: str, component: ModelExchange) -> None:
        """Record what has the continuous states of a component, to hand them over."""
        self.model_exchange[name] = component

    def add_identified(self, name: str, identified: IdentifiedPlant) -> None:
        """Have the estimates of an identifier judged at the end of the run."""
        self.identified[name] = identified


def _other_code(name: str, recorded: CodeRecord | None, own: CodeRecord) -> UsageError:
    """Return the error about code in a replay that is not that of the recorded run."""
    entry = option("set", short(f"components.{name}.class"), own.class_name)
    return UsageError(
        f"expected the recorded code, got {own.difference(recorded)}; {entry} uses the code as "
        "it is now (no longer a replay of the recorded run)"
    )


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
