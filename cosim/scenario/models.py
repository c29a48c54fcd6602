"""Models of [models]: from the matrices of a table to a descriptor system."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from cosim.arrays import Matrix
from cosim.errors import UsageError
from cosim.scenario.schema import ModelTable, matrix
from cosim.theory.descriptor import DescriptorSystem

LETTERS: Final = ("E", "A", "B", "Bu", "Bd", "C", "D", "Du", "Dd")
PARTITIONED: Final = ("A", "Bu", "Bd", "C")
WHOLE_B: Final = ("B", "D", "disturbances")  # u and delta together
SPLIT_B: Final = ("Bu", "Bd", "Du", "Dd")


def form_problems(table: ModelTable) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with the keys of a model: the key, "" for the table, and the problem."""
    given: list[str] = [
        name for name in (*LETTERS, "disturbances") if getattr(table, name) is not None
    ]
    if table.n_a is not None:
        yield from _problems_of_partitioned(given)
        return
    for name in ("A", "C"):
        if name not in given:
            yield "", f"'{name}' is missing; needed A and C (E, B or Bu and Bd, D as there are)"
    split = [name for name in SPLIT_B if name in given]
    whole = [name for name in WHOLE_B if name in given]
    if "B" in whole and split:
        yield split[0], f"found it beside B; needed B and D, or Bu, Bd, Du and Dd: {_cure(split)}"
    elif "B" in given:
        yield from _problems_of_columns(table)
    else:
        for name in whole:
            needed = "B" if name == "disturbances" else "B; with Bu and Bd it is Du and Dd"
            yield name, f"found it without B; needed {needed}"
    for name, B in (("Du", "Bu"), ("Dd", "Bd")):
        if name in given and B not in given and "B" not in given:
            yield name, f"found it without {B}; needed {B}, of zeros where it acts on y alone"


def _problems_of_partitioned(given: Sequence[str]) -> Iterator[tuple[str, str]]:
    for name in PARTITIONED:
        if name not in given:
            yield "", f"'{name}' is missing; needed {', '.join(PARTITIONED)} with n_a"
    for name in given:
        if name not in PARTITIONED:
            yield (
                name,
                (
                    "found it beside n_a, which stands for E = diag(I, 0) and has A, Bu, Bd and C "
                    f"only; needed no {name}, or the general form: E in place of n_a"
                ),
            )


def _problems_of_columns(table: ModelTable) -> Iterator[tuple[str, str]]:
    assert table.B is not None
    columns = max(map(len, table.B), default=0)
    unknown = table.disturbances or ()
    for column in unknown:
        if not 0 <= column < columns:
            yield "disturbances", f"found {column}; B has the columns 0 to {columns - 1}"
    if len(set(unknown)) < len(unknown):
        yield "disturbances", f"found {list(unknown)}; needed each column once"


def _cure(names: Sequence[str]) -> str:
    return f"leave {', '.join(names)} out, or split B"


def system_of(name: str, table: ModelTable) -> DescriptorSystem:
    """Build the descriptor system of a table.

    Raises
    ------
    UsageError
        If its keys do not make up a form.
    AssumptionError
        If its matrices do not fit together.
    ValueError
        If the rows of a matrix have different lengths.
    """
    for key, text in form_problems(table):
        raise UsageError(f"{key}: {text}" if key else text)
    matrices: dict[str, Matrix] = {}
    for letter in LETTERS:
        rows = getattr(table, letter)
        if rows is not None:
            matrices[letter] = matrix(rows, f"models.{name}.{letter}")
    if table.n_a is not None:
        return DescriptorSystem.partitioned(n_a=table.n_a, **matrices)
    return general_system(matrices, table.disturbances or ())


def general_system(
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
    for name in ("B", "D"):
        if name in matrices:
            columns = range(matrices[name].shape[1])
            known = [column for column in columns if column not in disturbances]
            unknown = [column for column in disturbances if column in columns]
            split[f"{name}u"] = matrices[name][:, known]
            split[f"{name}d"] = matrices[name][:, unknown]
    return DescriptorSystem.general(A=matrices["A"], C=matrices["C"], E=matrices.get("E"), **split)
