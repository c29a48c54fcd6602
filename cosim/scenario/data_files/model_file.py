"""Matrices of a model in a MAT-file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, frozen
from cosim.errors import UsageError, listing
from cosim.files import read_bounded
from cosim.scenario.data_files.mat_file import read_variables

LARGEST: Final = 2**28  # bytes of a file


@dataclass(frozen=True, eq=False)
class ModelFile:
    """The variables of a file that are matrices of a model, and a hash of the file.

    Parameters
    ----------
    matrices : dict of str to Matrix
    others : tuple of str
        What else is in the file.
    sha256 : str
    """

    matrices: dict[str, Matrix]
    others: tuple[str, ...]
    sha256: str


def read_model_file(path: Path, letters: tuple[str, ...]) -> ModelFile:
    """Read the matrices of these names, as far as a MAT-file has them.

    Raises
    ------
    UsageError
        If the file cannot be read or is none of that kind, or a variable of these names is no
        matrix of finite real numbers.
    """
    try:
        content = read_bounded(path, LARGEST)
    except OSError as error:
        raise UsageError(
            f"file {path} cannot be read ({error.strerror}); expected a MAT-file (.mat)"
        ) from error
    variables = read_variables(f"file {path}", content)
    matrices = {}
    for name in letters:
        value = variables.pop(name, None)
        if value is not None and getattr(value, "shape", None) != (0, 0):  # MATLAB's [], for none
            matrices[name] = _matrix(f"file {path}: {name}", value)
    sha256 = hashlib.sha256(content).hexdigest()
    return ModelFile(matrices, tuple(sorted(variables)), sha256)


def _matrix(label: str, value: Any) -> Matrix:
    """Return a variable as a matrix of real numbers, a sparse one as a full one."""
    dense = np.asarray(value.toarray() if hasattr(value, "toarray") else value)
    what = ""
    if dense.dtype.names is not None:
        what = "a struct"
    elif dense.dtype.kind == "U":
        what = "text"
    elif dense.dtype.kind == "c":
        what = "a matrix of complex numbers"
    elif dense.dtype.kind not in "biuf":
        what = "a cell array or an object"
    elif dense.ndim != 2:
        what = f"an array of {dense.ndim} dimensions"
    if what:
        raise UsageError(f"{label}: expected a matrix of real numbers, got {what}")
    return frozen(dense, 2)


def missing_text(file: str, content: ModelFile, missing: list[str]) -> str:
    """Return what to say where a file lacks matrices of a model."""
    names = listing([*content.matrices, *content.others]) or "none"
    return f"file {file}: expected A and C, got no {' and '.join(missing)}; available: {names}"
