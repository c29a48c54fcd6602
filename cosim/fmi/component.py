"""Units as components: the way in.

``ModelExchange`` and ``CoSimulation`` drive a unit of their kind, generated or loaded; ``load`` opens an .fmu.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, TypeAlias, final

from cosim.errors import FmuError, RunError
from cosim.fmi.binary.headers import built_for
from cosim.fmi.binary.loaded import LoadedInstance
from cosim.fmi.binary.messages import Message
from cosim.fmi.child_process import find_rollback_problems
from cosim.fmi.description import INTERFACE_TYPE_NAMES, INTERFACE_TYPES, Description, InterfaceType
from cosim.fmi.driving.co_simulation import CoSimulation
from cosim.fmi.driving.initialization import Starts, check_start, resized
from cosim.fmi.driving.model_exchange import RTOL, ModelExchange
from cosim.fmi.driving.residual import DaeForm
from cosim.fmi.driving.solvers import TOLERANT
from cosim.fmi.instance import ModelExchangeInstance
from cosim.fmi.platforms import ARCHITECTURE, SUFFIX, folders
from cosim.fmi.reading.model_description import Archive, read

__all__ = ["CoSimulation", "Fmu", "ModelExchange", "load"]

OUR_TOOL: Final = "cosim"  # whose FMUs the tests hold to their word
FmuComponent: TypeAlias = ModelExchange | CoSimulation


@final
class Fmu:
    """An FMU that was opened; a context manager that leaves nothing behind.

    Parameters
    ----------
    archive : Archive
    mode : Mode
    unit : LoadedInstance
    component : FmuComponent
    folder : Path
        Where it was unpacked.
    solving : mapping
        Of a model exchange FMU: its solver, and the tolerance where that keeps one.
    notes : tuple of str
        What is to be known about how it was opened.
    """

    def __init__(
        self,
        archive: Archive,
        interface_type: InterfaceType,
        *,
        instance: LoadedInstance,
        component: FmuComponent,
        folder: Path,
        solving: Mapping[str, str | float],
        notes: tuple[str, ...] = (),
    ) -> None:
        self.component, self.interface_type, self._solving, self._notes = (
            component,
            interface_type,
            solving,
            notes,
        )
        self._archive, self._instance, self._folder = archive, instance, folder

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
                f'{self._archive.path}: opened for co-simulation; its instance is there with interface_type = "me"'
            )
        return self._instance

    @property
    def metadata(self) -> dict[str, Any]:
        """What a log keeps: path, sha256 and modelDescription.xml of the file, FMI version, mode, solver and tolerance."""
        found = self._archive
        return {
            "path": str(found.path),
            "sha256": found.sha256,
            "fmi_version": found.description.version,
            "interface_type": self.interface_type,
            **self._solving,
            "model_description": found.xml,
        }

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be known about the FMU and about its results."""
        return self._notes + self.component.notes

    def drain(self) -> list[Message]:
        """Give what the FMU logged since the last call, how many messages were dropped, and what the run showed about it.

        The level is "info", "warning", "error" or "fatal", from the FMI status, and "debug" of an event.
        """
        return self._instance.messages.drain() + self.component.drain()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the run, free the instance, remove the temporary folder. Twice does no harm."""
        try:
            with suppress(RunError):  # an instance that cannot end is let go of all the same
                self._instance.terminate()
            self._instance.free_instance()
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)


def load(
    path: Path | str,
    *,
    interface_type: InterfaceType | None = None,
    solver: str | None = None,
    rtol: float | None = None,
    dae: DaeForm = "ode",
    start: Starts | None = None,
    instance_name: str | None = None,
) -> Fmu:
    """Open an FMU.

    Parameters
    ----------
    path : Path or str
    mode : {"me", "cs"} or None
        Model exchange or co-simulation; None: the one that is there, model exchange where both are.
    solver : str or None
        Of a model exchange FMU; see :class:`ModelExchange`.
    rtol : float or None
        Relative tolerance of the states of a model exchange FMU, for the solvers that keep one; None: 1e-9.
    dae : {"ode", "residual"}
        Of a model exchange FMU with a residual form (FMI-LS-DAE): which of its forms is integrated.
    start : mapping of variable name to StartValue
        Start values to set instead of the FMU's own: numbers, Booleans, items of enumerations, texts, lists; see ``start.py``.
    instance_name : str or None
        None: the name of the model.

    Raises
    ------
    FmuError
        If it is no FMU, cannot run here or in this mode, or a start value is wrong. Nothing is left behind.
    """
    folder = Path(tempfile.mkdtemp(prefix="cosim-fmu-"))
    instance: LoadedInstance | None = None
    try:
        archive = read(path, into=folder)
        interface_type, starts = _mode(archive, interface_type), dict(start or {})
        if interface_type == "cs" and solver is not None:
            raise FmuError(
                f'{path}: solver {solver!r}: a co-simulation FMU brings its own; leave it out or use interface_type = "me"'
            )
        if interface_type == "cs" and rtol is not None:
            raise FmuError(
                f'{path}: relative tolerance {rtol}: a co-simulation FMU brings its own solver; leave it out or use interface_type = "me"'
            )
        if interface_type == "cs" and dae == "residual":
            raise FmuError(
                f'{path}: dae = "residual": a co-simulation FMU solves for itself; use interface_type = "me", or dae = "ode"'
            )
        library = folder / _library(archive, interface_type)
        _check_architecture(archive, library)
        description = resized(archive.description, starts)
        check_start(description, starts)
        description, notes = _limited(archive, description, interface_type)
        name = instance_name or description.name
        instance = LoadedInstance(
            folder,
            library,
            description,
            interface_type=interface_type,
            name=name,
            label=str(archive.path),
        )
        component: FmuComponent
        if interface_type == "me":
            component = ModelExchange(instance, solver, starts=starts, rtol=rtol, dae=dae)
            solver = component.solver
        else:
            component = CoSimulation(instance, starts=starts)
        rtol = RTOL if rtol is None and solver in TOLERANT else rtol
    except BaseException:
        if instance is not None:
            instance.free_instance()
        shutil.rmtree(folder, ignore_errors=True)
        raise
    solving = {
        key: value for key, value in (("solver", solver), ("tolerance", rtol)) if value is not None
    }
    return Fmu(
        archive,
        interface_type,
        instance=instance,
        component=component,
        folder=folder,
        solving=solving,
        notes=notes,
    )


def _limited(
    archive: Archive, description: Description, interface_type: InterfaceType
) -> tuple[Description, tuple[str, ...]]:
    """Take from a description what is not supported or cannot be relied on; give what is to be known about that.

    A clock that an FMU only shows needs nothing from us. One that it must be given would never tick in model exchange; in
    co-simulation the FMU drives it itself, once it was told that event mode is not used.
    """
    can, notes = description.capabilities[interface_type], []
    if description.clocks:
        can = replace(can, event_mode=False)
        named = f"clocks are not supported: {', '.join(description.clocks)}"
        given = [name for name in description.clocks if description[name].causality == "input"]
        if interface_type == "me" and given:
            other = '; use interface_type = "cs"' if "cs" in description.capabilities else ""
            raise FmuError(
                f"{archive.path}: {named}; in model exchange {', '.join(given)} would have to be ticked{other}"
            )
        notes.append(
            f"{description.name}: {named}{'; the FMU drives them itself, without event mode' * (interface_type == 'cs')}"
        )
    problems = (
        find_rollback_problems(archive, interface_type)
        if can.saves_state and description.tool != OUR_TOOL
        else ()
    )
    if problems:
        can = replace(can, saves_state=False)
        notes.append(
            f"{description.name}: its state is not saved, although it says that it can be: {'; '.join(problems)}"
        )
    return replace(
        description, capabilities={**description.capabilities, interface_type: can}
    ), tuple(notes)


def _mode(archive: Archive, wanted: InterfaceType | None) -> InterfaceType:
    there = [
        interface_type
        for interface_type in INTERFACE_TYPES
        if interface_type in archive.description.capabilities
    ]
    if not there:
        raise FmuError(
            f"{archive.path}: neither model exchange nor co-simulation; needed one of them"
        )
    if wanted is None:
        return there[0]
    if wanted not in INTERFACE_TYPES:
        raise FmuError(f'{archive.path}: mode {wanted!r}; needed "me" or "cs"')
    if wanted not in there:
        raise FmuError(
            f'{archive.path}: not for {INTERFACE_TYPE_NAMES[wanted]} (interface_type = "{wanted}"); it is for {INTERFACE_TYPE_NAMES[there[0]]}: '
            f'interface_type = "{there[0]}"'
        )
    return wanted


def _library(archive: Archive, interface_type: InterfaceType) -> str:
    """Give the member of the archive that is the binary for this machine."""
    description, identifier = (
        archive.description,
        archive.description.capabilities[interface_type].identifier,
    )
    wanted = folders(description.version)
    for folder in wanted:
        member = f"binaries/{folder}/{identifier}{SUFFIX}"
        if member in archive.members:
            return member
    there = ", ".join(description.platforms) or "none"
    raise FmuError(
        f"{archive.path}: no binary for this platform; found binaries for: {there}; needed "
        f"binaries/{wanted[0]}/{identifier}{SUFFIX}"
    )


def _check_architecture(archive: Archive, library: Path) -> None:
    """Name what the loader calls a missing file: a binary of another machine."""
    with library.open("rb") as file:
        found = built_for(file.read(1024))
    if found and found[0] not in ("any", ARCHITECTURE):
        raise FmuError(
            f"{archive.path}: the binary {library.parent.name}/{library.name} is for {found[0]}, found in the folder for "
            f"{ARCHITECTURE}; needed one for {ARCHITECTURE}"
        )
