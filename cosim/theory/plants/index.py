"""Whether a plant has index 0 or 1 (Assumption 2), as far as rounding lets that be known.

The pencil and the decomposition of E are those of the system in units of size one
(:mod:`cosim.theory.plants.scaling`). Where rounding decides the rank of E, or A22 is so nearly
singular that little is known of the reduced system, that is the verdict, and not an index.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import AssumptionError
from cosim.theory.plants.elimination import DATA
from cosim.theory.plants.pencil import (
    EPSILON,
    RankDecomposition,
    determined_rank,
    rounding_of,
    shuffle,
)

GOOD_ACCURACY: Final = 1e-6  # of a reduced system, beyond which it is said
LEAST_ACCURACY: Final = 1e-3  # beyond which it is refused
MOST_VALUES: Final = 12  # singular values that a message lists
UNCLEAR: Final = 1e-6  # growth of rounding from which on no rank of A22 is known


def check_index(E: Matrix, A: Matrix, decomposition: RankDecomposition) -> None:
    """Check that a scaled pencil has dynamic states, and index 0 or 1.

    Raises
    ------
    AssumptionError
        If it does not, with evidence and what to do.
    """
    n = len(A)
    dynamic = len(decomposition.values)
    if dynamic == 0:
        raise AssumptionError(
            f"E = 0 ({n} x {n}): there are no dynamic states, all equations are algebraic "
            "(Assumption 1)",
            cure="give a model with dynamics (a static one is the gain of a connection)",
        )
    determined = determined_rank(decomposition, A)
    condition = _condition_of_A22(A, decomposition)
    if determined == n - dynamic:
        if condition >= 1.0 / EPSILON:  # it has no inverse
            check_accuracy(DATA * condition, A, decomposition)
        return
    check_rank(A, decomposition)
    evidence = f"rank {determined} of {n - dynamic}, condition {condition:.3g}"
    problem = (
        "the algebraic equations do not determine the algebraic states: A22 is singular "
        f"({evidence}; Assumption 2); "
    )
    try:
        structure = shuffle(E, A, decomposition)
    except AssumptionError as error:
        evidence = f"{problem}{error.evidence}"
        raise AssumptionError(evidence, error.verdict, error.cure) from error
    index = structure.index
    ranks = ", ".join(map(str, structure.ranks))
    dynamics = "" if structure.finite else ", and no finite eigenvalue: no dynamics at all"
    raise AssumptionError(
        f"{problem}INDEX_{index}: expected a pencil s E - A of index 1, got index {index} (ranks "
        f"of E by shuffles: {ranks} of {n}){dynamics}",
        f"INDEX_{index}",
        f"differentiate these algebraic equations {index - 1} time(s) and substitute them, or "
        "model what was neglected there (a small mass, capacity or resistance)",
    )


def check_rank(A: Matrix, decomposition: RankDecomposition) -> None:
    """Check that A22 is not singular only because its coordinates, those of E, are not known.

    Raises
    ------
    AssumptionError
        If it is: the rank of E is not clear.
    """
    rounding = rounding_of(len(A)) * decomposition.growth
    exact = replace(decomposition, growth=1.0)
    algebraic = len(A) - len(decomposition.values)
    if rounding > UNCLEAR and determined_rank(exact, A) == algebraic:
        raise _unclear_rank(decomposition)


def check_accuracy(accuracy: float, A: Matrix, decomposition: RankDecomposition) -> None:
    """Check that a reduced system is known well enough to be one.

    Raises
    ------
    AssumptionError
        If it is not; E is to blame for it, or A22.
    """
    if accuracy <= LEAST_ACCURACY:
        return
    if DATA * len(A) * decomposition.growth > GOOD_ACCURACY:
        raise _unclear_rank(decomposition, accuracy)
    condition = _condition_of_A22(A, decomposition)
    raise AssumptionError(
        "the algebraic equations hardly determine the algebraic states: A22 is nearly singular "
        f"(condition {condition:.3g}; Assumption 2): expected a relative accuracy of the reduced "
        f"system of {LEAST_ACCURACY:g}, got {accuracy:.1g} (INDEX_UNCLEAR)",
        "INDEX_UNCLEAR",
        "give the algebraic equations exactly, or in other units, or model what was neglected in "
        "them (a small mass, capacity or resistance)",
    )


def _condition_of_A22(A: Matrix, decomposition: RankDecomposition) -> float:
    """Return the condition of A22; 1 where there are no algebraic states."""
    A22 = decomposition.U2.T @ A @ decomposition.V2
    return float(np.linalg.cond(A22)) if A22.size else 1.0


def _unclear_rank(
    decomposition: RankDecomposition, accuracy: float | None = None
) -> AssumptionError:
    """Return the error of an E whose smallest singular values may be rounding."""
    values = decomposition.values
    everything = np.concatenate([values, decomposition.neglected]) / values[0]
    rank = len(values)
    begin = min(max(rank - MOST_VALUES // 2, 0), max(len(everything) - MOST_VALUES, 0))
    listed = ", ".join(f"{value:.1e}" for value in everything[begin : begin + MOST_VALUES])
    gap = f"the last of them {everything[rank - 1]:.1e} of the first"
    if rank < len(everything):
        gap += f", the next value {everything[rank]:.1e}"
    loss = "the coordinates in which E is diag(I, 0) are known too badly to tell the index"
    if accuracy is not None:
        loss = (
            f"expected a relative accuracy of the reduced system of {LEAST_ACCURACY:g}, got "
            f"{accuracy:.1g}"
        )
    return AssumptionError(
        f"the rank of E is not clear (Assumption 1): {rank} of its {len(everything)} singular "
        f"values, {listed}, count as not zero, {gap}, where the system is of size one; {loss} "
        "(RANK_OF_E_UNCLEAR)",
        "RANK_OF_E_UNCLEAR",
        "give E exactly, with 0 for entries that are 0, or in units in which its entries "
        "are of one size, or in the partitioned form with n_a",
    )
