"""Matrices of a model in a MAT-file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from cosim.arrays import Matrix
from cosim.errors import UsageError, listing
from cosim.scenario.data_files.mat_file import OtherVariable, variables_of
from cosim.scenario.data_files.table import content_of


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
    content = content_of(path)
    variables = variables_of(f"file {path}", content)
    matrices = {}
    for name in letters:
        value = variables.pop(name, None)
        if isinstance(value, OtherVariable):
            raise UsageError(
                f"file {path}: {name}: expected a matrix of real numbers, got {value.what}"
            )
        if value is not None and value.shape != (0, 0):  # MATLAB's [], which stands for none
            matrices[name] = value
    sha256 = hashlib.sha256(content).hexdigest()
    return ModelFile(matrices, tuple(sorted(variables)), sha256)


def missing_text(file: str, content: ModelFile, missing: list[str]) -> str:
    """Return what to say where a file lacks matrices of a model."""
    names = listing([*content.matrices, *content.others]) or "none"
    return f"file {file}: expected A and C, got no {' and '.join(missing)}; available: {names}"
