"""Models of [models]: from the matrices of a table or a file to a descriptor system."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import AssumptionError, UsageError
from cosim.scenario.document.problems import TableProblems
from cosim.scenario.document.schema import ModelTable
from cosim.theory.plants.descriptor import DescriptorSystem
from cosim.theory.plants.foreign_model import disturbance_columns, state_space_matrices

LETTERS: Final = ("E", "A", "B", "Bu", "Bd", "C", "D", "Du", "Dd")
PARTITIONED: Final = ("A", "Bu", "Bd", "C")
OF_ZEROS: Final = "zero if it acts on y only"
# keys of columns, the matrix that these are of, and what is expected without it
COLUMNS_OF: Final = MappingProxyType(
    {
        "D": ("B", "B (with Bu and Bd: Du and Dd)"),
        "disturbances": ("B", "B"),
        "Du": ("Bu", f"Bu ({OF_ZEROS})"),
        "Dd": ("Bd", f"Bd ({OF_ZEROS})"),
    }
)
SPLIT_B: Final = ("Bu", "Bd", "Du", "Dd")


def check_form(table: ModelTable) -> None:
    """Check that the keys of a model make up one of its forms.

    Raises
    ------
    TableProblems
        If they do not.
    """
    given = [name for name in (*LETTERS, "disturbances") if getattr(table, name) is not None]
    if table.n_a is not None and table.file is None:
        _refuse(_problems_of_partitioned(given))
    elif table.file is None:
        columns = None if table.B is None else len(table.B[0])
        _refuse(_problems_of_general(given, table.disturbances or (), columns))
    else:
        text = "not allowed with file; give all matrices in one of them"
        problems = [(name, text) for name in given if name != "disturbances"]
        if table.n_a is not None:
            problems.append(("n_a", "not allowed with file, which has the general form"))
        _refuse(problems)


def _refuse(problems: Iterable[tuple[str, str]]) -> None:
    """Raise the problems of a table: the key, "" for the table, and the problem."""
    found = [((key,) if key else (), text) for key, text in problems]
    if found:
        raise TableProblems(found)


def _problems_of_partitioned(given: Sequence[str]) -> Iterator[tuple[str, str]]:
    for name in PARTITIONED:
        if name not in given:
            yield "", f"'{name}' is missing; expected {', '.join(PARTITIONED)} with n_a"
    for name in given:
        if name not in PARTITIONED:
            text = (
                "not allowed with n_a, the partitioned form of A, Bu, Bd and C with "
                "E = diag(I, 0); for the general form give E in place of n_a"
            )
            yield name, text


def _problems_of_general(
    given: Sequence[str], unknown: Sequence[int], columns: int | None
) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with the general form; ``columns`` are those of B, where there is one."""
    for name in ("A", "C"):
        if name not in given:
            yield "", f"'{name}' is missing; expected A and C (optional: E, B or Bu and Bd, D)"
    split = [name for name in SPLIT_B if name in given]
    if "B" in given and split:
        cure = f"remove {', '.join(split)}, or split B"
        yield split[0], f"not allowed with B; expected B and D, or Bu, Bd, Du and Dd: {cure}"
    else:
        for name, (B, expected) in COLUMNS_OF.items():
            if name in given and B not in given:
                yield name, f"not allowed without {B}; expected {expected}"
    if columns is not None:
        for column in unknown:
            if not 0 <= column < columns:
                yield "disturbances", f"expected a column of B, 0 to {columns - 1}, got {column}"
        if len(set(unknown)) < len(unknown):
            yield "disturbances", f"expected each column once, got {list(unknown)}"


def system_of(table: ModelTable, content: Mapping[str, Matrix] | None = None) -> DescriptorSystem:
    """Build the descriptor system of a table, by its form or by the content of its file.

    Raises
    ------
    UsageError
        If the content of the file does not make up a form.
    AssumptionError
        If the matrices do not fit together.
    """
    unknown = table.disturbances or ()
    if content is not None:
        given = [*content, *(["disturbances"] if table.disturbances is not None else ())]
        columns = content["B"].shape[1] if "B" in content else None
        for key, text in _problems_of_general(given, unknown, columns):
            raise UsageError(f"{key}: {text}" if key else text)
        return _general_system(content, unknown)
    matrices: dict[str, Matrix] = {}
    for letter in LETTERS:
        rows = getattr(table, letter)
        if rows is not None:
            matrices[letter] = np.array(rows)
    if table.n_a is not None:
        return DescriptorSystem.partitioned(n_a=table.n_a, **matrices)
    return _general_system(matrices, unknown)


def model_table(
    system: object, disturbances: Iterable[int | str] = ()
) -> dict[str, list[list[float]] | list[int]]:
    """Return a model of another package as a table for [models].

    Parameters
    ----------
    system : object
        With A, B, C and D, such as a StateSpace of python-control or scipy.signal, in continuous
        time.
    disturbances : iterable of int or str
        The inputs that are unknown, by column of B or by name.

    Raises
    ------
    AssumptionError
        If it is no such model, or an input is not there.

    Examples
    --------
    >>> import cosim, scipy.signal
    >>> model = scipy.signal.StateSpace([[-1.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]])
    >>> cosim.model_table(model, disturbances=[1])["disturbances"]
    [1]
    """
    table: dict[str, list[list[float]] | list[int]] = {}
    for name, values in state_space_matrices(system).items():
        if values.size or name in ("A", "C"):
            table[name] = values.tolist()
    unknown = disturbance_columns(system, disturbances)
    if unknown:
        table["disturbances"] = list(unknown)
    return table


def _general_system(
    matrices: Mapping[str, Matrix], disturbances: tuple[int, ...]
) -> DescriptorSystem:
    """Build a system of the general form.

    ``matrices`` are A, C, and of E, B, D or Bu, Bd, Du, Dd what there is.

    Raises
    ------
    AssumptionError
        If they do not fit together.
    """
    split = {name: matrices[name] for name in SPLIT_B if name in matrices}
    n = len(matrices["A"])
    if "B" in matrices and len(matrices["B"]) != n:
        raise AssumptionError(
            f"B: expected {n} rows, one per row of A, got shape {matrices['B'].shape}"
        )
    if "D" in matrices:
        n_y = len(matrices["C"])
        expected = (n_y, matrices["B"].shape[1])
        if matrices["D"].shape != expected:
            raise AssumptionError(
                f"D: expected shape {expected}, one row per row of C and one column per column of "
                f"B, got {matrices['D'].shape}"
            )
    for name in ("B", "D"):
        if name in matrices:
            columns = range(matrices[name].shape[1])
            known = [column for column in columns if column not in disturbances]
            unknown = [column for column in disturbances if column in columns]
            split[f"{name}u"] = matrices[name][:, known]
            split[f"{name}d"] = matrices[name][:, unknown]
    return DescriptorSystem.general(A=matrices["A"], C=matrices["C"], E=matrices.get("E"), **split)
