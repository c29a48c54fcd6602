"""Write a model as an FMU: FMI 2.0 or 3.0, as C source and binaries.

The parts of the C source, each in ``c/``::

    fmi2.c | fmi3.c               the functions of the standard
    instance.c                    variables, modes, time, steps, derivatives, copies of the state
    continuous.c | discrete.c     a linear model | a model that changes at communication points
                                  only, around one kernel
    residual.c                    the equations of the algebraic variables that were eliminated from
                                  a linear model (FMI 3.0)
    model.c, kernels.h            written here: the numbers, and the headers of the steps
    cosim/native/*/*.c            the steps: the same arithmetic in the package and in the FMU

A linear model is for model exchange and for co-simulation; a discrete one for co-simulation only.
"""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final
from uuid import UUID

import numpy as np

from cosim.core.linear import DescriptorModel
from cosim.errors import FmuError, nearest, quoted
from cosim.files import expanded
from cosim.fmi.bundled import bundled
from cosim.fmi.description import INTERFACE_TYPE_NAMES, Description, InterfaceType
from cosim.fmi.exporting.arrays import with_arrays
from cosim.fmi.exporting.compiling import Binary, advice, check_platforms, compile_sources
from cosim.fmi.exporting.documenting import document
from cosim.fmi.exporting.kernels import integer, integers
from cosim.fmi.exporting.specifications import Exportable, ExportSpecification, specify
from cosim.fmi.exporting.writing_dae import write_dae
from cosim.fmi.exporting.writing_fmi2 import write_fmi2
from cosim.fmi.exporting.writing_fmi3 import write_build_description, write_fmi3
from cosim.fmi.reading.dae import MANIFEST
from cosim.fmi.variable import Variable
from cosim.native import build

HERE = Path(__file__).resolve().parent / "c"
EPOCH = (1980, 1, 1, 0, 0, 0)  # the same content gives the same archive
LARGEST = 2**27  # doubles of an instance, 1 GiB


@dataclass(frozen=True, slots=True)
class Version:
    """What differs between the versions of the standard.

    Parameters
    ----------
    number : str
    source : str
        The file with its functions.
    headers : tuple of str
    write : callable
        Writes the modelDescription.xml.
    arrange : callable
        Gives the description its variables: scalars, or arrays.
    write_build : callable or None
        Writes the buildDescription.xml; None: the version has none.
    """

    number: str
    source: str
    headers: tuple[str, ...]
    write: Callable[..., str]
    arrange: Callable[[Description], Description]
    write_build: Callable[[str, Sequence[str]], str] | None


def _arrays_and_time(description: Description) -> Description:
    """Join arrays; add the independent variable that FMI 3 needs (FMI 3.0.2 section 2.4.7.4)."""
    if "time" in description:
        raise FmuError(
            f"{description.name}: a variable is called 'time', which in FMI 3 is the time; "
            "use FMI 2, or another name"
        )
    ports = sum(v.causality in ("input", "output") for v in description.variables)
    reference = ports + 2 * len(description.states)  # behind the derivatives and the states
    time = Variable("time", reference, "independent", unit="s", doc="the time reached")
    arrays = with_arrays(description)
    return replace(arrays, variables=(*arrays.variables, time))


def _scalars(description: Description) -> Description:
    return description


VERSIONS: Final[Mapping[str, Version]] = {
    "2": Version(
        "2.0",
        "fmi2.c",
        ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
        write_fmi2,
        _scalars,
        None,
    ),
    "3": Version(
        "3.0",
        "fmi3.c",
        ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
        write_fmi3,
        _arrays_and_time,
        write_build_description,
    ),
}


@dataclass(frozen=True, slots=True)
class Exported:
    """An FMU that was written.

    Parameters
    ----------
    path : Path
    version : str
        FMI version.
    interface_types : tuple of InterfaceType
        Which it is for.
    platforms : tuple of str
        The folders under ``binaries/`` that were filled; none: sources only.
    notes : tuple of str
        What is to be known: why model exchange is missing, how to compile the sources where there
        was no compiler.
    """

    path: Path
    version: str
    interface_types: tuple[InterfaceType, ...]
    platforms: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def lines(self) -> list[str]:
        """What was written, for people."""
        interface_types = " and ".join(INTERFACE_TYPE_NAMES[name] for name in self.interface_types)
        content = "sources only"
        if self.platforms:
            binary = "binary" if len(self.platforms) == 1 else "binaries"
            content = f"{binary} for {', '.join(self.platforms)}"
        first = f"{self.path}: FMI {self.version}, {interface_types}, {content}"
        return [first, *self.notes]


def export(
    model: Exportable | DescriptorModel,
    path: Path | str,
    *,
    name: str,
    fmi: str = "2",
    platforms: Sequence[str] = (),
    description: str = "",
    extra: Mapping[str, bytes] | None = None,
) -> Exported:
    """Write a model as an FMU; an existing file is replaced only when the new one is complete.

    Parameters
    ----------
    model : LinearModel, DescriptorModel or DiscreteModel
        A descriptor model keeps its algebraic equations, for importers that solve them: FMI 3 only.
    path : Path or str
    name : str
        Name of the model; an identifier of C, as it is also that of the library.
    fmi : str
        Version: "2" or "3".
    platforms : sequence of str
        Machines to compile for; none: this one.
    description : str
        What it is, for people.
    extra : mapping of path to content, optional
        Further files of the archive.

    Raises
    ------
    FmuError
        If the model holds a number that is not finite, the name is no identifier, the version or a
        platform is not known or cannot have what the model needs, or the folder of ``path`` is
        missing.
    """
    path = expanded(path)
    _check_names(path, name, fmi)
    check_platforms(platforms)
    specification = specify(model, name)
    _check_specification(specification, VERSIONS[fmi])
    fmu = _assemble(specification, VERSIONS[fmi], summary=description)
    version = fmu.version.number
    binaries = compile_sources(
        fmu.sources, fmu.main, name=name, version=version, platforms=platforms
    )
    write_files(path, {**fmu.files(binaries), **(extra or {})})
    interface_types = tuple(fmu.description.capabilities)
    folders = tuple(binary.folder for binary in binaries)
    return Exported(path, version, interface_types, folders, fmu.notes(binaries))


MOST_IDENTIFIER = 200  # characters: with a suffix, the name of a file


def _check_names(path: Path, name: str, fmi: str) -> None:
    if fmi not in VERSIONS:
        raise FmuError(f"unknown FMI version {fmi!r}; {nearest(fmi, VERSIONS)}")
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
        raise FmuError(
            f"name {quoted(name)}: expected a C identifier: letters, digits and _, no digit first"
        )
    if len(name) > MOST_IDENTIFIER:
        raise FmuError(
            f"name {quoted(name)}: expected at most {MOST_IDENTIFIER} characters, got {len(name)}, "
            "as files in the FMU are named after it"
        )
    if not path.parent.is_dir():
        raise FmuError(f"{path}: no folder {path.parent}; create it first")


def _check_specification(specification: ExportSpecification, version: Version) -> None:
    name = specification.description.name
    for letter, array in specification.numbers.items():
        if not np.isfinite(array).all():
            raise FmuError(f"matrix {letter} holds NaN or infinity; an FMU needs finite numbers")
    size = specification.memory + specification.work
    if size > LARGEST:
        raise FmuError(f"{name}: an instance needs {size} numbers; the limit is {LARGEST}")
    if specification.n_residuals and version.number != "3.0":
        raise FmuError(
            f"{name}: FMI {version.number} has no residual form; the layered standard for it is "
            "on top of FMI 3: use FMI 3"
        )


@dataclass(frozen=True, slots=True)
class _ArchiveContent:
    """The content of an FMU.

    Parameters
    ----------
    specification : ExportSpecification
    version : Version
    description : Description
        With the variables of this version, identifier and token.
    summary : str
        What it is, for people.
    sources : mapping of file name to content
    main : tuple of str
        The C files among the sources.
    """

    specification: ExportSpecification
    version: Version
    description: Description
    summary: str
    sources: Mapping[str, bytes]
    main: tuple[str, ...]

    @property
    def xml(self) -> str:
        """The modelDescription.xml."""
        constant = self.specification.constant
        return self.version.write(
            self.description, summary=self.summary, sources=self.main, constant=constant
        )

    def files(self, binaries: Sequence[Binary]) -> dict[str, bytes]:
        """Return the files of the archive by path."""
        specification = self.specification
        page = document(
            self.description, specification.equations, summary=self.summary, main=self.main
        )
        files = {
            "modelDescription.xml": self.xml.encode(),
            "documentation/index.html": page.encode(),
        }
        for name, content in self.sources.items():
            files[f"sources/{name}"] = content
        if self.version.write_build is not None:
            build = self.version.write_build(self.description.name, self.main)
            files["sources/buildDescription.xml"] = build.encode()
        for binary in binaries:
            files[f"binaries/{binary.folder}/{binary.name}"] = binary.content
        if self.description.dae:
            manifest = write_dae(self.description, constant=specification.constant)
            files[MANIFEST] = manifest.encode()
        return files

    def notes(self, binaries: Sequence[Binary]) -> tuple[str, ...]:
        """Return what is to be known about the FMU."""
        notes: list[str] = []
        if self.specification.reason:
            notes.append(f"co-simulation only: {self.specification.reason}")
        if not binaries:
            notes.append(advice(self.main, self.description.name, self.version.number))
        notes += [binary.note for binary in binaries if binary.note]
        return tuple(notes)


def _assemble(
    specification: ExportSpecification, version: Version, *, summary: str
) -> _ArchiveContent:
    """Build the content of an FMU, identified by a digest of all that decides its results."""
    main = (version.source, "instance.c", *specification.sources, "model.c", *specification.natives)
    sources = _sources(specification, version)
    description = version.arrange(_with_identifier(specification.description, version))
    draft = _ArchiveContent(specification, version, description, summary, sources, main)
    constants = _constants(specification, description, stamp=0)
    content = [constants.encode(), draft.xml.encode(), *sources.values()]
    digest = hashlib.sha256(b"\0".join(content)).digest()
    token = UUID(bytes=digest[:16], version=5)
    stamp = int.from_bytes(digest[:6])
    identified = replace(description, token=f"{{{token}}}")
    constants = _constants(specification, identified, stamp)
    sources["model.c"] = constants.encode()
    return replace(draft, description=identified, sources=sources)


def _with_identifier(description: Description, version: Version) -> Description:
    capabilities = dict(description.capabilities)
    for interface_type, able in capabilities.items():
        capabilities[interface_type] = replace(able, identifier=description.name)
    return replace(description, version=version.number, capabilities=capabilities)


def _sources(specification: ExportSpecification, version: Version) -> dict[str, bytes]:
    """Read the files that are the same for every model of this kind."""
    standard = bundled("c-code")
    ours = (version.source, "instance.c", *specification.sources)
    headers = ("instance.h", "model.h", *specification.headers)
    paths = [HERE / name for name in (*ours, *headers)]
    natives = specification.natives
    paths += [*map(build.source, natives), *build.headers(natives)]
    paths += [standard / name for name in version.headers]
    sources = {path.name: path.read_bytes() for path in paths}
    includes = "".join(f'#include "{Path(native).stem}.h"\n' for native in natives)
    sources["kernels.h"] = includes.encode()
    return sources


def _constants(specification: ExportSpecification, description: Description, stamp: int) -> str:
    """Write model.c: every number as a hexadecimal float, which is exact."""
    n, m, p = specification.size
    memory = specification.memory
    work = specification.work
    n_references = m + p + 2 * n + 1 + specification.n_residuals
    sizes = [0] * n_references
    for variable in description.variables:
        sizes[variable.reference] = variable.size
    lines = [f'#include "{specification.headers[0]}"', ""]
    lines.append(f'const char *const model_token = "{description.token}";')
    lines.append(f"const double model_stamp = {float(stamp).hex()};")
    lines.append(f"const int32_t model_n = {n}, model_m = {m}, model_p = {p};")
    lines.append(f"const double model_step = {specification.step!r};")
    lines.append(integer("model_has_derivatives", int("me" in description.capabilities)))
    lines.append(f"const int32_t model_memory = {memory}, model_work = {work};")
    lines.append(integers("model_size", sizes))
    lines += specification.constants
    return "\n".join(lines) + "\n"


def write_files(path: Path, files: Mapping[str, bytes]) -> None:
    """Write the files of an FMU by their names in it; it is there whole, or not at all.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    partial = path.with_name(f".{path.name}.part")
    try:
        with zipfile.ZipFile(partial, "w") as archive:
            for name, content in files.items():
                archive.writestr(zipfile.ZipInfo(name, EPOCH), content, zipfile.ZIP_DEFLATED)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
