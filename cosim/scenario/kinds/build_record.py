"""Where the components of a build come from, and what is read, run and recorded for them."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from cosim.arguments import check_path
from cosim.arrays import Matrix
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.recording import Recording
from cosim.core.signals import Signal
from cosim.documents import plain
from cosim.errors import CosimError, LogError, UsageError, option, quoted
from cosim.files import expanded
from cosim.scenario.document.document import short
from cosim.scenario.document.problems import TableProblems
from cosim.scenario.kinds.models import LETTERS
from cosim.scenario.record import (
    CodeRecord,
    ComponentRecord,
    component_record,
    recorded_models,
)

if TYPE_CHECKING:
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
    """

    recording: Recording | None = None
    named: Collection[str] = ()
    left_out: Collection[str] = ()
    fmus_again: Mapping[str, RecordedFmu] = field(default_factory=dict)
    describes: bool = False


TABLES_ALONE: Final = Origins()


class Resources(ExitStack):
    """What a build has open, which it closes in the end.

    Parameters
    ----------
    unpacked : UnpackedFmus, optional
        Where FMUs are unpacked and loaded for all builds of a process; without it for this one.
    """

    def __init__(self, unpacked: UnpackedFmus | None = None) -> None:
        super().__init__()
        self.unpacked = unpacked


def unpacked_in(resources: ExitStack) -> UnpackedFmus | None:
    """Return where FMUs are unpacked for all builds of a process; None: for each build."""
    return resources.unpacked if isinstance(resources, Resources) else None


class BuildRecord:
    """What each component of a build reads, runs, opens and says.

    Parameters
    ----------
    folder : Path
        That paths of the scenario start from.
    resources : ExitStack
        Closes what is opened.
    origins : Origins
        Where components come from, beside their tables.
    connected : iterable of Port
        The inputs that the scenario connects.

    Attributes
    ----------
    current : str
        The component that is being built.
    metadata : dict of component name to plain values
    warnings : list of (component, text)
    reads : dict of component name to names of tables
        That were read to build the component, and its design rests on.
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
        self, folder: Path, resources: ExitStack, origins: Origins, connected: Iterable[Port]
    ) -> None:
        self.origins = origins
        self._connected = connected
        self._folder = folder
        self._resources = resources
        self.current = ""
        self.metadata: dict[str, dict[str, Any]] = {}
        self.warnings: list[tuple[str, str]] = []
        self.reads: dict[str, frozenset[str]] = {"": frozenset()}
        self.attachments: dict[str, str] = {}
        self.files: set[Path] = set()
        self.modules: set[Path] = set()
        self.model_records: dict[str, dict[str, Any]] = {}
        self.fmus: dict[str, Fmu] = {}
        self.fmu_files: dict[str, Path] = {}
        self.model_exchange: dict[str, ModelExchange] = {}
        self.identified: dict[str, Any] = {}  # IdentifiedPlant stands above this file
        self._kept: dict[tuple[str, str], tuple[Any, frozenset[str]]] = {}

    def begin(self, name: str) -> None:
        """Record what is read from now on for a component, and nothing else."""
        self.current = name
        self.reads[name] = frozenset()

    def go_on(self, name: str = "") -> None:
        """Record what is read from now on for a component, beside what was read for it."""
        self.current = name
        self.reads.setdefault(name, frozenset())

    def read(self, *tables: str) -> None:
        """Record that tables are read."""
        self.reads[self.current] |= set(tables)

    def made_once(self, what: str, name: str, make: Callable[[], T]) -> T:
        """Make something of a component or table, once in a build, and return it.

        The tables that are read for it count as read by every component that asks for it.
        """
        if (what, name) not in self._kept:
            current = self.current
            before = self.reads[current]
            self.reads[current] = frozenset()
            try:
                made = make()
                self._kept[what, name] = made, self.reads[current]
            finally:
                self.reads[current] |= before
        kept, reads = self._kept[what, name]
        self.read(*reads)
        answer: T = kept
        return answer

    def _recorded(self, name: str) -> ComponentRecord | None:
        """Return what a recording says of a component; None: there is no recording."""
        recording = self.origins.recording
        return None if recording is None else component_record(recording, name)

    def add_metadata(self, name: str, metadata: Mapping[str, Any]) -> None:
        """Record metadata of a component."""
        self.metadata.setdefault(name, {}).update(metadata)

    def warn(self, name: str, text: str) -> None:
        """Record a warning about a component; the log, which is sent to others, has it too."""
        text = text.replace(f"{self._folder}{os.sep}", "")
        self.warnings.append((name, text))

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

    def designed(self, name: str, design: Callable[[], T]) -> T:
        """Return what a component rests on, its design or its samples: made once in a build."""
        with self.reported_by(name):
            return self.made_once("design", name, design)

    @contextmanager
    def reported_by(self, name: str) -> Iterator[None]:
        """Take what is wrong inside for the problem of a component, which reports it itself.

        Raises
        ------
        DependsOnInvalid
            In the build of another one.
        """
        try:
            yield
        except (DependsOnInvalid, NotImported):
            raise
        except (CosimError, ValueError) as error:
            if self.current in ("", name):
                raise
            raise DependsOnInvalid(str(error)) from error

    def chosen(
        self, name: str, request: Mapping[str, Any], choose: Callable[[], Mapping[str, Any]]
    ) -> Mapping[str, Any]:
        """Return what was chosen for a component, and record it; a replay takes it from there.

        Parameters
        ----------
        name : str
        request : Mapping
            What the choice rests on: plain values.
        choose : callable
            Makes it, of plain values.
        """

        def make() -> Mapping[str, Any]:
            own = self._recorded(name)
            recorded = None if own is None else own.choice
            if recorded is not None and recorded.request == request:
                result: Mapping[str, Any] = plain(recorded.result)
            else:
                result = choose()
            self.add_metadata(name, {"choice": {"request": request, "result": result}})
            return result

        return self.made_once("choice", name, make)

    def matrices(self, name: str, path: str) -> Mapping[str, Matrix]:
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
        from cosim.scenario.data_files.mat_file import read_model_file

        matrices, sha256 = read_model_file(self.file(path), LETTERS)
        written = {letter: rows.tolist() for letter, rows in matrices.items()}
        self.model_records[name] = {"file": path, "sha256": sha256, "matrices": written}
        return matrices

    def user_class(
        self, name: str, code: str, class_name: str, package: str | None = None
    ) -> UserClass:
        """Import the class of a component, and record its source.

        Parameters
        ----------
        name : str
            Of the component.
        code : str
            What names the class in the component's table.
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
        is_replayed = recording is not None and code not in self.origins.named
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
        metadata = {
            "class": class_name,
            "sources": dict(user_class.sources),
            "distribution": user_class.distribution,
        }
        own = CodeRecord.model_validate(metadata)
        if is_replayed and own != recorded:
            raise _other_code(name, recorded, own)
        self.add_metadata(name, {"code": metadata})
        self.modules.update(user_class.files)
        return user_class

    def fmu(self, name: str, path: str, options: FmuOptions) -> Component:
        """Load an FMU; it is freed at the end of the run.

        Only its description is read where nothing is to run. What a recording has as signals of
        their own is no vector: of different units, it once was none. An input has the one of its
        names that is connected.
        """
        from cosim.fmi.component import describe

        connected = [port for port in self._connected if port.component == name]
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

    def recorded_signals(self, name: str) -> Mapping[str, Signal]:
        """Return the signals that the recording has of a component, also of one computed again."""
        channel = (
            None if self.origins.recording is None else self.origins.recording.channels.get(name)
        )
        return {} if channel is None else channel.by_name

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
            unpacked = unpacked_in(self._resources)
            return load(self.file(path), options, instance_name=name, unpacked=unpacked)
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
        from cosim.fmi.linearizing.linearize import linearize_archive
        from cosim.fmi.reading.model_description import read

        def make() -> Linearization:
            self._need_run(path)
            asked = {"fmu": path, **request.to_dict()}
            own = self._recorded(name)
            recorded = None if own is None else own.linearization
            if recorded is not None and recorded.request == asked:
                record = recorded.model_dump()
            else:
                archive = read(self.file(path))
                result = linearize_archive(archive, request).to_dict()
                record = {"request": asked, "sha256": archive.sha256, "result": result}
            try:
                linearization = Linearization.of(record["result"])
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise LogError(
                    f"the recorded linearization of {path!r} is invalid: {error}"
                ) from error
            self.add_metadata(name, {"linearization": record})
            for note in linearization.notes:
                self.warn(name, note)
            return linearization

        return self.made_once("linearization", name, make)

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


def _other_code(name: str, recorded: CodeRecord | None, own: CodeRecord) -> UsageError:
    """Return the error about code in a replay that is not that of the recorded run."""
    entry = option("set", short(f"components.{name}.class"), own.class_name)
    return UsageError(
        f"expected the recorded code, got {own.difference(recorded)}; {entry} uses the code as "
        "it is now (no longer a replay of the recorded run)"
    )
