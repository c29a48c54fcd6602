"""Write a linear model as an FMU: FMI 2.0, model exchange and co-simulation in one archive.

The C sources are ``c/fmi2.c`` around the same ``linear.c`` that steps the model here: one arithmetic in two homes.
"""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import UUID

import numpy as np

from cosim.arrays import Matrix
from cosim.core.solver import LinearModel
from cosim.errors import FmuError
from cosim.fmi.description import Capabilities, Description, Mode, describe, states_of_outputs
from cosim.fmi.platforms import SUFFIX, folders
from cosim.fmi.writing import write_model_description
from cosim.native import build

HERE = Path(__file__).resolve().parent / "c"
SOURCES = ("fmi2.c", "model.c", "linear.c")
HEADERS = ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h")
EPOCH = (1980, 1, 1, 0, 0, 0)  # the same content gives the same archive


@dataclass(frozen=True, slots=True)
class Exported:
    """An FMU that was written.

    Parameters
    ----------
    path : Path
    platform : str or None
        The folder under ``binaries/`` that was filled; None: sources only.
    note : str
        How to compile the sources, where there was no compiler.
    """

    path: Path
    platform: str | None
    note: str = ""


def export(model: LinearModel, path: Path | str, *, name: str, description: str = "") -> Exported:
    """Write a model as an FMU; an existing file is replaced only when the new one is complete.

    Parameters
    ----------
    model : LinearModel
    path : Path or str
    name : str
        Name of the model; an identifier of C, as it is also that of the library.
    description : str
        What it is, for people.

    Raises
    ------
    FmuError
        If the model holds a number that is not finite, the name is no identifier, or the folder of
        ``path`` is missing.
    """
    path = Path(path)
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
        raise FmuError(f"name {name!r}: needed an identifier of C: letters, digits and _, no digit first")
    if not path.parent.is_dir():
        raise FmuError(f"{path}: there is no folder {path.parent}; make it first")
    _need_finite(model)
    unit = _describe(model, name)
    token = _token(_constants(model, ""), _xml(unit, model, description), *(text.read_text() for text in _sources().values()))
    unit = replace(unit, token=token)
    files = {
        "modelDescription.xml": _xml(unit, model, description).encode(),
        "sources/model.c": _constants(model, token).encode(),
    }
    files |= {f"sources/{file}": source.read_bytes() for file, source in _sources().items()}
    with TemporaryDirectory(prefix="cosim-export-") as folder:
        platform = _compile(files, Path(folder), name)
    partial = path.with_name(f".{path.name}.part")
    try:
        _archive(partial, files)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return Exported(path, platform, "" if platform else _advice(name))


def _need_finite(model: LinearModel) -> None:
    for letter, array in model.arrays.items():
        if not np.isfinite(array).all():
            raise FmuError(f"matrix {letter} holds NaN or infinity; an FMU needs finite numbers")


def _describe(model: LinearModel, name: str) -> Description:
    both = Capabilities(name, directional_derivatives=True, saves_state=True, completed_step=False)
    kinds: dict[Mode, Capabilities] = {"me": both, "cs": replace(both, interpolates_inputs=True, variable_step=True)}
    return replace(describe(model, name, model), capabilities=kinds)


def _xml(unit: Description, model: LinearModel, text: str) -> str:
    return write_model_description(unit, text=text, sources=SOURCES, initial=_initial_unknowns(unit, model))


def _initial_unknowns(unit: Description, model: LinearModel) -> dict[str, tuple[str, ...]]:
    """Give what the unknowns of the initialization depend on: inputs, and states whose start value is given."""
    inputs = [v.name for v in unit.variables if v.causality == "input"]
    through = {
        x: tuple(u for u, value in zip(inputs, row, strict=True) if value) for x, row in zip(model.states, model.Xu, strict=True)
    }
    unknowns = {}
    for variable in unit.variables:
        if variable.initial != "calculated":
            continue
        needs: dict[str, None] = {}
        direct = (variable.name,) if variable.name in unit.states else unit.dependencies[variable.name] or ()
        for name in direct:
            needs |= dict.fromkeys(through.get(name) or (name,))
        unknowns[variable.name] = tuple(needs)
    return unknowns


def _constants(model: LinearModel, token: str) -> str:
    """Write model.c: every number as a hexadecimal float, which is exact."""
    settable = [int(not row.any()) for row in model.Xu]
    lines = ['#include "model.h"', "", f'const char *const model_guid = "{token}";']
    lines += [f"const int32_t model_n = {len(model.states)}, model_m = {model.interface.n_u}, model_p = {model.interface.n_y};"]
    lines += [_doubles(letter, array) for letter, array in model.arrays.items()]
    lines += [_integers("is_exact", settable), _integers("state_of", states_of_outputs(model))]
    return "\n".join(lines) + "\n"


def _doubles(name: str, values: Matrix) -> str:
    return f"const double model_{name}[] = {{{', '.join(float(v).hex() for v in values.ravel()) or '0.0'}}};"


def _integers(name: str, values: Sequence[int]) -> str:
    return f"const int32_t model_{name}[] = {{{', '.join(map(str, values)) or '0'}}};"


def _token(*texts: str) -> str:
    digest = hashlib.sha256("\0".join(texts).encode()).digest()
    return f"{{{UUID(bytes=digest[:16], version=5)}}}"


def _sources() -> dict[str, Path]:
    import fmpy

    headers = Path(fmpy.__file__).parent / "c-code"
    ours = {name: HERE / name for name in ("fmi2.c", "model.h")} | {name: build.HERE / name for name in ("linear.c", "cosim.h")}
    return ours | {name: headers / name for name in HEADERS}


def _compile(files: dict[str, bytes], folder: Path, name: str) -> str | None:
    """Compile into ``files``; give the folder under ``binaries/``, or None without a compiler."""
    if not build.compiler():
        return None
    for file in (file for file in files if file.startswith("sources/")):
        (folder / Path(file).name).write_bytes(files[file])
    library = folder / f"{name}{SUFFIX}"
    try:
        build.compile_library([folder / source for source in SOURCES], library)
    except RuntimeError as error:
        raise FmuError(f"the FMU {name!r} could not be compiled: {error}") from error
    platform = folders("2.0")[0]
    files[f"binaries/{platform}/{library.name}"] = library.read_bytes()
    return platform


def _archive(path: Path, files: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, EPOCH), content, zipfile.ZIP_DEFLATED)


def _advice(name: str) -> str:
    flags = " ".join(build.FLAGS)
    return (
        "no C compiler was found, so the FMU holds sources only. Install one as 'cc' or 'pip install ziglang' and export again, "
        f"or, in sources/: cc {flags} {' '.join(SOURCES)} -o ../binaries/{folders('2.0')[0]}/{name}{SUFFIX} -lm"
    )
