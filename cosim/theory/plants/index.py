"""Whether a plant has index 0 or 1 (Assumption 2), as far as rounding lets that be known.

The pencil and the decomposition of E are those of the system in units of size one
(:mod:`cosim.theory.plants.scaling`). Where rounding decides the rank of E, or A22 is so nearly
singular that little is known of the reduced system, that is the verdict, and not an index.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import AssumptionError
from cosim.theory.plants.elimination import DATA
from cosim.theory.plants.geometry import without_rounding
from cosim.theory.plants.pencil import (
    EPSILON,
    SHUFFLED,
    PencilStructure,
    RankDecomposition,
    decompose,
    determined_rank,
    rounding_of,
    shuffle,
)

GOOD_ACCURACY: Final = 1e-6  # of a reduced system, beyond which it is said
LEAST_ACCURACY: Final = 1e-3  # beyond which it is refused
MOST_VALUES: Final = 12  # singular values that a message lists
VISIBLE: Final = 1e-6  # of the largest part of a constraint: an equation that is named
UNCLEAR: Final = 1e-6  # growth of rounding from which on no rank of A22 is known


def check_index(E: Matrix, A: Matrix, decomposition: RankDecomposition) -> None:
    """Check that a scaled pencil of the partitioned form has dynamic states, and index 0 or 1.

    Raises
    ------
    AssumptionError
        If it does not, with evidence and what to do.
    """
    structure = _higher_index(E, A, decomposition)
    if structure is not None:
        index = structure.index
        n_a = len(decomposition.values)
        raise AssumptionError(
            f"{_undetermined(A, decomposition)}; A[{n_a}:, {n_a}:] is singular; INDEX_{index}: "
            f"expected a pencil s E - A of index 1, got index {index}",
            f"INDEX_{index}",
            f"differentiate these algebraic equations {index - 1} time(s) and substitute them, or "
            "give the model with E in place of n_a, which differentiates constraints of the "
            "states, or model what was neglected there (a small mass, capacity or resistance)",
        )


def of_index_one(
    E: Matrix, A: Matrix, B: Matrix, decomposition: RankDecomposition, inputs: Sequence[str]
) -> tuple[Matrix, Matrix, RankDecomposition, Matrix]:
    """Replace equations by derivatives of others until the index is 1; the states stay the same.

    Of the algebraic equations `0 = A2 x + B2 v` those with `w' A2 V2 = 0` constrain the dynamic
    states: `w' A2 = z' E1`, where `E1 = U1' E`. With `w' B2 = 0` their derivative is
    `0 = z' U1' (A x + B v)`, which takes the place of the dynamic equation `z' U1'`. The
    constraints, the hidden ones too, stay as algebraic equations.

    Parameters
    ----------
    E, A : Matrix, shape (n, n)
        Scaled: :mod:`cosim.theory.plants.scaling`.
    B : Matrix, shape (n, m)
        Scaled.
    decomposition : RankDecomposition
        Of E.
    inputs : sequence of str
        Names of the columns of B.

    Returns
    -------
    tuple of A, B, the decomposition of E, and the constraints H of `H x = 0`, shape (k, n)

    Raises
    ------
    AssumptionError
        If there are no dynamic states, or the derivative of an input would be needed.
    """
    structure = _higher_index(E, A, decomposition)
    if structure is None:
        return A, B, decomposition, np.zeros((0, len(A)))
    n, m = B.shape
    if not structure.finite:
        raise AssumptionError(
            f"{_undetermined(A, decomposition)}; INDEX_{structure.index}: constraints hold all "
            "states, s E - A has no finite eigenvalue: no dynamics at all",
            f"INDEX_{structure.index}",
            "give a model with dynamics: leave out what the constraints keep at rest",
        )
    growth = decomposition.growth
    rounding = rounding_of(n) * growth
    zero = rounding
    found = []
    right = np.hstack([A, B, np.eye(n)])  # the last: how much of each given equation is in it
    for _ in range(structure.index - 1):
        A2 = decomposition.U2.T @ right[:, :n]
        left, sizes, _ = np.linalg.svd(A2, full_matrices=False)
        algebraic = (left / sizes).T @ decomposition.U2.T @ right  # with orthonormal rows A2
        combinations, determined, _ = np.linalg.svd(algebraic[:, :n] @ decomposition.V2)
        constraints = combinations[:, determined <= zero].T @ algebraic
        _check_no_input(constraints, B, rounding, zero, structure, inputs)
        found.append(constraints[:, :n])
        z = constraints[:, :n] @ decomposition.V1 / decomposition.values
        basis, _ = np.linalg.qr(z.T, mode="complete")
        dynamic = (decomposition.U1 @ basis).T
        k = len(constraints)
        rank = len(dynamic) - k
        kept = without_rounding(dynamic[k:] @ E, np.abs(dynamic[k:]) @ np.abs(E))
        E = np.vstack([kept, np.zeros((n - rank, n))])
        right = np.vstack([dynamic[k:] @ right, algebraic, dynamic[:k] @ right])
        decomposition = replace(decompose(E, rank), growth=growth)
        zero = max(SHUFFLED, rounding)
    return right[:, :n], right[:, n : n + m], decomposition, np.vstack(found)


def _check_no_input(
    constraints: Matrix,
    B: Matrix,
    rounding: float,
    zero: float,
    structure: PencilStructure,
    inputs: Sequence[str],
) -> None:
    """Check that no input acts on constraints `[A B W]`, made of the given equations by W."""
    n, m = B.shape
    parts = constraints[:, n + m :]
    made_of = np.abs(parts)
    # What is only rounding of the largest part would be compared with itself below.
    is_part = made_of > zero * made_of.max(axis=1, keepdims=True)
    parts = np.where(is_part, parts, 0.0)
    made_of = np.abs(parts)
    acts = np.abs(parts @ B) > rounding * (made_of @ np.abs(B))
    if not acts.any():
        return
    of_inputs = made_of[acts.any(axis=1)].max(axis=0)
    equations = np.flatnonzero(of_inputs > VISIBLE * of_inputs.max())
    names = ", ".join(inputs[i] for i in np.flatnonzero(acts.any(axis=0)).tolist())
    raise AssumptionError(
        f"rows {', '.join(map(str, equations))} of E and A, counted from 0, have to be "
        f"differentiated to determine all states, which would need the derivative of {names}: "
        f"expected constraints without inputs, or index 1, got INDEX_{structure.index}",
        f"INDEX_{structure.index}",
        f"give what {names} is the integral of as the input, or model what was neglected in these "
        "equations (a small mass, capacity or resistance)",
    )


def _higher_index(E: Matrix, A: Matrix, decomposition: RankDecomposition) -> PencilStructure | None:
    """Return the structure of a scaled pencil whose index is above 1; None: it is 0 or 1.

    Raises
    ------
    AssumptionError
        If it has no dynamic states or no index, or that is not clear.
    """
    n = len(A)
    dynamic = len(decomposition.values)
    if dynamic == 0:
        raise AssumptionError(
            f"E = 0 ({n} x {n}): there are no dynamic states, all equations are algebraic "
            "(Assumption 1)",
            cure="give a model with dynamics (a static one is the gain of a connection)",
        )
    if determined_rank(decomposition, A) == n - dynamic:
        condition = _condition_of_A22(A, decomposition)
        if condition >= 1.0 / EPSILON:  # it has no inverse
            check_accuracy(DATA * condition, A, decomposition)
        return None
    check_rank(A, decomposition)
    try:
        return shuffle(E, A, decomposition)
    except AssumptionError as error:
        evidence = f"{_undetermined(A, decomposition)}; {error.evidence}"
        raise AssumptionError(evidence, error.verdict, error.cure) from error


def _undetermined(A: Matrix, decomposition: RankDecomposition) -> str:
    algebraic = len(A) - len(decomposition.values)
    return (
        "the algebraic equations do not determine the algebraic states "
        f"({determined_rank(decomposition, A)} of {algebraic}; Assumption 2)"
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
        "the algebraic equations hardly determine the algebraic states "
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
