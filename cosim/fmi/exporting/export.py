"""Write a model as an FMU: FMI 2.0 or 3.0, as C source and binaries.

The parts of the C source, each in ``c/``::

    fmi2.c | fmi3.c               the functions of the standard
    unit.c                        variables, modes, time, steps, derivatives, copies of the state
    continuous.c | discrete.c     a linear model | a model that lives at the communication points, around one kernel
    residual.c                    the equations of the algebraic variables that were eliminated from a linear model (FMI 3.0)
    model.c                       written here: the numbers
    cosim/native/*.c              the steps, as they run in the package: one arithmetic in two homes

A linear model is for model exchange and for co-simulation; a discrete one for co-simulation only.
"""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeAlias
from uuid import UUID

import numpy as np

from cosim.core.linear import DescriptorModel, LinearModel
from cosim.errors import FmuError, nearest
from cosim.fmi.description import INTERFACE_TYPE_NAMES, Description, InterfaceType
from cosim.fmi.exporting.arrays import with_arrays
from cosim.fmi.exporting.compiling import advice, check_platforms, compile_sources
from cosim.fmi.exporting.documenting import document
from cosim.fmi.exporting.kernels import DiscreteModel, integer, integers
from cosim.fmi.exporting.specifications import ExportSpecification, form_of
from cosim.fmi.exporting.writing_dae import write_dae
from cosim.fmi.exporting.writing_fmi2 import write_fmi2
from cosim.fmi.exporting.writing_fmi3 import write_build_description, write_fmi3
from cosim.fmi.reading.dae import MANIFEST
from cosim.fmi.variable import Variable
from cosim.native import build

HERE = Path(__file__).resolve().parent / "c"
EPOCH = (1980, 1, 1, 0, 0, 0)  # the same content gives the same archive
LARGEST = 2**27  # doubles of an instance, 1 GiB

Exportable: TypeAlias = LinearModel | DescriptorModel | DiscreteModel


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
    arranged : callable
        Gives the description its variables: scalars, or arrays.
    build : callable
        Writes files beside the sources, by name.
    """

    number: str
    source: str
    headers: tuple[str, ...]
    write: Callable[..., str]
    arranged: Callable[[Description], Description]
    build: Callable[[str, Sequence[str]], Mapping[str, str]]


def _with_time(description: Description) -> Description:
    """Give arrays, and the independent variable that FMI 3 wants (FMI 3.0.2 section 2.4.7.4), behind the states."""
    if any(v.name == "time" for v in description.variables):
        raise FmuError(
            f"{description.name}: a variable is called 'time', which in FMI 3 is the time; use FMI 2, or another name"
        )
    ports = sum(v.causality in ("input", "output") for v in description.variables)
    time = Variable(
        "time", ports + 2 * len(description.states), "independent", unit="s", doc="the time reached"
    )
    arrays = with_arrays(description)
    return replace(arrays, variables=(*arrays.variables, time))


def _as_it_is(description: Description) -> Description:
    return description


def _nothing(name: str, sources: Sequence[str]) -> dict[str, str]:
    return {}


def _build(name: str, sources: Sequence[str]) -> dict[str, str]:
    return {"buildDescription.xml": write_build_description(name, sources)}


VERSIONS: Final[Mapping[str, Version]] = {
    "2": Version(
        "2.0",
        "fmi2.c",
        ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
        write_fmi2,
        _as_it_is,
        _nothing,
    ),
    "3": Version(
        "3.0",
        "fmi3.c",
        ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
        write_fmi3,
        _with_time,
        _build,
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
    kinds : tuple of Mode
        Which it is for.
    platforms : tuple of str
        The folders under ``binaries/`` that were filled; none: sources only.
    notes : tuple of str
        What is to be known: why a kind is missing, how to compile the sources where there was no compiler.
    """

    path: Path
    version: str
    kinds: tuple[InterfaceType, ...]
    platforms: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def lines(self) -> list[str]:
        """What was written, for people."""
        kinds = " and ".join(INTERFACE_TYPE_NAMES[kind] for kind in self.kinds)
        binary = "binary" if len(self.platforms) == 1 else "binaries"
        built = f"{binary} for {', '.join(self.platforms)}" if self.platforms else "sources only"
        return [f"{self.path}: FMI {self.version}, {kinds}, {built}", *self.notes]


def export(
    model: Exportable,
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
        If the model holds a number that is not finite, the name is no identifier, the version or a platform is not known or
        cannot have what the model needs, or the folder of ``path`` is missing.
    """
    path = Path(path)
    _check_names(path, name, fmi)
    check_platforms(platforms)
    form, version = form_of(model, name), VERSIONS[fmi]
    _check_numbers(form)
    if form.residuals and fmi != "3":
        raise FmuError(
            f"{name}: FMI {version.number} has no residual form; the layered standard for it is on top of FMI 3: use FMI 3"
        )
    unit = version.arranged(_named(form.description, name, version))
    sources, main = _sources(form, version)

    def xml() -> str:
        return version.write(unit, text=description, sources=main, constant=form.constant)

    digest = hashlib.sha256(
        b"\0".join([_constants(form, unit, 0).encode(), xml().encode(), *sources.values()])
    ).digest()
    unit = replace(unit, token=f"{{{UUID(bytes=digest[:16], version=5)}}}")
    sources["model.c"] = _constants(form, unit, int.from_bytes(digest[:6])).encode()
    binaries = compile_sources(
        sources, main, name=name, version=version.number, platforms=platforms
    )
    files = {
        "modelDescription.xml": xml().encode(),
        "documentation/index.html": document(
            unit, form.equations, text=description, main=main
        ).encode(),
        **{f"sources/{file}": content for file, content in sources.items()},
        **{
            f"sources/{file}": content.encode()
            for file, content in version.build(name, main).items()
        },
        **{f"binaries/{binary.folder}/{binary.name}": binary.content for binary in binaries},
        **({MANIFEST: write_dae(unit, constant=form.constant).encode()} if unit.dae else {}),
        **(extra or {}),
    }
    _write(path, files)
    notes = [f"co-simulation only: {form.reason}"] if form.reason else []
    notes += (
        [binary.note for binary in binaries if binary.note]
        if binaries
        else [advice(main, name, version.number)]
    )
    return Exported(
        path,
        version.number,
        tuple(unit.capabilities),
        tuple(binary.folder for binary in binaries),
        tuple(notes),
    )


def _check_names(path: Path, name: str, fmi: str) -> None:
    if fmi not in VERSIONS:
        raise FmuError(f"FMI version {fmi!r}: {nearest(fmi, VERSIONS)}")
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
        raise FmuError(
            f"name {name!r}: needed an identifier of C: letters, digits and _, no digit first"
        )
    if not path.parent.is_dir():
        raise FmuError(f"{path}: there is no folder {path.parent}; make it first")


def _check_numbers(form: ExportSpecification) -> None:
    for letter, array in form.numbers.items():
        if not np.isfinite(array).all():
            raise FmuError(f"matrix {letter} holds NaN or infinity; an FMU needs finite numbers")
    if form.memory + form.work > LARGEST:
        raise FmuError(
            f"{form.description.name}: an instance needs {form.memory + form.work} numbers; needed at most {LARGEST}"
        )


def _named(unit: Description, name: str, version: Version) -> Description:
    kinds = {
        interface_type: replace(kind, identifier=name)
        for interface_type, kind in unit.capabilities.items()
    }
    return replace(unit, version=version.number, capabilities=kinds)


def _sources(form: ExportSpecification, version: Version) -> tuple[dict[str, bytes], list[str]]:
    """Give the files that are the same for every model of this form, and the C files to compile."""
    import fmpy

    ours = [version.source, "unit.c", *form.sources]
    places = {
        **{file: HERE / file for file in (*ours, "unit.h", "model.h", *form.headers)},
        **{file: build.HERE / file for file in (*form.natives, "cosim.h")},
        **{file: Path(fmpy.__file__).parent / "c-code" / file for file in version.headers},
    }
    return {file: place.read_bytes() for file, place in places.items()}, [
        *ours,
        "model.c",
        *form.natives,
    ]


def _constants(form: ExportSpecification, unit: Description, stamp: int) -> str:
    """Write model.c: every number as a hexadecimal float, which is exact."""
    n, m, p = form.size
    sizes = {v.reference: v.size for v in unit.variables}
    lines = [
        f'#include "{form.headers[0]}"',
        "",
        f'const char *const model_token = "{unit.token}";',
        f"const double model_stamp = {float(stamp).hex()};",
        f"const int32_t model_n = {n}, model_m = {m}, model_p = {p};",
        f"const int64_t model_step_ns = INT64_C({form.step_ns});",
        integer("model_has_derivatives", int("me" in unit.capabilities)),
        f"const int32_t model_memory = {form.memory}, model_work = {form.work};",
        integers(
            "model_size",
            [sizes.get(reference, 0) for reference in range(m + p + 2 * n + 1 + form.residuals)],
        ),
    ]
    return "\n".join([*lines, *form.constants, ""])


def _write(path: Path, files: Mapping[str, bytes]) -> None:
    partial = path.with_name(f".{path.name}.part")
    try:
        with zipfile.ZipFile(partial, "w") as archive:
            for name, content in files.items():
                archive.writestr(zipfile.ZipInfo(name, EPOCH), content, zipfile.ZIP_DEFLATED)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
