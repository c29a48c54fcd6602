"""Units as components: the way in.

``ModelExchange`` and ``CoSimulation`` drive a unit of their kind, generated or loaded; ``load`` opens an .fmu;
``compare_ports`` says whether one component fits in another's place.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias, final

from cosim.errors import FmuError, RunError
from cosim.fmi.co_simulation import CoSimulation
from cosim.fmi.compare import compare_ports
from cosim.fmi.description import MODE_NAMES, MODES, Description, Mode
from cosim.fmi.loaded import LoadedUnit
from cosim.fmi.messages import Message
from cosim.fmi.model_exchange import ModelExchange
from cosim.fmi.platforms import SUFFIX, folders
from cosim.fmi.reading import Archive, read
from cosim.fmi.start import check_start

__all__ = ["CoSimulation", "Fmu", "ModelExchange", "compare_ports", "load"]

FmuComponent: TypeAlias = ModelExchange | CoSimulation


@final
class Fmu:
    """An FMU that was opened; a context manager that leaves nothing behind.

    Parameters
    ----------
    archive : Archive
    mode : Mode
    unit : LoadedUnit
    component : FmuComponent
    folder : Path
        Where it was unpacked.
    solver : str or None
        Of a model exchange FMU.
    """

    def __init__(
        self, archive: Archive, mode: Mode, *, unit: LoadedUnit, component: FmuComponent, folder: Path, solver: str | None
    ) -> None:
        self.component, self.mode, self._solver = component, mode, solver
        self._archive, self._unit, self._folder = archive, unit, folder

    @property
    def description(self) -> Description:
        """Variables, structure, capabilities."""
        return self._archive.description

    @property
    def metadata(self) -> dict[str, Any]:
        """What a log keeps: path, sha256 and modelDescription.xml of the file, FMI version, mode, solver."""
        found = self._archive
        return {
            "path": str(found.path),
            "sha256": found.sha256,
            "fmi_version": found.description.version,
            "mode": self.mode,
            **({"solver": self._solver} if self._solver else {}),
            "model_description": found.xml,
        }

    def drain(self) -> list[Message]:
        """Give what the FMU logged since the last call, and how many messages were dropped.

        The level is "info", "warning", "error" or "fatal", from the FMI status. What is to be known about the FMU's results is
        in ``component.notes``.
        """
        return self._unit.messages.drain() + self.component.drain()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the run, free the instance, remove the temporary folder. Twice does no harm."""
        with suppress(RunError):  # an instance that cannot end is let go of all the same
            self._unit.terminate()
        self._unit.free_instance()
        shutil.rmtree(self._folder, ignore_errors=True)


def load(
    path: Path | str,
    *,
    mode: Mode | None = None,
    solver: str | None = None,
    start: Mapping[str, float] | None = None,
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
    start : mapping of variable name to float
        Start values to set instead of the FMU's own.
    instance_name : str or None
        None: the name of the model.

    Raises
    ------
    FmuError
        If it is no FMU, cannot run here or in this mode, or a start value is wrong. Nothing is left behind.
    """
    folder = Path(tempfile.mkdtemp(prefix="cosim-fmu-"))
    unit: LoadedUnit | None = None
    try:
        archive = read(path, into=folder)
        description, starts = archive.description, dict(start or {})
        mode = _mode(archive, mode)
        if description.version == "1.0":
            raise FmuError(f"{path}: FMI 1.0 can be read, but not run yet; FMI 2.0 and 3.0 can")
        if mode == "cs" and solver is not None:
            raise FmuError(f'{path}: solver {solver!r}: a co-simulation FMU brings its own; leave it out or use mode = "me"')
        library = _library(archive, mode)
        _check_events(archive, mode)
        check_start(description, starts)
        name = instance_name or description.name
        unit = LoadedUnit(folder, folder / library, description, mode=mode, name=name, label=str(archive.path))
        solver = solver or ("rk4" if mode == "me" else None)
        component = ModelExchange(unit, solver, starts=starts) if mode == "me" else CoSimulation(unit, starts=starts)
    except BaseException:
        if unit is not None:
            unit.free_instance()
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return Fmu(archive, mode, unit=unit, component=component, folder=folder, solver=solver)


def _mode(archive: Archive, wanted: Mode | None) -> Mode:
    there = [mode for mode in MODES if mode in archive.description.capabilities]
    if not there:
        raise FmuError(f"{archive.path}: neither model exchange nor co-simulation; needed one of them")
    if wanted is None:
        return there[0]
    if wanted not in MODES:
        raise FmuError(f'{archive.path}: mode {wanted!r}; needed "me" or "cs"')
    if wanted not in there:
        raise FmuError(
            f'{archive.path}: not for {MODE_NAMES[wanted]} (mode = "{wanted}"); it is for {MODE_NAMES[there[0]]}: '
            f'mode = "{there[0]}"'
        )
    return wanted


def _library(archive: Archive, mode: Mode) -> str:
    """Give the member of the archive that is the binary for this machine."""
    description, identifier = archive.description, archive.description.capabilities[mode].identifier
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


def _check_events(archive: Archive, mode: Mode) -> None:
    description = archive.description
    if mode == "cs":
        return
    other = '; use mode = "cs"' if "cs" in description.capabilities else ""
    if description.clocks:
        raise FmuError(
            f"{archive.path}: has clocks ({', '.join(description.clocks)}), which are not supported yet in model exchange{other}"
        )
