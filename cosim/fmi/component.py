"""FMUs as components: the way in.

``ModelExchange`` and ``CoSimulation`` drive an instance, generated or loaded; ``load`` opens an
.fmu.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, final

from cosim.arrays import Matrix, Vector
from cosim.errors import FmuError, RunError, listing
from cosim.fmi.binary.headers import built_for
from cosim.fmi.binary.library import is_loaded
from cosim.fmi.binary.loaded import LoadedInstance
from cosim.fmi.binary.messages import Message, Messages
from cosim.fmi.binary.process import Process, describe_changes
from cosim.fmi.child_process import find_rollback_problems
from cosim.fmi.description import INTERFACE_TYPE_NAMES, INTERFACE_TYPES, Description, InterfaceType
from cosim.fmi.driving.co_simulation import CoSimulation
from cosim.fmi.driving.diagnostics import InputLimits
from cosim.fmi.driving.guarded import FmuComponent, Guarded
from cosim.fmi.driving.initialization import check_start, resized
from cosim.fmi.driving.model_exchange import ModelExchange
from cosim.fmi.driving.tuning import tuned
from cosim.fmi.instance import ModelExchangeInstance
from cosim.fmi.options import DEFAULT_OPTIONS, FmuOptions
from cosim.fmi.platforms import ARCHITECTURE, SUFFIX, cure, folders
from cosim.fmi.reading.archive import read_archive
from cosim.fmi.reading.model_description import Archive, read
from cosim.fmi.unpacked import UnpackedFmu, UnpackedFmus
from cosim.temporary import TemporaryFolder

__all__ = ["CoSimulation", "DescribedFmu", "Fmu", "ModelExchange", "describe", "load"]

MOST_WARNINGS: Final = 5  # of one file, in the notes of a run
OUR_TOOL: Final = "cosim"  # the tests prove that its FMUs do what their descriptions say


@final
class Fmu:
    """An FMU that was opened; a context manager that leaves nothing behind.

    Parameters
    ----------
    archive : Archive
    instance : LoadedInstance
    component : Guarded
    resources : ExitStack
        Closed when the instance is freed: it removes the folder, where that is its own.
    solving : mapping
        Of a model exchange FMU: what is known of its solver.
    notes : tuple of str
        What is to be known about how it was opened.
    unsaved : str
        Why its state is not saved, although it says that it can be; empty: it is, or does not.

    Attributes
    ----------
    input_limits : InputLimits
        What it allows of its inputs.
    """

    def __init__(
        self,
        archive: Archive,
        instance: LoadedInstance,
        *,
        component: Guarded,
        resources: ExitStack,
        solving: Mapping[str, str | float],
        notes: tuple[str, ...] = (),
        unsaved: str = "",
    ) -> None:
        self.component = component
        self.interface_type = instance.interface_type
        self._archive = archive
        self._instance = instance
        self.input_limits = InputLimits(
            instance.description.name, instance.description.references("input")
        )
        self._resources = resources
        self._solving = solving
        self.unsaved = unsaved
        self.notes = notes

    @property
    def model_exchange(self) -> ModelExchange | None:
        """What drives it, if it was opened for model exchange."""
        component = self.component.component
        return component if isinstance(component, ModelExchange) else None

    @property
    def description(self) -> Description:
        """Variables, structure, capabilities; arrays as large as the structural parameters say."""
        return self._instance.description

    @property
    def instance(self) -> ModelExchangeInstance:
        """The instance itself, for what is asked of model exchange outside a run.

        Raises
        ------
        FmuError
            If it was opened for co-simulation.
        """
        if self.interface_type != "me":
            raise FmuError(
                f"{self._archive.path}: opened for co-simulation; its instance is there with "
                'interface_type = "me"'
            )
        return self._instance

    @property
    def refused(self) -> str:
        """That it refused the event mode that it declares, and runs without; empty: it did not."""
        return self._instance.refused

    @property
    def may_go_back(self) -> bool:
        """Whether the FMU is told that it may have to go back to an earlier time."""
        return self._instance.may_go_back

    @may_go_back.setter
    def may_go_back(self, possible: bool) -> None:
        self._instance.may_go_back = possible

    @property
    def metadata(self) -> dict[str, Any]:
        """What a log keeps of the file and of how it was opened.

        Path and sha256 of the file, FMI version, interface type, solver and tolerance.
        """
        return {**_metadata(self._archive, self.interface_type), **self._solving}

    @property
    def model_description(self) -> str:
        """The modelDescription.xml of the file."""
        return self._archive.xml

    def tune(self, t: float, values: Mapping[str, tuple[float, ...]]) -> None:
        """Set tunable parameters at ``t`` [s], the time reached; outputs follow them.

        Parameters
        ----------
        t : float
        values : mapping of str to tuple of float
            As :func:`cosim.fmi.driving.tuning.check_tuning` returned them.

        Raises
        ------
        RunError
            If the FMU refuses them.
        """
        self.component.tune(t, tuned(self.description, values))

    def drain(self) -> list[Message]:
        """Return the messages since the last call: the FMU's own, then those of its component.

        The level is "info", "warning", "error" or "fatal", from the FMI status, and "debug" of an
        event. Where messages were dropped, one says how many.
        """
        own = self._instance.drain() + self.component.drain()
        return own + self.input_limits.diagnostics.drain()

    def discard(self) -> None:
        """Forget the messages since the last call of ``drain``; what warns only once may again."""
        self._instance.drain()
        self.component.discard()
        self.input_limits.diagnostics.discard()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if error is None:
                self.terminate()
        finally:
            self.close()

    def terminate(self) -> None:
        """End the run, unless it has ended or failed.

        Raises
        ------
        RunError
            If the FMU says that it failed.
        """
        with self.component.outside(None):
            self._instance.terminate()

    def close(self) -> None:
        """End the run, free the instance, remove the temporary folder. Twice does no harm."""
        try:
            with suppress(RunError):  # an instance that cannot terminate is freed all the same
                self.terminate()
            with self.component.outside(None):
                self._instance.free_instance()
        finally:
            self._resources.close()


def load(
    path: Path | str,
    options: FmuOptions = DEFAULT_OPTIONS,
    *,
    instance_name: str | None = None,
    archive: Archive | None = None,
    unpacked: UnpackedFmus | None = None,
) -> Fmu:
    """Open an FMU.

    Parameters
    ----------
    path : Path or str
    options : FmuOptions
    instance_name : str or None
        None: the name of the model.
    archive : Archive or None
        What was read from the file already, which then is only unpacked.
    unpacked : UnpackedFmus or None
        Where it is unpacked and loaded once for all that open it; None: for this one alone.

    Raises
    ------
    FmuError
        If it is no FMU, cannot run here or with these options, or a start value is wrong. Nothing
        is left behind.
    """
    resources = ExitStack()
    shared: UnpackedFmu | None = None
    instance: LoadedInstance | None = None
    messages = Messages(instance_name or Path(path).stem)
    process = Process(messages.address)
    process.save()
    try:
        if unpacked is not None and archive is None:
            archive, shared = unpacked.take(Path(path))
            resources.callback(shared.give_back)
            if shared.keeps_values and shared.openings > 1:
                shared = None  # its values would be those of the other instance, too
        if archive is None or shared is None:
            temporary = TemporaryFolder("fmu")
            resources.callback(temporary.remove)
            folder = temporary.path
            if archive is None:
                archive = read(path, into=folder)
            elif read_archive(Path(path), (), folder).sha256 != archive.sha256:
                raise FmuError(f"{path}: was changed while it was opened; try it again")
        else:
            folder = shared.path
        interface_type, description = _with_options(archive, options)
        library = folder / _library(archive, interface_type)
        _check_architecture(archive, library)
        unsaved = _unsaved(archive, description, interface_type, options)
        if unsaved:
            description = description.without("saves_state", interface_type)
        shares = _notes_on_neighbors(description, interface_type, library)
        instance = LoadedInstance(
            folder,
            library,
            description,
            interface_type=interface_type,
            name=instance_name or description.name,
            label=str(archive.path),
            messages=messages,
        )
        if shared is not None:
            shared.keep_loaded(library)
        notes = _notes(archive, instance.description)
        notes += [text for text in (unsaved, instance.refused, *shares) if text]
        component, solving = _component(instance, interface_type, options)
    except BaseException:
        if instance is not None:
            instance.free_instance()
        resources.close()
        process.restore()
        raise
    changes = process.restore()
    return Fmu(
        archive,
        instance,
        component=Guarded(component, description.name, archive.sha256, called=messages.address),
        resources=resources,
        solving=solving,
        notes=(*notes, *_notes_on_loading(description.name, changes)),
        unsaved=unsaved,
    )


def describe(path: Path | str, options: FmuOptions = DEFAULT_OPTIONS) -> DescribedFmu:
    """Read an FMU's description, without its binary: nothing of it runs.

    Raises
    ------
    FmuError
        If it is no FMU, or these options do not fit its description.
    """
    archive = read(path)
    interface_type, description = _with_options(archive, options)
    return DescribedFmu(archive, interface_type, description)


@final
class DescribedFmu:
    """An FMU that shows its interface, and cannot run.

    Parameters
    ----------
    archive : Archive
    interface_type : {"me", "cs"}
    description : Description
        With the options that it would be opened with.
    """

    def __init__(
        self, archive: Archive, interface_type: InterfaceType, description: Description
    ) -> None:
        capabilities = description.capabilities[interface_type]
        self.interface = replace(
            description.interface,
            rollback=capabilities.saves_state,
            substeps=interface_type == "me" or capabilities.variable_step,
            continuous=interface_type == "me",
            one_value=description.one_value_inputs if interface_type == "cs" else (),
        )
        self.metadata = _metadata(archive, interface_type)
        self._refusal = FmuError(f"{archive.path}: only its description was read")

    def initialize(self, t: float, u: Vector) -> Vector:
        """Refuse."""
        raise self._refusal

    def outputs(self, t: float, u: Vector) -> Vector:
        """Refuse."""
        raise self._refusal

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Refuse."""
        raise self._refusal

    def save(self) -> None:
        """Refuse; an interface that declares ``rollback`` asks for the method."""
        raise self._refusal

    def restore(self, state: None) -> None:
        """Refuse."""
        raise self._refusal


def _metadata(archive: Archive, interface_type: InterfaceType) -> dict[str, Any]:
    """Return what a log keeps of every FMU, whether it was opened or only described."""
    return {
        "path": str(archive.path),
        "sha256": archive.sha256,
        "fmi_version": archive.description.version,
        "interface_type": interface_type,
    }


def _with_options(archive: Archive, options: FmuOptions) -> tuple[InterfaceType, Description]:
    """Return the interface type that options ask for, and the description with them."""
    interface_type = _choose_interface_type(archive, options.interface_type)
    if interface_type == "cs":
        _check_options_for_co_simulation(archive, options)
    described = archive.description.calling(options.called)
    # In co-simulation clocks are active in event mode only (FMI 3.0 section 4.2.1).
    has_events = interface_type == "me" or described.capabilities["cs"].event_mode
    if described.clocks and has_events:
        described = replace(described, drives_clocks=True)
    # Structural parameters first: they decide how many elements other start values have.
    description = resized(described, options.start)
    numbers = check_start(description, options.start).numbers
    # what is known of a large description stays known where nothing of it is another
    if any(description[name].causality == "input" for name in numbers):
        description = description.with_inputs(numbers)
    if options.outputs:
        description = description.recording(options.outputs)
    if options.apart:
        description = replace(description, apart=frozenset(options.apart))
    return interface_type, description


def _choose_interface_type(archive: Archive, wanted: InterfaceType | None) -> InterfaceType:
    """Return the wanted interface type, or the first one that the FMU has."""
    capabilities = archive.description.capabilities
    available = [
        interface_type for interface_type in INTERFACE_TYPES if interface_type in capabilities
    ]
    if not available:
        raise FmuError(f"{archive.path}: {archive.description.missing_interface}")
    if wanted is None:
        return available[0]
    if wanted not in INTERFACE_TYPES:
        raise FmuError(f'{archive.path}: interface_type: expected "me" or "cs", got {wanted!r}')
    if wanted not in available:
        wanted_name = INTERFACE_TYPE_NAMES[wanted]
        available_name = INTERFACE_TYPE_NAMES[available[0]]
        raise FmuError(
            f'{archive.path}: not for {wanted_name} (interface_type = "{wanted}"); '
            f'it is for {available_name}: interface_type = "{available[0]}"'
        )
    return wanted


def _check_options_for_co_simulation(archive: Archive, options: FmuOptions) -> None:
    """Refuse options that only a solver of ours could follow."""
    ours = {
        "solver": options.solver,
        "relative tolerance": options.tolerance,
        "max_step": options.max_step,
    }
    for name, value in ours.items():
        if value is not None:
            raise FmuError(
                f"{archive.path}: {name} {value!r}: a co-simulation FMU brings its own solver; "
                'leave it out or use interface_type = "me"'
            )
    if options.dae == "residual":
        raise FmuError(
            f'{archive.path}: dae = "residual": a co-simulation FMU solves for itself; '
            'use interface_type = "me", or dae = "ode"'
        )


def _component(
    instance: LoadedInstance, interface_type: InterfaceType, options: FmuOptions
) -> tuple[FmuComponent, dict[str, str | float]]:
    """Return the component that drives an instance, and what it is solved with."""
    if interface_type == "cs":
        return CoSimulation(instance, starts=options.start), {}
    component = ModelExchange(
        instance,
        options.solver,
        starts=options.start,
        rtol=options.tolerance,
        max_step=options.max_step,
        dae=options.dae,
    )
    return component, component.metadata


def _unsaved(
    archive: Archive, description: Description, interface_type: InterfaceType, options: FmuOptions
) -> str:
    """Return why the state of an FMU is not saved that says that it can be; empty: it is."""
    if not description.capabilities[interface_type].saves_state or description.tool == OUR_TOOL:
        return ""
    problems = find_rollback_problems(archive, interface_type, options.step)
    if not problems:
        return ""
    return (
        f"{description.name}: its state is not saved, although it says that it can be: "
        f"{'; '.join(problems)}"
    )


def _notes(archive: Archive, description: Description) -> list[str]:
    """Return notes about what was taken of a file."""
    notes = [f"{description.name}: {text}" for text in _shortened(archive.warnings)]
    notes += _notes_on_texts(description)
    notes += _notes_on_clocks(description)
    return notes


def _shortened(warnings: Sequence[str]) -> list[str]:
    """Return the first of the warnings, and how many more there are."""
    shown = list(warnings[:MOST_WARNINGS])
    omitted = len(warnings) - len(shown)
    if omitted:
        plural = "" if omitted == 1 else "s"
        shown.append(f"and {omitted} more warning{plural}; 'cosim check' lists all")
    return shown


def _notes_on_loading(name: str, changes: int) -> list[str]:
    """Return what loading changed of the process, and was put back."""
    if not changes:
        return []
    text = f"{name}: changed {describe_changes(changes)} when it was loaded"
    return [f"{text}; it is as before again"]


def _notes_on_neighbors(
    description: Description, interface_type: InterfaceType, library: Path
) -> list[str]:
    """Return which libraries beside a binary for one instance are another one's, too.

    The binary is a copy of its own; what it needs is found by name, where it is in memory already.
    """
    if not description.capabilities[interface_type].once_per_process:
        return []
    others = [path.name for path in library.parent.iterdir() if path != library]
    names = [name for name in sorted(others) if is_loaded(name)]
    if not names:
        return []
    text = "can be instantiated only once per process, and shares what is loaded already"
    return [f"{description.name}: {text}, with the values that it keeps: {listing(names)}"]


def _notes_on_texts(description: Description) -> list[str]:
    """Return which Strings and Binaries are outputs or inputs, as no signal carries them."""
    notes = []
    outputs = description.texts("output")
    if outputs:
        names = listing(outputs)
        notes.append(f"{description.name}: outputs that are strings are not recorded: {names}")
    inputs = description.texts("input")
    if inputs:
        names = listing(inputs)
        notes.append(
            f"{description.name}: inputs that are strings keep their start values, the FMU's or "
            f"those of 'start': {names}"
        )
    return notes


def _notes_on_clocks(description: Description) -> list[str]:
    """Return what is to be known about an FMU's clocks."""
    if not description.clocks:
        return []
    if not description.drives_clocks:
        return [
            f"{description.name}: its clocks are not activated, as it has no event mode: "
            f"{listing(description.clocks)}"
        ]
    notes = []
    ports = [name for name in description.clocks if description[name].is_triggered]
    if ports:
        notes.append(
            f"{description.name}: a tick inside a communication step reaches other components at "
            f"its end, and they trigger clocks at communication points: {listing(ports)}"
        )
    sampled = [v.name for v in description.variables if v.causality == "input" and v.clocks]
    if sampled:
        notes.append(
            f"{description.name}: where a clock ticks inside a communication step, what it samples "
            f"is as at the start of that step: {listing(sampled)}"
        )
    return notes


def _library(archive: Archive, interface_type: InterfaceType) -> str:
    """Return the name of the member of the archive that is the binary for this machine."""
    description = archive.description
    identifier = description.capabilities[interface_type].identifier
    platform_folders = folders(description.version)
    for folder in platform_folders:
        member = f"binaries/{folder}/{identifier}{SUFFIX}"
        if member in archive.members:
            return member
    available = ", ".join(description.platforms) or "none"
    raise FmuError(
        f"{archive.path}: no binary for this platform; found binaries for: {available}; expected "
        f"binaries/{platform_folders[0]}/{identifier}{SUFFIX}; "
        f"{cure(archive.path, archive.members)}"
    )


def _check_architecture(archive: Archive, library: Path) -> None:
    """Name what the loader calls a missing file: a binary of another machine."""
    with library.open("rb") as file:
        header = file.read(1024)
    built = built_for(header)
    if built and built[0] not in ("any", ARCHITECTURE):
        raise FmuError(
            f"{archive.path}: the binary {library.parent.name}/{library.name} is for {built[0]}, "
            f"found in the folder for {ARCHITECTURE}; expected one for {ARCHITECTURE}"
        )
